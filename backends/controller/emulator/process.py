"""The emulator of a cell: its world in real time, behind the wires of all backends that can be emulated."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from backends.controller.emulator.faults import FaultSchedule, parse_fault
from backends.controller.emulator.world import EmulatedWorld
from backends.controller.options import CAN_NEEDS, CanLink, ControllerOptions
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import CellFileError, Contact, Problem, UsageError
from dualcal_hal.registry import require_extra

if TYPE_CHECKING:
    from backends.controller.emulator.drives import DriveBuses

FORMAT = "dualcal.emulator/1"

_LOOPBACK = "127.0.0.1"

_REST_WITHIN = 3.0  # s after the end within which an arm is to stand
_LOOK = 0.02  # s from one look whether it does to the next


class Emulator:
    """A context manager: it serves from its beginning until its end.

    endpoints: where each backend of the cell is served, by its name.
    """

    def __init__(
        self,
        path: Path,
        overrides: Sequence[str] = (),
        faults: Sequence[str] = (),
        *,
        free_ports: bool,
        say: Callable[[str], None],
        failed: Callable[[str], None],
    ) -> None:
        """``say`` gets a line for what happens; ``failed`` is told why it cannot go on. CellFileError, UsageError."""
        self._path, self._overrides = path, tuple(overrides)
        self._file = load_cell(path, overrides)
        self._free_ports, self._say, self._failed = free_ports, say, failed
        self._faults = [parse_fault(fault, self._file.cell.arms) for fault in faults]
        self._controllers, self._cameras = _backends(self._file)
        _require_extras(self._controllers, self._cameras)
        self.endpoints: dict[str, Any] = {}

    def __enter__(self) -> Self:
        assert self._file.simulation is not None
        with ExitStack() as opening:
            world = self._world = EmulatedWorld(self._file.cell, self._file.simulation)
            opening.callback(world.close)
            if world.stepper.fault is not None:
                raise Contact("emulator", "start", world.stepper.fault, "check home_deg and the bases in the cell file")
            schedule = FaultSchedule(self._faults, world.clock, self._say)
            opening.callback(schedule.close)
            for arm in world.arms.values():
                arm.on_motion(schedule.moved)
            world.on_contact(lambda contact: self._say(f"contact: {contact}; the arms have halted"))
            for name, options in self._controllers.items():
                self._serve(name, options, schedule, opening)
            for name in self._cameras:
                self._film(name, opening)
            schedule.start()
            self._opened = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        distances = self._world.distances()
        if self._faults:
            self._tell_of_rest()
        self._opened.close()
        if distances.times:
            self._say(f"least distance between the arms {distances.least()}")

    def _tell_of_rest(self) -> None:
        """Whether arms that had a fault come to rest, also when nobody is there any more who stops them."""
        clock, arms = self._world.clock, self._world.arms.values()
        end, never = clock.now() + _REST_WITHIN, threading.Event()
        while clock.now() < end and any(arm.rests_since is None for arm in arms):
            clock.wait(never, clock.now() + _LOOK)
        for arm in arms:
            self._say(f"{arm.name}: {_rest(arm.rests_since)}")

    def _serve(self, name: str, options: ControllerOptions, schedule: FaultSchedule, opening: ExitStack) -> None:
        cell, world = self._file.cell, self._world
        if options.link.tcp is not None:
            from backends.controller.emulator.tcp.stations import SimpleMessageServers

            servers = SimpleMessageServers(options.link.tcp, cell, world.arms, schedule, self._free_ports)
            opening.callback(servers.close)
            world.on_contact(servers.touched)
            self.endpoints[name] = {"tcp": servers.endpoints}
        elif options.link.can is not None:
            for fault in self._faults:
                if fault.when.kind == "point":
                    raise UsageError(
                        f"--fault {fault}: drives on CAN get no trajectory points; give seconds or motion:N"
                    )
            from backends.controller.emulator.drives import FAULTS, DriveBuses

            arms = {arm: world.arms[arm] for arm in options.link.can.arms}
            port = 0 if self._free_ports else _port(options.link.can)
            try:
                buses = DriveBuses(options.link.can, arms, world.clock, port)
            except OSError as error:
                raise UsageError(f"{_LOOPBACK}:{port}: cannot be listened to: {error.strerror}") from error
            opening.callback(buses.close)
            for arm in arms:
                buses.arms[arm].on_target = partial(schedule.pointed, arm)
                buses.arms[arm].on_stop = partial(schedule.stopped, arm)
                world.on_contact(_struck(buses, arm))
                for each in FAULTS:
                    schedule.attach(each, arm, partial(buses.strike, each, arm))
            self.endpoints[name] = {"can": buses.endpoints}

    def _film(self, name: str, opening: ExitStack) -> None:
        from backends.cameras.zmq_backend import ZmqOptions
        from backends.controller.emulator.camera import CameraProcess

        options = self._file.cell.backends[name].checked
        assert isinstance(options, ZmqOptions)
        endpoint = f"tcp://{_LOOPBACK}:*" if self._free_ports else options.endpoint
        process = CameraProcess(self._path, self._overrides, (endpoint, options.camera), self._world, self._failed)
        opening.callback(process.close)
        self.endpoints[name] = {"camera": {"endpoint": process.endpoint}}


def _backends(file: CellFile) -> tuple[dict[str, ControllerOptions], list[str]]:
    """The controllers, with their options, and the cameras that the cell's devices are reached through."""
    cell = file.cell
    used = {f"robots.{name}.backend": robot.backend for name, robot in cell.arms.items()}
    used["camera.backend"] = cell.camera.backend
    problems = []
    controllers: dict[str, ControllerOptions] = {}
    cameras: list[str] = []
    for where, name in used.items():
        entry = cell.backends[name]
        if isinstance(entry.checked, ControllerOptions) and where != "camera.backend":
            controllers[name] = entry.checked
        elif entry.type == "zmq" and where == "camera.backend":
            cameras.append(name)
        else:
            problems.append(Problem(where, f"is '{name}', of type {entry.type}, which has no emulator"))
    if file.simulation is None:
        problems.append(Problem("simulation", "missing key: the emulator needs to know how the cell truly is"))
    if problems:
        raise CellFileError(problems)
    return controllers, cameras


def _require_extras(controllers: Mapping[str, ControllerOptions], cameras: Sequence[str]) -> None:
    """CellFileError if what one of them needs is not installed."""
    from backends.cameras.zmq_backend import ZMQ_NEEDS

    for name, options in controllers.items():
        if options.link.can is not None:
            require_extra(f"backends.{name}.link.can", "can", CAN_NEEDS)
    for name in cameras:
        require_extra(f"backends.{name}", "zmq", ZMQ_NEEDS)


def _port(options: CanLink) -> int:
    """Where the cell file has its buses; UsageError unless that is one port of this machine."""
    ports = set()
    for name, arm in options.arms.items():
        host, _, rest = arm.channel.partition(":")
        number, _, bus = rest.partition("/")
        if options.interface != "socketcand" or host not in (_LOOPBACK, "localhost") or not number.isdecimal():
            raise UsageError(
                f"{name}: an emulator serves CAN by socketcand on this machine only, and the cell file has its bus at "
                f"{options.interface} {arm.channel}; use --free-ports, or --set its channel to {_LOOPBACK}:PORT/{name}"
            )
        if bus != name:
            raise UsageError(f"{name}: the emulator's bus of this arm is called {name}, not '{bus}'")
        ports.add(int(number))
    if len(ports) != 1:
        raise UsageError(f"an emulator serves all buses at one port, and the cell file names {sorted(ports)}")
    return ports.pop()


def _rest(since: float | None) -> str:
    if since is None:
        return "moves"
    return f"rests since {since:.6f} s of the clock" if math.isfinite(since) else "has never moved"


def _struck(buses: DriveBuses, arm: str) -> Callable[[str], None]:
    def on_contact(contact: str) -> None:
        buses.strike("drive-fault", arm)

    return on_contact
