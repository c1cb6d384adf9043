"""What would help most where no plan is found: one thing about the cell is changed at a time, and tried."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.geometry import CellGeometry, Placement
from dualcal_hal.transforms import Array, smallest_rotation, transform
from procedures.planning.belief import Belief
from procedures.planning.model import ArmModel, CellModel

_MOVES = (-0.1, 0.1, -0.2, 0.2)  # of the distance between the bases
_FAR_MOVES = (-0.35, 0.35, -0.5, 0.5, -0.65, 1.0, -0.8, 2.0)  # where nothing smaller helps
_FREE_JOINTS = 6  # that an arm needs to hold what it carries at any pose
_TILT = np.deg2rad(15.0)
_LARGEST_TILT = np.deg2rad(75.0)
_WIDER = (2 / 3, 4 / 3)
_CLEARANCE = 0.01  # m
_MEASURED = 0.04, np.deg2rad(4.0)  # m and rad that the bases may be wrong by after some care with a tape measure

Success = Callable[[CellModel, Belief], float]
"""How well a cell does: larger is better, zero is useless."""


@dataclass(frozen=True, eq=False)
class _Change:
    words: str
    model: CellModel
    belief: Belief


def advice(model: CellModel, belief: Belief, success: Success) -> str:
    """A sentence with the one change after which a cell does best, or that none of those tried helps.

    The bases are moved far only where no other change helps, and then no farther than does some good.
    """
    for arm in (model.active, model.passive):
        if arm.chain.joints < _FREE_JOINTS:
            return (
                f"What would help most: an arm of {_FREE_JOINTS} joints in place of '{arm.name}', whose "
                f"{arm.chain.joints} cannot hold what it carries at any place in any direction"
            )
    now = success(model, belief)
    tried = [(success(change.model, change.belief), change.words) for change in _changes(model, belief)]
    most, words = max(tried, key=lambda found: found[0])
    if most <= now:
        far = (change for change in _moves(model, belief, _FAR_MOVES) if success(change.model, change.belief) > now)
        words = next((change.words for change in far), "")
    return f"What would help most: {words}" if words else "No single change of those tried would help"


def counted(refused: Counter[str]) -> str:
    """How many of what was tried failed which condition, the most first."""
    return "Refused: " + "; ".join(f"{what}: {count}" for what, count in refused.most_common() if count)


def _changes(model: CellModel, belief: Belief) -> Iterator[_Change]:
    """The smaller changes first: of two that help as much the first is named."""
    yield from _moves(model, belief, _MOVES)
    low, high = model.distance[0] * _WIDER[0], model.distance[1] * _WIDER[1]
    words = f"widen procedure.distance_mm to [{low * 1e3:.0f}, {high * 1e3:.0f}]"
    yield _Change(words, model.but(distance=(low, high)), belief)
    tilt = min(model.tilt_max + _TILT, _LARGEST_TILT)
    if tilt > model.tilt_max:
        words = f"raise procedure.tilt_max_deg to {np.rad2deg(tilt):.0f}"
        yield _Change(words, model.but(tilt_max=tilt), belief)
    placement = belief.placement
    if placement.translation > _MEASURED[0] or placement.rotation > _MEASURED[1]:
        less = min(placement.translation, _MEASURED[0]), min(placement.rotation, _MEASURED[1])
        words = (
            "measure the bases, correct the nominal transforms and lower nominal.uncertainty to "
            f"{less[0] * 1e3:.0f} mm and {np.rad2deg(less[1]):.0f} deg"
        )
        yield _Change(words, model, replace(belief, placement=Placement(belief.T_P_A, *less)))
    if model.margin > _CLEARANCE:
        words = f"lower procedure.clearance_mm to {_CLEARANCE * 1e3:.0f}"
        yield _Change(words, model.but(margin=_CLEARANCE), belief)
    for name in [fixture.name for body in (model.geometry.active, model.geometry.passive) for fixture in body.fixtures]:
        bodies = model.geometry.active.without(name), model.geometry.passive.without(name)
        yield _Change(f"move fixtures.{name} out of the way", model.but(geometry=CellGeometry(*bodies)), belief)
    for role, arm in (("active", model.active), ("passive", model.passive)):
        if np.any(arm.limit_margin > 0):
            yield _Change(f"lower limit_margin_deg of '{arm.name}' to 0", model.but(**{role: _unheld(arm)}), belief)
    yield _Change(
        f"mount the target on '{model.passive.name}' so that it faces away from the flange",
        model.but(T_F_T=_along_flange(model.T_F_T)),
        belief,
    )
    # The placement is as wrong as before but not the nominal's own: so the housing stands where the lens is then.
    placement = replace(belief.placement, T_P_A=belief.placement.T_P_A.copy())
    turned = replace(belief, T_H_E=_along_flange(belief.T_H_E), placement=placement)
    yield _Change(
        f"mount the camera on '{model.active.name}' so that it looks away from the flange",
        model.believing(turned),
        turned,
    )


def _moves(model: CellModel, belief: Belief, moves: Iterable[float]) -> Iterator[_Change]:
    apart = float(np.linalg.norm(belief.T_P_A[:3, 3]))
    for move in moves:
        words = f"move the bases {abs(move) * apart * 1e3:.0f} mm {'closer together' if move < 0 else 'farther apart'}"
        yield _Change(words, model, _moved(belief, 1 + move))


def _moved(belief: Belief, factor: float) -> Belief:
    """The bases farther apart by a factor, along the line between them."""
    T_P_A = transform(belief.T_P_A[:3, :3], factor * belief.T_P_A[:3, 3])
    placement = Placement(T_P_A, belief.placement.translation, belief.placement.rotation)
    return replace(belief, T_P_A=T_P_A, placement=placement)


def _unheld(arm: ArmModel) -> ArmModel:
    return replace(
        arm, lower=arm.lower - arm.limit_margin, upper=arm.upper + arm.limit_margin, limit_margin=0 * arm.lower
    )


def _along_flange(T: Array) -> Array:
    """What is mounted turned by the smallest rotation that brings its z axis onto the flange's, at the same place."""
    return transform(smallest_rotation(T[:3, 2], np.array([0.0, 0.0, 1.0])) @ T[:3, :3], T[:3, 3])
