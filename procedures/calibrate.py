"""The calibration procedure: first look, plan, and for each constraint align and capture at every position.

A generator of steps; it touches no device and knows no file. It plans with a belief that every finished constraint
improves; estimation and verification work on the captures alone and start from the nominal.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from dualcal_hal.config import CellConfig, ProcedureConfig
from dualcal_hal.errors import NoPlan
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CaptureRecord, Captures, CellShape
from dualcal_hal.session.journal import Journal, StepKey
from dualcal_hal.session.plain import Fields, expect, finites
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, Rejected
from dualcal_hal.transforms import Array
from procedures.alignment import (
    Aligner,
    Alignment,
    AxisTrack,
    Outcome,
    Servo,
    point_on_axis,
    target_on_axis,
    tolerance_px,
)
from procedures.detection import Detector
from procedures.detection.outcome import corners_from_record, corners_to_record
from procedures.events import (
    BeliefRefined,
    ConstraintDone,
    ConstraintGivenUp,
    LooksProposed,
    LookTaken,
    NominalContradicted,
    NotHome,
    PlanReady,
    PointDone,
)
from procedures.going import go, here
from procedures.planning.advice import counted
from procedures.planning.belief import Belief
from procedures.planning.candidates import ROOM
from procedures.planning.first_look import find_stand_off, look_postures
from procedures.planning.model import CellModel, Posture
from procedures.planning.plan import Plan, PlannedConstraint
from procedures.planning.poses import PosePlanner, Request, judged_anew
from procedures.planning.refine import LEAST_VIEWS, WORST_FIT, View, arrival_scatter, nominal_excess, refine
from procedures.planning.sight import require_visible
from procedures.planning.ways import WayFinder
from procedures.seeing import see
from procedures.steps import Believe, Confirm, KeepDocument, KeepImage, Procedure, task, tell, work

_TRIES_A_LOOK = 20
NO_WAY_TO_LOOK = "no clear way leads there"
_WHAT_TO_CHECK = (
    "check square_mm, target_mount, the camera's matrix, the nominal transforms, and order, sign and zero of the joints"
)
_WORST_CONDITION = 1e6
"""Of a recorded Jacobian: beyond, no shift can be worked out by it."""
_REPLACEMENTS = 3
"""Constraints that may be given up, for each that is wanted."""


@dataclass(frozen=True)
class StandOffRecord:
    """Where the looks are taken from."""

    posture: Posture

    def to_record(self) -> dict[str, Any]:
        return self.posture.to_record()

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        return cls(Posture.from_record(record))


@dataclass(frozen=True, eq=False)
class LookRecord:
    """What a look saw, or why it saw nothing."""

    view: View | None
    reason: str

    def to_record(self) -> dict[str, Any]:
        return {"view": _view_record(self.view), "reason": self.reason}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        fields = Fields(record, "the look")
        return cls(_view_from(fields.any("view")), fields.text("reason"))


@dataclass(frozen=True, eq=False)
class PointRecord:
    """What came of one position: a capture, or the outcome and reason it was given up for.

    ``view`` is what the last picture showed, captured or not; ``servo`` is what to go on with;
    ``arrivals_px`` the offsets (2,) that were left after small corrections.
    """

    outcome: str
    frames: int
    reason: str
    offset_px: tuple[float, float] | None
    view: View | None
    capture: CaptureRecord | None
    servo: Servo | None
    arrivals_px: tuple[Array, ...]

    def to_record(self) -> dict[str, Any]:
        return {
            "outcome": self.outcome,
            "frames": self.frames,
            "reason": self.reason,
            "offset_px": self.offset_px,
            "view": _view_record(self.view),
            "capture": None if self.capture is None else self.capture.to_record(),
            "servo": None if self.servo is None else self.servo.jacobian.tolist(),
            "servo_first": None if self.servo is None else self.servo.first.tolist(),
            "arrivals_px": [offset.tolist() for offset in self.arrivals_px],
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        fields = Fields(record, "the point")
        offset = None if fields.is_null("offset_px") else fields.finites("offset_px", 2)
        return cls(
            fields.choice("outcome", list(Outcome)),
            fields.whole("frames"),
            fields.text("reason"),
            None if offset is None else (offset[0], offset[1]),
            _view_from(fields.any("view")),
            None if fields.is_null("capture") else CaptureRecord.from_record(fields.part("capture").content),
            None if fields.is_null("servo") else _servo_from(fields),
            tuple(np.array(finites(arrival, "arrivals_px", 2)) for arrival in fields.items("arrivals_px")),
        )


class Calibration:
    """One run of the procedure on one cell; :meth:`steps` is what the engine runs."""

    def __init__(self, cell: CellConfig, model: CellModel) -> None:
        self._procedure = cell.procedure
        self._model = model
        self._shape = CellShape.of(cell)
        self._detector = Detector(model.board, model.intrinsics.size)
        self._arrivals_px: list[Array] = []
        require_visible(model)
        tolerance_px(model, cell.procedure.tolerance_px)
        self._belief = model.nominal
        self._views: list[View] = []
        self._looks_confirmed = self._plan_confirmed = False
        self._retreats: list[Posture] = [model.home]
        self._ways = WayFinder(model, self._belief, self._retreats)

    def steps(self) -> Procedure[None]:
        """First look, plan, calibration, verification, home."""
        yield from self._adopt(self._belief)
        if self._procedure.first_looks:
            yield from self._first_look()
        wanted = requests_of(self._procedure)
        planned = yield from task(
            StepKey("plan", None, None, "plan"), lambda: self._select(wanted, "plan"), self._plan_from
        )
        yield from self._adopt_plan(planned)
        for request in wanted:
            yield from self._constraints(request, list(planned.of(request.use)))
        yield from self._go_home()

    # -- first look ---------------------------------------------------------------------------------------------

    def _first_look(self) -> Procedure[None]:
        stand_off = yield from task(StepKey("looks", None, None, "stand-off"), self._stand_off, self._stand_off_from)
        self._retreats.insert(0, stand_off.posture)
        yield from self._adopt(self._belief)
        count = self._procedure.first_looks
        reasons = []
        for number in range(count):
            key = StepKey("looks", f"looks/{number}", None, "look")
            record = yield from task(key, lambda n=number: self._look(stand_off.posture, n), self._look_from)  # type: ignore[misc]
            yield from tell(LookTaken(number, count, record.view is not None, record.reason))
            if record.view is not None:
                self._views.append(record.view)
                yield from self._refine()
            else:
                reasons.append(f"look {number + 1}: {record.reason}")
                if number == 0:
                    break
        if len(self._views) < LEAST_VIEWS:
            raise NoPlan(
                f"first look: {len(self._views)} looks found the target, {LEAST_VIEWS} are needed "
                f"({'; '.join(reasons)}); see the pictures images/looks-*.png; "
                "check the nominal transforms, the lighting and that nothing hides the target"
            )
        if (excess := nominal_excess(self._model, self._belief)) is not None:
            yield from tell(NominalContradicted(*excess))

    def _stand_off(self) -> Procedure[StandOffRecord]:
        start = yield from here()

        def find() -> StandOffRecord:
            found = find_stand_off(self._model, self._belief, self._ways, start, self._procedure.seed)
            return StandOffRecord(found.posture)

        asked = {"from": start.to_record()}
        return (yield from work("stand-off", asked, find, StandOffRecord.to_record, self._stand_off_from))

    def _confirm_looks(self, stand_off: Posture) -> Procedure[None]:
        """Before the first move that this program makes for the looks."""
        if self._looks_confirmed:
            return

        def proposed() -> Procedure[LooksProposed]:
            way = self._ways.find((yield from here()), stand_off)
            return LooksProposed(stand_off, way, self._procedure.first_looks)

        yield Confirm(proposed)
        self._looks_confirmed = True

    def _confirm_plan(self) -> Procedure[None]:
        """Before the first move that this program makes by the plan."""
        if self._plan_confirmed:
            return

        def planned() -> Procedure[PlanReady]:
            yield from ()
            return PlanReady(self._plan)

        yield Confirm(planned)
        self._plan_confirmed = True

    def _look(self, stand_off: Posture, number: int) -> Procedure[LookRecord]:
        yield from self._confirm_looks(stand_off)
        reason, taken = "no posture for it keeps clear and shows the target", 0
        refused: Counter[str] = Counter()
        postures = look_postures(self._model, self._belief, self._ways, stand_off, number, refused)
        for number_of_try in range(_TRIES_A_LOOK):
            asked = {"look": number, "try": number_of_try}
            posture = yield from work(
                "look posture", asked, lambda: next(postures, None), _posture_record, self._posture_from
            )
            if posture is None:
                break
            if not (yield from go(self._ways, posture)):
                refused[NO_WAY_TO_LOOK] += 1
                continue
            picture = yield from see(self._model, self._detector, self._belief)
            if picture.sighting is not None and picture.detection is not None and not picture.reason:
                yield KeepImage(f"looks/{number}", picture.sighting.frame.image)
                joints = picture.sighting.active, picture.sighting.passive
                return LookRecord(View(*joints, picture.detection.corners), "")
            reason, taken = picture.reason, taken + 1
            if picture.sighting is not None:
                # What the camera saw instead of the target tells what is wrong.
                yield KeepImage(f"looks/{number}-{taken}", picture.sighting.frame.image)
        reason = f"{reason} ({taken} pictures)" if taken > 1 else reason
        return LookRecord(None, f"{reason}. {counted(refused)}" if refused.total() else reason)

    # -- constraints --------------------------------------------------------------------------------------------

    def _select(self, requests: list[Request], purpose: str) -> Procedure[Plan]:
        start = yield from here()

        def plan() -> Plan:
            seed = [self._procedure.seed, *purpose.encode()]
            planner = PosePlanner(self._model, self._belief, self._ways, seed)
            return planner.plan(requests, start, provisional=False)

        asked = {"from": start.to_record(), "for": purpose}
        return (yield from work("plan", asked, plan, Plan.to_record, self._plan_from))

    def _adopt_plan(self, plan: Plan) -> Procedure[None]:
        self._plan = plan
        belief, placement = self._belief, self._belief.placement
        believed = {
            "transforms": {T_P_A_NAME: belief.T_P_A.tolist(), T_H_E_NAME: belief.T_H_E.tolist()},
            "allowed_base_error": {
                "translation_mm": placement.translation * 1e3,
                "rotation_deg": float(np.rad2deg(placement.rotation)),
            },
        }
        yield KeepDocument("plan.json", {**plan.to_record(), **believed})
        yield from tell(PlanReady(plan))

    def _constraints(self, request: Request, queue: list[PlannedConstraint]) -> Procedure[None]:
        """Capture as many constraints as requested; one that fails is replaced by another."""
        captured: tuple[PlannedConstraint, ...] = ()
        given_up: list[PlannedConstraint] = []
        next_number = len(queue)
        while len(captured) < request.constraints:
            if not queue or self._is_outdated(queue[0]):
                count = request.constraints - len(captured)
                missing = Request(request.use, count, request.positions, next_number, captured)
                key = StepKey("plan", f"{request.use}/{next_number:02d}", None, "replacement")
                again = yield from task(key, lambda r=missing, k=key: self._select([r], k.constraint), self._plan_from)  # type: ignore[misc]
                plan = self._plan.replaced([*given_up, *queue], again)
                yield from self._adopt_plan(judged_anew(plan, self._model, self._belief))
                queue = list(again.constraints)
                next_number += len(queue)
            constraint = queue.pop(0)
            failure = yield from self._constraint(constraint)
            if failure is None:
                captured = (*captured, constraint)
                yield from tell(ConstraintDone(request.use, constraint.name, len(captured), request.constraints))
            else:
                given_up.append(constraint)
                yield from tell(ConstraintGivenUp(constraint.name, failure))
                if len(given_up) > _REPLACEMENTS * request.constraints:
                    raise NoPlan(
                        f"{len(given_up)} {request.use} constraints were given up, the last one because: {failure}"
                    )
            if self._views:
                yield from self._refine()

    def _constraint(self, constraint: PlannedConstraint) -> Procedure[str | None]:
        """Align and capture at all positions; returns why the constraint is given up, or None."""
        model, belief = self._model, self._belief
        T_P_E = model.camera_in_passive(constraint.active, belief)
        track = self._track(constraint, T_P_E)
        tolerance = tolerance_px(model, self._procedure.tolerance_px, self._arrivals_px)
        aligner = Aligner(model, belief, self._ways, self._detector, tolerance)
        for i, planned in enumerate(constraint.positions):
            T_P_T = target_on_axis(model, track, planned.passive, planned.distance)
            key = StepKey(constraint.use, constraint.name, i, "point")

            def body(i: int = i, near: Joints = planned.passive, goal: Array = T_P_T) -> Procedure[PointRecord]:
                yield from self._confirm_plan()
                alignment = yield from aligner.align(constraint.active, near, goal, T_P_E)
                return (yield from self._captured(constraint, i, alignment, aligner))

            point = yield from task(key, body, lambda record: point_of(record, self._shape))
            yield from tell(_point_done(constraint, i, point))
            self._arrivals_px += point.arrivals_px
            if point.view is not None:
                self._views.append(point.view)
            if point.capture is None:
                return f"position {i + 1}: {point.outcome}, {point.reason}"
            aligner.go_on_with(point.servo)
            track.add(point_on_axis(model, point.capture.passive_joints, np.array(point.capture.feature), T_P_E))
        return None

    def _captured(
        self, constraint: PlannedConstraint, position: int, alignment: Alignment, aligner: Aligner
    ) -> Procedure[PointRecord]:
        sighting, seen = alignment.sighting, alignment.detection
        view = None
        if sighting is not None and seen is not None and seen.order_known:
            view = View(sighting.active, sighting.passive, seen.corners)
        capture = None
        if alignment.captured and sighting is not None and seen is not None:
            name = f"{constraint.name}/{position}"
            capture = CaptureRecord(
                id=name,
                use=constraint.use,
                constraint=constraint.name,
                position=position,
                active_arrival=sighting.active_arrival,
                active_joints=sighting.active,
                passive_joints=sighting.passive,
                feature=(float(seen.feature[0]), float(seen.feature[1])),
                corners=corners_to_record(seen.corners),
                image_size=self._model.intrinsics.size,
                aligned=alignment.outcome is Outcome.ALIGNED,
                order_known=seen.order_known,
            )
            yield KeepImage(name, sighting.frame.image)
        offset = None if alignment.offset is None else (float(alignment.offset[0]), float(alignment.offset[1]))
        outcome, frames, reason = str(alignment.outcome), alignment.frames, alignment.reason
        return PointRecord(outcome, frames, reason, offset, view, capture, aligner.servo, alignment.arrivals)

    def _track(self, constraint: PlannedConstraint, T_P_E: Array) -> AxisTrack:
        model = self._model
        believed = self._belief.rotation_sigma(model.active.chain.forward(constraint.active))
        arrival = model.active.joint_sigma * np.sqrt(model.active.chain.joints)
        focal = float(np.mean(model.intrinsics.matrix[[0, 1], [0, 1]]))
        point_sigma = max(arrival_scatter(model), 0.01) / focal * float(np.mean(model.distance))
        return AxisTrack(T_P_E, float(np.hypot(believed, arrival)), point_sigma)

    def _is_outdated(self, constraint: PlannedConstraint) -> bool:
        """Whether the belief has moved the axis by more than the room that the plan left for alignment."""
        model = self._model
        camera = model.camera_in_passive(constraint.active, self._belief)
        planned = model.target_in_passive([position.passive for position in constraint.positions])[:, :3, 3]
        in_camera = (planned - camera[:3, 3]) @ camera[:3, :3]
        return bool(np.any(np.linalg.norm(in_camera[:, :2], axis=1) > ROOM))

    # -- what was recorded --------------------------------------------------------------------------------------
    # ValueError for what is none of this cell's.

    def _posture_from(self, record: dict[str, Any] | None) -> Posture | None:
        return None if record is None else self._stand_off_from(record).posture

    def _stand_off_from(self, record: dict[str, Any]) -> StandOffRecord:
        found = StandOffRecord.from_record(record)
        self._model.require_joints(found.posture.active, found.posture.passive)
        return found

    def _look_from(self, record: dict[str, Any]) -> LookRecord:
        return look_of(record, self._shape)

    def _plan_from(self, record: dict[str, Any]) -> Plan:
        plan = Plan.from_record(record)
        plan.require_joints(*self._shape.joints)
        return plan

    # -- both ---------------------------------------------------------------------------------------------------

    def _refine(self) -> Procedure[None]:
        try:
            belief, rms = refine(self._model, self._views)
        except ValueError as error:
            raise NoPlan(f"what the camera saw does not fit this cell: {error}; {_WHAT_TO_CHECK}") from error
        if rms > WORST_FIT:
            misfit = f"{rms:.1f} px rms over {len(self._views)} views"
            raise NoPlan(f"what the camera saw does not fit this cell: {misfit}; {_WHAT_TO_CHECK}")
        yield from self._adopt(belief)
        yield from tell(BeliefRefined(len(self._views), rms))

    def _adopt(self, belief: Belief) -> Procedure[None]:
        """Go on with a belief; without looks, as simulated cells may, it is always taken as exact."""
        belief = belief if self._procedure.first_looks else belief.taken_as_exact()
        self._belief = belief
        self._model = self._model.believing(belief)
        self._ways = WayFinder(self._model, belief, self._retreats)
        yield Believe(belief.placement, self._model.geometry, belief.T_H_E)

    def _go_home(self) -> Procedure[None]:
        if not (yield from go(self._ways, self._model.home)):
            # All is captured: where the arms rest takes nothing from the result.
            yield from tell(NotHome(self._ways.blocked_by((yield from here()), self._model.home)))


def requests_of(procedure: ProcedureConfig) -> list[Request]:
    """The constraints that a cell file asks for; verification may be none."""
    verification = procedure.verification
    requests = [
        Request("calibration", procedure.constraints, procedure.positions),
        Request("verification", verification.constraints, verification.positions),
    ]
    return [request for request in requests if request.constraints]


def look_of(record: dict[str, Any], shape: CellShape) -> LookRecord:
    """What came of a look of a cell, as it is recorded; ValueError for anything else."""
    found = LookRecord.from_record(record)
    _require_view(found.view, shape)
    return found


def point_of(record: dict[str, Any], shape: CellShape) -> PointRecord:
    """What came of a point of a cell, as it is recorded; ValueError for anything else."""
    point = PointRecord.from_record(record)
    _require_view(point.view, shape)
    if point.capture is not None:
        shape.require(point.capture)
    return point


def captures_of(journal: Journal, cell_sha256: str, started: str | None, shape: CellShape | None = None) -> Captures:
    """The captures of a run so far, in the order taken; without those of constraints that were given up.

    FormatError for a point that cannot be read, or is of another cell than ``shape`` says, where that is given.
    """
    keys = [key for key, _ in journal.results() if key.kind == "point"]

    def read(record: dict[str, Any]) -> PointRecord:
        return PointRecord.from_record(record) if shape is None else point_of(record, shape)

    points = [(key, journal.read(key, read)) for key in keys]
    given_up = {key.constraint for key, point in points if point.capture is None}
    captures = [point.capture for key, point in points if point.capture and key.constraint not in given_up]
    return Captures(cell_sha256, started, tuple(captures))


def is_complete(captures: Captures, procedure: ProcedureConfig) -> bool:
    """Whether nothing is left to be captured."""
    kept, _ = finished(captures, procedure)
    constraints = {(capture.use, capture.constraint) for capture in kept.captures}
    done = Counter(use for use, _ in constraints)
    return all(done[request.use] >= request.constraints for request in requests_of(procedure))


def finished(captures: Captures, procedure: ProcedureConfig) -> tuple[Captures, tuple[Rejected, ...]]:
    """A session's captures without those of a constraint that was interrupted, and these with the reason."""
    wanted = {request.use: request.positions for request in requests_of(procedure)}
    taken = Counter((capture.use, capture.constraint) for capture in captures.captures)
    kept, left_out = [], []
    for capture in captures.captures:
        have, want = taken[capture.use, capture.constraint], wanted.get(capture.use, 0)
        if have >= want:
            kept.append(capture)
        else:
            reason = f"{capture.constraint} is not finished: {have} of {want} positions"
            left_out.append(Rejected(capture.id, reason))
    return replace(captures, captures=tuple(kept)), tuple(left_out)


def _point_done(constraint: PlannedConstraint, position: int, point: PointRecord) -> PointDone:
    return PointDone(
        constraint.use,
        constraint.name,
        position,
        len(constraint.positions),
        point.outcome,
        point.capture is not None,
        point.frames,
        point.offset_px,
        point.reason,
    )


def _view_record(view: View | None) -> dict[str, Any] | None:
    if view is None:
        return None
    return {"active_rad": view.active, "passive_rad": view.passive, "corners_px": corners_to_record(view.corners)}


def _view_from(record: dict[str, Any] | None) -> View | None:
    if record is None:
        return None
    fields = Fields(record, "the view")
    corners = corners_from_record(fields.any("corners_px"))
    return View(fields.joints("active_rad"), fields.joints("passive_rad"), corners)


def _require_view(view: View | None, shape: CellShape) -> None:
    if view is None:
        return
    found = (len(view.active), len(view.passive)), len(view.corners)
    if found != (shape.joints, shape.corners):
        raise ValueError(f"view: joints and corners are {found}, the cell has {(shape.joints, shape.corners)}")


def _servo_from(fields: Fields) -> Servo:
    jacobian = _matrix_from(fields.any("servo"), "servo")
    recorded = fields.any("servo_first") if "servo_first" in fields else None
    first = jacobian if recorded is None else _matrix_from(recorded, "servo_first")
    if np.linalg.cond(first) > _WORST_CONDITION:
        raise ValueError("servo_first: nothing can be corrected by it")
    return Servo(first, jacobian)


def _matrix_from(record: Any, name: str) -> Array:
    rows = expect(record, list, name)
    if len(rows) != 2:
        raise ValueError(f"{name} is no matrix of 2 x 2")
    return np.array([finites(row, name, 2) for row in rows])


def _posture_record(posture: Posture | None) -> dict[str, Any] | None:
    return None if posture is None else posture.to_record()
