"""What an arm's joints can do, and why a path asks for more."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from dualcal_hal.robot import JointPath
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from dualcal_hal.config import RobotConfig

_TOLERANCE = 1e-6  # rad, for what rounding does at a limit


@dataclass(frozen=True, eq=False)
class JointLimits:
    """lower, upper: (n,) rad; speed: (n,) rad/s; acceleration: (n,) rad/s^2, all largest allowed."""

    lower: Array
    upper: Array
    speed: Array
    acceleration: Array

    @staticmethod
    def of(config: RobotConfig) -> JointLimits:
        """Those of the cell file."""
        return JointLimits(config.lower, config.upper, config.speed, config.acceleration)

    def objection(self, path: JointPath) -> str | None:
        """Why no arm with these limits can follow ``path``: values that are none, or beyond; None if it can."""
        if not path.waypoints:
            return "the path is empty"
        joints = len(self.lower)
        if not joints:
            return "it has no joints"
        numbers = [("waypoint", w) for w in path.waypoints]
        for what, values in (*numbers, ("speed", path.speed), ("acceleration", path.acceleration)):
            if len(values) != joints or not np.all(np.isfinite(values)):
                return f"the {what} is not {joints} finite numbers: {values}"
        waypoints = np.array(path.waypoints)
        beyond = np.maximum(self.lower - waypoints, waypoints - self.upper)
        if np.max(beyond) > _TOLERANCE:
            joint = int(np.unravel_index(np.argmax(beyond), beyond.shape)[1])
            return f"joint {joint + 1} would be {np.rad2deg(np.max(beyond)):.3f} deg beyond its limit"
        for what, bound, largest in (
            ("speed", path.speed, self.speed),
            ("acceleration", path.acceleration, self.acceleration),
        ):
            if np.any(np.asarray(bound) <= 0):
                return f"the {what} must be above zero for every joint"
            if np.any(np.asarray(bound) > largest * (1 + 1e-9)):
                return f"the {what} is beyond the arm's own"
        return None
