"""Alignment (paper, section 4.2): the passive arm brings the feature point onto the optical axis.

A picture is taken after each settled move. The passive arm shifts the target in the camera plane and keeps its
orientation; the image Jacobian comes from the board's pose in the constraint's first picture, is corrected by what
moves bring about (Broyden) and kept along the constraint.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from dualcal_hal.errors import UsageError
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array, inverse, rotation_angle, transform
from procedures.analysis.paper import FARTHEST_ALIGNED
from procedures.detection import Detection, Detector, Miss, Missed, board_poses
from procedures.estimation.projection import undistort
from procedures.going import go
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel, Posture
from procedures.planning.refine import arrival_scatter
from procedures.planning.ways import WayFinder
from procedures.seeing import see
from procedures.steps import Procedure, Sighting

MOST_FRAMES = 12
LONGEST_STEP = 0.3
"""m; a longer correction is a wrong one."""

LEAST_CHANGE_PX = 0.5
"""px; smaller changes are noise and teach the Jacobian nothing."""

AUTO_TOLERANCE = 2.8
"""``auto`` in units of the arrivals' scatter: 99 % of arrivals at the right place are within it in both axes."""

SMALL_CORRECTION_PX = 3.0
"""After a correction this small (px) what is left of the offset is the arrival's scatter, not the servo's error."""

MEDIAN_TO_SIGMA = 1.4826
"""Sigma of a normal distribution over the median of its magnitudes."""

LEAST_ARRIVALS = 8
"""Arrivals after small corrections from which on their scatter counts as measured."""

LEAST_AUTO_PX = 0.02
"""px; ``auto`` does not go below what the detection of corners resolves."""

_FEATURE_HIDDEN = Missed(Miss.OCCLUDED, "the feature point is not seen; look what is in front of it")
_POSE_ROTATION_SIGMA = 0.03  # rad; orientation of a small board from one picture
_WORST_CONDITION = 5.0  # of the Jacobian, in units in which it is near a rotation


class Outcome(StrEnum):
    ALIGNED = "aligned"
    SEEN = "seen"
    """And not to be aligned: a view of a cell with one arm."""
    NOT_CONVERGED = "not converged"
    LOST = "lost"
    OUT_OF_REACH = "out of reach"


@dataclass(frozen=True, eq=False)
class Alignment:
    """What came of one point. ``sighting`` and ``detection`` are of the last picture that showed the target.

    ``arrivals``: offsets (2,) in px that were left after small corrections.
    """

    outcome: Outcome
    frames: int
    offset: Array | None  # (2,) px from the principal point
    reason: str = ""
    sighting: Sighting | None = None
    detection: Detection | None = None
    arrivals: tuple[Array, ...] = ()

    @property
    def captured(self) -> bool:
        """Whether the point is one to calibrate with."""
        if self.outcome is Outcome.ALIGNED:
            return True
        near = self.offset is not None and bool(np.max(np.abs(self.offset)) <= FARTHEST_ALIGNED)
        return self.outcome is Outcome.NOT_CONVERGED and near


def tolerance_px(model: CellModel, wanted: float | str, arrivals: Sequence[Array] = ()) -> float:
    """The tolerance in px per axis.

    ``auto`` follows the scatter of arrivals: the one that the stated joint noise implies or, where it is larger, the
    one of the ``arrivals`` so far (offsets (2,) in px that were left after small corrections), up to what still counts
    as aligned. Raises UsageError for a tolerance below twice the implied scatter, which most arrivals would miss.
    """
    scatter = arrival_scatter(model)
    if wanted == "auto":
        if len(arrivals) >= LEAST_ARRIVALS:
            # By the median: one arrival gone astray must not open the door to others.
            scatter = max(scatter, MEDIAN_TO_SIGMA * float(np.median(np.abs(arrivals))))
        return min(max(LEAST_AUTO_PX, AUTO_TOLERANCE * scatter), FARTHEST_ALIGNED)
    tolerance = float(wanted)
    if tolerance < 2 * scatter:
        raise UsageError(
            f"procedure.tolerance_px: {tolerance:g} px is below twice the scatter of arrivals, {2 * scatter:.3f} px, "
            f"that joint_sigma_mrad of '{model.passive.name}' implies; allow more or write auto"
        )
    return tolerance


def largest_alignment_error(model: CellModel, tolerance: float) -> float:
    """``e_c_max`` in m at the largest distance (paper, eqs. 17 and 18)."""
    focal = model.intrinsics.matrix[[0, 1], [0, 1]]
    return float(np.linalg.norm(tolerance * model.distance[1] / focal))


@dataclass
class AxisTrack:
    """Where the optical axis runs in P: as believed, corrected by the points already aligned with it.

    T_P_E: (4, 4) camera as believed; direction_sigma: rad per axis; point_sigma: m per axis of one aligned point.
    """

    T_P_E: Array
    direction_sigma: float
    point_sigma: float
    _points: list[Array] = field(default_factory=list)

    def add(self, point_on_axis: Array) -> None:
        """Learn from a point (3,) in P that lies on the axis."""
        self._points.append(inverse(self.T_P_E)[:3, :3] @ (point_on_axis - self.T_P_E[:3, 3]))

    def at(self, distance: float) -> Array:
        """The point (3,) in P on the axis at a distance (m) from the camera.

        A straight line through the points, least squares, its direction held to the believed one by that
        direction's uncertainty; through one point it runs parallel to the belief.
        """
        lateral = np.zeros(2)
        if self._points:
            points = np.array(self._points)
            depth = points[:, 2] - points[:, 2].mean()
            stiffness = (self.point_sigma / max(self.direction_sigma, 1e-9)) ** 2
            slope = depth @ points[:, :2] / (depth @ depth + stiffness)
            lateral = points[:, :2].mean(axis=0) + slope * (distance - points[:, 2].mean())
        return np.asarray(self.T_P_E[:3, 3] + self.T_P_E[:3, :3] @ [*lateral, distance])


class Servo:
    """The image Jacobian of one constraint: how the feature moves across the axis when the target is shifted.

    In metres on both sides (offset times depth over focal length), so it keeps its value along the axis: the
    identity if the camera's orientation were known exactly.
    """

    def __init__(self, first: Array, jacobian: Array | None = None) -> None:
        """``first`` (2, 2) is what it falls back on; ``jacobian`` (2, 2) what moves have made of it so far."""
        self.first = first
        self.jacobian = (first if jacobian is None else jacobian).copy()

    def step(self, lateral: Array) -> Array:
        """The shift (2,) in m in the believed camera plane that takes away an offset (2,) in m."""
        if np.linalg.cond(self.jacobian) > _WORST_CONDITION:
            self.jacobian = self.first.copy()
        shift = -np.linalg.solve(self.jacobian, lateral)
        return np.asarray(shift * min(1.0, LONGEST_STEP / max(float(np.linalg.norm(shift)), 1e-12)))

    def learn(self, shift: Array, change: Array) -> None:
        """Broyden's update by a shift (2,) and the change (2,) of the offset that it brought, both in m."""
        length = float(shift @ shift)
        if length > 0.0:
            self.jacobian = self.jacobian + np.outer(change - self.jacobian @ shift, shift) / length


class Aligner:
    """Aligns points of one constraint."""

    def __init__(self, model: CellModel, belief: Belief, ways: WayFinder, detector: Detector, tolerance: float) -> None:
        self._model, self._belief, self._ways = model, belief, ways
        self._detector, self._tolerance = detector, tolerance
        self._servo: Servo | None = None

    @property
    def servo(self) -> Servo | None:
        """As the points so far have left it, None before the first correction."""
        return self._servo

    def go_on_with(self, servo: Servo | None) -> None:
        """Use what the position before ended with; None where it has needed no correction."""
        if servo is not None:
            self._servo = Servo(servo.first, servo.jacobian)

    def align(self, active: Joints, passive: Joints, T_P_T: Array, camera: Array) -> Procedure[Alignment]:
        """Bring the target from where it is to ``T_P_T`` and from there onto the axis.

        active: the constraint's joint angles; passive: joint angles near the goal; camera: believed T_P_E.
        """
        goal, near = T_P_T.copy(), passive
        frames = 0
        arrivals: tuple[Array, ...] = ()
        last: tuple[Array, Array, Array] | None = None  # shift, lateral and offset of the picture before
        reply = Alignment(Outcome.NOT_CONVERGED, 0, None)
        while frames < MOST_FRAMES:
            joints = self._reach(goal, near)
            if joints is None:
                why = "not reached by the passive arm"
                return Alignment(Outcome.OUT_OF_REACH, frames, reply.offset, why, arrivals=arrivals)
            if not (yield from go(self._ways, Posture(active, joints))):
                return Alignment(Outcome.OUT_OF_REACH, frames, reply.offset, "no clear way", arrivals=arrivals)
            near = joints
            picture = yield from see(self._model, self._detector, self._belief)
            frames += 1
            if picture.sighting is None:
                # An arm was not at rest yet; the same place is tried again.
                reply = replace(reply, frames=frames, reason=picture.reason)
                continue
            if picture.detection is None or not (picture.detection.order_known or self._model.board.feature_is_central):
                return Alignment(Outcome.LOST, frames, reply.offset, picture.reason, arrivals=arrivals)
            sighting, seen = picture.sighting, picture.detection
            if not np.all(np.isfinite(seen.feature)):
                return Alignment(Outcome.LOST, frames, reply.offset, str(_FEATURE_HIDDEN), arrivals=arrivals)
            offset = seen.feature - self._model.intrinsics.principal_point
            if last is not None and np.all(np.abs(last[2]) <= SMALL_CORRECTION_PX):
                arrivals = (*arrivals, offset)
            if np.all(np.abs(offset) <= self._tolerance):
                return Alignment(Outcome.ALIGNED, frames, offset, "", sighting, seen, arrivals)
            reason = f"{MOST_FRAMES} pictures"
            reply = Alignment(Outcome.NOT_CONVERGED, frames, offset, reason, sighting, seen, arrivals)
            lateral, servo = self._lateral(sighting, seen)
            if last is not None and np.linalg.norm(offset - last[2]) >= LEAST_CHANGE_PX:
                servo.learn(last[0], lateral - last[1])
            shift = servo.step(lateral)
            last = (shift, lateral, offset)
            goal[:3, 3] += camera[:3, :2] @ shift
        return reply

    def _reach(self, T_P_T: Array, near: Joints) -> Joints | None:
        arm = self._model.passive
        q, reached = arm.chain.inverse(T_P_T @ inverse(self._model.T_F_T), [near], arm.lower, arm.upper)
        return tuple(map(float, q[0])) if reached[0] else None

    def _lateral(self, sighting: Sighting, seen: Detection) -> tuple[Array, Servo]:
        """The feature's offset across the axis (2,) in m, and the constraint's servo."""
        model = self._model
        poses = [T for T, _ in board_poses(seen.corners, model.board, model.intrinsics)]
        T_P_E = model.camera_in_passive(sighting.active, self._belief)
        T_P_T = model.target_in_passive(sighting.passive)
        predicted = inverse(T_P_E) @ T_P_T
        T_E_T = min(poses, key=lambda T: float(rotation_angle(T[:3, :3], predicted[:3, :3])))
        if self._servo is None:
            self._servo = Servo(self._first_jacobian(sighting, T_E_T, T_P_T, T_P_E) if seen.order_known else np.eye(2))
        intrinsics = model.intrinsics
        ray = undistort(seen.feature, intrinsics.matrix, intrinsics.distortion)
        return np.asarray(ray * T_E_T[2, 3]), self._servo

    def _first_jacobian(self, sighting: Sighting, T_E_T: Array, T_P_T: Array, T_P_E: Array) -> Array:
        """From the board's pose, unless the camera's orientation is known better than one picture tells it."""
        sigma = self._belief.rotation_sigma(self._model.active.chain.forward(sighting.active))
        if sigma < _POSE_ROTATION_SIGMA:
            return np.eye(2)
        R_E_P = T_E_T[:3, :3] @ T_P_T[:3, :3].T
        return np.asarray((R_E_P @ T_P_E[:3, :2])[:2])


def point_on_axis(model: CellModel, passive: Joints, feature: Array, T_P_E: Array) -> Array:
    """The point (3,) in P on the axis beside the feature: where the joints say it is, less its offset in the image.

    feature: (2,) px.
    """
    point = model.target_in_passive(passive)[:3, 3]
    depth = (inverse(T_P_E)[:3, :3] @ (point - T_P_E[:3, 3]))[2]
    ray = undistort(feature, model.intrinsics.matrix, model.intrinsics.distortion)
    return np.asarray(point - T_P_E[:3, :2] @ (ray * depth))


def target_on_axis(model: CellModel, track: AxisTrack, passive: Joints, distance: float) -> Array:
    """``T_P_T`` (4, 4) with the planned orientation of the target, its feature point on the axis at a distance."""
    return transform(model.target_in_passive(passive)[:3, :3], track.at(distance))
