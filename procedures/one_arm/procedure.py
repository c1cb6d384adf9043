"""The calibration of a cell with one arm: first looks, plan, views. A generator of steps, as that of two arms."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dualcal_hal.config import OneArmCell
from dualcal_hal.errors import NoPlan
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CaptureRecord, CellShape
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME
from dualcal_hal.transforms import Array, inverse, rotation_angle
from procedures.alignment import Outcome
from procedures.calibrate import LookRecord, PointRecord, look_of, point_of, requests_of
from procedures.detection import Detector
from procedures.detection.outcome import corners_to_record
from procedures.estimation import Degenerate
from procedures.estimation.refined.one_arm import described
from procedures.events import BeliefRefined, ConstraintGivenUp, LookTaken, NotHome, PlanReady, PointDone
from procedures.going import go, here
from procedures.one_arm.fit import estimate, placement_of, views_of
from procedures.one_arm.known import Known
from procedures.one_arm.views import Request, ViewPlanner
from procedures.planning.model import Posture
from procedures.planning.plan import Plan, PlannedConstraint
from procedures.planning.refine import LEAST_VIEWS, WORST_FIT, View
from procedures.planning.sight import require_visible
from procedures.planning.ways import WayFinder
from procedures.seeing import see
from procedures.steps import Believe, Confirm, KeepDocument, KeepImage, Procedure, task, tell, work

LOOKS = "looks"

_TRIES = 3
"""Postures planned for each look that is wanted: a nominal that is off leaves some without the target."""

_REPLACEMENTS = 3
"""Views that may be given up, for each that is wanted."""

_WHAT_TO_CHECK = (
    "check square_mm, the camera's matrix, the nominal transforms, whether the target was moved, and order, sign and "
    "zero of the joints"
)


@dataclass(frozen=True, eq=False)
class ViewsReady(PlanReady):
    """Views were selected."""

    def __str__(self) -> str:
        counts: dict[str, int] = {}
        for view in self.plan.constraints:
            phase = view.name.partition("/")[0]
            counts[phase] = counts.get(phase, 0) + 1
        named = (f"{count} {'' if phase == LOOKS else 'views of '}{phase}" for phase, count in counts.items())
        return f"plan, from {self.plan.planned_from}: {', '.join(named)}"


@dataclass(frozen=True)
class ViewDone(PointDone):
    """A view was captured, or given up."""

    def __str__(self) -> str:
        return f"{self.constraint}: {self.outcome}{f' ({self.reason})' if self.reason else ''}"


@dataclass(frozen=True)
class PlaceContradicted:
    """The looks found what stands farther from its nominal place than ``nominal.uncertainty`` allows; m and rad."""

    what: str
    translation: float
    rotation: float

    def __str__(self) -> str:
        off = f"{self.translation * 1e3:.0f} mm and {np.rad2deg(self.rotation):.1f} deg"
        return (
            f"warning: the looks found {self.what} {off} from where the cell file has it, farther than its uncertainty "
            "allows: the way so far was not sure to be clear. The run goes on by what was found; correct nominal."
            f"{self.what} or raise the uncertainty"
        )


class OneArmCalibration:
    """One run of the procedure on one cell; :meth:`steps` is what the engine runs."""

    def __init__(self, cell: OneArmCell) -> None:
        self._config, self._procedure = cell.one_arm, cell.procedure
        self._shape = CellShape.of(cell)
        self._known = Known.nominal(cell.one_arm)
        self._detector = Detector(cell.target.board, cell.camera.intrinsics.size)
        require_visible(self._known.model)
        self._ways = ways_of(self._known)
        self._confirmed: Plan | None = None

    def steps(self) -> Procedure[None]:
        """First looks, plan, views, home."""
        yield from self._adopt()
        if self._procedure.first_looks:
            yield from self._first_looks()
        wanted = [Request(request.use, request.constraints, request.use) for request in requests_of(self._procedure)]
        planned = yield from self._planned(StepKey("plan", None, None, "plan"), wanted)
        yield from self._adopt_plan(planned)
        for request in wanted:
            yield from self._views(request, list(planned.of(request.use)))
        yield from self._go_home()

    # -- first looks --------------------------------------------------------------------------------------------

    def _first_looks(self) -> Procedure[None]:
        count = self._procedure.first_looks
        plan = yield from self._planned(StepKey(LOOKS, None, None, "plan"), [looks_request(count)])
        seen: list[View] = []
        reasons: list[str] = []
        for number, planned in enumerate(plan.constraints):
            key = StepKey(LOOKS, f"{LOOKS}/{number}", None, "look")
            record = yield from task(key, lambda p=planned: self._look(plan, p), self._look_from)  # type: ignore[misc]
            if record.view is None:
                reasons.append(f"{planned.name}: {record.reason}")
            else:
                seen.append(record.view)
            yield from tell(LookTaken(len(seen) - 1 if record.view else len(seen), count, *_found(record)))
            if len(seen) >= count and (yield from self._learn(seen)):
                return
        if len(seen) < LEAST_VIEWS:
            raise NoPlan(
                f"first looks: {len(seen)} of {len(plan.constraints)} found the target, {LEAST_VIEWS} are needed "
                f"({'; '.join(reasons)}); see the pictures images/{LOOKS}-*.png; check the nominal transforms, the "
                "lighting and that nothing hides the target"
            )
        if not (yield from self._learn(seen)):
            raise NoPlan(f"first looks: {len(seen)} views do not tell where camera and target are; {_WHAT_TO_CHECK}")

    def _look(self, plan: Plan, planned: PlannedConstraint) -> Procedure[LookRecord]:
        yield from self._confirm(plan)
        posture = _posture(planned)
        if not (yield from go(self._ways, posture)):
            return LookRecord(None, self._ways.blocked_by((yield from here()), posture))
        picture = yield from see(self._known.model, self._detector, self._known.belief)
        if picture.sighting is not None:
            # What the camera saw instead of the target tells what is wrong.
            yield KeepImage(planned.name, picture.sighting.frame.image)
        if picture.sighting is None or picture.detection is None or picture.reason:
            return LookRecord(None, picture.reason)
        return LookRecord(View(picture.sighting.active, picture.sighting.passive, picture.detection.corners), "")

    def _learn(self, seen: list[View]) -> Procedure[bool]:
        """Go on by what the looks have shown; whether they tell enough."""
        joints = [view.active or view.passive for view in seen]
        try:
            views = views_of(self._config, joints, [view.corners for view in seen])
            found = described(views, placement_of(self._config), estimate(self._config, views))
        except Degenerate:
            return False
        if found.rms > WORST_FIT:
            misfit = f"{found.rms:.1f} px rms over {len(seen)} views"
            raise NoPlan(f"what the camera saw does not fit this cell: {misfit}; {_WHAT_TO_CHECK}")
        for name, believed, nominal, allowed in (
            (self._config.names[0], found.camera, self._config.nominal.camera, self._allowed(of_camera=True)),
            (self._config.names[1], found.target, self._config.nominal.target, self._allowed(of_camera=False)),
        ):
            translation, rotation = _off(nominal, believed)
            if translation > allowed[0] or rotation > allowed[1]:
                yield from tell(PlaceContradicted(name, translation, rotation))
        self._known = self._known.by_views(found)
        yield from self._adopt()
        yield from tell(BeliefRefined(len(seen), found.rms))
        return True

    def _allowed(self, *, of_camera: bool) -> tuple[float, float]:
        nominal = self._config.nominal
        carried = of_camera == self._config.camera_on_arm
        given = nominal.mount_uncertainty if carried else nominal.uncertainty
        return given.translation, given.rotation

    # -- views --------------------------------------------------------------------------------------------------

    def _planned(self, key: StepKey, requests: list[Request]) -> Procedure[Plan]:
        purpose = key.constraint or key.phase

        def body() -> Procedure[Plan]:
            start = yield from here()

            def plan() -> Plan:
                seed = [self._procedure.seed, *purpose.encode()]
                return ViewPlanner(self._known, self._ways, seed).plan(requests, self._known.joints(start))

            asked = {"from": start.to_record(), "for": purpose}
            return (yield from work("plan", asked, plan, Plan.to_record, self._plan_from))

        return (yield from task(key, body, self._plan_from))

    def _adopt_plan(self, plan: Plan) -> Procedure[None]:
        self._plan = plan
        belief = self._known.belief
        believed = {"transforms": {T_P_A_NAME: belief.T_P_A.tolist(), T_H_E_NAME: belief.T_H_E.tolist()}}
        yield KeepDocument("plan.json", {**plan.to_record(), **believed})
        yield from tell(ViewsReady(plan))

    def _views(self, request: Request, queue: list[PlannedConstraint]) -> Procedure[None]:
        """Capture as many views as requested; one that fails is replaced by another."""
        taken: list[Joints] = []
        given_up: list[PlannedConstraint] = []
        next_number = len(queue)
        while len(taken) < request.views:
            if not queue:
                missing = Request(request.use, request.views - len(taken), request.phase, next_number, tuple(taken))
                key = StepKey("plan", f"{request.use}/{next_number:02d}", None, "replacement")
                again = yield from self._planned(key, [missing])
                yield from self._adopt_plan(self._plan.replaced(given_up, again))
                queue = list(again.constraints)
                next_number += len(queue)
            planned = queue.pop(0)
            key = StepKey(planned.use, planned.name, 0, "point")
            point = yield from task(key, lambda p=planned: self._view(p), lambda r: point_of(r, self._shape))  # type: ignore[misc]
            yield from tell(_done(planned, point))
            if point.capture is not None:
                taken.append(self._known.joints(_posture(planned)))
                continue
            given_up.append(planned)
            yield from tell(ConstraintGivenUp(planned.name, point.reason))
            if len(given_up) > _REPLACEMENTS * request.views:
                raise NoPlan(f"{len(given_up)} {request.use} views were given up, the last one because: {point.reason}")

    def _view(self, planned: PlannedConstraint) -> Procedure[PointRecord]:
        yield from self._confirm(self._plan)
        posture = _posture(planned)
        if not (yield from go(self._ways, posture)):
            return _missed(Outcome.OUT_OF_REACH, self._ways.blocked_by((yield from here()), posture))
        picture = yield from see(self._known.model, self._detector, self._known.belief)
        sighting, seen = picture.sighting, picture.detection
        if sighting is None or seen is None or not seen.order_known:
            return _missed(Outcome.LOST, picture.reason)
        if not np.all(np.isfinite(seen.feature)):
            return _missed(Outcome.LOST, "the feature point is not seen; look what is in front of it")
        capture = CaptureRecord(
            id=f"{planned.name}/0",
            use=planned.use,
            constraint=planned.name,
            position=0,
            active_arrival=sighting.active_arrival,
            active_joints=sighting.active,
            passive_joints=sighting.passive,
            feature=(float(seen.feature[0]), float(seen.feature[1])),
            corners=corners_to_record(seen.corners),
            image_size=self._known.model.intrinsics.size,
            aligned=False,
        )
        yield KeepImage(capture.id, sighting.frame.image)
        return PointRecord(str(Outcome.SEEN), 1, "", None, None, capture, None, ())

    # -- both ---------------------------------------------------------------------------------------------------

    def _confirm(self, plan: Plan) -> Procedure[None]:
        """Before the first move that this program makes by a plan."""
        if self._confirmed is plan:
            return

        def shown() -> Procedure[ViewsReady]:
            yield from ()
            return ViewsReady(plan)

        yield Confirm(shown)
        self._confirmed = plan

    def _adopt(self) -> Procedure[None]:
        self._ways = ways_of(self._known)
        belief = self._known.belief
        yield Believe(belief.placement, self._known.model.geometry, belief.T_H_E)

    def _go_home(self) -> Procedure[None]:
        home = self._known.model.home
        if not (yield from go(self._ways, home)):
            # All is captured: where the arm rests takes nothing from the result.
            yield from tell(NotHome(self._ways.blocked_by((yield from here()), home)))

    def _plan_from(self, record: dict[str, Any]) -> Plan:
        plan = Plan.from_record(record)
        plan.require_joints(*self._shape.joints)
        return plan

    def _look_from(self, record: dict[str, Any]) -> LookRecord:
        return look_of(record, self._shape)


def looks_request(count: int) -> Request:
    """The postures for so many first looks."""
    return Request("calibration", _TRIES * count, LOOKS)


def ways_of(known: Known) -> WayFinder:
    return WayFinder(known.model, known.belief, [known.model.home])


def _posture(planned: PlannedConstraint) -> Posture:
    return Posture(planned.active, planned.positions[0].passive)


def _found(record: LookRecord) -> tuple[bool, str]:
    return record.view is not None, record.reason


def _off(nominal: Array, found: Array) -> tuple[float, float]:
    apart = inverse(nominal) @ found
    return float(np.linalg.norm(apart[:3, 3])), float(rotation_angle(apart[:3, :3], np.eye(3)))


def _missed(outcome: Outcome, reason: str) -> PointRecord:
    return PointRecord(str(outcome), int(outcome is not Outcome.OUT_OF_REACH), reason, None, None, None, None, ())


def _done(planned: PlannedConstraint, point: PointRecord) -> ViewDone:
    captured = point.capture is not None
    return ViewDone(planned.use, planned.name, 0, 1, point.outcome, captured, point.frames, None, point.reason)
