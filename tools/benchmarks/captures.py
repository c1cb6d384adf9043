"""Captures of a simulated cell without its images, for what its errors do to the result: exact but for them, and fast.

The arms stand where recorded captures have them, the passive arm brings the feature point onto the axis, and the true
optics project the true corners.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backends.simulator.mechanics import Approach
from backends.simulator.optics import true_intrinsics
from backends.simulator.surface import Surface
from backends.simulator.truth import Truth
from dualcal_hal.config import CellConfig, RobotConfig, SimulationConfig
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.transforms import Array, apply
from procedures.estimation.projection import project, undistort

INTERVAL = 10.0
"""s of simulated time from one capture to the next."""

REST = 1.0
"""s from the arms' coming to rest to the picture."""

_EXACT = 1e-5  # px in each axis
_ALIGNED = 0.1  # px in each axis, the servo's tolerance: backlash leaves no more accurate place
_STEPS = 15


def simulated_captures(cell: CellConfig, simulation: SimulationConfig, poses: Captures) -> Captures:
    """What the simulated cell would give for the ``poses``, without noise.

    Raises RuntimeError for a pose that cannot be aligned.
    """
    bench = _Bench(cell, simulation)
    return replace(poses, captures=tuple(map(bench.capture, poses.captures)))


class _Arm:
    """An arm that goes from capture to capture; ``read`` is where its encoders have it, (n,) rad."""

    def __init__(self, robot: RobotConfig, truth: Truth) -> None:
        self._truth = truth
        self.read = robot.home
        self.approach = Approach.at_rest(robot.chain.joints)

    def go(self, read: Array, when: float) -> None:
        self.approach = self._truth.approach(self.approach, [read - self.read], when)
        self.read = read


class _Bench:
    def __init__(self, cell: CellConfig, simulation: SimulationConfig) -> None:
        self._cell, self._errors = cell, simulation.errors
        self._truth = Truth(cell, simulation)
        self._corners = Surface.of(cell.target.board, simulation.errors).points(cell.target.board.corners)
        self._known = cell.camera.intrinsics
        self._camera = true_intrinsics(self._known, simulation.errors)
        self._active, self._passive = (_Arm(arm, self._truth) for arm in (cell.active, cell.passive))
        self._now = 0.0

    def capture(self, pose: CaptureRecord) -> CaptureRecord:
        self._now += INTERVAL
        self._active.go(np.array(pose.active_joints), self._now)
        self._passive.go(np.array(pose.passive_joints), self._now)
        for tolerance in [_EXACT] * _STEPS + [_ALIGNED] * _STEPS:
            T_P_E, T_E_T = self._truth_now()
            corners = self._seen(T_E_T)
            feature = corners[self._cell.target.board.feature]
            if np.all(np.abs(feature - self._known.principal_point) <= tolerance):
                return replace(
                    pose,
                    passive_joints=tuple(self._passive.read.tolist()),
                    feature=tuple(feature.tolist()),
                    corners=tuple(map(tuple, corners.tolist())),
                )
            self._correct(feature, T_P_E, T_E_T[2, 3])
        raise RuntimeError(f"{pose.id}: not aligned after {2 * _STEPS} corrections")

    def _truth_now(self) -> tuple[Array, Array]:
        """T_P_E and T_E_T (4, 4), long after the arms have come to rest."""
        when = self._now + REST
        names = self._cell.active_name, self._cell.passive_name
        q_a, q_p = (
            self._truth.link_angles(name, arm.read, arm.approach, when)
            for name, arm in zip(names, (self._active, self._passive), strict=True)
        )
        return self._truth.T_P_E(q_a, when), self._truth.T_E_T(q_a, q_p, when)

    def _seen(self, T_E_T: Array) -> Array:
        """(n, 2) px"""
        bias = self._errors.corner_bias
        pixels = project(apply(T_E_T, self._corners), self._camera.matrix, self._camera.distortion)
        return np.asarray(pixels + [bias.right_px, bias.down_px])

    def _correct(self, feature: Array, T_P_E: Array, depth: float) -> None:
        """Shift the target across the axis, by the smallest move of the joints."""
        lateral = depth * undistort(feature, self._known.matrix, self._known.distortion)
        # The target is so near to the flange that its Jacobian is good enough.
        J = self._cell.passive.chain.jacobian(self._passive.read)
        self._passive.go(self._passive.read - np.linalg.pinv(J[:3]) @ T_P_E[:3, :2] @ lateral, self._now)
