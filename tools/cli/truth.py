"""The simulator's truth, which only the command line compares a frozen result with."""

from __future__ import annotations

from collections.abc import Mapping

from dualcal_hal.cellfile import CellFile
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME
from dualcal_hal.transforms import Array


def simulated_truth(file: CellFile) -> Mapping[str, Array] | None:
    """The true transforms by their public names, or None for a cell without simulation."""
    if file.simulation is None:
        return None
    return {T_P_A_NAME: file.simulation.truth.T_P_A, T_H_E_NAME: file.simulation.truth.T_H_E}
