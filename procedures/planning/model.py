"""The cell as planning sees it: kinematics, limits and shapes, without any device."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.camera import Intrinsics
from dualcal_hal.config import CellConfig, RobotConfig
from dualcal_hal.geometry import CellGeometry
from dualcal_hal.kinematics import Chain
from dualcal_hal.robot import Joints
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, Mask, inverse
from procedures.estimation.projection import project
from procedures.planning.belief import Belief

IMAGE_MARGIN = 20.0
"""The whole target stays this far (px) inside the image."""


@dataclass(frozen=True, eq=False)
class ArmModel:
    """One arm's kinematics, the limits a procedure keeps (rad) and where it rests."""

    name: str
    chain: Chain
    lower: Array
    upper: Array
    home: Array
    joint_sigma: float

    @staticmethod
    def of(name: str, robot: RobotConfig) -> ArmModel:
        margin = robot.limit_margin
        return ArmModel(
            name,
            robot.chain,
            robot.lower + margin,
            robot.upper - margin,
            robot.home,
            robot.joint_sigma,
        )

    def nearest_turn(self, q: Array, reference: Array) -> Array:
        """Each angle of (k, n) turned by whole turns to the one nearest to the reference within the limits."""
        turn = 2 * np.pi
        near = q - turn * np.round((q - reference) / turn)
        near = np.where(near > self.upper, near - turn, near)
        near = np.where(near < self.lower, near + turn, near)
        return np.asarray(np.where((near > self.upper) | (near < self.lower), q, near))


@dataclass(frozen=True)
class Posture:
    """Joint angles of both arms, rad."""

    active: Joints
    passive: Joints

    @staticmethod
    def of(q_a: ArrayLike, q_p: ArrayLike) -> Posture:
        return Posture(tuple(map(float, np.asarray(q_a))), tuple(map(float, np.asarray(q_p))))


class CellModel:
    """Everything about the cell that planning needs and the cell file says, without ``simulation``."""

    def __init__(self, cell: CellConfig) -> None:
        self.active = ArmModel.of(cell.active_name, cell.active)
        self.passive = ArmModel.of(cell.passive_name, cell.passive)
        self.T_F_T: Array = cell.passive.target_mount_transform
        self.board: Checkerboard = cell.target.board
        self.intrinsics: Intrinsics = cell.camera.intrinsics
        self.distance: tuple[float, float] = cell.procedure.distance
        self.tilt_max: float = cell.procedure.tilt_max
        self.margin: float = cell.procedure.clearance
        self.nominal = Belief.nominal(cell.nominal)
        self.geometry = CellGeometry.of(cell)
        # The plate may not leave the image either: its margin helps nobody but the eye that looks for the corners.
        self._in_view = np.concatenate([self.board.corners, self.board.outline])

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
