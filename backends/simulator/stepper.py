"""What moves the arms' joints: one object for all arms of a world, as they may meet."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from dualcal_hal.errors import CellFileError, Problem
from dualcal_hal.robot import JointPath, Joints
from dualcal_hal.trajectory import Trajectory
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.simulator.bullet.bodies import BulletBodies
    from backends.simulator.truth import Truth
    from dualcal_hal.config import CellConfig


class SetPoints(Protocol):
    """Where an arm's motors are to have its joints, as a function of time in s."""

    @property
    def end(self) -> float:
        """From when on they rest; infinity where that is not known yet."""

    @property
    def destination(self) -> Joints:
        """The joint angles in rad at which they are to rest, or do."""

    def sample(self, when: float) -> tuple[Array, Array]:
        """Joint angles (n,) in rad and velocities (n,) in rad/s."""


class Stepper(ABC):
    """Moves the joints along the arms' trajectories, in simulated time that never goes back.

    Called under the world's lock. ``fault``: the contact that has halted all arms for good, None without one.
    ``scene``: PyBullet's bodies, None where there are none.
    """

    scene: BulletBodies | None = None

    def __init__(self, cell: CellConfig, truth: Truth) -> None:
        self.fault: str | None = None
        self._trajectories = {
            name: Trajectory(robot.home, robot.acceleration) for name, robot in sorted(cell.robots.items())
        }
        self._set_points: dict[str, SetPoints] = dict(self._trajectories)

    def follow(self, arm: str, path: JointPath, now: float) -> float:
        """Have an arm at rest begin to follow ``path``; returns when its set points come to rest."""
        trajectory = self._trajectories[arm]
        trajectory.follow(path, now)
        return trajectory.end

    def track(self, arm: str, set_points: SetPoints, now: float) -> None:
        """Have an arm's joints go where ``set_points`` of somebody else are, from ``now`` on."""
        self._set_points[arm] = set_points

    def brake(self, arm: str, now: float) -> float:
        """Bring an arm to rest on its path as fast as it can; returns when its set points come to rest."""
        trajectory = self._trajectories[arm]
        trajectory.brake(now)
        return trajectory.end

    def stand(self, joints: Mapping[str, tuple[Joints, Array]], now: float) -> None:
        """Have each arm be at rest from ``now`` on: where it was sent, and the angles (n,) at which its joints are."""
        for arm, (target, _) in joints.items():
            self._trajectories[arm].rest(np.array(target), now)

    def destination(self, arm: str) -> Joints:
        """The joint angles in rad at which an arm is to rest, or does."""
        return self._set_points[arm].destination

    @abstractmethod
    def sample(self, arm: str, when: float) -> tuple[Array, Array]:
        """An arm's joint angles (n,) in rad and velocities (n,) in rad/s."""

    @abstractmethod
    def next_look(self, arm: str, now: float) -> float | None:
        """When to look again whether an arm has settled; None once it has, or has halted by the ``fault``."""

    def documents(self, now: float) -> Mapping[str, dict[str, Any]]:
        """What it has measured up to now that is to be kept beside the run, by file name."""
        return {}

    @abstractmethod
    def close(self) -> None:
        """Release what it holds."""


class KinematicStepper(Stepper):
    """Joints are exactly where their trajectories have them; nothing is in anything's way."""

    def sample(self, arm: str, when: float) -> tuple[Array, Array]:
        return self._set_points[arm].sample(when)

    def next_look(self, arm: str, now: float) -> float | None:
        end = self._set_points[arm].end
        return end if now < end else None

    def close(self) -> None:
        """It holds nothing."""


def stepper_class(name: str) -> type[Stepper]:
    """By what a cell file calls it; CellFileError if what it needs is not installed."""
    if name == "kinematic":
        return KinematicStepper
    try:
        from backends.simulator.bullet import BulletStepper
    except ImportError as error:
        what = (
            f"is '{name}', and PyBullet cannot be imported ({error}): pip install 'dualcal[bullet]', "
            "or do without physics by --set simulation.stepper=kinematic"
        )
        raise CellFileError([Problem("simulation.stepper", what)]) from error
    return BulletStepper
