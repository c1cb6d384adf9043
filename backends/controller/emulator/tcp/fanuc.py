"""FANUC with ROS-Industrial's KAREL relay: a stream at the controller's own speed, acknowledged before it moves."""

from __future__ import annotations

import asyncio
from contextlib import suppress

from backends.controller.emulator.faults import FaultSchedule
from backends.controller.emulator.tcp.controller import Controller, ServedArm
from backends.controller.emulator.tcp.own_speed import OwnSpeed
from backends.controller.emulator.tcp.packets import (
    FAILURE,
    PREFIX,
    REPLY,
    STOP,
    SUCCESS,
    NotAMessage,
    Packing,
    Point,
)
from backends.controller.emulator.tcp.paths import RunOn
from backends.controller.emulator.tcp.server import Server, is_reachable
from backends.controller.emulator.tcp.wires import Connection, Line

_LOOK = 0.005  # s from one look whether the motion program is ready to the next


class FanucServer(Server):
    """Takes whatever comes for a trajectory point.

    A point is acknowledged at once; then nothing is read, a stop neither, until the motion program has taken it, which
    is when the point before is left behind. START and END get no answer. Its status comes with every tenth state only.
    """

    state_period = 0.02
    states_a_status = 10

    def __init__(
        self, controller: Controller, line: Line, packing: Packing, schedule: FaultSchedule, own_speed: OwnSpeed
    ) -> None:
        super().__init__(controller, line, packing, schedule)
        (self._served,) = controller.arms.values()
        self._own_speed = own_speed
        self._path: RunOn | None = None
        self._began = 0.0

    async def received(self, connection: Connection, data: bytes) -> None:
        message = self._packing.message(data)
        point = self._packing.point(message.body)
        if point.sequence == STOP:
            self.told_to_stop()
            self._path = None
            self.controller.halt()
            await self._acknowledge(connection, point, SUCCESS)
        elif point.sequence >= 0:
            self.pointed(self._served)
            await self._acknowledge(connection, point, SUCCESS)
            await self._execute(connection, point)

    async def _wait(self, connection: Connection) -> None:
        """A stop that comes meanwhile is seen, and not read."""
        await asyncio.sleep(_LOOK)
        data = connection.waiting()
        with suppress(NotAMessage):
            if len(data) >= PREFIX:
                last = self._packing.message(data[-self.length(data) :])
                if self._packing.point(last.body).sequence == STOP:
                    self.told_to_stop()

    def joint_state(self, group: int, served: ServedArm) -> bytes:
        return self._packing.joint_position(served.state()[0])

    async def _acknowledge(self, connection: Connection, point: Point, code: int) -> None:
        reply = self._packing.joint_position((), comm=REPLY, reply=code, sequence=point.sequence)
        await self.reply(connection, reply)

    async def _execute(self, connection: Connection, point: Point) -> None:
        place = self._served.place(point.joints)
        if not is_reachable(self._served, place):
            await self._acknowledge(connection, point, FAILURE)
            raise NotAMessage("a point out of reach")
        while not self.controller.motion_possible:
            await self._wait(connection)
        arm = self._served.arm
        with arm.lock:
            path, t = self._path, arm.clock.now() - self._began
            if path is None or t > path.end:
                path, t = RunOn(arm.commanded(), arm.speed, arm.acceleration), 0.0
            ready = path.add(place, t, self._own_speed.along(path.last, place))
            if t == 0.0:
                self._path, self._began = path, arm.follow(path)
        while arm.clock.now() < self._began + ready and self.controller.motion_possible:
            await self._wait(connection)
        if not self.controller.motion_possible:
            self._path = None
