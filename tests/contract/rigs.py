"""The backends that the contract is held against.

A backend joins by one function here that makes a rig, and its entry in ``RIGS``.
"""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from backends.cameras.zmq_backend import ZmqBackend
from backends.controller import ControllerBackend
from backends.replay import ReplayBackend
from backends.simulator import SimulatorBackend
from dualcal_hal.backend import Backend
from dualcal_hal.camera import Camera
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import Clock
from dualcal_hal.config import RobotConfig
from dualcal_hal.robot import JointPath, Joints, Mode, Robot
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
    switches: bool = True  # whether the device lets drives be switched over its wires

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


UNHURRIED_MS = 30
"""Period of the CAN cycle in tests: a machine that does more than that is late now and then."""

NOBODYS_PORT = 1
"""Where no unprivileged program listens."""

RIGS: dict[str, Callable[[], Rig]] = {
    "simulator, kinematic": partial(_simulator, "kinematic", 0.0),
    "simulator, bullet": partial(_simulator, "bullet", 2e-5),
}


# A controller has arms and no camera: the one that its cell has beside it is looked at through the same rig, and what
# operators do before a run, to enable the arms, is done as it is opened.


class FactoryBackend(Backend):
    """A controller's arms, enabled, and a camera, both at an emulator."""

    time = "real"
    simulated = True
    Options = ControllerBackend.Options

    def __init__(self, cell: CellFile, endpoints: Mapping[str, Any]) -> None:
        super().__init__("cell", cell)
        self._controller, self._camera = ControllerBackend("cell", cell), ZmqBackend("eye", cell)
        self._controller.use_emulator(endpoints["cell"])
        self._camera.use_emulator(endpoints["eye"])

    @property
    def clock(self) -> Clock:
        return self._controller.clock

    def open(self, timeout: float) -> None:
        with ExitStack() as if_it_fails:
            self._controller.open(timeout)
            if_it_fails.callback(self._controller.close)
            for name in self.cell.cell.robots:
                robot = self._controller.robot(name)
                # A machine that stood still for a moment has had the drives miss this program's heartbeat.
                if robot.read(timeout).mode is Mode.FAULT:
                    robot.reset_fault(timeout)
                if robot.read(timeout).mode is not Mode.READY:
                    robot.enable(timeout)
            self._camera.open(timeout)
            if_it_fails.pop_all()

    def close(self) -> None:
        self._camera.close()
        self._controller.close()

    def robot(self, name: str) -> Robot:
        return self._controller.robot(name)

    def camera(self, name: str) -> Camera:
        return self._camera.camera(name)


FACTORY_RIGS = {
    "controller, rep": ("paper-tcp-fast.yaml", ()),
    "controller, abb": ("paper-tcp-fast.yaml", ("backends.cell.link.tcp.dialect=abb",)),
    "controller, fanuc": ("paper-tcp-fast.yaml", ("backends.cell.link.tcp.dialect=fanuc",)),
    "controller, motoman": ("paper-tcp-fast.yaml", ("backends.cell.link.tcp.dialect=motoman",)),
    "controller, can": ("paper-can-fast.yaml", (f"backends.cell.link.can.sync_period_ms={UNHURRIED_MS}",)),
}
"""The cell file of each, and what is set in it."""


def factory_cell(rig: str) -> CellFile:
    """The cell that an emulator is started for."""
    name, overrides = FACTORY_RIGS[rig]
    return load_cell(PAPER_CELL.with_name(name), overrides)


def factory(rig: str, endpoints: Mapping[str, Any]) -> Rig:
    """At an emulator of :func:`factory_cell`, whose arms stand where the last clause left them."""
    cell, nobody = factory_cell(rig), copy.deepcopy(dict(endpoints))
    arm = cell.cell.passive_name  # the second to be opened: the first has to be closed again
    if "tcp" in nobody["cell"]:
        nobody["cell"]["tcp"][arm]["state_port"] = NOBODYS_PORT
    else:
        nobody["cell"]["can"]["arms"][arm]["channel"] = f"127.0.0.1:{NOBODYS_PORT}/{arm}"
    return Rig(
        backend=FactoryBackend(cell, endpoints),
        broken=FactoryBackend(cell, nobody),
        config=cell.cell.active,
        robot_name=cell.cell.active_name,
        camera_name="camera",
        timeout=30.0,
        repeatability=1e-3,
        switches=rig in ("controller, motoman", "controller, can"),
    )


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
