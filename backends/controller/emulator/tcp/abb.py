"""ABB's IRC5 with ROS-Industrial's RAPID server: downloads, at the controller's own speed."""

from __future__ import annotations

import asyncio

import numpy as np

from backends.controller.emulator.faults import FaultSchedule
from backends.controller.emulator.tcp.controller import SERVER_FAULT, Controller, ServedArm
from backends.controller.emulator.tcp.own_speed import OwnSpeed
from backends.controller.emulator.tcp.packets import (
    END,
    JOINT_TRAJ_PT,
    PREFIX,
    REPLY,
    REQUEST,
    START_DOWNLOAD,
    STOP,
    SUCCESS,
    NotAMessage,
    Packing,
    Point,
)
from backends.controller.emulator.tcp.paths import RunOn, corners
from backends.controller.emulator.tcp.server import Server, is_reachable
from backends.controller.emulator.tcp.wires import Connection, Line
from dualcal_hal.transforms import Array

ROOM = 200
"""Points that there is room for; further ones are lost without a word."""

_IS_THERE = np.radians(0.1)  # from where the arm stands a first point is left out
_LOOK = 0.01  # s from one look whether the arm rests to the next


class AbbServer(Server):
    """START and END are points themselves, as the client's first and last; nothing moves before END.

    Anything but a trajectory point is an error that ends the server's program, and so is a piece of one: it does not
    wait for the rest. A lost client stops nothing.
    """

    state_period = 0.1

    def __init__(
        self,
        controller: Controller,
        line: Line,
        packing: Packing,
        schedule: FaultSchedule,
        own_speed: OwnSpeed,
        room: int = ROOM,
    ) -> None:
        super().__init__(controller, line, packing, schedule)
        (self._served,) = controller.arms.values()
        self._own_speed, self._room = own_speed, room
        self._points: list[Array] = []
        self._going: asyncio.Task[None] | None = None

    async def next_message(self, connection: Connection) -> bytes:
        start = await connection.receive(PREFIX)
        if not start:
            return start
        if len(start) < PREFIX:
            raise NotAMessage("a piece of a length")
        length = self.length(start)
        rest = await connection.receive(length - PREFIX)
        if len(rest) < length - PREFIX:
            raise NotAMessage("a piece of a message")
        return start + rest

    async def received(self, connection: Connection, data: bytes) -> None:
        message = self._packing.message(data)
        if message.kind != JOINT_TRAJ_PT:
            raise NotAMessage(f"a message of type {message.kind}")
        self._take(self._packing.point(message.body))
        if message.comm == REQUEST:
            await self.reply(connection, self._packing.frame(JOINT_TRAJ_PT, REPLY, SUCCESS))

    async def misunderstood(self, connection: Connection, error: NotAMessage) -> None:
        self.controller.ready = False
        self._halt()
        self.controller.error = SERVER_FAULT

    def joint_state(self, group: int, served: ServedArm) -> bytes:
        return self._packing.joint_position(served.state()[0])

    def _take(self, point: Point) -> None:
        if point.sequence == STOP:
            self.told_to_stop()
            self._points = []
            self._halt()
            return
        self.pointed(self._served)
        if point.sequence == START_DOWNLOAD:
            self._points = []
        if len(self._points) < self._room:
            self._points.append(self._served.place(point.joints))
        if point.sequence == END:
            points, self._points = self._points, []
            self._halt()
            self._going = asyncio.create_task(self._go(points))

    def _halt(self) -> None:
        if self._going is not None:
            self._going.cancel()
            self._going = None
        self.controller.halt()

    async def _go(self, points: list[Array]) -> None:
        """Once the arm rests, by all points; not where motion is not possible."""
        arm = self._served.arm
        while arm.in_motion:
            await asyncio.sleep(_LOOK)
        if not self.controller.motion_possible or not all(is_reachable(self._served, point) for point in points):
            return
        with arm.lock:
            here = start = arm.commanded()
            if np.max(np.abs(points[0] - here)) < _IS_THERE:
                points = points[1:]
            path = RunOn(start, arm.speed, arm.acceleration)
            for corner in corners(start, points):
                path.add(corner, 0.0, self._own_speed.along(here, corner))
                here = corner
            if path.end > 0.0:
                arm.follow(path)
