"""The paper's cell and its reference captures as plain arrays, with the noise of METHOD's table."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.transforms import Array, rotation_from_vector, transform

REFERENCE = Path(__file__).parent / "data" / "reference-7x4.json"
DOCUMENT: dict[str, Any] = json.loads(REFERENCE.read_text())
EXPECTED: dict[str, Any] = DOCUMENT["expected"]

T_P_A = np.array(EXPECTED["active_base_in_passive_base"])
T_H_E = np.array(EXPECTED["camera_in_active_flange"])
NOMINAL_T_P_A = np.array(EXPECTED["nominal"]["active_base_in_passive_base"])
NOMINAL_T_H_E = np.array(EXPECTED["nominal"]["camera_in_active_flange"])
T_F_T = np.array(EXPECTED["target_in_passive_flange"])
FOCAL = DOCUMENT["camera"]["matrix"][0][0]


def _chain(*rows: tuple[float, float, float | None, float, float | None]) -> Chain:
    """Rows as printed: alpha (deg), a (mm), d (mm), theta (deg), beta (deg)."""
    return Chain(
        tuple(
            Row(
                theta=np.radians(theta),
                d=(d or 0.0) / 1000,
                a=a / 1000,
                alpha=np.radians(alpha),
                beta=None if beta is None else np.radians(beta),
            )
            for alpha, a, d, theta, beta in rows
        )
    )


ACTIVE = _chain(
    (89.97, 105.9, 136.5, -0.15, None),
    (0.26, 287.8, None, 89.89, 0.05),
    (89.66, 121.4, 4.7, 0.37, None),
    (-90.59, -0.2, 312.3, -0.49, None),
    (89.63, -2.1, -1.2, -90.33, None),
    (0, 60, 123.7, -0.14, None),
)
PASSIVE = _chain(
    (90.35, 105.7, 136.5, -1.37, None),
    (-0.53, 289.0, None, 89.90, 0.52),
    (90.58, 124.5, -3.6, -0.29, None),
    (-91.10, -0.1, 313.6, -1.51, None),
    (91.21, 1.0, 0.7, -91.35, None),
    (0, 60.4, 133.8, -0.48, None),
)


@dataclass(frozen=True)
class Data:
    """Joint angles as read (k, 6), and the constraint of each capture."""

    active: Array
    passive: Array
    constraints: tuple[str, ...]

    @property
    def T_A_H(self) -> Array:
        return ACTIVE.forward(self.active)

    @property
    def T_P_T(self) -> Array:
        return PASSIVE.forward(self.passive) @ T_F_T

    @property
    def p_P_T(self) -> Array:
        return self.T_P_T[:, :3, 3]

    def noisy(self, rng: np.random.Generator, pixel: float, joint: float) -> Data:
        """Readings that miss the truth by ``joint`` (rad, 1 sigma): the active arm's once per arrival, the passive
        arm's per capture, of points off the axis by ``pixel`` (px, 1 sigma, per axis)."""
        arrivals = {name: rng.normal(0, joint, 6) for name in dict.fromkeys(self.constraints)}
        T_P_E = T_P_A @ self.T_A_H @ T_H_E
        depth = np.einsum("ki,ki->k", self.p_P_T - T_P_E[:, :3, 3], T_P_E[:, :3, 2])
        offset = rng.normal(0, pixel / FOCAL, (len(depth), 2)) * depth[:, None]
        shift = np.einsum("kij,kj->ki", T_P_E[:, :3, :2], offset)
        J = np.linalg.pinv(PASSIVE.jacobian(self.passive))[:, :, :3]
        return replace(
            self,
            active=self.active + np.array([arrivals[name] for name in self.constraints]),
            passive=self.passive + np.einsum("kij,kj->ki", J, shift) + rng.normal(0, joint, self.passive.shape),
        )


def reference(use: str) -> Data:
    """The noise-free captures for ``calibration`` or ``verification``."""
    captures = [capture for capture in DOCUMENT["captures"] if capture["use"] == use]
    return Data(
        active=np.array([capture["active_joints_rad"] for capture in captures]),
        passive=np.array([capture["passive_joints_rad"] for capture in captures]),
        constraints=tuple(capture["constraint"] for capture in captures),
    )


@dataclass(frozen=True)
class Aligned:
    """A made-up cell's captures with the feature point on the optical axis exactly, and its truth."""

    T_A_H: Array
    T_P_T: Array
    constraints: tuple[int, ...]
    T_P_A: Array
    T_H_E: Array

    def noisy(self, rng: np.random.Generator, joint: float = 1e-4, point: float = 1e-4) -> Aligned:
        """Flanges turned by ``joint`` (rad per axis, per constraint) and points moved by ``point`` (m per axis)."""
        turns = rng.normal(0, joint, (max(self.constraints) + 1, 3))[list(self.constraints)]
        T_A_H, T_P_T = self.T_A_H.copy(), self.T_P_T.copy()
        T_A_H[:, :3, :3] = T_A_H[:, :3, :3] @ rotation_from_vector(turns)
        T_P_T[:, :3, 3] += rng.normal(0, point, (len(T_P_T), 3))
        return replace(self, T_A_H=T_A_H, T_P_T=T_P_T)


def aligned(rng: np.random.Generator, flanges: Array, T_P_A: Array, T_H_E: Array, positions: int = 4) -> Aligned:
    """Captures for flange orientations (n, 3, 3) at random places, the points 0.3 to 0.5 m in front of the lens."""
    n = len(flanges)
    T_A_H = transform(flanges, rng.uniform([0.2, -0.4, 0.2], [0.6, 0.4, 0.7], (n, 3))).repeat(positions, axis=0)
    T_P_E = T_P_A @ T_A_H @ T_H_E
    depth = np.tile(np.linspace(0.3, 0.5, positions), n)
    points = T_P_E[:, :3, 3] + depth[:, None] * T_P_E[:, :3, 2]
    orientations = rotation_from_vector(rng.normal(0, 1, (len(points), 3)))
    return Aligned(T_A_H, transform(orientations, points), tuple(np.arange(n).repeat(positions).tolist()), T_P_A, T_H_E)
