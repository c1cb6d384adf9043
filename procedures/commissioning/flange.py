"""Where the controller shows its flange, against where our kinematics have it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import astuple, dataclass
from functools import partial
from itertools import combinations

import numpy as np

from dualcal_hal.errors import UsageError
from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array
from procedures.commissioning.causes import Cause, Deviation, Poses
from procedures.commissioning.frame_causes import frame_causes
from procedures.commissioning.joint_causes import joint_causes, scaled, swapped, taken_along

LEAST_POSES = 3

_MOST = 2.0
"""Of the tolerance: what models may differ by at most, and what a cause may leave where it is more."""

_AS_GOOD = 6.0
"""Difference of two causes' scores below which poses do not tell which of them it is."""


@dataclass(frozen=True)
class Tolerance:
    """What a controller's model may differ by from calibrated kinematics, m and rad."""

    translation: float = 3e-3
    rotation: float = float(np.deg2rad(0.5))


@dataclass(frozen=True, eq=False)
class FlangeCheck:
    """What poses of the flange tell.

    deviation: of our kinematics from what was shown; usual: whether it is within the tolerance in all poses; agrees:
    whether at least within twice that, as where models differ and no joint is mistaken; cause: what explains it best
    where it is not usual, None if no single one does; others: what explains it as well; unproven: what these poses
    would not have shown, in words, with the pose that would.
    """

    deviation: Deviation
    usual: bool
    agrees: bool
    cause: Cause | None
    others: tuple[Cause, ...]
    unproven: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether the joints are proven to be what the kinematics take them for."""
        return self.agrees and not self.unproven


def check_flange(chain: Chain, joints: Array, flange: Array, tolerance: Tolerance | None = None) -> FlangeCheck:
    """Hold poses (k, 4, 4) of the flange in the base, m, against joint angles (k, n) in rad read at the same moments.

    UsageError for fewer than three.
    """
    tolerance = tolerance or Tolerance()
    if len(flange) != len(joints) or len(flange) < LEAST_POSES:
        raise UsageError(f"{len(flange)} poses of the flange; at least {LEAST_POSES} are needed")
    poses = Poses(chain, joints, flange)
    deviation, most = poses.deviation(joints), Tolerance(*(_MOST * each for each in astuple(tolerance)))
    agrees = _within(deviation, most)
    unproven = tuple(_unproven(poses, most)) if agrees else ()
    if _within(deviation, tolerance):
        return FlangeCheck(deviation, True, True, None, (), unproven)
    causes = sorted((*joint_causes(poses), *frame_causes(poses)), key=lambda cause: cause.score)
    # Where models differ anyway only what leaves less than usual is worth being named.
    explaining = [cause for cause in causes if _within(cause.deviation, tolerance if agrees else most)]
    if not explaining:
        return FlangeCheck(deviation, False, agrees, None, (), unproven)
    likeliest = explaining[0]
    as_good = [cause for cause in explaining if cause.score < likeliest.score + _AS_GOOD]
    others = {cause.kind: cause for cause in reversed(as_good) if cause.kind is not likeliest.kind}
    return FlangeCheck(deviation, False, agrees, likeliest, tuple(others.values()), unproven)


def _within(deviation: Deviation, tolerance: Tolerance) -> bool:
    return deviation.within(tolerance.translation, tolerance.rotation)


def _unproven(poses: Poses, tolerance: Tolerance) -> Iterator[str]:
    """What could be wrong and would not be seen in these poses."""

    def unseen(joints: Array) -> bool:
        return _within(poses.deviation(joints), tolerance)

    q = poses.joints
    minus, n = np.array([-1.0]), poses.chain.joints
    for joint in range(n):
        middle = (q[:, joint].min() + q[:, joint].max()) / 2
        mirrored = q.copy()
        mirrored[:, joint] = 2 * middle - q[:, joint]
        if unseen(scaled(joint, q, minus)[0]) or unseen(mirrored):
            yield f"the sign of joint {joint + 1}: take a pose in which it stands elsewhere by 10 deg or more"
    for joint, other in combinations(range(n), 2):
        if unseen(swapped(joint, other, q)):
            yield f"which of joints {joint + 1} and {other + 1} is which: take a pose in which they stand differently"
    if n > 2:
        coupled = partial(taken_along, 2, 1, q)
        if any(unseen(coupled(np.array([factor]))[0]) for factor in (-1.0, 1.0)):
            yield "whether joint 3 is coupled to joint 2: take a pose in which joint 2 is away from zero"
