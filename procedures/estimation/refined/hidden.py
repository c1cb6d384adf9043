"""What no capture can show, because another transform takes it up, and what it does to a point in space."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.transforms import Array, apply, inverse
from procedures.estimation.refined.arms import Arm
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.inexact import COMMON_SCALE, Known
from procedures.estimation.refined.mount import is_free_mount

# What is told of where no sigma is stated.
_ANGLE = float(np.radians(0.1))
_LENGTH = 1e-3  # m
_SCALE = 1e-3

_STEP = 1e-6  # m or rad: of the differences


@dataclass(frozen=True)
class Hidden:
    """what, and the error (m) of the worst of the points where it is off ``by`` so much: between where the active arm
    is told that the passive arm holds it, and where it is.
    """

    what: str
    by: str
    error: float


def hidden(result: Refined, points: Array) -> tuple[Hidden, ...]:
    """At points (k, 3) of P, m; off by their sigma, where one is stated, else by what is easily wrong.

    The zero of joint 1 and the height d1 of an arm turn and lift all of it about its own base's z-axis: T_P_A takes
    that up, and the arms still meet where they met, but T_P_A is that between the turned bases. All four numbers of the
    active arm's last row move its flange as it sees itself: T_H_E takes them up, and is then off at the camera. So does
    a mount T_F_T that is free with those of the passive arm's last row, and is off at the target. A scale common to
    both arms stretches the whole cell.
    """
    sigmas = {known.name: known.prior for known in result.known if np.isfinite(known.prior)}
    knowns = result.knowns
    told = [
        *_of_base("passive arm", knowns.passive, points),
        *_of_base("active arm", knowns.active, apply(inverse(result.T_P_A), points)),
        *_of_flange("active arm", knowns.active, result.T_H_E[None, :3, 3]),
    ]
    if any(is_free_mount(one) for one in result.inexact):
        told += _of_flange("passive arm", knowns.passive, knowns.T_F_T[None, :3, 3])
    apart = _farthest(points - result.T_P_A[:3, 3])
    return (*(one.off_by(sigmas) for one in told), _of_scale(COMMON_SCALE, apart, sigmas))


def hidden_of_one_arm(arm: Arm, in_base: Array, in_flange: Array, known: Sequence[Known] = ()) -> tuple[Hidden, ...]:
    """At the worst of points in the base (k, 3), m, where the camera saw the target, and of points in the flange (m, 3)
    of what the arm carries; off by their sigma in ``known``, where one is stated, else by what is easily wrong.

    Zero and d of joint 1 turn and lift all of the arm: what stands is told so much off, against the base. The last row
    leads from the last joint's axis to the flange: what the arm carries is told so much off, against the flange. If all
    lengths of arm and target are too long by one part, the images are the same.
    """
    sigmas = {one.name: one.prior for one in known if np.isfinite(one.prior)}
    told = [*_of_base("arm", arm, in_base), *_of_flange("arm", arm, in_flange)]
    scale = "scale of the arm's lengths and the target's squares together"
    return (*(one.off_by(sigmas) for one in told), _of_scale(scale, _farthest(in_base), sigmas))


@dataclass(frozen=True)
class _Number:
    """name: as of an inexact known; of: what it is in its row; against: what; lever: error of the worst point by one m
    or rad.
    """

    name: str
    of: str
    against: str
    lever: float

    def off_by(self, sigmas: dict[str, float]) -> Hidden:
        if self.of in ("d", "a"):
            off = sigmas.get(self.name, _LENGTH)
            by = f"{1e3 * off:.2g} mm"
        else:
            off = sigmas.get(self.name, _ANGLE)
            by = f"{np.degrees(off):.2g} deg"
        return Hidden(f"the {self.name}, against its {self.against}", by, off * self.lever)


def _of_base(name: str, arm: Arm, points: Array) -> Iterator[_Number]:
    """points (k, 3) in the arm's base, m."""
    if isinstance(arm, Chain):
        row = arm.rows[0]
        for of in ("theta",) if row.beta is not None else ("theta", "d"):
            before, after = _there(row), _there(_changed(row, of))
            yield _Number(_named(of, 1, name), of, "base", _largest(after @ inverse(before), points))


def _of_flange(name: str, arm: Arm, points: Array) -> Iterator[_Number]:
    """points (k, 3) in the arm's flange, m."""
    if isinstance(arm, Chain):
        row = arm.rows[-1]
        for of in ("theta", "d", "a", "alpha") if row.beta is None else ("theta", "a", "alpha", "beta"):
            before, after = _there(row), _there(_changed(row, of))
            yield _Number(_named(of, arm.joints, name), of, "flange", _largest(inverse(before) @ after, points))


def _named(of: str, number: int, arm: str) -> str:
    return f"zero of joint {number} of the {arm}" if of == "theta" else f"{of} of row {number} of the {arm}"


def _of_scale(name: str, lever: float, sigmas: dict[str, float]) -> Hidden:
    by = sigmas.get(name, _SCALE)
    return Hidden(f"the {name}", f"{1e6 * by:g} ppm", by * lever)


def _there(row: Row) -> Array:
    return Chain((row,)).forward([0.0])


def _changed(row: Row, of: str) -> Row:
    return replace(row, **{of: getattr(row, of) + _STEP})


def _largest(moved: Array, points: Array) -> float:
    """By which one of the points (k, 3) is moved, by the step."""
    return _farthest(apply(moved, points) - points) / _STEP


def _farthest(points: Array) -> float:
    return float(np.linalg.norm(points, axis=-1).max())
