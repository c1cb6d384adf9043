"""The simulator's truth, which only the command line compares a frozen result with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from dualcal_hal import registry
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.config import StandTruthConfig
from dualcal_hal.session.conduct import read_conduct
from dualcal_hal.session.folder import CELL_FILE, Session
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME
from dualcal_hal.transforms import Array


def simulated_truth(file: CellFile, session: Path) -> Mapping[str, Array] | None:
    """The true transforms by their public names, or None where what was run is no simulated cell.

    session: the folder of the run, which says whether its devices were those of an emulator, which simulates what the
    cell file says; any other folder for captures without one.
    """
    if file.simulation is None or not (_is_simulated(file) or read_conduct(Session(session)).emulated):
        return None
    return told_truth(file)


def told_truth(file: CellFile) -> Mapping[str, Array] | None:
    """The true transforms that a cell file tells, None if it tells none; whoever asks knows that it was simulated."""
    if file.simulation is None:
        return None
    truth = file.simulation.truth
    if file.one_arm is not None and isinstance(truth, StandTruthConfig):
        return dict(zip(file.one_arm.names, (truth.transforms.camera, truth.transforms.target), strict=True))
    return {T_P_A_NAME: truth.T_P_A, T_H_E_NAME: truth.T_H_E}


def _is_simulated(file: CellFile) -> bool:
    cell = file.cell
    used = [cell.backends[name] for name in {*(arm.backend for arm in cell.arms.values()), cell.camera.backend}]
    return all(
        _was_simulated(Path(entry.options["session"])) if entry.type == "replay" else registry.is_simulated(entry.type)
        for entry in used
    )


def _was_simulated(recording: Path) -> bool:
    """Whether a recorded run was one of a simulated cell; of one that is gone that is not known."""
    session = recording if recording.is_dir() else recording.parent
    if not (session / CELL_FILE).exists():
        return False
    return simulated_truth(load_cell(session / CELL_FILE, meshes=False, backends=False), session) is not None
