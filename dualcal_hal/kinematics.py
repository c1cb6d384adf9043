"""Serial arms of revolute joints by Denavit-Hartenberg and Hayati rows.

A row is ``Rz(theta + q) Tz(d) Tx(a) Rx(alpha)``; a row with a beta is Hayati's for near-parallel
neighbours, ``Rz(theta + q) Tx(a) Rx(alpha) Ry(beta)`` (paper, appendix; the product of elementary
transforms, because the printed matrix has misprints). Metres and radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array, Mask, rotation_from_vector, transform, vector_from_rotation


@dataclass(frozen=True)
class Row:
    """One joint: ``theta``, ``alpha``, ``beta`` in rad, ``d``, ``a`` in m; ``beta`` None for a plain DH row."""

    theta: float
    d: float
    a: float
    alpha: float
    beta: float | None = None

    def after_joint(self) -> Array:
        """(4, 4): what follows the turn about the joint's axis, ``Tz(d) Tx(a) Rx(alpha) [Ry(beta)]``."""
        R = rotation_from_vector([self.alpha, 0.0, 0.0])
        if self.beta is not None:
            R = R @ rotation_from_vector([0.0, self.beta, 0.0])
        return transform(R, [self.a, 0.0, self.d])


@dataclass(frozen=True)
class Chain:
    """An arm's calibrated kinematics: one row a joint, base to flange. Of a stand there is none: both are one frame."""

    rows: tuple[Row, ...]

    @property
    def joints(self) -> int:
        return len(self.rows)

    @cached_property
    def _after_joint(self) -> Array:
        return np.array([row.after_joint() for row in self.rows]).reshape(-1, 4, 4)

    @cached_property
    def _theta(self) -> Array:
        return np.array([row.theta for row in self.rows])

    def frames(self, q: ArrayLike) -> Array:
        """Joint angles (..., n) in rad to the frames (..., n + 1, 4, 4) in the base: base, then after each row."""
        q = np.asarray(q, dtype=float)
        if q.shape[-1] != self.joints:
            raise ValueError(f"expected {self.joints} joint angles, got {q.shape[-1]}")
        angles = (q + self._theta).reshape(int(np.prod(q.shape[:-1])), self.joints)
        cosine, sine = np.cos(angles)[:, :, None], np.sin(angles)[:, :, None]
        after = self._after_joint
        rows = np.empty((len(angles), self.joints, 4, 4))
        rows[:, :, 0] = cosine * after[:, 0] - sine * after[:, 1]
        rows[:, :, 1] = sine * after[:, 0] + cosine * after[:, 1]
        rows[:, :, 2:] = after[:, 2:]
        frames = np.empty((len(angles), self.joints + 1, 4, 4))
        frames[:, 0] = np.eye(4)
        for i in range(self.joints):
            np.matmul(frames[:, i], rows[:, i], out=frames[:, i + 1])
        return frames.reshape(*q.shape[:-1], self.joints + 1, 4, 4)

    def forward(self, q: ArrayLike) -> Array:
        """Joint angles (..., n) in rad to the flange in the base, (..., 4, 4)."""
        return self.frames(q)[..., -1, :, :]

    def jacobian(self, q: ArrayLike) -> Array:
        """Geometric Jacobian (..., 6, n) of the flange in the base: linear rows (m/rad), then angular."""
        return _jacobian(self.frames(q))

    def inverse(
        self,
        flange: ArrayLike,
        starts: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        iterations: int = 60,
        tolerance: float = 1e-10,
    ) -> tuple[Array, Mask]:
        """Joint angles that bring the flange to given poses, by damped Newton steps from given starts.

        flange: (k, 4, 4) or (4, 4) poses in the base; starts: (k, n) in rad; lower, upper: (n,) limits
        in rad. Returns the angles (k, n) and which of them (k,) reached their pose within ``tolerance``
        (m and rad) inside the limits. Solutions are those nearest to the start modulo 2 pi. Many
        problems are solved as one batch; a caller wanting restarts repeats a pose with other starts
        (:func:`random_joints`).
        """
        q = np.array(starts, dtype=float, ndmin=2)
        lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        goal = np.broadcast_to(np.asarray(flange, dtype=float), (len(q), 4, 4))
        reached = np.zeros(len(q), dtype=bool)
        pending = np.arange(len(q))
        for _ in range(iterations):
            frames = self.frames(q[pending])
            error = pose_error(frames[:, -1], goal[pending])
            size = np.linalg.norm(error, axis=1)
            arrived = size < tolerance
            reached[pending[arrived]] = True
            pending, frames, error, size = (x[~arrived] for x in (pending, frames, error, size))
            if len(pending) == 0:
                break
            q[pending] += _damped_step(_jacobian(frames), error, size)
        q = _into_limits(q, lower, upper)
        inside = np.all((q >= lower) & (q <= upper), axis=1)
        return q, reached & inside


def pose_error(T: Array, goal: Array) -> Array:
    """What takes poses T (k, 4, 4) to the goals: (k, 6) translation in m and rotation vector in rad, in the base."""
    turn = goal[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2)
    return np.concatenate([goal[:, :3, 3] - T[:, :3, 3], vector_from_rotation(turn)], axis=1)


def random_joints(rng: np.random.Generator, count: int, lower: ArrayLike, upper: ArrayLike) -> Array:
    """(count, n) joint angles in rad, uniform between the limits."""
    lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
    return rng.uniform(lower, upper, size=(count, len(lower)))


def _jacobian(frames: Array) -> Array:
    axes = frames[..., :-1, :3, 2]
    arms = frames[..., -1:, :3, 3] - frames[..., :-1, :3, 3]
    return np.concatenate([np.swapaxes(np.cross(axes, arms), -1, -2), np.swapaxes(axes, -1, -2)], axis=-2)


_LARGEST_STEP = 0.5  # rad; keeps far starts from jumping between branches


def _damped_step(J: Array, error: Array, size: Array) -> Array:
    # Levenberg's damping falls with the error, so the last steps are Newton's.
    damping = np.minimum(1e-2, size**2) * 0.1 + 1e-14
    normal = J @ np.swapaxes(J, 1, 2) + damping[:, None, None] * np.eye(6)
    step = (np.swapaxes(J, 1, 2) @ np.linalg.solve(normal, error[:, :, None]))[:, :, 0]
    largest = np.max(np.abs(step), axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, _LARGEST_STEP / np.maximum(largest, 1e-300)))


def _into_limits(q: Array, lower: Array, upper: Array) -> Array:
    """Turn each angle by whole turns into its limits where that is possible."""
    turn = 2.0 * np.pi
    q = np.where(q > upper, q - turn * np.ceil((q - upper) / turn), q)
    return np.asarray(np.where(q < lower, q + turn * np.ceil((lower - q) / turn), q))
