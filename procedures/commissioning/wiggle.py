"""One joint turned by a degree: what should be seen of it, and what was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, inverse, vector_from_rotation
from procedures.commissioning.causes import joints_in_words
from procedures.estimation.projection import project
from procedures.planning.model import CellModel

STEP = float(np.deg2rad(1.0))
"""rad by which each joint is turned, there and back."""

SPEED, ACCELERATION = float(np.deg2rad(2.0)), float(np.deg2rad(10.0))
"""rad/s and rad/s^2 at which it turns: to be watched."""

_FITS = 0.35
"""Part of the motion in the image that the nominal hand-eye transform may be wrong by, at most."""

_DIFFERS = 0.6
"""Part of the motion by which what was seen is certainly not what was expected."""

_LEAST_MOTION = 0.5
"""px, rms over the corners: less tells nothing."""

_STILL = 0.2
"""Part of the expected motion below which nothing has moved."""

_WORTH_SAYING = 0.3
"""Part of the largest component of a motion from which on another one is named."""


class Outcome(StrEnum):
    """What a joint's motion was seen to be."""

    PROVEN = "proven"
    WRONG = "wrong"
    OPEN = "open"


@dataclass(frozen=True)
class Seen:
    """outcome, and in words what was seen, or why it does not tell."""

    outcome: Outcome
    said: str


def turned(q: Array, joint: int, lower: Array, upper: Array) -> Array:
    """Joint angles (n,) in rad with one turned by a step: up, or down where up is beyond its limit."""
    goal = q.copy()
    up = q[joint] + STEP <= upper[joint] or q[joint] - STEP < lower[joint]
    goal[joint] += STEP if up else -STEP
    return goal


def words(chain: Chain, start: Array, goal: Array, on_flange: Array, carries: str) -> str:
    """What is to be seen when the arm goes from joint angles (n,) to others, rad.

    on_flange: (4, 4) of what the flange ``carries``; the further of both is told of. Up is the z of the arm's base,
    outward away from its axis, left and right as of one who stands behind the base and looks to the flange.
    """
    before, after = chain.forward(start), chain.forward(goal)
    moved = after[:3, 3] - before[:3, 3]
    of_carried = (after @ on_flange)[:3, 3] - (before @ on_flange)[:3, 3]
    what, shift, point = "its flange", moved, before[:3, 3]
    if np.linalg.norm(of_carried) > 1.5 * np.linalg.norm(moved):
        what, shift, point = carries, of_carried, (before @ on_flange)[:3, 3]
    x, y, z = 1e3 * moved
    turn = before[:3, :3].T @ vector_from_rotation(after[:3, :3] @ before[:3, :3].T)
    spin = ""
    if abs(turn[2]) > 0.8 * np.linalg.norm(turn):
        way = "counter-clockwise" if turn[2] > 0 else "clockwise"
        spin = f", and the flange turns {way} for one who looks at its face"
    return f"{what} moves {_direction(shift, point)}{spin}; its pendant's X Y Z change by {x:+.1f} {y:+.1f} {z:+.1f} mm"


def _direction(shift: Array, point: Array) -> str:
    radius = float(np.hypot(point[0], point[1]))
    outward = np.array([point[0], point[1], 0.0]) / radius if radius > 1e-6 else np.array([1.0, 0.0, 0.0])
    left = np.array([-outward[1], outward[0], 0.0])
    along = {
        ("up", "down"): float(shift[2]),
        ("outward", "inward"): float(shift @ outward),
        ("to the left", "to the right"): float(shift @ left),
    }
    largest = max(map(abs, along.values()))
    if largest < 1e-4:
        return "hardly"
    named = sorted(along.items(), key=lambda item: -abs(item[1]))
    parts = [
        f"{names[0] if by > 0 else names[1]} by {1e3 * abs(by):.1f} mm"
        for names, by in named
        if abs(by) >= _WORTH_SAYING * largest
    ]
    return " and ".join(parts)


def expected_motions(model: CellModel, arm: str, start: Array, T_E_T: Array, step: float = STEP) -> dict[int, Array]:
    """How each joint of an arm, turned by ``step`` rad, would move the corners in the image, (corners, 2) px.

    start: (n,) rad; T_E_T: (4, 4) where the target was seen before. Of the nominal transforms only the one between the
    arm's flange and what it carries has a share, so a wrong guess of the bases does no harm.
    """
    side = model.arm(arm)
    before = side.chain.forward(start)
    motions = {}
    for joint in range(side.chain.joints):
        goal = start.copy()
        goal[joint] += step
        moved = inverse(before) @ side.chain.forward(goal)
        if arm == model.active.name:
            T_H_E = model.nominal.T_H_E
            after = inverse(T_H_E) @ inverse(moved) @ T_H_E @ T_E_T
        else:
            after = T_E_T @ inverse(model.T_F_T) @ moved @ model.T_F_T
        motions[joint] = _pixels(model, after) - _pixels(model, T_E_T)
    return motions


def _pixels(model: CellModel, T_E_T: Array) -> Array:
    points = model.board.corners @ T_E_T[:3, :3].T + T_E_T[:3, 3]
    return project(points, model.intrinsics.matrix, model.intrinsics.distortion)


def judge(motion: Array, expected: Mapping[int, Array], joint: int) -> Seen:
    """What the corners' motion (corners, 2) in px, NaN where one was not seen, says of a joint, counted from 0.

    expected: by joint, as of :func:`expected_motions`.
    """
    seen = np.isfinite(motion[:, 0])
    size = _rms(expected[joint][seen]) if seen.any() else 0.0
    if not size > _LEAST_MOTION:
        return Seen(Outcome.OPEN, "the target moves too little in the image to tell")
    if _rms(motion[seen]) < _STILL * size:
        return Seen(
            Outcome.WRONG, "the target did not move in the image: this joint did not turn, or another arm's did"
        )
    misfits = {
        (other, sign): _rms(motion[seen] - sign * by[seen]) / size for other, by in expected.items() for sign in (1, -1)
    }
    fitting = [each for each, misfit in misfits.items() if misfit < _FITS]
    if (joint, 1) in fitting:
        if len(fitting) == 1:
            return Seen(Outcome.PROVEN, f"the camera saw it, within {100 * misfits[joint, 1]:.0f} % of its motion")
        rivals = joints_in_words(sorted({other for other, _ in fitting if other != joint}))
        return Seen(Outcome.OPEN, f"in this posture the camera cannot tell it from {rivals}")
    if misfits[joint, 1] < _DIFFERS or not fitting:
        return Seen(Outcome.OPEN, "what the camera saw is no single joint's motion by the nominal hand-eye transform")
    other, sign = min(fitting, key=lambda each: misfits[each])
    return Seen(Outcome.WRONG, f"the camera saw {_instead(joint, other, sign)}")


def _instead(joint: int, other: int, sign: int) -> str:
    if other == joint:
        return "it turn the other way: its sign is wrong"
    way = "" if sign > 0 else ", the other way"
    return f"joint {other + 1} turn in its place{way}: the order of the joints is wrong"


def _rms(pixels: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(pixels**2, axis=-1))))
