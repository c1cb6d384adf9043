"""What a run would do, as far as it can be told without a device: the way to the stand-off, the looks, a first plan."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from dualcal_hal.config import CellConfig, ProcedureConfig
from dualcal_hal.errors import NoPlan
from procedures.calibrate import NO_WAY_TO_LOOK, requests_of
from procedures.planning.advice import counted
from procedures.planning.first_look import StandOff, find_stand_off, look_postures
from procedures.planning.model import CellModel, Posture
from procedures.planning.plan import Plan
from procedures.planning.poses import PosePlanner
from procedures.planning.refine import LEAST_VIEWS
from procedures.planning.ways import Leg, WayFinder


@dataclass(frozen=True, eq=False)
class RehearsedLook:
    """The legs that lead to a look from where the arms are before it; None, and why, for one that cannot be taken."""

    way: tuple[Leg, ...] | None
    missed: str = ""


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


def require_reach(cell: CellConfig, model: CellModel) -> None:
    """Raises NoPlan where the nominal transforms leave not one constraint possible, with the reasons counted.

    The looks would find them off by a decimetre: no reason to move the arms.
    """
    _planner(cell, model, []).require_candidates(requests_of(cell.procedure)[0])


def rehearse(cell: CellConfig, model: CellModel) -> Rehearsal:
    """From ``home``, with the nominal transforms; the plan as if the looks had found them right.

    Raises NoPlan where a run would be sure to end without moving or with too few looks, and where a cell that takes no
    looks has no plan.
    """
    require_reach(cell, model)
    if not cell.procedure.first_looks:
        return Rehearsal(model.home, None, (), _plan(cell, model, model.home, [model.home]), "")
    ways = WayFinder(model, model.nominal, [model.home])
    stand_off = find_stand_off(model, model.nominal, ways, model.home, cell.procedure.seed)
    retreats = [stand_off.posture, model.home]
    looks, here = _looks(model, WayFinder(model, model.nominal, retreats), stand_off.posture, cell.procedure)
    try:
        plan = _plan(cell, model, here, retreats)
    except NoPlan as refusal:
        return Rehearsal(stand_off.posture, stand_off, looks, None, str(refusal))
    return Rehearsal(stand_off.posture, stand_off, looks, plan, "")


def _plan(cell: CellConfig, model: CellModel, start: Posture, retreats: Sequence[Posture]) -> Plan:
    return _planner(cell, model, retreats).plan(requests_of(cell.procedure), start, provisional=True)


def _planner(cell: CellConfig, model: CellModel, retreats: Sequence[Posture]) -> PosePlanner:
    """The planner with what a run would believe after its looks had they found the nominal transforms right."""
    belief = model.nominal.as_if_looked() if cell.procedure.first_looks else model.nominal.taken_as_exact()
    model = model.believing(belief)
    return PosePlanner(model, belief, WayFinder(model, belief, retreats), [cell.procedure.seed, *b"plan"])


def _looks(
    model: CellModel, ways: WayFinder, stand_off: Posture, procedure: ProcedureConfig
) -> tuple[tuple[RehearsedLook, ...], Posture]:
    """The looks, and where the arms are after them; NoPlan where there are too few."""
    looks: list[RehearsedLook] = []
    here = stand_off
    for number in range(procedure.first_looks):
        refused: Counter[str] = Counter()
        for posture in look_postures(model, model.nominal, ways, stand_off, number, refused):
            way = ways.find(here, posture)
            if way is not None:
                looks.append(RehearsedLook(way))
                here = posture
                break
            refused[NO_WAY_TO_LOOK] += 1
        else:
            looks.append(RehearsedLook(None, f"no posture for it will do. {counted(refused)}"))
    _require_enough(looks, procedure)
    return tuple(looks), here


def _require_enough(looks: Sequence[RehearsedLook], procedure: ProcedureConfig) -> None:
    missed = [f"look {number}: {look.missed}" for number, look in enumerate(looks, start=1) if look.way is None]
    taken = len(looks) - len(missed)
    if taken < LEAST_VIEWS:
        raise NoPlan(
            f"first look: {taken} of {len(looks)} looks can be taken, {LEAST_VIEWS} are needed ({'; '.join(missed)}); "
            f"give {'procedure.stand_off' if procedure.stand_off is None else 'another procedure.stand_off'}, where "
            "both wrists can turn by 25 deg, and the camera by 60 deg about its axis, clear of all"
        )
