"""A server that keeps the REP to the letter: a stream of points, each with its duration."""

from __future__ import annotations

import itertools

import numpy as np

from backends.controller.emulator.faults import FaultSchedule
from backends.controller.emulator.tcp.controller import Controller, ServedArm
from backends.controller.emulator.tcp.packets import (
    FAILURE,
    JOINT_TRAJ_PT,
    JOINTS,
    PING,
    REPLY,
    REQUEST,
    STOP,
    SUCCESS,
    Packing,
    Point,
)
from backends.controller.emulator.tcp.paths import TimedStream
from backends.controller.emulator.tcp.server import Server, is_reachable
from backends.controller.emulator.tcp.wires import Connection, Line
from dualcal_hal.transforms import Array

_AHEAD = 0.05  # s that it waits for more points before it moves
_FASTER = 1.05  # than the arm's own speed is refused


class RepServer(Server):
    """Replies with and without a body in turn; stops if its client is lost."""

    state_period = 0.02

    def __init__(self, controller: Controller, line: Line, packing: Packing, schedule: FaultSchedule) -> None:
        super().__init__(controller, line, packing, schedule)
        (self._served,) = controller.arms.values()
        self._stream: TimedStream | None = None
        self._began = 0.0
        self._awaited = 0
        self._bodies = itertools.cycle((False, True))

    async def received(self, connection: Connection, data: bytes) -> None:
        message = self._packing.message(data)
        if message.comm != REQUEST:
            return
        if message.kind == PING:
            body = self._packing.ints(JOINTS)
            await self.reply(connection, self._packing.frame(PING, REPLY, SUCCESS, body))
        elif message.kind == JOINT_TRAJ_PT:
            taken = self._take(self._packing.point(message.body))
            body = self._packing.reals(JOINTS) if next(self._bodies) else b""
            await self.reply(connection, self._packing.frame(JOINT_TRAJ_PT, REPLY, SUCCESS if taken else FAILURE, body))
        else:
            await self.reply(connection, self._packing.frame(message.kind, REPLY, FAILURE))

    def client_lost(self) -> None:
        self._halt()

    def joint_state(self, group: int, served: ServedArm) -> bytes:
        return self._packing.joint_feedback(group, served.arm.clock.now(), *served.state())

    def _take(self, point: Point) -> bool:
        if point.sequence < 0:
            if point.sequence == STOP:
                self.told_to_stop()
                self._halt()
            return True
        self.pointed(self._served)
        if point.sequence not in (0, self._awaited):
            self._halt()
            return False
        place = self._served.place(point.joints)
        if not self.controller.motion_possible or not is_reachable(self._served, place):
            return False
        if not self._queue(point, place):
            return False
        self._awaited = point.sequence + 1
        return True

    def _queue(self, point: Point, place: Array) -> bool:
        arm = self._served.arm
        with arm.lock:
            now = arm.clock.now()
            stream = self._stream
            if stream is None or now - self._began > stream.end:
                stream = TimedStream(arm.commanded(), _AHEAD)
            fastest = float(np.max(np.abs(place - stream.last) / arm.speed))  # s
            if point.duration > 0:
                duration = point.duration
            elif 0 < point.velocity <= 1:
                duration = max(fastest / point.velocity, 1e-3)
            else:
                return False
            if not np.isfinite(duration) or duration * _FASTER < fastest:
                return False
            if stream is self._stream:
                stream.add(place, duration, now - self._began)
            else:
                stream.add(place, duration, 0.0)
                self._stream, self._began = stream, arm.follow(stream)
        return True

    def _halt(self) -> None:
        self._stream, self._awaited = None, 0
        self.controller.halt()
