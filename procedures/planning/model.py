"""The cell as planning sees it: kinematics, limits and shapes, without any device."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.camera import Intrinsics
from dualcal_hal.config import CellConfig, RobotConfig
from dualcal_hal.geometry import CellGeometry
from dualcal_hal.geometry.exact import ExactCell
from dualcal_hal.kinematics import Chain
from dualcal_hal.robot import Joints
from dualcal_hal.session.plain import Fields
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array, Mask, inverse
from procedures.estimation.projection import project
from procedures.planning.belief import Belief

CAMERA_ERROR = 0.010, np.deg2rad(6.0)
"""m and rad, about the lens, by which the nominal hand-eye transform may be wrong as far as the camera's shape goes."""

IMAGE_MARGIN = 20.0
"""The whole target stays this far (px) inside the image."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """One arm's kinematics, the limits a procedure keeps and where it rests.

    lower, upper: (n,) rad, inside the arm's own limits by limit_margin; home: (n,) rad; speed: (n,) rad/s;
    acceleration: (n,) rad/s^2; joint_sigma: rad.
    """

    name: str
    chain: Chain
    lower: Array
    upper: Array
    limit_margin: Array
    home: Array
    speed: Array
    acceleration: Array
    joint_sigma: float

    @staticmethod
    def of(name: str, robot: RobotConfig) -> ArmModel:
        margin = robot.limit_margin
        return ArmModel(
            name,
            robot.chain,
            robot.lower + margin,
            robot.upper - margin,
            margin,
            robot.home,
            robot.speed,
            robot.acceleration,
            robot.joint_sigma,
        )

    def within_limits(self, q: ArrayLike) -> Mask:
        """Which of the joint angles (..., n) are within the procedure's limits, (..., n)."""
        q = np.asarray(q, dtype=float)
        return np.asarray((q >= self.lower) & (q <= self.upper))

    def joint_margin(self, q: ArrayLike) -> Array:
        """How far (...,) in rad the nearest of the joint angles (..., n) is inside the procedure's limits."""
        q = np.asarray(q, dtype=float)
        return np.asarray(np.min(np.minimum(q - self.lower, self.upper - q), axis=-1))

    def manipulability(self, q: ArrayLike) -> Array:
        """T. Yoshikawa's measure (...,) at joint angles (..., n), sqrt(det J J^T) of the flange: m^3 for six joints.

        Zero in a singular posture (Manipulability of Robotic Mechanisms, 1985).
        """
        J = self.chain.jacobian(q)
        return np.asarray(np.sqrt(np.maximum(np.linalg.det(J @ np.swapaxes(J, -1, -2)), 0.0)))

    def move_time(self, start: ArrayLike, goal: ArrayLike) -> Array:
        """Seconds (...,) of straight moves between joint angles (..., n), by trapezoids of velocity from rest to rest.

        The joints move in proportion: the slowest sets the pace.
        """
        way = np.abs(np.asarray(goal, dtype=float) - np.asarray(start, dtype=float))
        slowest = np.max(way / self.speed, axis=-1, initial=0.0)  # of a stand there is no joint
        least_gain = np.max(way / self.acceleration, axis=-1, initial=0.0)
        ramp = least_gain / np.maximum(slowest, 1e-12)
        reaches_speed = ramp <= slowest
        return np.asarray(np.where(reaches_speed, slowest + ramp, 2 * np.sqrt(least_gain)))

    def nearest_turn(self, q: Array, reference: Array) -> Array:
        """Angles (..., n), each turned by whole turns to the one nearest to the reference within the limits."""
        turn = 2 * np.pi
        near = q - turn * np.round((q - reference) / turn)
        near = np.where(near > self.upper, near - turn, near)
        near = np.where(near < self.lower, near + turn, near)
        return np.asarray(np.where(self.within_limits(near), near, q))


@dataclass(frozen=True)
class Posture:
    """Joint angles of both arms, rad."""

    active: Joints
    passive: Joints

    @staticmethod
    def of(q_a: ArrayLike, q_p: ArrayLike) -> Posture:
        return Posture(tuple(map(float, np.asarray(q_a))), tuple(map(float, np.asarray(q_p))))

    def to_record(self) -> dict[str, Any]:
        """As plain JSON."""
        return {"active_rad": self.active, "passive_rad": self.passive}

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        """And back, to the last bit; ValueError."""
        fields = Fields(record, "the posture")
        return cls(fields.joints("active_rad"), fields.joints("passive_rad"))


class CellModel:
    """Everything about the cell that planning needs and the cell file says, without ``simulation``."""

    def __init__(self, cell: CellConfig) -> None:
        self._cell = cell
        self.active = ArmModel.of(cell.active_name, cell.active)
        self.passive = ArmModel.of(cell.passive_name, cell.passive)
        self.T_F_T: Array = cell.passive.target_mount_transform
        self.board: Target = cell.target.board
        self.intrinsics: Intrinsics = cell.camera.intrinsics
        self.distance: tuple[float, float] = cell.procedure.distance
        self.tilt_max: float = cell.procedure.tilt_max
        self.margin: float = cell.clearance
        given = cell.procedure.stand_off
        self.stand_off = None if given is None else Posture.of(given.active, given.passive)
        self.nominal = Belief.nominal(cell.nominal)
        # Without looks the nominal transforms are all there is, and taken as exact.
        self.geometry = CellGeometry.of(cell, camera_error=_camera_error(cell) if cell.procedure.first_looks else 0.0)
        self._T_H_E = self.nominal.T_H_E
        # The plate may not leave the image either: its margin helps nobody but the eye that looks for the corners.
        self._in_view = np.concatenate([self.board.corners, self.board.outline])

    def require_joints(self, active: Joints, passive: Joints) -> None:
        """ValueError where these angles, which come from somewhere else, are not as many as the arms have joints."""
        for arm, angles in ((self.active, active), (self.passive, passive)):
            if len(angles) != arm.chain.joints:
                raise ValueError(f"'{arm.name}' has {arm.chain.joints} joints, not {len(angles)}")

    @cached_property
    def exact(self) -> ExactCell:
        """The cell in its true shapes, slow: for the final check."""
        return ExactCell.of(self._cell, self._T_H_E)

    def believing(self, belief: Belief) -> Self:
        """The same cell with the camera's housing where a belief from enough looks says."""
        if belief.placement.T_P_A is self.nominal.placement.T_P_A:
            return self
        other = self.but(geometry=CellGeometry.of(self._cell, belief.T_H_E), _T_H_E=belief.T_H_E)
        vars(other).pop("exact", None)
        return other

    def but(self, **changes: object) -> Self:
        """The same cell with some of its attributes changed; its shapes stay."""
        other = copy(self)
        vars(other).update(changes)
        return other

    @property
    def home(self) -> Posture:
        return Posture.of(self.active.home, self.passive.home)

    def arm(self, name: str) -> ArmModel:
        return {self.active.name: self.active, self.passive.name: self.passive}[name]

    def camera_in_passive(self, q_a: ArrayLike, belief: Belief) -> Array:
        """``T_P_E`` (..., 4, 4) at the active arm's joint angles (..., n)."""
        return np.asarray(belief.T_P_A @ self.active.chain.forward(q_a) @ belief.T_H_E)

    def target_in_passive(self, q_p: ArrayLike) -> Array:
        """``T_P_T`` (..., 4, 4) at the passive arm's joint angles (..., n)."""
        return np.asarray(self.passive.chain.forward(q_p) @ self.T_F_T)

    def project_board(self, T_E_T: Array, points: Array | None = None) -> Array:
        """Pixels (..., k, 2) of the board's corners, or of points (k, 3) in T; those behind the camera are NaN."""
        points = self.board.corners if points is None else points
        in_camera = points @ np.swapaxes(T_E_T[..., :3, :3], -1, -2) + T_E_T[..., None, :3, 3]
        behind = in_camera[..., 2:] <= 1e-3
        pixels = project(
            np.where(behind, [0.0, 0.0, 1.0], in_camera), self.intrinsics.matrix, self.intrinsics.distortion
        )
        return np.where(behind, np.nan, pixels)

    def predict_corners(self, q_a: ArrayLike, q_p: ArrayLike, belief: Belief) -> Array:
        """Pixels (..., corners, 2) at which the corners should appear."""
        return self.project_board(inverse(self.camera_in_passive(q_a, belief)) @ self.target_in_passive(q_p))

    def in_view(self, T_E_T: Array) -> Mask:
        """Which of (k, 4, 4) show the whole pattern from its front, inside the image by a margin."""
        pixels = self.project_board(T_E_T, self._in_view)
        size = np.array(self.intrinsics.size, dtype=float)
        inside = np.all((pixels >= IMAGE_MARGIN) & (pixels <= size - 1 - IMAGE_MARGIN), axis=(-1, -2))
        facing = -np.einsum("...i,...i->...", T_E_T[..., :3, 2], T_E_T[..., :3, 3]) > 0
        return np.asarray(inside & facing)


def _camera_error(cell: CellConfig) -> float:
    """How far (m) the ends of the camera's capsule may be from where the nominal hand-eye transform has them."""
    translation, rotation = CAMERA_ERROR
    return float(translation + 2 * np.sin(rotation / 2) * (cell.camera.body_radius + cell.camera.body_length))
