"""A client of simple message for tests of servers: bytes by struct alone, and an emulated cell to talk to."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from backends.controller.emulator.arm import EmulatedArm
from backends.controller.emulator.faults import FaultSchedule, parse_fault
from backends.controller.emulator.tcp.stations import SimpleMessageServers
from backends.controller.emulator.world import EmulatedWorld
from backends.controller.options import ControllerOptions
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import RealClock
from tests.cells import TINY

PATIENCE = 20.0
"""Seconds within which whatever is waited for must have come, also on a machine that has much else to do."""

ARMS = (
    "{left: {host: 127.0.0.1, motion_port: 1, state_port: 2}, right: {host: 127.0.0.1, motion_port: 3, state_port: 4}}"
)


def tcp_overrides(link: str = "dialect: rep", arms: str = ARMS) -> list[str]:
    """What makes the tiny cell one with a controller over TCP, and a camera over ZeroMQ."""
    cell = f"cell: {{type: controller, link: {{tcp: {{{link}, arms: {arms}}}}}}}"
    eye = "eye: {type: zmq, endpoint: 'tcp://127.0.0.1:5', camera: tiny}"
    devices = ("robots.left.backend=cell", "robots.right.backend=cell", "camera.backend=eye")
    return [f"backends={{{cell}, {eye}}}", *devices]


@cache
def tcp_cell(link: str = "dialect: rep", arms: str = ARMS, *overrides: str) -> CellFile:
    return load_cell(Path(TINY), [*tcp_overrides(link, arms), *overrides])


@dataclass
class Client:
    """Connections to one arm's servers. order: struct's sign of the byte order; real: of the reals."""

    motion: socket.socket
    state: socket.socket
    order: str = "<"
    real: str = "f"

    def pack(self, layout: str, *values: float) -> bytes:
        return struct.pack(self.order + layout, *values)

    def unpack(self, layout: str, data: bytes) -> tuple[Any, ...]:
        return struct.unpack(self.order + layout, data)

    def send(self, kind: int, body: bytes, comm: int = 2) -> None:
        self.motion.sendall(self.pack("4i", 12 + len(body), kind, comm, 0) + body)

    def receive(self, connection: socket.socket | None = None) -> tuple[int, int, int, bytes]:
        """Type, communication, reply code and body of the next message; ConnectionError at the end."""
        connection = connection or self.motion
        (length,) = self.unpack("i", _exactly(connection, 4))
        data = _exactly(connection, length)
        return (*self.unpack("3i", data[:12]), data[12:])

    def ask(self, kind: int, body: bytes) -> tuple[int, int, int, bytes]:
        self.send(kind, body)
        return self.receive()

    def point(self, sequence: int, joints: Sequence[float], velocity: float = 1.0, duration: float = 0.0) -> bytes:
        return self.pack(f"i12{self.real}", sequence, *_ten(joints), velocity, duration)

    def full_point(
        self, sequence: int, time: float, positions: Sequence[float], velocities: Sequence[float] = (), **of: int
    ) -> bytes:
        values = (*_ten(positions), *_ten(velocities), *_ten(()))
        return self.pack(f"3i31{self.real}", of.get("group", 0), sequence, of.get("valid", 7), time, *values)

    def command(self, command: int, group: int = 0) -> bytes:
        return self.pack(f"3i10{self.real}", group, 0, command, *_ten(()))

    def next_length(self) -> int:
        """What the next state says of its length; it is read over, if that can be."""
        (length,) = self.unpack("i", _exactly(self.state, 4))
        if 0 < length < 4096:
            _exactly(self.state, length)
        return int(length)

    def receive_until_the_end(self) -> None:
        """States, until the connection is silent or breaks: TimeoutError, ConnectionError."""
        while self.state.recv(4096):
            pass
        raise ConnectionError("closed")

    def next_status(self) -> tuple[int, ...]:
        """The next STATUS: powered, e-stopped, code, in error, in motion, mode, motion possible."""
        while True:
            kind, _, _, body = self.receive(self.state)
            if kind == 13:
                return self.unpack("7i", body)

    def status_with(self, condition: Callable[[tuple[int, ...]], bool]) -> tuple[int, ...]:
        """The first STATUS that is so."""
        clock = RealClock()
        end = clock.now() + PATIENCE
        while clock.now() < end:
            if condition(status := self.next_status()):
                return status
        raise AssertionError("no such status")


def _ten(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(values) + (0.0,) * (10 - len(values))


def _exactly(connection: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        piece = connection.recv(count - len(data))
        if not piece:
            raise ConnectionError("closed")
        data += piece
    return data


@dataclass
class Rig:
    """An emulated cell, and clients of its arms."""

    world: EmulatedWorld
    servers: SimpleMessageServers
    cell: CellFile
    lines: list[str]
    opened: ExitStack
    order: str
    real: str

    def client(self, arm: str = "left") -> Client:
        return Client(self.connect(arm, "motion_port"), self.connect(arm, "state_port"), self.order, self.real)

    def connect(self, arm: str, port: str) -> socket.socket:
        endpoint = self.servers.endpoints[arm]
        connection = socket.create_connection((endpoint["host"], endpoint[port]), timeout=PATIENCE)
        self.opened.callback(connection.close)
        return connection

    @property
    def left(self) -> EmulatedArm:
        return self.world.arms["left"]

    def wait(self, condition: Callable[[], object]) -> None:
        clock, never = RealClock(), threading.Event()
        end = clock.now() + PATIENCE
        while not condition():
            assert clock.now() < end, "it did not come to that"
            clock.wait(never, clock.now() + 0.005)

    def settled(self) -> np.ndarray[Any, Any]:
        """Where the left arm rests, rad, once it has moved."""
        self.wait(lambda: self.left.motions and not self.left.in_motion)
        return self.left.read().positions


@contextmanager
def serving(
    link: str = "dialect: rep", *overrides: str, arms: str = ARMS, order: str = "<", real: str = "f", fault: str = ""
) -> Iterator[Rig]:
    """The tiny cell's controllers, emulated at free ports."""
    file = tcp_cell(link, arms, *overrides)
    options = file.cell.backends["cell"].checked
    assert isinstance(options, ControllerOptions)
    assert options.link.tcp is not None
    assert file.simulation is not None
    lines: list[str] = []
    with ExitStack() as opened:
        world = EmulatedWorld(file.cell, file.simulation)
        opened.callback(world.close)
        faults = [parse_fault(fault, world.arms)] if fault else []
        schedule = FaultSchedule(faults, world.clock, lines.append)
        opened.callback(schedule.close)
        for arm in world.arms.values():
            arm.on_motion(schedule.moved)
        servers = SimpleMessageServers(options.link.tcp, file.cell, world.arms, schedule, free_ports=True)
        opened.callback(servers.close)
        world.on_contact(servers.touched)
        schedule.start()
        with ExitStack() as connections:
            yield Rig(world, servers, file, lines, connections, order, real)
