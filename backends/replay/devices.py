"""Arms and camera that answer as they did when they were recorded."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeVar

from backends.replay.comparison import difference
from backends.replay.timeline import Timeline, ended
from dualcal_hal.camera import Camera, Frame
from dualcal_hal.errors import LogDamaged, ReplayMismatch
from dualcal_hal.robot import JointPath, Motion, Robot, RobotState, StopResult
from dualcal_hal.session.log import Call, FrameRef, Reply, Value

if TYPE_CHECKING:
    from dualcal_hal.clock import Clock

T = TypeVar("T")
Opened = Callable[[str, str], Timeline]
"""By device and what is attempted: what is played back, or NotOpen."""


class ReplayedRobot(Robot):
    """An arm of a recording."""

    def __init__(self, name: str, joints: int, clock: Clock, opened: Opened) -> None:
        self.name = name
        self._joints = joints
        self._clock = clock
        self._opened = opened

    @property
    def joints(self) -> int:
        return self._joints

    def read(self, timeout: float) -> RobotState:
        _, reply = _answer(self._opened(self.name, "read"), self.name, "read")
        return _expect(reply, RobotState)

    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """What arrived by the recorded subscription; where none was, which is no command, the states for viewers."""
        timeline = self._opened(self.name, "subscribe")
        unwatch = timeline.watch(self.name, function)  # before the recording is read any further
        recorded = timeline.next_call(self.name)
        if recorded is None or recorded.call.method != "subscribe":
            return unwatch
        unwatch()
        call, _ = _answer(timeline, self.name, "subscribe")
        return timeline.subscribe(self.name, call.index, function)

    def start(self, path: JointPath) -> Motion:
        timeline = self._opened(self.name, "move")
        call, _ = _answer(timeline, self.name, "start", path=path)
        motion = Motion(self.name, self._clock)
        timeline.follow(self.name, call.index, motion)
        return motion

    def stop(self, reason: str) -> StopResult:
        """As recorded; where none is, whatever moves ends at once: a stop is never refused."""
        timeline = self._opened(self.name, "stop")
        recorded = timeline.next_call(self.name)
        if recorded is not None and recorded.call.method == "stop":
            reply = timeline.take(recorded)
            if reply.error is not None:
                raise reply.error.error()
            return _expect(reply, StopResult)
        for motion in timeline.moving(self.name):
            motion.stop(reason)
        return StopResult(confirmed=True, detail="not recorded; what is played back stands")

    def enable(self, timeout: float) -> None:
        _answer(self._opened(self.name, "enable"), self.name, "enable")

    def disable(self, timeout: float) -> None:
        _answer(self._opened(self.name, "disable"), self.name, "disable")

    def reset_fault(self, timeout: float) -> None:
        _answer(self._opened(self.name, "reset a fault"), self.name, "reset_fault")


class ReplayedCamera(Camera):
    """The camera of a recording."""

    def __init__(self, name: str, opened: Opened) -> None:
        self.name = name
        self._opened = opened

    def grab(self, not_before: float, timeout: float) -> Frame:
        timeline = self._opened(self.name, "grab")
        _, reply = _answer(timeline, self.name, "grab")
        return timeline.frame(_expect(reply, FrameRef))


def _answer(timeline: Timeline, device: str, method: str, **arguments: Value) -> tuple[Call, Reply]:
    """The recorded call and its reply, if the same is asked now; the recorded error if it ended in one.

    Times and timeouts are not compared: recorded time goes on by recorded replies.
    """
    recorded = timeline.next_call(device)
    if recorded is None:
        raise ended(device, method)
    call = recorded.call
    if call.method != method:
        raise ReplayMismatch.at(device, call.index, call.method, method, "another command")
    for name, got in arguments.items():
        expected = call.arguments.get(name)
        differs = difference(expected, got)
        if differs is not None:
            raise ReplayMismatch.at(device, call.index, expected, got, f"{method}: {differs}")
    reply = timeline.take(recorded)
    if reply.error is not None:
        raise reply.error.error()
    return call, reply


def _expect(reply: Reply, kind: type[T]) -> T:
    if not isinstance(reply.value, kind):
        what = f"{reply.device}: reply {reply.index} is no {kind.__name__}"
        raise LogDamaged("the log", None, what)
    return reply.value
