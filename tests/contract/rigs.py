"""The backends that the contract is held against.

A backend joins by one function here that makes a rig, and its entry in ``RIGS``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from backends.simulator import SimulatorBackend
from dualcal_hal.backend import Backend
from dualcal_hal.camera import Camera
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.config import RobotConfig
from dualcal_hal.robot import JointPath, Joints, Robot

PAPER_CELL = Path(__file__).parents[2] / "cells" / "paper.yaml"


@dataclass(frozen=True)
class Rig:
    """A backend that is not open yet, one that cannot be opened, and what the clauses ask of its devices."""

    backend: Backend
    broken: Backend
    config: RobotConfig
    robot_name: str
    camera_name: str
    timeout: float  # s of the backend's clock, ample for any clause's motion
    repeatability: float  # rad within which readings at the same target agree

    @property
    def robot(self) -> Robot:
        return self.backend.robot(self.robot_name)

    @property
    def camera(self) -> Camera:
        return self.backend.camera(self.camera_name)

    def path(self, *offsets: float) -> JointPath:
        """Waypoints with all joints this far, in rad, from the reference position."""
        waypoints = tuple(self.target(offset) for offset in offsets)
        return JointPath(waypoints, tuple(self.config.speed), tuple(self.config.acceleration))

    def target(self, offset: float) -> Joints:
        return tuple((self.config.home + offset).tolist())


def _simulator(stepper: str, unrest: float) -> Rig:
    """``unrest``: rad that an arm which has settled may stand from its target."""
    chosen = f"simulation.stepper={stepper}"
    cell, folded = _paper_cell(chosen), _paper_cell(chosen, "camera.distortion=[-2, 0, 0, 0, 0]")
    noise = _simulation_noise(cell)
    return Rig(
        backend=SimulatorBackend("sim", cell),
        broken=SimulatorBackend("sim", folded),
        config=cell.cell.active,
        robot_name=cell.cell.active_name,
        camera_name="camera",
        timeout=30.0,
        repeatability=float(12 * noise) + unrest,
    )


@cache
def _paper_cell(*overrides: str) -> CellFile:
    return load_cell(PAPER_CELL, overrides)


def _simulation_noise(cell: CellFile) -> float:
    assert cell.simulation is not None
    return float(np.sqrt(2) * cell.simulation.noise.encoder)


RIGS: dict[str, Callable[[], Rig]] = {
    "simulator, kinematic": partial(_simulator, "kinematic", 0.0),
    "simulator, bullet": partial(_simulator, "bullet", 2e-5),
}
