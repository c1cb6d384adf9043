"""What all controllers' servers share: a port that takes motion messages, and one that tells states."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from backends.controller.emulator.faults import FaultSchedule
from backends.controller.emulator.tcp.controller import Controller, ServedArm
from backends.controller.emulator.tcp.packets import HEADER, PREFIX, NotAMessage, Packing
from backends.controller.emulator.tcp.wires import Connection, Line
from dualcal_hal.transforms import Array

_LONGEST = 4096  # bytes of a message
_BEYOND = 1e-3  # rad by which a point may be beyond a limit


class Server(ABC):
    """One controller's two servers; on the servers' thread only.

    state_period: s between states; states_a_status: states for each status.
    """

    state_period: ClassVar[float]
    states_a_status: ClassVar[int] = 1

    def __init__(self, controller: Controller, line: Line, packing: Packing, schedule: FaultSchedule) -> None:
        self.controller = controller
        self._line = line
        self._packing = packing
        self._schedule = schedule

    async def serve_motion(self, connection: Connection) -> None:
        """Talk to the client that moves the arms."""
        try:
            while data := await self.next_message(connection):
                await self.received(connection, data)
        except NotAMessage as error:
            await self.misunderstood(connection, error)
        finally:
            self.client_lost()

    async def next_message(self, connection: Connection) -> bytes:
        """The next message, put together from its pieces; empty at the end. NotAMessage for a length that cannot be."""
        start = await connection.receive_exactly(PREFIX)
        if len(start) < PREFIX:
            return b""
        length = self.length(start)
        rest = await connection.receive_exactly(length - PREFIX)
        return start + rest if len(rest) == length - PREFIX else b""

    def length(self, start: bytes) -> int:
        """Bytes of the message that begins so. NotAMessage for a length that cannot be."""
        length = self._packing.length(start)
        if not HEADER <= length <= _LONGEST:
            raise NotAMessage(f"a length of {length}")
        return length

    @abstractmethod
    async def received(self, connection: Connection, data: bytes) -> None:
        """A message came. NotAMessage."""

    async def misunderstood(self, connection: Connection, error: NotAMessage) -> None:
        """What came was no message; the connection is closed behind this."""
        return  # nothing else is done

    def client_lost(self) -> None:
        """Nobody is there any more who moves the arms."""
        return  # they go on

    async def serve_state(self, connection: Connection) -> None:
        """Tell a client how things are, again and again."""
        loop = asyncio.get_running_loop()
        due, number = loop.time(), 0
        while True:
            for group, served in self.controller.arms.items():
                await self._line.state(connection, self.joint_state(group, served))
            if number % self.states_a_status == 0:
                await self._line.state(connection, self._packing.status(self.controller.status()))
            number += 1
            due = max(due + self.state_period, loop.time())
            await asyncio.sleep(due - loop.time())

    @abstractmethod
    def joint_state(self, group: int, served: ServedArm) -> bytes:
        """The message with an arm's joints."""

    async def reply(self, connection: Connection, data: bytes) -> None:
        """Answer a client."""
        await self._line.reply(connection, data)

    def pointed(self, served: ServedArm) -> None:
        """A trajectory point came."""
        self._schedule.pointed(served.name)

    def told_to_stop(self) -> None:
        """A stop came, which is one for all arms of a controller."""
        for served in self.controller.arms.values():
            self._schedule.stopped(served.name)


def is_reachable(served: ServedArm, place: Array) -> bool:
    """Whether joint angles (n,) are numbers within the limits."""
    arm = served.arm
    return bool(np.all(np.isfinite(place)) and np.all((place >= arm.lower - _BEYOND) & (place <= arm.upper + _BEYOND)))
