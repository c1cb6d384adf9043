"""Yaskawa's controllers with MotoROS: points with time, position and velocity, once its trajectory mode is started."""

from __future__ import annotations

import numpy as np

from backends.controller.emulator.faults import FaultSchedule
from backends.controller.emulator.tcp.controller import Controller, ServedArm
from backends.controller.emulator.tcp.packets import (
    JOINT_TRAJ_PT_FULL,
    MOTION_CTRL,
    PING,
    POSITION,
    PREFIX,
    REPLY,
    SUCCESS,
    TIME,
    VELOCITY,
    Command,
    FullPoint,
    Message,
    NotAMessage,
    Packing,
)
from backends.controller.emulator.tcp.paths import Cubic, Pieces
from backends.controller.emulator.tcp.server import Server
from backends.controller.emulator.tcp.wires import Connection, Line
from dualcal_hal.transforms import Array

_CHECK_READY = 200101
_STOP_MOTION, _START_SERVOS, _STOP_SERVOS, _RESET_ALARM = 200111, 200112, 200113, 200114
_START_TRAJECTORY_MODE, _STOP_TRAJECTORY_MODE, _DISCONNECT = 200121, 200122, 200130

OK, BUSY, FAILED, INVALID, NOT_READY = 0, 1, 2, 3, 5

SIZE, KIND, GROUP, SEQUENCE = 3001, 3003, 3004, 3005
START_POSITION, SPEED, INSUFFICIENT, NO_TIME = 3011, 3013, 3015, 3016
ALARM, E_STOP, NOT_REMOTE, SERVO_OFF, NOT_STARTED = 5001, 5003, 5005, 5006, 5008

PULSES_PER_RAD = 76_800.0
START_WITHIN = 30
"""Pulses that a first point may be off where the arm was sent."""

QUEUE = 0.8
"""Seconds of motion that there is room for: 200 increments of 4 ms."""

_TICK = 0.004  # s in which a point that was taken is put into the queue
_FASTER = 1.001  # than the arm's own speed is refused


class _Group:
    """An arm's trajectory: when it began by the clock (0 before it did), and time and velocity of its last point."""

    def __init__(self, served: ServedArm) -> None:
        self.served = served
        self.path: Pieces | None = None
        self.began = self.time = self.busy_until = 0.0
        self.velocity: Array = np.zeros(served.arm.joints)


class MotomanServer(Server):
    """All replies are of one type; the header always says success, the result what came of it.

    Starting the trajectory mode acknowledges alarms and switches the servos on; a stop stops all groups.
    """

    state_period = 0.02

    def __init__(self, controller: Controller, line: Line, packing: Packing, schedule: FaultSchedule) -> None:
        super().__init__(controller, line, packing, schedule)
        controller.ready = False
        self._groups = {number: _Group(served) for number, served in controller.arms.items()}

    async def next_message(self, connection: Connection) -> bytes:
        return await connection.receive()

    async def received(self, connection: Connection, data: bytes) -> None:
        """All messages that came in one piece; what is left of it is none."""
        while data:
            length = self._packing.length(data) if len(data) >= PREFIX else 0
            try:
                message = self._packing.message(data[:length])
            except NotAMessage:
                await self._answer(connection, 0, 0, 0, INVALID, SIZE)
                return
            await self._hear(connection, message)
            data = data[length:]

    async def _hear(self, connection: Connection, message: Message) -> None:
        if message.kind == PING:
            await self.reply(connection, self._packing.frame(PING, REPLY, SUCCESS))
            if message.body:  # it takes what it does not expect for another message
                await self._answer(connection, 0, 0, 0, INVALID, KIND)
        elif message.kind == MOTION_CTRL:
            command = self._packing.command(message.body)
            result, subcode = self._obey(command)
            await self._answer(connection, command.group, command.sequence, command.command, result, subcode)
        elif message.kind == JOINT_TRAJ_PT_FULL:
            point = self._packing.full_point(message.body)
            result, subcode = self._take(point)
            await self._answer(connection, point.group, point.sequence, JOINT_TRAJ_PT_FULL, result, subcode)
        else:
            await self._answer(connection, 0, 0, message.kind, INVALID, KIND)

    def client_lost(self) -> None:
        self._halt()

    def joint_state(self, group: int, served: ServedArm) -> bytes:
        return self._packing.joint_feedback(group, served.arm.clock.now() % 1e4, *served.state())

    async def _answer(
        self, connection: Connection, group: int, sequence: int, command: int, result: int, subcode: int
    ) -> None:
        await self.reply(connection, self._packing.motion_reply(group, sequence, command, result, subcode))

    # Commands

    def _obey(self, command: Command) -> tuple[int, int]:
        controller = self.controller
        if command.command == _CHECK_READY:
            return (OK, 0) if controller.motion_possible else (FAILED, self._why_not_ready())
        if command.command == _START_TRAJECTORY_MODE:
            return self._start()
        if command.command in (_STOP_TRAJECTORY_MODE, _DISCONNECT) and controller.in_motion:
            return FAILED, 0
        if command.command in (_STOP_MOTION, _STOP_SERVOS):
            self.told_to_stop()
            self._halt()
        if command.command in (_STOP_SERVOS, _STOP_TRAJECTORY_MODE, _DISCONNECT):
            controller.ready = False
        if command.command == _STOP_SERVOS:
            controller.powered = False
        if command.command == _RESET_ALARM:
            controller.reset()
        if command.command == _START_SERVOS:
            controller.powered = not controller.e_stopped and not controller.error
            return (OK if controller.powered else FAILED), 0
        return OK, 0

    def _start(self) -> tuple[int, int]:
        controller = self.controller
        if not controller.e_stopped and controller.automatic:
            controller.reset()
            controller.powered = controller.ready = True
        return (OK, 0) if controller.motion_possible else (NOT_READY, self._why_not_ready())

    def _why_not_ready(self) -> int:
        controller = self.controller
        if controller.error:
            return ALARM
        if controller.e_stopped:
            return E_STOP
        if not controller.automatic:
            return NOT_REMOTE
        return NOT_STARTED if controller.powered else SERVO_OFF

    def _halt(self) -> None:
        for group in self._groups.values():
            group.path = None
        self.controller.halt()

    # Points

    def _take(self, point: FullPoint) -> tuple[int, int]:
        if not self.controller.motion_possible:
            return NOT_READY, self._why_not_ready()
        group = self._groups.get(point.group)
        if group is None:
            return INVALID, GROUP
        self.pointed(group.served)
        needed = TIME | POSITION | VELOCITY
        if point.valid & needed != needed:
            return INVALID, INSUFFICIENT
        if point.sequence < 0:
            return INVALID, SEQUENCE
        arm = group.served.arm
        with arm.lock:
            place, velocity = group.served.place(point.positions), group.served.velocity(point.velocities)
            if not np.all(np.abs(velocity) <= _FASTER * arm.speed):
                return INVALID, SPEED
            if point.sequence == 0:
                return self._begin(group, point, place, velocity)
            return self._go_on(group, point, place, velocity)

    def _begin(self, group: _Group, point: FullPoint, place: Array, velocity: Array) -> tuple[int, int]:
        commanded = group.served.arm.commanded()
        off = group.served.map.to_controller(place) - group.served.map.to_controller(commanded)
        if not np.all(np.abs(np.rint(PULSES_PER_RAD * off)) <= START_WITHIN):
            return INVALID, START_POSITION
        group.path, group.time, group.velocity = Pieces(commanded), point.time, velocity
        group.began = group.busy_until = 0.0
        return OK, 0

    def _go_on(self, group: _Group, point: FullPoint, place: Array, velocity: Array) -> tuple[int, int]:
        arm, path, now = group.served.arm, group.path, group.served.arm.clock.now()
        if path is None:
            return INVALID, SEQUENCE
        t = now - group.began
        if now < group.busy_until or path.end - t > QUEUE:
            return BUSY, 0
        lasts = point.time - group.time
        if not lasts > 0.0:
            return INVALID, NO_TIME
        if t > path.end:  # it stands, at the first point or because no other came in time
            leaving = group.velocity if group.began == 0.0 else np.zeros_like(velocity)
            path = group.path = Pieces(path.last)
            path.add(Cubic(0.0, lasts, path.last, place, leaving, velocity), place)
            group.began = arm.follow(path)
        else:
            path.add(Cubic(path.end, path.end + lasts, path.last, place, group.velocity, velocity), place)
        group.time, group.velocity, group.busy_until = point.time, velocity, now + _TICK
        return OK, 0
