"""What no capture can show, because another transform takes it up, and what it does to a point in space."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, apply, inverse
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.inexact import COMMON_SCALE

# What is told of where no sigma is stated.
_ANGLE = float(np.radians(0.1))
_LENGTH = 1e-3  # m
_SCALE = 1e-3


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
    that up, and the arms still meet where they met, but T_P_A is that between the turned bases. Row 6 of the active arm
    is taken up by T_H_E, which is then off at the camera. A scale common to both arms stretches the whole cell.
    """
    sigmas = {known.name: known.prior for known in result.known if np.isfinite(known.prior)}
    in_active = apply(inverse(result.T_P_A), points)
    apart = float(np.linalg.norm(points - result.T_P_A[:3, 3], axis=-1).max())
    aside = float(np.hypot(*result.T_H_E[:2, 3]))
    told = [*_of_base("passive", points), *_of_base("active", in_active)]
    told += [
        ("zero of joint 6 of the active arm", "against its flange", _ANGLE, aside),
        ("d of row 6 of the active arm", "against its flange", _LENGTH, 1.0),
        ("a of row 6 of the active arm", "against its flange", _LENGTH, 1.0),
        (COMMON_SCALE, "", _SCALE, apart),
    ]
    return tuple(_hidden(name, where, sigmas.get(name, easily), lever) for name, where, easily, lever in told)


def _of_base(arm: str, points: Array) -> Iterator[tuple[str, str, float, float]]:
    """Names, against what, by what they are easily off, and the error of the worst point by one rad or m."""
    across = float(np.hypot(points[:, 0], points[:, 1]).max())
    yield f"zero of joint 1 of the {arm} arm", "against its base", _ANGLE, across
    yield f"d of row 1 of the {arm} arm", "against its base", _LENGTH, 1.0


def _hidden(name: str, where: str, off: float, lever: float) -> Hidden:
    if name == COMMON_SCALE:
        by = f"{1e6 * off:g} ppm"
    elif name.startswith("zero"):
        by = f"{np.degrees(off):.2g} deg"
    else:
        by = f"{1e3 * off:.2g} mm"
    return Hidden(f"the {name}, {where}" if where else f"the {name}", by, off * lever)
