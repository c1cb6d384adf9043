"""The cell as it truly is; nothing outside the simulator's backend may read it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from backends.simulator.mechanics import Approach, JointErrors, directions, displacement, true_chain
from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig, SimulationConfig

_DOWN = np.array([0.0, 0.0, -1.0])  # in the bases


class Truth:
    """True transforms and chains, at true angles of the joints and times in s.

    chains: of each arm, its thermal growth left out. T_P_A (4, 4): as the simulation starts; T_H_E (4, 4): of an
    unbent mount; T_F_T (4, 4): before the target slips.
    """

    def __init__(self, cell: CellConfig, simulation: SimulationConfig) -> None:
        self._active, self._passive = cell.active_name, cell.passive_name
        errors, seed = simulation.errors, simulation.seed
        self._errors = errors
        self._drift, self._slip = (directions(seed, error) for error in ("base_drift", "target_slip"))
        mount = errors.target_mount
        mounted = displacement(directions(seed, "target_mount"), mount.translation, mount.rotation)
        self.T_P_A: Array = simulation.truth.T_P_A
        self.T_H_E: Array = simulation.truth.T_H_E
        self.T_F_T: Array = simulation.truth.target_mount(cell) @ mounted
        known = simulation.truth.chains(cell)
        self.chains = {name: true_chain(name, chain, errors, seed) for name, chain in known.items()}
        self._joints = {
            name: JointErrors(name, robot, self.chains[name], errors, seed) for name, robot in cell.arms.items()
        }

    def approach(self, before: Approach, stretches: Iterable[Array], end: float) -> Approach:
        """How an arm comes to rest at time ``end`` that goes on by straight ``stretches`` (n,) in rad."""
        for way in stretches:
            before = before.then(way, self._errors.backlash.gap, end)
        return before

    def link_angles(self, arm: str, read: Array, approach: Approach, when: float) -> Array:
        """(n,) rad at which the arm's links stand where ideal encoders read ``read`` (n,) rad."""
        if arm not in self._joints:  # a stand, which has none
            return read
        return read + self._joints[arm].deviation(read, approach, when)

    def T_P_E(self, q_a: Array, when: float) -> Array:
        """(4, 4): the camera in the passive base with the active arm's links at ``q_a`` (n,) rad."""
        T_A_H = self._grown(self.chains[self._active].forward(q_a), when)
        return self.T_P_A @ self._wandered(when) @ T_A_H @ self._bent(T_A_H[:3, :3]) @ self.T_H_E

    def T_E_T(self, q_a: Array, q_p: Array, when: float) -> Array:
        """(4, 4): the target in the camera with the arms' links at ``q_a`` and ``q_p`` (n,) rad."""
        T_P_F = self._grown(self.chains[self._passive].forward(q_p), when)
        return inverse(self.T_P_E(q_a, when)) @ T_P_F @ self.T_F_T @ self._slipped(when)

    def _wandered(self, when: float) -> Array:
        drift = self._errors.base_drift
        return displacement(self._drift, drift.translation * when, drift.rotation * when)

    def _slipped(self, when: float) -> Array:
        slip = self._errors.target_slip
        return displacement(self._slip, slip.translation, slip.rotation) if when >= slip.at_s else np.eye(4)

    def _grown(self, T: Array, when: float) -> Array:
        """A flange (4, 4) of an arm all of whose lengths have grown."""
        return transform(T[:3, :3], self._errors.thermal.factor(when) * T[:3, 3])

    def _bent(self, R_A_H: Array) -> Array:
        """(4, 4): what the camera's mount bends by where the flange is turned by R_A_H (3, 3)."""
        lean = np.cross(self.T_H_E[:3, 2], R_A_H.T @ _DOWN)
        return transform(rotation_from_vector(self._errors.mount_flex.bend * lean), np.zeros(3))
