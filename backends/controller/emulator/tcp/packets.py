"""Simple message as a controller's server writes and reads it; written by REP I0006, without the driver's code."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

PING, JOINT_POSITION, JOINT_TRAJ_PT, STATUS, JOINT_TRAJ_PT_FULL, JOINT_FEEDBACK = 1, 10, 11, 13, 14, 15
MOTION_CTRL, MOTION_REPLY = 2001, 2002

TOPIC, REQUEST, REPLY = 1, 2, 3
UNUSED, SUCCESS, FAILURE = 0, 1, 2

START_DOWNLOAD, START_STREAMING, END, STOP = -1, -2, -3, -4
"""Sequence numbers that are none."""

UNKNOWN, OFF, ON = -1, 0, 1
MANUAL, AUTO = 1, 2

TIME, POSITION, VELOCITY = 1, 2, 4
"""Bits of the fields that are valid."""

JOINTS = 10
"""Entries of every array of joints."""

PREFIX, HEADER = 4, 16
"""Bytes of the length, and up to the body."""


class NotAMessage(Exception):
    """Bytes that a controller can make nothing of."""


@dataclass(frozen=True)
class Message:
    """kind: its type; comm: topic, request or reply."""

    kind: int
    comm: int
    reply: int
    body: bytes


@dataclass(frozen=True)
class Point:
    """Of a trajectory; in the controller's joints (10,) rad; velocity: a fraction of the largest; duration: s."""

    sequence: int
    joints: tuple[float, ...]
    velocity: float
    duration: float


@dataclass(frozen=True)
class FullPoint:
    """Of a trajectory; ``time`` in s since its begin, positions (10,) rad and velocities (10,) rad/s of the
    controller's joints; valid: bits."""

    group: int
    sequence: int
    valid: int
    time: float
    positions: tuple[float, ...]
    velocities: tuple[float, ...]


@dataclass(frozen=True)
class Command:
    """Of MotoROS."""

    group: int
    sequence: int
    command: int


@dataclass(frozen=True)
class Status:
    """Each 1, 0 or -1 for unknown, but the code and the mode."""

    drives_powered: int
    e_stopped: int
    error_code: int
    in_error: int
    in_motion: int
    mode: int
    motion_possible: int


class Packing:
    """How one controller's server packs its numbers."""

    def __init__(self, big: bool, double: bool) -> None:
        self._order = ">" if big else "<"
        self._real = "d" if double else "f"

    def frame(self, kind: int, comm: int, reply: int, body: bytes = b"") -> bytes:
        """A message with its length before it."""
        return struct.pack(f"{self._order}4i", HEADER - PREFIX + len(body), kind, comm, reply) + body

    def length(self, start: bytes) -> int:
        """Bytes of the message that begins so, its length's included."""
        (length,) = struct.unpack_from(f"{self._order}i", start)
        return PREFIX + int(length)

    def message(self, data: bytes) -> Message:
        """What bytes say that came in one piece; NotAMessage if they are not one message."""
        if len(data) < HEADER:
            raise NotAMessage(f"{len(data)} bytes")
        if self.length(data) != len(data):
            raise NotAMessage(f"{len(data)} bytes that say of themselves to be {self.length(data)}")
        _, kind, comm, reply = struct.unpack_from(f"{self._order}4i", data)
        return Message(kind, comm, reply, data[HEADER:])

    def point(self, body: bytes) -> Point:
        """NotAMessage for a body of another size."""
        sequence, *reals = self._unpack(f"i{JOINTS + 2}{self._real}", body)
        return Point(int(sequence), tuple(reals[:JOINTS]), reals[JOINTS], reals[JOINTS + 1])

    def full_point(self, body: bytes) -> FullPoint:
        """NotAMessage for a body of another size."""
        group, sequence, valid, time, *reals = self._unpack(f"3i{3 * JOINTS + 1}{self._real}", body)
        positions, velocities = tuple(reals[:JOINTS]), tuple(reals[JOINTS : 2 * JOINTS])
        return FullPoint(int(group), int(sequence), int(valid), time, positions, velocities)

    def command(self, body: bytes) -> Command:
        """NotAMessage for a body of another size."""
        group, sequence, command, *_ = self._unpack(f"3i{JOINTS}{self._real}", body)
        return Command(int(group), int(sequence), int(command))

    def joint_position(
        self, joints: Sequence[float], comm: int = TOPIC, reply: int = UNUSED, sequence: int = 0
    ) -> bytes:
        """A state, or FANUC's reply to a point."""
        return self.frame(JOINT_POSITION, comm, reply, self._pack(f"i{JOINTS}{self._real}", sequence, *_ten(joints)))

    def joint_feedback(self, group: int, time: float, positions: Sequence[float], velocities: Sequence[float]) -> bytes:
        """A state with velocities."""
        values = (*_ten(positions), *_ten(velocities), *_ten(()))
        body = self._pack(f"2i{3 * JOINTS + 1}{self._real}", group, TIME | POSITION | VELOCITY, time, *values)
        return self.frame(JOINT_FEEDBACK, TOPIC, UNUSED, body)

    def status(self, status: Status) -> bytes:
        """A state of the controller."""
        return self.frame(
            STATUS,
            TOPIC,
            UNUSED,
            self._pack(
                "7i",
                status.drives_powered,
                status.e_stopped,
                status.error_code,
                status.in_error,
                status.in_motion,
                status.mode,
                status.motion_possible,
            ),
        )

    def motion_reply(self, group: int, sequence: int, command: int, result: int, subcode: int) -> bytes:
        """MotoROS's answer to everything."""
        values = (group, sequence, command, result, subcode, *_ten(()))
        return self.frame(MOTION_REPLY, REPLY, SUCCESS, self._pack(f"5i{JOINTS}{self._real}", *values))

    def ints(self, count: int) -> bytes:
        """So many zeros."""
        return self._pack(f"{count}i", *[0] * count)

    def reals(self, count: int) -> bytes:
        """So many zeros."""
        return self._pack(f"{count}{self._real}", *[0.0] * count)

    def _pack(self, layout: str, *values: float) -> bytes:
        return struct.pack(self._order + layout, *values)

    def _unpack(self, layout: str, body: bytes) -> tuple[float, ...]:
        try:
            return struct.unpack(self._order + layout, body)
        except struct.error as error:
            raise NotAMessage(f"a body of {len(body)} bytes") from error


def _ten(values: Sequence[float]) -> tuple[float, ...]:
    return tuple(values) + (0.0,) * (JOINTS - len(values))
