"""What differs between servers that all speak simple message: how points are cut, sent, acknowledged and stopped."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from typing import ClassVar

import numpy as np

from backends.controller.course import Course
from backends.controller.options import TcpLink
from backends.controller.tcp.codec import (
    END_DOWNLOAD,
    START_DOWNLOAD,
    STOP,
    Acknowledgement,
    Code,
    Comm,
    JointPosition,
    JointTrajPt,
    JointTrajPtFull,
    Message,
    MotoMotionCtrl,
    MotoMotionReply,
    Ping,
    Valid,
    ten,
)
from dualcal_hal.robot import Joints

STOP_BEHIND = 0.3
"""Seconds that a stop may wait behind points that a controller has begun with or has taken before it."""

START_COMMANDS, START_SERVOS, STOP_SERVOS, RESET_ALARM = 200121, 200112, 200113, 200114
STOP_MOTION = 200111
"""MotoROS' commands."""

_RESULTS = {
    **{2: "it failed", 3: "it is invalid", 4: "the controller has an alarm", 5: "the controller is not ready"},
    6: "the controller's own programming interface failed",
}
_SUBCODES = {
    **{3001: "size", 3002: "header", 3003: "kind of message", 3004: "group", 3005: "sequence", 3006: "command"},
    **{3011: "start is not where the arm stands", 3012: "position", 3013: "speed", 3014: "acceleration"},
    **{3015: "time, position or velocity missing", 3016: "time"},
    **{5001: "alarm", 5002: "error", 5003: "emergency stop", 5004: "not in play mode", 5005: "not in remote mode"},
    **{5006: "servos are off", 5007: "hold", 5008: "job is not started", 5009: "job does not wait for points"},
    **{5010: "waits for another job", 5011: "power and force limiting is active", 5012: "increment refused"},
}


class Verdict(StrEnum):
    """What a reply says of a request."""

    TAKEN = "taken"
    BUSY = "busy"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Judged:
    """``why`` a request was refused, in words and with the controller's codes."""

    verdict: Verdict
    why: str = ""


class TooManyPoints(ValueError):
    """A course that the controller has no room for."""


class Dialect(ABC):
    """A server's ways. ``group`` is the arm's, where messages carry one.

    acknowledges_within: s in which a reply comes. downloads: whether nothing moves before all points are there.
    begins_within: s in which the arm begins to move once all points are taken. pings: whether the motion port takes a
    PING. switches: whether drives and faults can be reached by messages.
    """

    acknowledges_within: ClassVar[float] = 1.0
    downloads: ClassVar[bool] = False
    begins_within: ClassVar[float] = 0.1
    pings: ClassVar[bool] = False
    switches: ClassVar[bool] = False

    def __init__(self, top_speed: Joints) -> None:
        """``top_speed``: rad/s of each of the controller's joints, what a velocity is a fraction of."""
        self._top_speed = np.array(top_speed)

    def opening(self, group: int) -> tuple[Message, ...]:
        """What is to be taken before the first point of a course."""
        return ()

    @abstractmethod
    def points(self, course: Course, group: int) -> tuple[Message, ...]:
        """A course as messages, each of which is to be taken before the next is sent; TooManyPoints."""

    @abstractmethod
    def stop(self, group: int) -> Message:
        """What ends all motion."""

    @abstractmethod
    def answers(self, reply: Message, request: Message) -> bool:
        """Whether this is the reply to that request."""

    @abstractmethod
    def judge(self, reply: Message) -> Judged:
        """What a reply says of the request that it answers."""

    def _point(self, course: Course, sequence: int, times: tuple[float, float], slowest: float) -> JointTrajPt:
        """The point at the end of a segment between two times; ``slowest``: its least duration, s."""
        begin, end = times
        duration = max(end - begin, slowest)
        position = course.sample(end)[0]
        speed = np.abs(position - course.sample(begin)[0]) / duration
        return JointTrajPt(
            sequence=sequence,
            positions=ten(position),
            velocity=float(np.clip(np.max(speed / self._top_speed), _LEAST_FRACTION, 1.0)),
            duration=duration,
        )


_LEAST_FRACTION = 1e-3  # zero is no velocity
_LEAST_DURATION = 0.01  # s; nor zero a duration


class _PointByPoint(Dialect):
    """A stream of JOINT_TRAJ_PT: the next point once the last was taken."""

    longest: ClassVar[float] = STOP_BEHIND / 2
    """Seconds of a segment: a stop may wait behind the one that is executed and one that was taken after it."""

    def points(self, course: Course, group: int) -> tuple[Message, ...]:
        times = (0.0, *course.times(self.longest))
        if len(times) == 1:  # it ends where it begins
            times = (0.0, 0.0)
        return tuple(
            self._point(course, sequence, segment, _LEAST_DURATION) for sequence, segment in enumerate(pairwise(times))
        )

    def stop(self, group: int) -> Message:
        return _stop()


class Rep(_PointByPoint):
    """As the REP has it: same id in the reply, with or without a body."""

    pings = True

    def answers(self, reply: Message, request: Message) -> bool:
        return _is_reply_to(reply, request)

    def judge(self, reply: Message) -> Judged:
        return _by_code(reply)


class Fanuc(_PointByPoint):
    """Replies by a JOINT_POSITION with the point's number, before it moves, and reads no more until it has moved."""

    # A reply waits behind a segment, which lasts as long as the speed set at the controller has it.
    acknowledges_within = 5.0

    def answers(self, reply: Message, request: Message) -> bool:
        if isinstance(reply, Acknowledgement):
            return reply.id == JointPosition.ID and reply.code == Code.FAILURE
        return (
            isinstance(reply, JointPosition)
            and isinstance(request, JointTrajPt)
            and reply.comm == Comm.REPLY
            and reply.sequence == request.sequence
        )

    def judge(self, reply: Message) -> Judged:
        return _by_code(reply)


class Abb(Dialect):
    """Takes all points before it moves, and blends the corners; it has room for so many."""

    begins_within = 0.5
    downloads = True

    def __init__(self, top_speed: Joints, room: int) -> None:
        super().__init__(top_speed)
        self._room = room

    def points(self, course: Course, group: int) -> tuple[Message, ...]:
        times = (0.0, 0.0, *_arrivals(course))
        if len(times) == 2:
            times = (0.0, 0.0, 0.0)
        count = len(times) - 1
        if count > self._room:
            raise TooManyPoints(
                f"{count} points, the start among them, and the controller takes {self._room} and loses the rest"
            )
        numbers = (START_DOWNLOAD, *range(1, count - 1), END_DOWNLOAD)
        segments = pairwise(times)
        return tuple(
            self._point(course, sequence, segment, _LEAST_DURATION * 10)
            for sequence, segment in zip(numbers, segments, strict=True)
        )

    def stop(self, group: int) -> Message:
        return _stop()

    def answers(self, reply: Message, request: Message) -> bool:
        return _is_reply_to(reply, request)

    def judge(self, reply: Message) -> Judged:
        return _by_code(reply)


class Motoman(Dialect):
    """MotoROS: points with time, position and velocity, interpolated by the controller; busy when it has no room."""

    switches = True
    longest: ClassVar[float] = 0.1
    """Seconds between points. Its cubics through them stay on a segment's line, since all joints are in proportion."""

    def opening(self, group: int) -> tuple[Message, ...]:
        return (self.command(START_COMMANDS, group),)

    def points(self, course: Course, group: int) -> tuple[Message, ...]:
        return tuple(
            self._full(course, time, sequence, group)
            for sequence, time in enumerate((0.0, *course.times(self.longest)))
        )

    def stop(self, group: int) -> Message:
        return self.command(STOP_MOTION, group)

    def command(self, command: int, group: int) -> Message:
        """One of MotoROS' commands."""
        return MotoMotionCtrl(group=group, sequence=0, command=command)

    def answers(self, reply: Message, request: Message) -> bool:
        if isinstance(reply, Acknowledgement):
            return reply.id == MotoMotionReply.ID and reply.code == Code.FAILURE
        if not isinstance(reply, MotoMotionReply) or not isinstance(request, MotoMotionCtrl | JointTrajPtFull):
            return False
        asked = request.command if isinstance(request, MotoMotionCtrl) else JointTrajPtFull.ID
        return reply.command == asked and reply.sequence == request.sequence and reply.group == request.group

    def judge(self, reply: Message) -> Judged:
        if not isinstance(reply, MotoMotionReply):
            return _by_code(reply)
        if reply.result == 0:
            return Judged(Verdict.TAKEN)
        if reply.result == 1:
            return Judged(Verdict.BUSY)
        why = f"{_RESULTS.get(reply.result, 'it was not taken')} (result {reply.result}, code {reply.subcode}"
        detail = _SUBCODES.get(reply.subcode)
        return Judged(Verdict.REFUSED, why + (f": {detail})" if detail else ")"))

    def _full(self, course: Course, time: float, sequence: int, group: int) -> JointTrajPtFull:
        position, velocity = course.sample(time)
        return JointTrajPtFull(
            group=group,
            sequence=sequence,
            valid=Valid.TIME | Valid.POSITION | Valid.VELOCITY,
            time=time,
            positions=ten(position),
            velocities=ten(velocity),
        )


ABB_ROOM = 200
"""Points that an ABB server has room for."""


def dialect(options: TcpLink, top_speed: Joints) -> Dialect:
    """The one that the cell file names."""
    match options.dialect:
        case "rep":
            return Rep(top_speed)
        case "abb":
            return Abb(top_speed, options.max_points or ABB_ROOM)
        case "fanuc":
            return Fanuc(top_speed)
        case "motoman":
            return Motoman(top_speed)


def ping() -> Message:
    """Asks whether a server is there."""
    return Ping()


def _stop() -> Message:
    return JointTrajPt(sequence=STOP, positions=ten(()), velocity=0.0, duration=0.0)


def _arrivals(course: Course) -> Iterator[float]:
    """When each waypoint is reached that the arm is not at already."""
    before = 0.0
    for arrival in course.arrivals:
        if arrival > before:
            yield arrival
        before = arrival


def _is_reply_to(reply: Message, request: Message) -> bool:
    return isinstance(reply, Acknowledgement) and reply.id == request.ID


def _by_code(reply: Message) -> Judged:
    if reply.code == Code.SUCCESS:
        return Judged(Verdict.TAKEN)
    return Judged(Verdict.REFUSED, f"the controller says that it failed (reply_code {int(reply.code)})")
