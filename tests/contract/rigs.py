"""The backends that the contract is held against.

A backend joins by one function here that makes a rig, and its entry in ``RIGS``.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from backends.replay import ReplayBackend
from backends.simulator import SimulatorBackend
from dualcal_hal.backend import Backend
from dualcal_hal.camera import Camera
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import Clock
from dualcal_hal.config import RobotConfig
from dualcal_hal.robot import JointPath, Joints, Robot
from dualcal_hal.session.log import segment_name
from dualcal_hal.session.log.recording import LogRecording, Recording

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


# The replay plays back a recording of the very clause that it is held against.


class RecordedBackend(Backend):
    """Another backend, with all that passes its border recorded."""

    time = "drives"
    simulated = True
    Options = SimulatorBackend.Options

    def __init__(self, backend: Backend, recording: Recording) -> None:
        super().__init__(backend.name, backend.cell)
        self._backend, self._recording = backend, recording
        self._robots = {name: recording.robot(backend.robot(name)) for name in backend.cell.cell.robots}
        self._camera = recording.camera(backend.camera("camera"))

    @property
    def clock(self) -> Clock:
        return self._backend.clock

    def open(self, timeout: float) -> None:
        self._backend.open(timeout)

    def close(self) -> None:
        self._backend.close()

    def robot(self, name: str) -> Robot:
        self._backend.robot(name)
        return self._robots[name]

    def camera(self, name: str) -> Camera:
        self._backend.camera(name)
        return self._camera


def recorded(session: Path) -> tuple[Rig, LogRecording]:
    """The kinematic simulator, recorded into the session's log until that is left."""
    rig = RIGS["simulator, kinematic"]()
    recording = LogRecording(session / segment_name(1), rig.backend.cell, rig.backend.clock)
    return replace(rig, backend=RecordedBackend(rig.backend, recording)), recording


def replayed(session: Path) -> Rig:
    """What was recorded there; the one that cannot be opened is of a recording that is gone by then."""
    rig = RIGS["simulator, kinematic"]()
    gone = shutil.copytree(session, session / "gone")
    broken = _replay(gone)
    shutil.rmtree(gone)
    return replace(rig, backend=_replay(session), broken=broken)


def _replay(session: Path) -> ReplayBackend:
    entry = f"backends.log={{type: replay, session: {session}}}"
    return ReplayBackend("log", _paper_cell(entry, *(f"{device}.backend=log" for device in _DEVICES)))


_DEVICES = ("robots.left", "robots.right", "camera")
