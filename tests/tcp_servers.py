"""Small controllers that speak simple message, one for each way of answering. Written with struct, not with the codec:
what both sides would get wrong in the same way cannot hide here.
"""

from __future__ import annotations

import math
import socket
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from backends.controller.course import Course
from backends.controller.joint_map import JointMap
from dualcal_hal.clock import RealClock
from dualcal_hal.robot import JointPath

JOINTS = 6
CLOCK = RealClock()
PATIENCE = 10.0  # s that a test waits for what is to happen soon


@dataclass
class Received:
    """One motion message: its id, comm_type and body."""

    id: int
    comm: int
    body: bytes
    time: float = 0.0

    def integer(self, place: int, order: str = ">") -> int:
        return int(struct.unpack_from(f"{order}i", self.body, 4 * place)[0])


@dataclass
class Status:
    drives_powered: int = 1
    e_stopped: int = 0
    error_code: int = 0
    in_error: int = 0
    in_motion: int = 0
    mode: int = 2
    motion_possible: int = 1

    def values(self) -> tuple[int, ...]:
        return tuple(vars(self).values())


@dataclass
class SmallServer:
    """A controller whose arm is where it was last sent. ``answer``: what it does with a motion message.

    order, real: struct's letters. feedback: whether it tells joints by JOINT_FEEDBACK. groups: of its arms.
    """

    answer: Callable[[SmallServer, Received], bytes | None]
    order: str = ">"
    real: str = "f"
    period: float = 0.01
    feedback: bool = False
    groups: tuple[int, ...] = (0,)
    status: Status = field(default_factory=Status)
    tells_status: bool = True
    state_chunks: Callable[[bytes], Iterator[bytes]] = lambda data: iter([data])

    def __post_init__(self) -> None:
        self.received: list[Received] = []
        self.positions = {group: [0.1 * joint for joint in range(JOINTS)] for group in self.groups}
        self.news = threading.Condition()
        self.quiet = threading.Event()  # the state port is silent
        self.states = 0  # so many were sent
        self.memory: dict[str, Any] = {}
        self.closing = threading.Event()
        self._listening: list[socket.socket] = []
        self._accepted: dict[str, list[socket.socket]] = {"motion_port": [], "state_port": []}
        self._changed = threading.Condition()  # of what is accepted
        self._threads: list[threading.Thread] = []
        self.motion_port = self.state_port = 0
        self.start()

    # -- for tests ----------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Listen: on the ports that it had before, if it had any."""
        self.closing.clear()
        for name, serve in (("motion_port", self._motion), ("state_port", self._state)):
            listener = socket.socket()
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(("127.0.0.1", getattr(self, name)))
            listener.listen()
            setattr(self, name, listener.getsockname()[1])
            self._listening.append(listener)
            self._begin(self._accept, listener, name, serve)

    def close(self) -> None:
        """As a controller that is switched off."""
        self.closing.set()
        self.cut()
        while self._threads:
            self._threads.pop().join()

    def cut(self, port: str | None = None) -> None:
        """Break connections: all and the listening, or those of one port alone, of which there is one at least."""
        with self._changed:
            if port is not None:
                # To the client it is made before it is accepted here.
                assert self._changed.wait_for(lambda: self._accepted[port], PATIENCE), f"nobody came to the {port}"
            for name, connections in self._accepted.items():
                if port in (None, name):
                    _end(connections)
            if port is None:
                _end(self._listening)

    def wait_for(self, happened: Callable[[], bool]) -> None:
        """Until it has, whenever a message came; fails after a while."""
        with self.news:
            assert self.news.wait_for(happened, PATIENCE), [(r.id, r.body[:8].hex()) for r in self.received]

    def tells_anew(self) -> None:
        """Wait until a state was sent that was made after this call: one may be on its way that was made before."""
        before = self.states
        self.wait_for(lambda: self.states >= before + 2)

    @property
    def asked(self) -> list[Received]:
        """What it was sent but PINGs, which come whenever nothing else has for a while."""
        return [message for message in self.received if message.id != 1]

    def of(self, identity: int) -> list[Received]:
        return [message for message in self.received if message.id == identity]

    def sequences(self, place: int = 0) -> list[int]:
        """The sequence numbers of the points that it was sent, PINGs and commands left out."""
        return [m.integer(place, self.order) for m in self.received if m.id in (11, 14)]

    # -- messages -----------------------------------------------------------------------------------------------

    def packet(self, identity: int, comm: int, code: int, layout: str = "", *values: float) -> bytes:
        body = struct.pack(self.order + layout.replace("r", self.real), *values)
        return struct.pack(self.order + "4i", 12 + len(body), identity, comm, code) + body

    def joints_packets(self) -> bytes:
        data = b""
        for group in self.groups:
            ten = (*self.positions[group], *[0.0] * (10 - JOINTS))
            if self.feedback:
                data += self.packet(15, 1, 0, "iir30r", group, 7, 0.0, *ten, *[0.0] * 20)
            else:
                data += self.packet(10, 1, 0, "i10r", 0, *ten)
        return data

    def status_packet(self) -> bytes:
        return self.packet(13, 1, 0, "7i", *self.status.values())

    # -- serving ------------------------------------------------------------------------------------------------

    def _begin(self, function: Callable[..., None], *arguments: Any) -> None:
        thread = threading.Thread(target=function, args=arguments, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _accept(self, listener: socket.socket, name: str, serve: Callable[[socket.socket], None]) -> None:
        while not self.closing.is_set():
            try:
                made, _ = listener.accept()
            except OSError:
                return
            with self._changed:
                if self.closing.is_set():
                    made.close()
                    return
                self._accepted[name].append(made)
                self._changed.notify_all()
            self._begin(self._guarded, name, serve, made)

    def _guarded(self, name: str, serve: Callable[[socket.socket], None], made: socket.socket) -> None:
        with suppress(OSError):
            serve(made)
        with self._changed:
            if made in self._accepted[name]:
                self._accepted[name].remove(made)
                made.close()

    def _state(self, made: socket.socket) -> None:
        due = CLOCK.now()
        while not self.closing.is_set():
            if not self.quiet.is_set():
                data = self.joints_packets() + (self.status_packet() if self.tells_status else b"")
                for chunk in self.state_chunks(data):
                    made.sendall(chunk)
                with self.news:
                    self.states += 1
                    self.news.notify_all()
            due = max(due + self.period, CLOCK.now())
            CLOCK.wait(self.closing, due)

    def _motion(self, made: socket.socket) -> None:
        while (head := _exactly(made, 4)) is not None:
            frame = _exactly(made, struct.unpack(self.order + "i", head)[0])
            if frame is None:
                return
            identity, comm, _ = struct.unpack_from(self.order + "3i", frame)
            message = Received(identity, comm, frame[12:], CLOCK.now())
            with self.news:
                self.received.append(message)
                self.news.notify_all()
            reply = self.answer(self, message)
            if reply is not None:
                made.sendall(reply)


def _end(connections: list[socket.socket]) -> None:
    while connections:
        ended = connections.pop()
        with suppress(OSError):
            ended.shutdown(socket.SHUT_RDWR)
        ended.close()


def _exactly(made: socket.socket, count: int) -> bytes | None:
    data = b""
    while len(data) < count:
        part = made.recv(count - len(data))
        if not part:
            return None
        data += part
    return data


# -- ways of answering ----------------------------------------------------------------------------------------------


def _go_to(server: SmallServer, message: Received, place: int, group: int = 0) -> None:
    ten = struct.unpack_from(f"{server.order}10{server.real}", message.body, place)
    server.positions[group] = list(ten[:JOINTS])


def rep(server: SmallServer, message: Received) -> bytes | None:
    """As the REP has it, with the header alone."""
    if message.id == 11 and message.integer(0, server.order) >= 0:
        _go_to(server, message, 4)
    return server.packet(message.id, 3, 1)


def rep_with_body(server: SmallServer, message: Received) -> bytes | None:
    """The same with ten dummies, which are anything but numbers."""
    rep(server, message)
    return server.packet(message.id, 3, 1, "10r", *[math.nan] * 10)


def rep_with_an_echo(server: SmallServer, message: Received) -> bytes | None:
    """The same with the request's own body, as the REP's authors' library replies."""
    rep(server, message)
    return server.packet(message.id, 3, 1, f"{len(message.body)}B", *message.body)


def abb(server: SmallServer, message: Received) -> bytes | None:
    """Gathers points, and goes when the last one has come."""
    if message.id != 11:
        raise OSError("the motion program has stopped: it takes nothing else")
    sequence = message.integer(0, server.order)
    points = server.memory.setdefault("points", [])
    if sequence in (-1, -4):
        points.clear()
    if sequence != -4:
        points.append(message)
    if sequence == -3:
        _go_to(server, points[-1], 4)
    return server.packet(11, 3, 1) if message.comm == 2 else None


def fanuc(server: SmallServer, message: Received) -> bytes | None:
    """Answers with the sequence number; of the special ones only to the stop."""
    if message.id != 11:
        raise OSError("the relay has no case for it")
    sequence = message.integer(0, server.order)
    if sequence in (-1, -2, -3):
        return None
    if sequence >= 0:
        _go_to(server, message, 4)
    return server.packet(10, 3, 1, "i10r", sequence, *[0.0] * 10)


def moto_reply(server: SmallServer, message: Received, result: int = 0, subcode: int = 0) -> bytes:
    group, sequence = message.integer(0, server.order), message.integer(1, server.order)
    command = message.integer(2, server.order) if message.id == 2001 else message.id
    return server.packet(2002, 3, 1, "5i10r", group, sequence, command, result, subcode, *[0.0] * 10)


def motoman(server: SmallServer, message: Received) -> bytes | None:
    """Always a 2002; it has switches, too."""
    if message.id == 14:
        _go_to(server, message, 16, message.integer(0, server.order))
    elif message.id == 2001:
        match message.integer(2, server.order):
            case 200112:
                server.status.drives_powered = 1
            case 200113:
                server.status.drives_powered = 0
            case 200114:
                server.status.in_error, server.status.error_code = 0, 0
            case 200121:
                server.status.motion_possible = 1
    return moto_reply(server, message)


def course(*offsets: float, start: list[float] | None = None, speed: float = 1.0) -> Course:
    """A course of all joints by so many rad from where a small server's arm stands at first."""
    begin = np.array(start or [0.1 * joint for joint in range(JOINTS)])
    waypoints = tuple(tuple((begin + offset).tolist()) for offset in offsets)
    path = JointPath(waypoints, (speed,) * JOINTS, (5.0,) * JOINTS)
    return Course(begin, path, JointMap(None, JOINTS))
