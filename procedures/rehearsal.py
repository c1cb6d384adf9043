"""What a run would do, as far as it can be told without a device: the way to the stand-off, the looks, a first plan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from dualcal_hal.config import CellConfig
from dualcal_hal.errors import NoPlan
from procedures.calibrate import requests_of
from procedures.planning.first_look import StandOff, find_stand_off, look_postures
from procedures.planning.model import CellModel, Posture
from procedures.planning.plan import Plan
from procedures.planning.poses import PosePlanner
from procedures.planning.ways import Leg, WayFinder


@dataclass(frozen=True, eq=False)
class RehearsedLook:
    """A look's posture and the legs that lead there from the one before."""

    posture: Posture
    way: tuple[Leg, ...]


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """``arms``: where they are before the plan begins, at the stand-off or at home.

    ``stand_off`` is None without first looks; ``plan`` is provisional, ``no_plan`` says why there is none.
    """

    arms: Posture
    stand_off: StandOff | None
    looks: tuple[RehearsedLook, ...]
    plan: Plan | None
    no_plan: str


def rehearse(cell: CellConfig, model: CellModel) -> Rehearsal:
    """From ``home``, with the nominal transforms; the plan as if the looks had found them right.

    Raises NoPlan if there is no stand-off or no posture for a look, and where a cell that takes no looks has no plan.
    """
    belief, start = model.nominal, model.home
    if not cell.procedure.first_looks:
        belief = belief.taken_as_exact()
    ways = WayFinder(model, belief, [model.home])
    stand_off: StandOff | None = None
    looks: tuple[RehearsedLook, ...] = ()
    if cell.procedure.first_looks:
        stand_off = find_stand_off(model, belief, ways, start, cell.procedure.seed)
        ways = WayFinder(model, belief, [stand_off.posture, model.home])
        looks = tuple(_looks(model, ways, stand_off.posture, cell.procedure.first_looks))
        start = looks[-1].posture
        belief = belief.as_if_looked()
        ways = WayFinder(model, belief, [stand_off.posture, model.home])
    arms = model.home if stand_off is None else stand_off.posture
    try:
        plan = PosePlanner(model, belief, ways, [cell.procedure.seed, *b"plan"]).plan(
            requests_of(cell.procedure), start, provisional=True
        )
    except NoPlan as refusal:
        if stand_off is None:
            raise
        return Rehearsal(arms, stand_off, looks, None, str(refusal))
    return Rehearsal(arms, stand_off, looks, plan, "")


def _looks(model: CellModel, ways: WayFinder, stand_off: Posture, count: int) -> Sequence[RehearsedLook]:
    looks: list[RehearsedLook] = []
    here = stand_off
    for number in range(count):
        for posture in look_postures(model, model.nominal, ways, stand_off, number):
            way = ways.find(here, posture)
            if way is not None:
                looks.append(RehearsedLook(posture, way))
                here = posture
                break
        else:
            raise NoPlan(f"look {number + 1}: no posture for it keeps clear and shows the target")
    return looks
