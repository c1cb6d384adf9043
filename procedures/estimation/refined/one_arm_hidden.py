"""What no view of one arm can show, because where camera or target are takes it up, and what it does to a point."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, apply, rotation_from_vector
from procedures.estimation.refined.hidden import Hidden
from procedures.estimation.refined.inexact import Known

# What is told of where no sigma is stated.
_ANGLE = float(np.radians(0.1))
_LENGTH = 1e-3  # m
_SCALE = 1e-3


def hidden_of_one_arm(
    chain: Chain, in_base: Array, in_flange: Array, known: Sequence[Known] = ()
) -> tuple[Hidden, ...]:
    """At the worst of points in the base (k, 3), m, where the camera saw the target, and of points in the flange (m, 3)
    of what the arm carries; off by their sigma in ``known``, where one is stated, else by what is easily wrong.

    Zero and d of joint 1 turn and lift all of the arm: what stands is told so much off, against the base. The last row
    leads from the last joint's axis to the flange: what the arm carries is told so much off, against the flange. If all
    lengths of arm and target are too long by one part, the images are the same.
    """
    sigmas = {one.name: one.prior for one in known if np.isfinite(one.prior)}
    found = []
    for name, against, is_angle, lever in (*_at_base(chain, in_base), *_at_flange(chain, in_flange)):
        off = sigmas.get(name, _ANGLE if is_angle else _LENGTH)
        by = f"{np.degrees(off):.2g} deg" if is_angle else f"{1e3 * off:.2g} mm"
        found.append(Hidden(f"the {name}, against its {against}", by, off * lever))
    scale = "the scale of the arm's lengths and the target's squares together"
    return (*found, Hidden(scale, f"{1e6 * _SCALE:g} ppm", _SCALE * _farthest(in_base)))


def _at_base(chain: Chain, points: Array) -> Iterator[tuple[str, str, bool, float]]:
    """Names, against what, whether it is an angle, and the error of the worst point by one rad or m."""
    yield "zero of joint 1 of the arm", "base", True, _from_axis(points, 2)
    if chain.rows[0].beta is None:
        yield "d of row 1 of the arm", "base", False, 1.0


def _at_flange(chain: Chain, points: Array) -> Iterator[tuple[str, str, bool, float]]:
    number, row = len(chain.rows), chain.rows[-1]
    yield f"zero of joint {number} of the arm", "flange", True, _from_axis(apply(row.after_joint(), points), 2)
    turned = points @ rotation_from_vector([0.0, row.beta or 0.0, 0.0]).T
    yield f"alpha of row {number} of the arm", "flange", True, _from_axis(turned, 0)
    if row.beta is None:
        yield f"d of row {number} of the arm", "flange", False, 1.0
    else:
        yield f"beta of row {number} of the arm", "flange", True, _from_axis(points, 1)
    yield f"a of row {number} of the arm", "flange", False, 1.0


def _from_axis(points: Array, axis: int) -> float:
    return _farthest(np.delete(points, axis, axis=1))


def _farthest(points: Array) -> float:
    return float(np.linalg.norm(points, axis=1).max())
