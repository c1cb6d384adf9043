"""Both arms of a cell at emulated controllers in this process, over real wires, each behind the guard."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from backends.controller import ControllerBackend
from backends.controller.emulator.drives import FAULTS, DriveBuses
from backends.controller.emulator.tcp.stations import SimpleMessageServers
from backends.controller.emulator.world import EmulatedWorld
from backends.controller.options import ControllerOptions
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import DeviceError
from dualcal_hal.geometry import CellGeometry
from dualcal_hal.guard import CellGuard, GuardedRobot
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import Mode, Motion, RobotState
from tests.cells import TINY
from tests.relay import Relay
from tests.simple_message_client import PATIENCE, tcp_overrides

ARMS = ("left", "right")
PORTS = MOTION, STATE = "motion_port", "state_port"
BUS = "bus"
NODES = range(1, 7)
UNHURRIED_MS = 30
"""Period of the CAN cycle: a machine that does more than that is late now and then."""

MOVES = 0.02
"""rad that a joint has turned by once an arm is taken to move."""

UNMOVED = 1e-3
"""rad within which an arm stands where it stood: encoders flicker."""

NEVER = threading.Event()


@cache
def wired_cell(link: str, *overrides: str) -> CellFile:
    """The tiny cell with a controller over ``link``: a dialect of TCP, or can."""
    return load_cell(Path(TINY), [*wired(link), *overrides])


def wired(link: str) -> list[str]:
    """What makes it one."""
    if link == "can":
        drives = ", ".join(f"{{node: {node}, counts_per_rad: 1000000}}" for node in NODES)
        arms = ", ".join(f"{arm}: {{channel: '127.0.0.1:1/{arm}', drives: [{drives}]}}" for arm in ARMS)
        can = f"{{interface: socketcand, sync_period_ms: {UNHURRIED_MS}, arms: {{{arms}}}}}"
        backends, *devices = tcp_overrides()
        return [backends, f"backends.cell={{type: controller, link: {{can: {can}}}}}", *devices]
    return tcp_overrides(f"dialect: {link}")


def ports_of(endpoints: Mapping[str, Any]) -> dict[tuple[str, str], int]:
    """By arm and what is there, from what an emulator says of a controller."""
    if "can" in endpoints:
        arms = endpoints["can"]["arms"]
        return {(arm, BUS): int(arms[arm]["channel"].partition(":")[2].partition("/")[0]) for arm in ARMS}
    return {(arm, port): endpoints["tcp"][arm][port] for arm in ARMS for port in PORTS}


class Faults:
    """What servers know as the schedule of their faults: here a test has them come when it likes.

    stops: the arms that were told to stop, in their order.
    """

    def __init__(self) -> None:
        self.stops: list[str] = []
        self._begin: dict[tuple[str, str], list[Callable[[], object]]] = {}

    def attach(self, name: str, arm: str, begin: Callable[[], object]) -> None:
        self._begin.setdefault((name, arm), []).append(begin)

    def pointed(self, arm: str) -> None:
        pass

    def stopped(self, arm: str, when: float | None = None) -> None:
        self.stops.append(arm)

    def strike(self, name: str, arm: str) -> Callable[[], None]:
        """Have it come now; returns what ends it."""
        ends = [begin() for begin in self._begin[name, arm]]
        return lambda: [end() for end in ends if callable(end)] and None


class Served:
    """Emulated controllers of a cell; ``world.arms`` are the emulated arms. ports: by arm and what is there."""

    def __init__(self, link: str, *overrides: str) -> None:
        file = wired_cell(link, *overrides)
        options = file.cell.backends["cell"].checked
        assert isinstance(options, ControllerOptions)
        assert file.simulation is not None
        self.world = EmulatedWorld(file.cell, file.simulation)
        self.faults = Faults()
        if options.link.tcp is not None:
            servers = SimpleMessageServers(options.link.tcp, file.cell, self.world.arms, self.faults, free_ports=True)
            self.ports = ports_of({"tcp": servers.endpoints})
            self._close = servers.close
        else:
            buses = DriveBuses(options.link.can, self.world.arms, self.world.clock)
            self.ports = ports_of({"can": buses.endpoints})
            for arm in ARMS:
                buses.arms[arm].on_stop = partial(self.faults.stopped, arm)
                for fault in FAULTS:
                    self.faults.attach(fault, arm, partial(buses.strike, fault, arm))
            self._close = buses.close

    def close(self) -> None:
        """As if it were killed."""
        self._close()
        self.world.close()

    def places(self) -> np.ndarray[Any, Any]:
        """(2, n) rad: where its arms are now."""
        return np.array([arm.read().positions for _, arm in sorted(self.world.arms.items())])

    def rests(self) -> bool:
        """Whether no arm moves."""
        return all(arm.rests_since is not None for arm in self.world.arms.values())


class Guarded:
    """The driver of such a cell, and the guard before it. served: what it is connected to at the moment."""

    def __init__(self, link: str) -> None:
        self._link = link
        self._file = wired_cell(link)
        self.clock = RealClock()
        self.served: Served | None = None
        self.relays = {(arm, port): Relay() for arm in ARMS for port in ((BUS,) if link == "can" else PORTS)}
        self.backend = ControllerBackend("cell", self._file)
        self.backend.use_emulator(self._endpoints())
        cell = self._file.cell
        self.arms = {
            arm: GuardedRobot(self.backend.robot(arm), JointLimits.of(cell.robots[arm]), self.clock) for arm in ARMS
        }
        self.guard = CellGuard(
            self.arms[cell.active_name],
            self.arms[cell.passive_name],
            CellGeometry.of(cell),
            cell.nominal.placement,
            cell.procedure.clearance,
            watched=True,
        )

    def serve(self, *overrides: str) -> Served:
        """Have a server there from now on."""
        self.served = Served(self._link, *overrides)
        self.reach(self.served.ports)
        return self.served

    def reach(self, ports: Mapping[tuple[str, str], int]) -> None:
        """Connect to what is there from now on."""
        for place, relay in self.relays.items():
            relay.target = ("127.0.0.1", ports[place])

    def kill(self) -> None:
        """Have none there any more."""
        for relay in self.relays.values():
            relay.target = None
        if self.served is not None:
            self.served.close()
            self.served = None

    def open(self) -> None:
        """Connect, and do what operators do before a run."""
        self.backend.open(PATIENCE)
        self.enable()

    def enable(self) -> None:
        """Switch drives on that are off, where that goes by the wires."""
        for arm in ARMS:
            robot = self.backend.robot(arm)
            if robot.read(PATIENCE).mode is not Mode.READY:
                robot.enable(PATIENCE)

    def start(self, arm: str, *by: float) -> Motion:
        """Begin to turn an arm's first joints by so many rad, and wait until it moves."""
        state = self.arms[arm].read(PATIENCE)
        target = tuple(q + turn for q, turn in zip(state.positions, (*by, *[0.0] * 6), strict=False))
        motion = self.arms[arm].start(self.guard.path(arm, state.positions, (target,)))
        assert self.served is not None
        emulated = self.served.world.arms[arm]
        self.wait(lambda: np.max(np.abs(np.subtract(emulated.read().positions, state.positions))) > MOVES)
        return motion

    def reads(self, arm: str, condition: Callable[[RobotState], object] = lambda state: True) -> RobotState:
        """A state of an arm that is so, however often its link breaks until then."""
        end = self.clock.now() + PATIENCE
        while True:
            try:
                state = self.arms[arm].read(1.0)
                if condition(state):
                    return state
            except DeviceError:
                pass
            assert self.clock.now() < end, "no such state"
            self.pause(0.02)

    def comes_to_rest(self) -> np.ndarray[Any, Any]:
        """Wait until both emulated arms stand; (2, n) rad: where."""
        assert self.served is not None
        self.wait(self.served.rests)
        return self.served.places()

    def stays(self, places: np.ndarray[Any, Any], seconds: float = 0.5) -> None:
        """See that the emulated arms do not move from there."""
        assert self.served is not None
        self.pause(seconds)
        assert self.served.rests()
        np.testing.assert_allclose(self.served.places(), places, atol=UNMOVED)

    def wait(self, condition: Callable[[], object]) -> None:
        end = self.clock.now() + PATIENCE
        while not condition():
            assert self.clock.now() < end, "it did not come to that"
            self.pause(0.005)

    def pause(self, seconds: float) -> None:
        self.clock.wait(NEVER, self.clock.now() + seconds)

    def close(self) -> None:
        self.backend.close()
        self.kill()
        for relay in self.relays.values():
            relay.close()

    def _endpoints(self) -> dict[str, object]:
        if self._link == "can":
            arms = {arm: {"channel": f"127.0.0.1:{self.relays[arm, BUS].port}/{arm}"} for arm in ARMS}
            return {"can": {"interface": "socketcand", "arms": arms}}
        return {
            "tcp": {arm: {"host": "127.0.0.1", **{port: self.relays[arm, port].port for port in PORTS}} for arm in ARMS}
        }


class Emulating:
    """``dualcal emulate`` of such a cell in a process of its own. ports: as its endpoints say."""

    def __init__(self, link: str, *overrides: str) -> None:
        settings = [part for setting in (*wired(link), *overrides) for part in ("--set", setting)]
        command = [sys.executable, "-m", "tools.cli", "emulate", str(TINY), *settings, "--free-ports"]
        self._process = subprocess.Popen(
            [*command, "--until-stdin-closes"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
        )
        assert self._process.stdout is not None
        self.ports = ports_of(json.loads(self._process.stdout.readline())["backends"]["cell"])

    def kill(self) -> None:
        """As nothing can be kept from."""
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()


@contextmanager
def guarded(link: str) -> Iterator[Guarded]:
    """A cell that is served, its backend open."""
    cell = Guarded(link)
    try:
        cell.serve()
        cell.open()
        yield cell
    finally:
        cell.close()
