"""The procedure for intrinsics: first look, then the target shown over the whole image in rounds.

The camera matrix of the cell file is where it begins, and may be off by 5 % and 20 px, with a distortion that is not
known. So the first round stays away from the image's edges, by what such a camera may show elsewhere, and the arms keep
clear of each other by what it may have them stand elsewhere; each further round knows the camera from those before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np

from dualcal_hal.camera import Intrinsics
from dualcal_hal.config import CellConfig
from dualcal_hal.errors import DegenerateCaptures, NoPlan
from dualcal_hal.geometry import Placement
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import CellShape
from dualcal_hal.session.journal import Journal, StepKey
from dualcal_hal.session.plain import Fields
from dualcal_hal.transforms import Array, inverse
from procedures.calibrate import Calibration
from procedures.detection import board_poses
from procedures.detection.outcome import corners_from_record, corners_to_record
from procedures.events import counted
from procedures.going import go, here
from procedures.intrinsics.coverage import Coverage
from procedures.intrinsics.estimate import LEAST_VIEWS, Estimate, estimate, parameters
from procedures.intrinsics.views import Shown, ViewPlanner
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel, Posture
from procedures.planning.refine import View, refine
from procedures.seeing import see
from procedures.steps import Confirm, KeepImage, Procedure, task, tell, work

FOCAL_ERROR = 0.06
"""Parts by which the focal lengths of the cell file may be wrong, and what is seen nearer or farther than it seems."""
CENTRE_ERROR = 20.0
"""px by which its principal point may be."""

ROUNDS = (12, 14, 12)
"""Views of the rounds that are always gone through."""
EXTRA_ROUNDS = 2
EXTRA_VIEWS = 6
"""Rounds more, with so many views each, while the coverage is poor."""

EDGE_MARGIN = 28.0
"""px that corners are kept inside the image once the camera is known roughly: detection needs 21 of them."""

PHASE = "intrinsics"
WORST_LOOKS = 30.0
"""px rms of the looks, above which not even a wrong camera explains them."""


@dataclass(frozen=True)
class ViewsProposed:
    """The first round of views, before its first move.

    distance: least and largest from camera to target, m; clearance: least of the views, whatever the bases' error, m;
    rests: postures of the active arm that they are taken from; most: views that all rounds may come to.
    """

    count: int
    distance: tuple[float, float]
    clearance: float
    rests: int
    most: int

    def __str__(self) -> str:
        near, far = (f"{1e3 * distance:.0f}" for distance in self.distance)
        return (
            f"The first {counted(self.count, 'view')} of at most {self.most}: the target all over the image, {near} to "
            f"{far} mm from the camera, tilted to all sides; the camera rests in {counted(self.rests, 'posture')}; "
            f"the arms keep at least {1e3 * self.clearance:.0f} mm clear there whatever the bases' error."
        )


@dataclass(frozen=True)
class ViewTaken:
    """A view of a round; ``reason`` says why it shows nothing, ``count`` how many there are so far planned."""

    number: int
    count: int
    found: bool
    reason: str

    def __str__(self) -> str:
        return f"view {self.number + 1}/{self.count}: {'target found' if self.found else self.reason}"


@dataclass(frozen=True, eq=False)
class CameraRefined:
    """The camera as the views so far have it; ``sigma`` (9,) as in :class:`Estimate`."""

    views: int
    intrinsics: Intrinsics
    sigma: Array
    rms_px: float
    share: float

    def __str__(self) -> str:
        matrix = self.intrinsics.matrix
        pairs = zip((matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]), self.sigma, strict=False)
        values = ", ".join(f"{value:.1f} +- {sigma:.1f}" for value, sigma in pairs)
        return (
            f"camera from {counted(self.views, 'view')}: fx, fy, cx, cy {values} px; "
            f"{self.rms_px:.3f} px rms, corners in {self.share:.0%} of the image"
        )


@dataclass(frozen=True)
class PostureRecords:
    """The views of a round."""

    postures: tuple[Posture, ...]

    def to_record(self) -> dict[str, Any]:
        return {"postures": [posture.to_record() for posture in self.postures]}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        items = Fields(record, "the round").items("postures")
        return cls(tuple(Posture.from_record(each) for each in items))


@dataclass(frozen=True, eq=False)
class ViewRecord:
    """What a view showed: joint angles (rad) and corners, or why there are none.

    order_known: whether the corners are surely in the target's order; for the camera alone any of those in which the
    target looks alike will do.
    """

    view: View | None
    order_known: bool
    reason: str

    def to_record(self) -> dict[str, Any]:
        seen = None
        if self.view is not None:
            corners = corners_to_record(self.view.corners)
            seen = {"active_rad": self.view.active, "passive_rad": self.view.passive, "corners_px": corners}
        return {"view": seen, "order_known": self.order_known, "reason": self.reason}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        fields = Fields(record, "the view")
        view = None
        if (seen := fields.part_or_none("view")) is not None:
            corners = corners_from_record(seen.any("corners_px"))
            view = View(seen.finites("active_rad"), seen.finites("passive_rad"), corners)
        return cls(view, fields.flag("order_known"), fields.text("reason"))


@dataclass(frozen=True, eq=False)
class SeenView:
    """A view that showed the target; ``name`` is also that of its image in the session."""

    name: str
    corners: Array


class IntrinsicsProcedure(Calibration):
    """One run for the camera of one cell; :meth:`steps` is what the engine runs."""

    def __init__(self, cell: CellConfig, model: CellModel) -> None:
        super().__init__(cell, model)
        self._camera_known = self._views_confirmed = False
        self._corners: list[Array] = []
        self._planned = 0

    def steps(self) -> Procedure[None]:
        """First look, rounds of views, home."""
        yield from self._adopt(self._belief)
        if self._procedure.first_looks:
            yield from self._first_look()
            at = self._retreats[0]
        else:
            key = StepKey(PHASE, None, None, "stand-off")
            at = (yield from task(key, self._stand_off, self._stand_off_from)).posture
        for number in range(len(ROUNDS) + EXTRA_ROUNDS):
            if number >= len(ROUNDS) and not self._is_poor():
                break
            yield from self._round(number, ROUNDS[number] if number < len(ROUNDS) else EXTRA_VIEWS, at)
            yield from self._know_camera()
        yield from self._go_home()

    def _round(self, number: int, count: int, at: Posture) -> Procedure[None]:
        """Choose so many views and take them."""
        name = f"views/{number}"
        key = StepKey(PHASE, name, None, "plan")
        chosen = yield from task(key, lambda: self._choose(number, count, at), self._round_from)
        taken, self._planned = self._planned, self._planned + len(chosen.postures)
        missed = ""
        for i, posture in enumerate(chosen.postures):
            key = StepKey(PHASE, name, i, "view")
            body = partial(self._view, posture, f"{name}-{i:02d}", chosen)
            record = yield from task(key, body, self._view_from)
            yield from tell(ViewTaken(taken + i, self._planned, record.view is not None, record.reason))
            self._learn(record)
            missed = record.reason or missed
        if not self._corners:
            raise NoPlan(f"none of the first {counted(len(chosen.postures), 'view')} showed the target: {missed}")

    def _choose(self, number: int, count: int, at: Posture) -> Procedure[PostureRecords]:
        start = yield from here()
        model = self._model
        margin = EDGE_MARGIN
        if not self._camera_known:
            margin += CENTRE_ERROR + FOCAL_ERROR * max(model.intrinsics.size) / 2

        def choose() -> PostureRecords:
            seed = [self._procedure.seed, *PHASE.encode(), number]
            planner = ViewPlanner(model, self._belief, self._ways, margin, seed)
            poses = [board_poses(corners, model.board, model.intrinsics)[0][0] for corners in self._corners]
            shown = Shown.of(self._corners, poses, model.board.corners, model.intrinsics)
            chosen = planner.choose(count, shown, at, start)
            if not chosen and not self._corners:
                raise NoPlan(f"no view of the target is possible from the stand-off. {planner.why_refused()}")
            return PostureRecords(tuple(chosen))

        asked = {"from": start.to_record(), "round": number}
        return (yield from work("views", asked, choose, PostureRecords.to_record, self._round_from))

    def _confirm_views(self, chosen: PostureRecords) -> Procedure[None]:
        """Before the first move that this program makes for the views."""
        if self._views_confirmed:
            return
        model, belief = self._model, self._belief
        q_a, q_p = (np.array([getattr(p, arm) for p in chosen.postures]) for arm in ("active", "passive"))

        def proposed() -> Procedure[ViewsProposed]:
            yield from ()
            T_E_T = inverse(model.camera_in_passive(q_a, belief)) @ model.target_in_passive(q_p)
            distance = np.linalg.norm(T_E_T[:, :3, 3], axis=1)
            clearance = model.geometry.clearance(q_a, q_p, belief.placement)
            most = sum(ROUNDS) + EXTRA_ROUNDS * EXTRA_VIEWS
            ends = float(distance.min()), float(distance.max())
            rests = len({posture.active for posture in chosen.postures})
            return ViewsProposed(len(chosen.postures), ends, float(clearance.min()), rests, most)

        yield Confirm(proposed)
        self._views_confirmed = True

    def _view(self, posture: Posture, name: str, chosen: PostureRecords) -> Procedure[ViewRecord]:
        yield from self._confirm_views(chosen)
        if not (yield from go(self._ways, posture)):
            return ViewRecord(None, False, "no clear way leads there")
        picture = yield from see(self._model, self._detector, self._belief)
        if picture.sighting is None:
            return ViewRecord(None, False, picture.reason)
        yield KeepImage(name, picture.sighting.frame.image)
        if picture.detection is None:
            return ViewRecord(None, False, picture.reason)
        view = View(picture.sighting.active, picture.sighting.passive, picture.detection.corners)
        return ViewRecord(view, picture.detection.order_known, "")

    def _learn(self, record: ViewRecord) -> None:
        if record.view is None:
            return
        self._corners.append(record.view.corners)
        if record.order_known:
            self._views.append(record.view)

    def _know_camera(self) -> Procedure[None]:
        """Go on with the camera that the views so far tell of, and with the transforms that follow with it."""
        try:
            found = estimate(self._corners, self._model.board, self._model.intrinsics)
        except DegenerateCaptures:
            return  # the further rounds may yet show enough
        if not self._tells_more(found):
            return
        self._model = self._model.but(intrinsics=found.intrinsics)
        self._camera_known = True
        coverage = coverage_of(found, self._corners)
        used = int(found.used.sum())
        yield from tell(CameraRefined(used, found.intrinsics, found.sigma, found.rms, coverage.share))
        if self._procedure.first_looks:
            yield from self._refine()

    def _tells_more(self, found: Estimate) -> bool:
        """Whether the views tell of the camera more than is taken for granted of the cell file's."""
        focal = float(np.max(found.sigma[:2] / parameters(found.intrinsics)[:2]))
        return focal < FOCAL_ERROR / 2 and float(np.max(found.sigma[2:4])) < CENTRE_ERROR / 2

    def _is_poor(self) -> bool:
        if len(self._corners) < LEAST_VIEWS:
            return True
        try:
            found = estimate(self._corners, self._model.board, self._model.intrinsics)
        except DegenerateCaptures:
            return True
        return any(coverage_of(found, self._corners).lacking())

    # -- the belief while the camera is not known -----------------------------------------------------------------

    def _refine(self) -> Procedure[None]:
        if self._camera_known:
            yield from super()._refine()
            return
        try:
            belief, rms = refine(self._model, self._views)
        except ValueError as error:
            raise NoPlan(f"what the camera saw does not fit this cell: {error}; {_WHAT_TO_CHECK}") from error
        if rms > WORST_LOOKS:
            raise NoPlan(f"what the camera saw does not fit this cell: {rms:.1f} px rms; {_WHAT_TO_CHECK}")
        yield from self._adopt(belief)

    def _adopt(self, belief: Belief) -> Procedure[None]:
        fitted = belief.T_P_A is not self._model.nominal.T_P_A
        if fitted and not self._camera_known:
            belief = replace(belief, placement=self._widened(belief))
        yield from super()._adopt(belief)

    def _widened(self, belief: Belief) -> Placement:
        """What the bases' error may be besides, seen by a wrong camera."""
        last, model = self._views[-1], self._model
        T_E_T = inverse(model.camera_in_passive(last.active, belief)) @ model.target_in_passive(last.passive)
        turn = CENTRE_ERROR / float(model.intrinsics.matrix[0, 0])
        placement = belief.placement
        translation = placement.translation + FOCAL_ERROR * float(np.linalg.norm(T_E_T[:3, 3]))
        return Placement(placement.T_P_A, translation, placement.rotation + turn)

    # -- what was recorded ------------------------------------------------------------------------------------------

    def _round_from(self, record: dict[str, Any]) -> PostureRecords:
        found = PostureRecords.from_record(record)
        for posture in found.postures:
            self._model.require_joints(posture.active, posture.passive)
        return found

    def _view_from(self, record: dict[str, Any]) -> ViewRecord:
        return view_of(record, self._shape)


_WHAT_TO_CHECK = (
    "check square_mm, target_mount, the nominal transforms, and order, sign and zero of the joints; of the camera's "
    f"matrix the focal lengths to {FOCAL_ERROR:.0%} and the principal point to {CENTRE_ERROR:.0f} px"
)


def coverage_of(found: Estimate, corners: Sequence[Array]) -> Coverage:
    """Of the views that an estimate from these corners (n, 2) px used."""
    return Coverage.of(np.array(corners)[found.used], found.poses[found.used], found.intrinsics)


def view_of(record: dict[str, Any], shape: CellShape) -> ViewRecord:
    """A view of a cell, as it is recorded; ValueError for anything else."""
    found = ViewRecord.from_record(record)
    if found.view is not None:
        counts = _counts(found.view.active, found.view.passive, found.view.corners)
        if counts != (shape.joints, shape.corners):
            raise ValueError(f"the view's joints and corners are {counts}, not {(shape.joints, shape.corners)}")
    return found


def views_of(journal: Journal, shape: CellShape) -> tuple[SeenView, ...]:
    """The views of a run so far that showed the target, in the order taken; FormatError for those of another cell."""
    keys = [key for key, _ in journal.results() if key.phase == PHASE and key.kind == "view"]
    records = [(key, journal.read(key, lambda record: view_of(record, shape))) for key in keys]
    return tuple(
        SeenView(f"{key.constraint}-{key.position:02d}", record.view.corners)
        for key, record in records
        if record.view is not None
    )


def _counts(active: Joints, passive: Joints, corners: Array) -> tuple[tuple[int, int], int]:
    return (len(active), len(passive)), len(corners)
