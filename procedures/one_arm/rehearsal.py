"""What a run on a cell with one arm would do, as far as it can be told without a device."""

from __future__ import annotations

from dataclasses import dataclass

from dualcal_hal.config import OneArmCell
from dualcal_hal.errors import NoPlan
from procedures.calibrate import requests_of
from procedures.one_arm.known import Known
from procedures.one_arm.procedure import LOOKS, looks_request, ways_of
from procedures.one_arm.views import Request, ViewPlanner
from procedures.planning.belief import LEAST_ERROR
from procedures.planning.model import Posture
from procedures.planning.plan import Plan


@dataclass(frozen=True, eq=False)
class RehearsedViews:
    """home: where the arm begins; looks: None without first looks; plan: as if the looks had found the nominal right,
    None where there is none, and ``no_plan`` says why.
    """

    home: Posture
    looks: Plan | None
    plan: Plan | None
    no_plan: str


def rehearse_views(cell: OneArmCell) -> RehearsedViews:
    """From ``home``, with the nominal transforms. Raises NoPlan where a run would end before it has seen anything."""
    config, procedure = cell.one_arm, cell.procedure
    known = Known.nominal(config)
    home = known.model.home
    looks = None
    start = known.joints(home)
    if procedure.first_looks:
        planner = ViewPlanner(known, ways_of(known), [procedure.seed, *LOOKS.encode()])
        looks = planner.plan([looks_request(procedure.first_looks)], start, provisional=True)
        known = Known(
            config.known_as(config.nominal.camera, config.nominal.target, LEAST_ERROR, LEAST_ERROR), "nominal"
        )
    wanted = [Request(request.use, request.constraints, request.use) for request in requests_of(procedure)]
    try:
        plan = ViewPlanner(known, ways_of(known), [procedure.seed, *b"plan"]).plan(wanted, start, provisional=True)
    except NoPlan as refusal:
        if looks is None:
            raise
        return RehearsedViews(home, looks, None, str(refusal))
    return RehearsedViews(home, looks, plan, "")
