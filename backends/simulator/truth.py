"""The cell as it truly is; nothing outside the simulator's backend may read it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualcal_hal.transforms import Array, inverse

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig, SimulationConfig


class Truth:
    """True transforms and chains, for true angles of the joints."""

    def __init__(self, cell: CellConfig, simulation: SimulationConfig) -> None:
        self._active, self._passive = cell.active_name, cell.passive_name
        self.T_P_A: Array = simulation.truth.T_P_A
        self.T_H_E: Array = simulation.truth.T_H_E
        self.T_F_T: Array = cell.passive.target_mount_transform
        self.chains = simulation.truth.chains(cell)

    def T_E_T(self, q_a: Array, q_p: Array) -> Array:
        """(4, 4): the target in the camera with the arms' joints truly at ``q_a`` and ``q_p`` (n,) rad."""
        T_P_E = self.T_P_A @ self.chains[self._active].forward(q_a) @ self.T_H_E
        return inverse(T_P_E) @ self.chains[self._passive].forward(q_p) @ self.T_F_T
