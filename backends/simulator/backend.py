"""The virtual cell: both arms and the camera in one world, in simulated time."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict

from backends.simulator.camera import Sight, SimulatedCamera
from backends.simulator.left import CellLeft
from backends.simulator.rendering import Renderer
from backends.simulator.robot import SimulatedRobot
from backends.simulator.scene import Scene
from backends.simulator.stepper import stepper_class
from backends.simulator.world import World
from dualcal_hal.backend import Backend
from dualcal_hal.clock import VirtualClock
from dualcal_hal.errors import CellFileError, Contact, NotOpen, Problem, UnknownDevice, UsageError

if TYPE_CHECKING:
    from dualcal_hal.cellfile import CellFile
    from dualcal_hal.config import SimulationConfig

CAMERA = "camera"


class SimulatorOptions(BaseModel):
    """The simulator has no options: what it simulates is under ``simulation``."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class SimulatorBackend(Backend):
    """Simulates a whole cell; CellFileError if a device of the cell is another backend's.

    Its time is virtual and goes on over closing and opening; its arms are at home again after opening, unless it goes
    on from where another was left.
    """

    time: ClassVar[Literal["drives", "real"]] = "drives"
    simulated = True
    repeats_targets: ClassVar[bool] = True
    Options: ClassVar[type[BaseModel]] = SimulatorOptions

    def __init__(self, name: str, cell: CellFile) -> None:
        super().__init__(name, cell)
        self._simulation = _simulation(name, cell)
        stepper_class(self._simulation.stepper)  # refused now, before anything is begun
        self._clock = VirtualClock()
        self._open: Sight | None = None
        self._left: CellLeft | None = None
        robots = cell.cell.arms.items()
        self._robots = {arm: SimulatedRobot(arm, config, self._opened_world) for arm, config in robots}
        self._camera = SimulatedCamera(CAMERA, self._opened, self._simulation.errors.motion_blur.exposure)

    @property
    def clock(self) -> VirtualClock:
        return self._clock

    def open(self, timeout: float) -> None:
        if self._open is not None:
            raise UsageError(f"{self.name}: open: it is open already; close it first")
        cell, simulation = self.cell.cell, self._simulation
        board, margin, intrinsics = cell.target.board, cell.target.margin, cell.camera.intrinsics
        renderer = Renderer(board, margin, intrinsics, simulation.noise.blur_px, simulation.errors)
        world = World(cell, simulation, self._clock)
        with ExitStack() as if_it_fails:
            if_it_fails.callback(world.close)
            if self._left is not None:
                world.go_on_from(self._left)
                self._left = None
            if world.stepper.fault is not None:
                raise Contact(self.name, "open", world.stepper.fault, "check home_deg and the bases in the cell file")
            bodies = world.stepper.scene
            self._open = Sight(world, renderer, None if bodies is None else Scene(bodies, cell, renderer.rays))
            if_it_fails.pop_all()

    def close(self) -> None:
        opened, self._open = self._open, None
        if opened is not None:
            opened.world.close()

    def robot(self, name: str) -> SimulatedRobot:
        if name not in self._robots:
            raise UnknownDevice(name, "find the arm", f"'{self.name}' has {', '.join(sorted(self._robots))}")
        return self._robots[name]

    def camera(self, name: str) -> SimulatedCamera:
        if name != CAMERA:
            raise UnknownDevice(name, "find the camera", f"'{self.name}' has {CAMERA}")
        return self._camera

    def documents(self) -> Mapping[str, dict[str, Any]]:
        return {} if self._open is None else self._open.world.documents()

    def left(self) -> dict[str, Any]:
        return {} if self._open is None else self._open.world.left(self._camera.frames).model_dump()

    def go_on_from(self, state: Mapping[str, Any]) -> None:
        left = CellLeft.read(state, self.name, self.cell.cell)
        if self._clock.now() > left.clock_s:
            raise UsageError(f"{self.name}: go on: its time has begun already; use a new one")
        self._clock.wait(threading.Event(), left.clock_s)
        self._camera.frames = left.frames
        self._left = left

    def _opened(self, device: str, attempted: str) -> Sight:
        if self._open is None:
            raise NotOpen(device, attempted, f"backend '{self.name}' is not open", "open it first")
        return self._open

    def _opened_world(self, device: str, attempted: str) -> World:
        return self._opened(device, attempted).world


def _simulation(name: str, cell: CellFile) -> SimulationConfig:
    """The cell's ``simulation`` section, once the cell is one that this backend can simulate."""
    devices = {f"robots.{arm}.backend": config.backend for arm, config in cell.cell.arms.items()}
    devices["camera.backend"] = cell.cell.camera.backend
    problems = [
        Problem(where, f"is '{backend}': the simulator '{name}' simulates the whole cell, not a part of it")
        for where, backend in devices.items()
        if backend != name
    ]
    if cell.simulation is None:
        problems.append(Problem("simulation", f"missing key: the simulator '{name}' needs it"))
    if problems or cell.simulation is None:
        raise CellFileError(problems)
    return cell.simulation
