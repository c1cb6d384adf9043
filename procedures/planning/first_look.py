"""The first look: a stand-off that is clear whatever the bases' error, and a few images that make planning possible.

The nominal transforms may be off by a decimetre and ten degrees: too much to plan near the other arm. From the
stand-off the camera sees the board from afar; with the board tilted differently in each of a few images, both
transforms follow well enough (about 2 mm and 0.1 deg after five) to plan with and to start the servo from.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.errors import NoPlan
from dualcal_hal.geometry import BETWEEN_SAMPLES
from dualcal_hal.kinematics import random_joints
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array, Mask, inverse, rotation_from_vector, smallest_rotation, transform
from procedures.planning.advice import advice, counted
from procedures.planning.belief import Belief
from procedures.planning.model import ArmModel, CellModel, Posture
from procedures.planning.obstacles import closer_than, closest_own
from procedures.planning.sight import in_sight
from procedures.planning.ways import Leg, WayFinder

BOARD_TILT = np.deg2rad(25.0)
"""The board's normal leans by this much (rad) from the camera's, each time in another quarter of its view: between any
two looks it is tilted by at least 20 degrees."""

STAND_OFF_CLEARANCE = 0.25
"""Clearance (m) from which on more is worth nothing: a decimetre of base error and its lever are inside."""

_LEAST_FORWARD, _MOST_FORWARD = 0.225, 0.425  # m in front of its own base, the middle of what is tried
_FORWARD = (-0.025, 0.025, -0.075, 0.075)  # m from there
_HEIGHT = (0.50, 0.45, 0.55, 0.40, 0.60)  # m above its own base
_FARTHER = (0.0, 0.2)  # m forward and up, for arms that cannot fold so close to their bases
_ROLLS = np.deg2rad([0.0, 90.0, 180.0, -90.0])
_STARTS = 6
_PAIRS_COMPARED = 12
_LOOKS_COMPARED = 5
_TILTS_PER_LOOK = 4  # a look counts for as much as so many tilts of the search
_WAYS_TRIED = 5
STEEPER_TILT = np.deg2rad(45.0)
"""The same (rad) for the looks after the fifth."""

CAMERA_LEAN = np.deg2rad(6.0)
"""The camera looks past the board's centre by this much (rad), in another direction in each look."""

_GOOD_DISTANCE = 0.65  # m between camera and board
_TOO_CLOSE = "an arm is too close to the other, itself or what stands about it"
_NOT_IN_VIEW = "the target is not wholly in view"
_HIDDEN = "an arm or a fixture hides the target"
_AT_HOME = 0.02  # rad
_LEAST_APART = 1e-3  # m between the bases on the level
_SEARCH_RINGS = np.deg2rad([12.0, 20.0])
_CAMERA_ROLLS = np.deg2rad([40.0, 25.0, 12.0, 60.0])


@dataclass(frozen=True, eq=False)
class StandOff:
    """Where both arms face each other from afar, the legs that lead there, and how far apart the arms are there (m)."""

    posture: Posture
    way: tuple[Leg, ...]
    clearance: float
    distance: float


def find_stand_off(model: CellModel, belief: Belief, ways: WayFinder, start: Posture, seed: int) -> StandOff:
    """The stand-off that the cell file gives, else the one with the best clearance and distance, and the way there.

    Camera and board are held in front of their own bases, facing each other along the line between the bases. Raises
    NoPlan: for a given one that is not fit, with the reason; where none is found, with what would help; where no way
    leads there from ``start``, with what is in the way.
    """
    if model.stand_off is not None:
        _require_fit(model, belief, ways, model.stand_off)
        postures = [model.stand_off]
    else:
        postures = _stand_offs(model, belief, ways, seed)
    for posture in postures[:_WAYS_TRIED]:
        way = ways.find(start, posture)
        if way is not None:
            return StandOff(posture, way, _between(ways, belief, posture), float(_T_E_T(model, belief, posture)[2, 3]))
    raise NoPlan(
        "no way from where the arms stand to the stand-off is clear for every error of the bases that "
        f"nominal.uncertainty allows ({ways.blocked_by(start, postures[0])}): "
        f"{_what_to_jog(model, ways, start, postures[0])}"
    )


def _what_to_jog(model: CellModel, ways: WayFinder, start: Posture, goal: Posture) -> str:
    """The arm to move by hand so that there is a way; from home, to where."""
    home = model.home
    if np.allclose([*start.active, *start.passive], [*home.active, *home.passive], atol=_AT_HOME):
        another = "choose another home_deg in the cell file, clear of what is in the way, jog the arms there"
        known = model.nominal.as_if_looked()
        if WayFinder(model, known, [home]).find(start, goal) is not None:
            return f"measure the bases better and lower nominal.uncertainty, or {another}"
        return another
    for arm, q, instead in (
        (model.passive, home.passive, Posture(start.active, home.passive)),
        (model.active, home.active, Posture(home.active, start.passive)),
    ):
        if ways.find(instead, goal) is not None:
            other = (model.active if arm is model.passive else model.passive).name
            return f"jog '{arm.name}' away from '{other}', towards its home [{_degrees(q)}] deg"
    return f"jog both arms apart, towards their homes [{_degrees(home.active)}] and [{_degrees(home.passive)}] deg"


def _degrees(q: Joints) -> str:
    return ", ".join(f"{angle:.0f}" for angle in np.rad2deg(q))


def _require_fit(model: CellModel, belief: Belief, ways: WayFinder, posture: Posture) -> None:
    for arm, q in ((model.active, posture.active), (model.passive, posture.passive)):
        if arm.joint_margin(q) < 0:
            joint = int(np.argmin(np.minimum(q - arm.lower, arm.upper - q)))
            low, high = np.rad2deg([arm.lower[joint], arm.upper[joint]])
            raise NoPlan(
                f"procedure.stand_off: joint {joint + 1} of '{arm.name}' is not within its limits by limit_margin_deg: "
                f"it is at {np.rad2deg(q[joint]):.1f} deg, allowed are {low:.1f} to {high:.1f} deg"
            )
    geometry = ways.geometry
    for arm, body, q in (
        (model.active, geometry.active, posture.active),
        (model.passive, geometry.passive, posture.passive),
    ):
        own = float(body.own_clearance([q])[0])
        if own < ways.margin:
            raise NoPlan(
                f"procedure.stand_off: '{arm.name}' is only {own * 1e3:.0f} mm clear of "
                f"{closest_own(body, np.array(q))}, {ways.margin * 1e3:.0f} mm are needed"
            )
    between = _between(ways, belief, posture)
    if between < ways.margin:
        raise NoPlan(
            f"procedure.stand_off: only {between * 1e3:.0f} mm between the arms are sure to be clear, "
            f"{ways.margin * 1e3:.0f} mm are needed whatever the error of the bases that nominal.uncertainty allows; "
            "move the arms farther apart there"
        )
    if not model.in_view(_T_E_T(model, belief, posture)[None])[0]:
        raise NoPlan(
            "procedure.stand_off: the camera does not see the whole front of the target there, by the nominal "
            "transforms; let camera and target face each other"
        )
    if not in_sight(model, [posture.active], [posture.passive], belief)[0]:
        raise NoPlan(
            "procedure.stand_off: an arm or a fixture stands between the camera and the target there, by the nominal "
            "transforms; choose one with a clear line of sight"
        )


def _stand_offs(model: CellModel, belief: Belief, ways: WayFinder, seed: int) -> list[Posture]:
    """Postures in which both face each other and all is clear, best first; NoPlan if there is none."""
    for other in (inverse(belief.T_P_A), belief.T_P_A):
        if np.linalg.norm(other[:2, 3]) < _LEAST_APART:
            raise NoPlan(
                "no stand-off: the bases stand above each other, there is no direction in which they face; move one "
                "of them sideways, or give procedure.stand_off"
            )
    refused: Counter[str] = Counter()
    pairs = _facing_pairs(model, belief, seed, refused)
    if not pairs:
        help_ = advice(model, belief, lambda other, belief: len(_facing_pairs(other, belief, seed, Counter())))
        raise NoPlan(
            "no stand-off: there is no posture in which camera and target face each other in front of their own bases, "
            "within the limits and clear for every error of the bases that nominal.uncertainty allows. "
            f"{counted(refused)}. {help_}; or give procedure.stand_off"
        )
    compared = pairs[:_PAIRS_COMPARED]
    return sorted(compared, key=lambda posture: -_looks_possible(model, belief, ways, posture))


def _looks_possible(model: CellModel, belief: Belief, ways: WayFinder, stand_off: Posture) -> int:
    """How many tilts of the camera can search for the board from there, and how many of the looks can follow."""
    tilts = len(list(look_postures(model, belief, ways, stand_off, 0))) - 1
    looks = [next(look_postures(model, belief, ways, stand_off, number), None) for number in range(1, _LOOKS_COMPARED)]
    return tilts + _TILTS_PER_LOOK * sum(look is not None for look in looks)


_MILDER = ((1.0, 0.06), (0.7, 0.0), (0.7, 0.06), (0.7, 0.12), (0.7, 0.25), (0.5, 0.0), (0.5, 0.12))
"""Shares of a look's tilt, and m that camera and board are farther apart, where nothing better will do."""


def look_postures(
    model: CellModel, belief: Belief, ways: WayFinder, at: Posture, number: int, refused: Counter[str] | None = None
) -> Iterator[Posture]:
    """Postures for look ``number``, the preferred first, by wrist moves from the stand-off ``at``.

    Counts in ``refused`` those that failed a condition.

    Look 0 is the stand-off itself and, should the board not be seen there, the camera tilted about its own lens in
    rings. Later ones tilt the board about its own centre, point the camera at it as now believed, and roll it; less and
    from farther away where nothing else will do.
    """
    refused = Counter() if refused is None else refused
    aimed = model.camera_in_passive(at.active, belief)
    T_P_T = model.target_in_passive(at.passive)
    if number == 0:
        yield at
        tilts = itertools.product(_SEARCH_RINGS, np.arange(8) * np.pi / 4)
        cameras = np.array([_turned(aimed, _about(azimuth, angle)) for angle, azimuth in tilts])
        yield from _clear_postures(model, belief, ways, at, cameras, np.tile(T_P_T, (len(cameras), 1, 1)), refused)
        return
    for share, apart in ((1.0, 0.0), *_MILDER):
        yield from _tilted_postures(model, belief, ways, at, number, refused, share=share, apart=apart)


def _tilted_postures(
    model: CellModel,
    belief: Belief,
    ways: WayFinder,
    at: Posture,
    number: int,
    refused: Counter[str],
    *,
    share: float = 1.0,
    apart: float = 0.0,
) -> Iterator[Posture]:
    """Postures with the board tilted as the look wants it and the camera leaning and rolled.

    share: of the tilt; apart: m by which camera and board are farther from each other than at the stand-off.
    """
    T_P_T = model.target_in_passive(at.passive)
    aimed = _aimed(model.camera_in_passive(at.active, belief), T_P_T[:3, 3])
    axis = aimed[:3, 2].copy()
    aimed[:3, 3] -= apart / 2 * axis
    T_P_T[:3, 3] += apart / 2 * axis
    azimuth = np.pi / 4 + (number - 1) * np.pi / 2
    lean = _about(azimuth + np.pi / 2, CAMERA_LEAN)
    rolls = (1.0 if number % 2 else -1.0) * np.array([*_CAMERA_ROLLS, *-_CAMERA_ROLLS])
    cameras = np.array([_turned(aimed, lean @ rotation_from_vector([0.0, 0.0, roll])) for roll in rolls])
    angle = share * (BOARD_TILT if number <= 4 else STEEPER_TILT)
    boards = np.array([_tilted(T_P_T, T_P_E, azimuth, angle) for T_P_E in cameras])
    for posture in _clear_postures(model, belief, ways, at, cameras, boards, refused):
        if model.in_view(_T_E_T(model, belief, posture)[None])[0]:
            yield posture
        else:
            refused[_NOT_IN_VIEW] += 1


def _clear_postures(
    model: CellModel,
    belief: Belief,
    ways: WayFinder,
    near: Posture,
    cameras: Array,
    boards: Array,
    refused: Counter[str],
) -> list[Posture]:
    """Postures with camera and board at poses in P (k, 4, 4): those reached, clear and in sight."""
    a, p = model.active, model.passive
    flanges = inverse(belief.T_P_A) @ cameras @ inverse(belief.T_H_E), boards @ inverse(model.T_F_T)
    starts = (np.tile(q, (len(cameras), 1)) for q in (near.active, near.passive))
    (q_a, reached_a), (q_p, reached_p) = (
        arm.chain.inverse(flange, start, arm.lower, arm.upper)
        for arm, flange, start in zip((a, p), flanges, starts, strict=True)
    )
    for arm, reached in ((a, reached_a), (p, reached_p)):
        refused[f"'{arm.name}' does not get there"] += int(np.sum(~reached))
    which = np.flatnonzero(reached_a & reached_p)
    if len(which) == 0:
        return []
    clear = ways.geometry.clearance(q_a[which], q_p[which], belief.placement) >= ways.margin
    refused[_TOO_CLOSE] += int(np.sum(~clear))
    which = which[clear]
    unhidden = in_sight(model, q_a[which], q_p[which], belief)
    refused[_HIDDEN] += int(np.sum(~unhidden))
    return [Posture.of(q_a[k], q_p[k]) for k in which[unhidden]]


def _between(ways: WayFinder, belief: Belief, posture: Posture) -> float:
    return float(ways.geometry.between([posture.active], [posture.passive], belief.placement)[0])


def _T_E_T(model: CellModel, belief: Belief, posture: Posture) -> Array:
    return inverse(model.camera_in_passive(posture.active, belief)) @ model.target_in_passive(posture.passive)


def _turned(T: Array, rotation: Array) -> Array:
    """A frame turned about its own origin."""
    return transform(T[:3, :3] @ rotation, T[:3, 3])


def _tilted(T_P_T: Array, T_P_E: Array, azimuth: float, angle: float) -> Array:
    """The board turned about its centre until its normal leans by ``angle`` from the camera, at ``azimuth`` in view."""
    leaning = np.array([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])
    normal = -T_P_E[:3, :3] @ leaning
    return transform(smallest_rotation(T_P_T[:3, 2], normal) @ T_P_T[:3, :3], T_P_T[:3, 3])


def _facing_postures(
    arm: ArmModel, other: Array, T_tool_flange: Array, rng: np.random.Generator, refused: Counter[str]
) -> Array:
    """Joint angles (k, n) that hold the tool in front of the arm's base, its z axis towards the ``other`` base (3,)."""
    up = np.array([0.0, 0.0, 1.0])
    apart = float(np.linalg.norm(other[:2]))
    toward = np.array([*other[:2] / apart, 0.0])
    middle = np.clip((apart - _GOOD_DISTANCE) / 2, _LEAST_FORWARD, _MOST_FORWARD)
    facing = np.stack([np.cross(-up, toward), -up, toward], axis=1)
    for farther in _FARTHER:
        tools = [
            transform(
                facing @ rotation_from_vector([0.0, 0.0, roll]),
                (middle + forward + farther) * toward + (height + farther) * up,
            )
            for forward, height, roll in itertools.product(_FORWARD, _HEIGHT, _ROLLS)
        ]
        goals = np.array(tools) @ T_tool_flange
        starts = np.concatenate(
            [random_joints(rng, len(goals) * (_STARTS - 1), arm.lower, arm.upper), np.tile(arm.home, (len(goals), 1))]
        )
        q, reached = arm.chain.inverse(np.tile(goals, (_STARTS, 1, 1)), starts, arm.lower, arm.upper)
        refused[f"'{arm.name}' does not get there"] += int(np.sum(~reached))
        if np.any(reached):
            break
    q = arm.nearest_turn(q[reached], arm.home)
    _, different = np.unique(np.round(q, 3), axis=0, return_index=True)
    return np.asarray(q[np.sort(different)])


def _facing_pairs(model: CellModel, belief: Belief, seed: int, refused: Counter[str]) -> list[Posture]:
    """Postures that are clear of everything, at a good distance, short of travel and with room at limits come first.

    Counts in ``refused`` those that failed a condition.
    """
    rng = np.random.default_rng([seed, 1])
    q_a = _facing_postures(model.active, inverse(belief.T_P_A)[:3, 3], inverse(belief.T_H_E), rng, refused)
    q_p = _facing_postures(model.passive, belief.T_P_A[:3, 3], inverse(model.T_F_T), rng, refused)
    if not (len(q_a) and len(q_p)):
        return []
    geometry, margin = model.geometry, model.margin + BETWEEN_SAMPLES
    own_a, own_p = geometry.active.own_clearance(q_a), geometry.passive.own_clearance(q_p)
    for arm, body, q in ((model.active, geometry.active, q_a), (model.passive, geometry.passive, q_p)):
        for what, count in closer_than(margin, body, q).items():
            refused[f"'{arm.name}' is too close to {what}"] += count
    merit_a = _ease(model.active, q_a) + np.minimum(own_a, 0.1)
    merit_p = _ease(model.passive, q_p) + np.minimum(own_p, 0.1)
    pairs = list(itertools.product(_best(merit_a, own_a >= margin), _best(merit_p, own_p >= margin)))
    if not pairs:
        return []
    first, second = np.array(pairs).T
    between = geometry.between(q_a[first], q_p[second], belief.placement)
    T_E_T = inverse(model.camera_in_passive(q_a[first], belief)) @ model.target_in_passive(q_p[second])
    merit = merit_a[first] + merit_p[second] + 4 * np.minimum(between, STAND_OFF_CLEARANCE)
    merit = merit - np.abs(T_E_T[:, 2, 3] - _GOOD_DISTANCE)
    # The camera is tilted alike to all sides in search of the board: it should stand in the middle.
    merit = merit - 3 * np.linalg.norm(T_E_T[:, :2, 3], axis=1)
    seen, clear = model.in_view(T_E_T), between >= margin
    refused[_NOT_IN_VIEW] += int(np.sum(~seen))
    refused["the arms are too close to each other"] += int(np.sum(seen & ~clear))
    fit = seen & clear
    fit[fit] = in_sight(model, q_a[first[fit]], q_p[second[fit]], belief)
    refused[_HIDDEN] += int(np.sum(seen & clear & ~fit))
    order = _best(merit, fit)
    return [Posture.of(q_a[first[k]], q_p[second[k]]) for k in order]


def _best(merit: Array, fit: Mask, most: int = 24) -> list[int]:
    """The numbers of those that are fit, the best first."""
    return [int(k) for k in np.argsort(-merit, kind="stable") if fit[k]][:most]


def _ease(arm: ArmModel, q: Array) -> Array:
    """Higher for postures near home and away from the limits and singularities."""
    travel = np.max(np.abs(q - arm.home), axis=1)
    room = arm.joint_margin(q)
    smallest = np.linalg.svd(arm.chain.jacobian(q), compute_uv=False)[:, -1]
    return np.asarray(-0.1 * travel + 0.3 * np.minimum(room, 0.5) + 3 * np.minimum(smallest, 0.15))


def _about(azimuth: float, angle: float) -> Array:
    """Rotation by ``angle`` about the axis at ``azimuth`` in the x-y plane."""
    return rotation_from_vector(angle * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))


def _aimed(T_P_E: Array, point: Array) -> Array:
    """The camera turned about its lens by the smallest rotation that brings its axis onto the point."""
    return transform(smallest_rotation(T_P_E[:3, 2], point - T_P_E[:3, 3]) @ T_P_E[:3, :3], T_P_E[:3, 3])
