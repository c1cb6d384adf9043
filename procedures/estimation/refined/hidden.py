"""What no capture can show, because another transform takes it up, and what it does to a point in space."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, apply, inverse
from procedures.estimation.refined.estimate import Refined

_ANGLE = float(np.radians(0.1))
_LENGTH = 1e-3  # m
_SCALE = 1e-3


@dataclass(frozen=True)
class Hidden:
    """what, and the error (m) of the worst of the points in space where it is off ``by`` so much."""

    what: str
    by: str
    error: float


def hidden(result: Refined, points: Array) -> tuple[Hidden, ...]:
    """At points (k, 3) of P, m.

    The zero of joint 1 and the height d1 of an arm turn and lift all of it about its own base's z-axis: T_P_A takes
    that up, and the arms still meet where they met, but T_P_A is that between the turned bases. Row 6 of the active arm
    is taken up by T_H_E. A scale common to both arms stretches the whole cell.
    """
    in_active = apply(inverse(result.T_P_A), points)
    return tuple(
        Hidden(what, by, float(np.linalg.norm(moves, axis=-1).max()))
        for what, by, moves in (
            *_of_base("passive", points),
            *_of_base("active", in_active),
            *_of_last_row(result),
            ("a scale common to both arms", "1000 ppm", _SCALE * (points - result.T_P_A[:3, 3])),
        )
    )


def _of_base(arm: str, points: Array) -> Iterator[tuple[str, str, Array]]:
    across = np.hypot(points[:, 0], points[:, 1])[:, None]
    yield f"the zero of joint 1 of the {arm} arm, against its base", "0.1 deg", _ANGLE * across
    yield f"d of row 1 of the {arm} arm, against its base", "1 mm", np.full((1, 1), _LENGTH)


def _of_last_row(result: Refined) -> Iterator[tuple[str, str, Array]]:
    aside = np.hypot(*result.T_H_E[:2, 3])
    yield "the zero of the active arm's last joint, against its flange", "0.1 deg", np.full((1, 1), _ANGLE * aside)
    yield "d and a of the active arm's last row, against its flange", "1 mm", np.full((1, 1), _LENGTH)
