"""A log as it is played back: what devices answered waits until it is asked for, the rest happens at its time."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from dualcal_hal.camera import Frame
from dualcal_hal.clock import VirtualClock
from dualcal_hal.errors import WORK, FrameMissing, LogDamaged, LogEnded
from dualcal_hal.robot import Mode, Motion, MotionState, RobotState
from dualcal_hal.session.log import (
    Arrived,
    Call,
    FrameRef,
    Item,
    JointReading,
    LogReader,
    MotionEnded,
    Picture,
    Reply,
    Worked,
)
from dualcal_hal.session.log.attempts import FinishedAttempts

_COMMANDS = frozenset({"start", "grab", "enable", "disable", "reset_fault"})
"""Calls that make something happen; a stop may always be one more or less, and a reading harms nobody."""

_SEQUENCES = 1 << 32
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_MICROSECOND = timedelta(microseconds=1)


class RecordedClock(VirtualClock):
    """Recorded time: waiting plays the log, up to the end of the wait."""

    def __init__(self) -> None:
        super().__init__()
        self.play_next: Callable[[float | None], float | None] = lambda until: None
        """Lets the log's next item happen if it is no later than ``until``; its time, or None."""

    def wait(self, event: threading.Event, deadline: float | None) -> bool:
        while not event.is_set():
            when = self.play_next(deadline)
            if when is None:
                break
            super().wait(event, when)
        return super().wait(event, deadline)

    def advance(self, when: float) -> None:
        """Let the time come, and happen what is due."""
        super().wait(threading.Event(), when)


@dataclass(frozen=True)
class Recorded:
    """A call and what came of it."""

    call: Call
    reply: Reply


class Timeline:
    """The items of a log, read as they are needed and each once. Any thread may ask."""

    def __init__(self, paths: list[Path], clock: RecordedClock) -> None:
        """Reads the files once; LogMissing, LogDamaged or LogTooNew."""
        self._clock = clock
        about = [_About.of(path) for path in paths]
        self._exact = [each.exact for each in about]
        self._watchers: dict[str, Callable[[RobotState], None]] = {}
        items = FinishedAttempts(paths).items(self._watchers.__contains__)
        self._items = _in_one_time(items, about, clock.now())
        self._lock = threading.RLock()
        self._calls: dict[str, deque[Call]] = {}
        self._replies: dict[tuple[str, int], Reply] = {}
        self._pictures: dict[tuple[str, int], Picture] = {}
        self._works: deque[tuple[Worked, bool]] = deque()
        self._motions: dict[tuple[str, int], Motion] = {}
        self._ending: set[tuple[str, int]] = set()
        """Motions of which it is known when they end."""
        self._ends: dict[tuple[str, int], MotionEnded] = {}
        self._subscribers: dict[tuple[str, int], Callable[[RobotState], None]] = {}
        self._next: tuple[float, int, Item] | None = None
        clock.play_next = self._play_next

    def close(self) -> None:
        """Read nothing more; end what moves. Any number of times."""
        with self._lock:
            self._clock.play_next = lambda until: None
            self._items.close()
            self._next = None
            motions, self._motions = list(self._motions.values()), {}
            self._subscribers.clear()
            self._watchers.clear()
        for motion in motions:
            motion.stop("the recording was closed")

    def next_call(self, device: str) -> Recorded | None:
        """What the device is asked next in the recording, with what came of it; None at its end."""
        with self._lock:
            while True:
                calls = self._calls.get(device)
                if calls:
                    reply = self._replies.get((device, calls[0].index))
                    if reply is not None and _found_it_closed(reply):
                        self._replies.pop((device, calls.popleft().index))
                        continue
                    if reply is not None:
                        return Recorded(calls[0], reply)
                if self._play_next(None) is None:
                    return None

    def take(self, recorded: Recorded) -> Reply:
        """The call is made now: what came of it, at the time when it came."""
        with self._lock:
            self._calls[recorded.call.device].popleft()
            reply = self._replies.pop((recorded.call.device, recorded.call.index))
        self._clock.advance(recorded.reply.time)
        return reply

    def next_work(self) -> tuple[Worked, bool] | None:
        """What is worked out next in the recording, and whether its images are exact; None at its end."""
        with self._lock:
            while not self._works:
                if self._play_next(None) is None:
                    return None
            return self._works[0]

    def take_work(self) -> None:
        """The work of :meth:`next_work` is done."""
        with self._lock:
            self._works.popleft()

    def follow(self, device: str, index: int, motion: Motion) -> None:
        """End the motion that this call began as it was recorded to end."""
        with self._lock:
            self._motions[device, index] = motion
            ended = self._ends.pop((device, index), None)
        if ended is not None:
            self._schedule_end(ended)

    def moving(self, device: str) -> list[Motion]:
        """The device's motions that have not ended."""
        with self._lock:
            return [motion for (name, _), motion in self._motions.items() if name == device]

    def subscribe(self, device: str, index: int, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """Hand over what arrived by this call; returns what ends that."""
        with self._lock:
            self._subscribers[device, index] = function
        return lambda: self._unsubscribe(device, index)

    def watch(self, device: str, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """Hand over the joint states that were kept for viewers; returns what ends that.

        They do not say in which mode the arm was.
        """
        with self._lock:
            self._watchers[device] = function
        return lambda: self._unwatch(device)

    def not_asked(self) -> Call | Worked | None:
        """The first command or piece of work in the rest of the recording that nobody has asked for."""
        while self._play_next(None) is not None:
            pass
        with self._lock:
            calls = (call for calls in self._calls.values() for call in calls)
            rest: list[Call | Worked] = [
                call for call in calls if call.method in _COMMANDS and not self._was_closed(call)
            ]
            rest += [work for work, _ in self._works]
        return min(rest, key=lambda each: each.time, default=None)

    def frame(self, reference: FrameRef) -> Frame:
        """The frame that a reply speaks of; FrameMissing, LogDamaged."""
        with self._lock:
            picture = self._pictures.pop((reference.camera, reference.sequence % _SEQUENCES), None)
        if picture is None:
            why = f"the recording has no image {reference.sequence}"
            raise FrameMissing(reference.camera, "grab", why, "see what dualcal log check says of it")
        image = picture.decode()
        image.setflags(write=False)
        return Frame(image, reference.time, reference.sequence)

    # The log goes on

    def _play_next(self, until: float | None) -> float | None:
        with self._lock:
            if self._next is None:
                self._next = next(self._items, None)
            if self._next is not None:
                when, file, item = self._next
                if until is not None and when > until:
                    return None
                self._next = None
                self._happen(item, file, when)
                return when
            endless = [self._motions.pop(key) for key in self._motions.keys() - self._ending]
        for motion in endless:
            motion.end(MotionState.FAILED, None, ended(motion.device, "move"))
        return None

    def _happen(self, item: Item, file: int, when: float) -> None:
        match item:
            case Call(device):
                self._calls.setdefault(device, deque()).append(item)
            case Reply(device, index):
                self._replies[device, index] = item
            case Picture(camera, sequence):
                # One that no reply spoke of is not needed any more when the next comes.
                self._pictures = {key: kept for key, kept in self._pictures.items() if self._is_awaited(key)}
                self._pictures[camera, sequence] = item
            case Worked():
                self._works.append((item, self._exact[file]))
            case MotionEnded(device, index):
                if (device, index) in self._motions:
                    self._schedule_end(item)
                else:
                    self._ends[device, index] = item
            case Arrived(device, index, _, time):
                self._clock.call_at(time, lambda: self._hand_over(device, index, item.state))
            case JointReading(arm, sequence, positions, velocities):
                state = RobotState(positions, velocities, Mode.UNKNOWN, (), when, sequence)
                self._clock.call_at(when, lambda: self._show(arm, state))

    def _is_awaited(self, picture: tuple[str, int]) -> bool:
        frames = (reply.value for reply in self._replies.values())
        return any(isinstance(f, FrameRef) and (f.camera, f.sequence % _SEQUENCES) == picture for f in frames)

    def _schedule_end(self, ended: MotionEnded) -> None:
        def end() -> None:
            with self._lock:
                motion = self._motions.pop((ended.device, ended.index), None)
                self._ending.discard((ended.device, ended.index))
            if motion is not None:
                motion.end(ended.state, ended.final, None if ended.error is None else ended.error.error())

        with self._lock:
            self._ending.add((ended.device, ended.index))
        self._clock.call_at(ended.time, end)

    def _hand_over(self, device: str, index: int, state: RobotState) -> None:
        with self._lock:
            function = self._subscribers.get((device, index))
        if function is not None:
            function(state)

    def _show(self, arm: str, state: RobotState) -> None:
        with self._lock:
            function = self._watchers.get(arm)
        if function is not None:
            function(state)

    def _unwatch(self, device: str) -> None:
        with self._lock:
            self._watchers.pop(device, None)

    def _was_closed(self, call: Call) -> bool:
        reply = self._replies.get((call.device, call.index))
        return reply is not None and _found_it_closed(reply)

    def _unsubscribe(self, device: str, index: int) -> None:
        with self._lock:
            self._subscribers.pop((device, index), None)


def ended(device: str, attempted: str) -> LogEnded:
    """Nothing more is recorded of the device."""
    what = "worked out" if device == WORK else "asked of it"
    why = f"the recording ends here: nothing more was {what}"
    return LogEnded(device, attempted, why, "the recorded run had ended, or was cut off")


@dataclass(frozen=True)
class _About:
    """What a file says of itself. started: ns since 1970 (UTC), when its clock showed clock_started (s)."""

    exact: bool
    started: int
    clock_started: float

    @staticmethod
    def of(path: Path) -> _About:
        with LogReader(path) as reader:
            about = reader.about()
        try:
            since = datetime.fromisoformat(about["started"]) - _EPOCH
            clock_started = float(about["clock_started_s"])
        except (KeyError, TypeError, ValueError) as error:
            raise LogDamaged(str(path), None, "does not say when it was begun") from error
        return _About(about.get("frames") == "png", since // _MICROSECOND * 1000, clock_started)

    def clock(self, when: int) -> float:
        """Seconds of the file's clock at a time in ns since 1970."""
        return self.clock_started + (when - self.started) * 1e-9


def _found_it_closed(reply: Reply) -> bool:
    """Whether a call never reached a device: what was not open answers by itself."""
    return reply.error is not None and reply.error.name == "NotOpen"


def _in_one_time(
    items: Iterator[tuple[int, Item]], about: list[_About], start: float
) -> Generator[tuple[float, int, Item]]:
    """Items with their time, which never goes back: each file goes on from where the one before it ended."""
    newest, shift, current = start, 0.0, -1
    for file, item in items:
        if isinstance(item, Picture):
            yield newest, file, item
            continue
        time = about[file].clock(item.when) if isinstance(item, JointReading) else item.time
        if file != current:
            current, shift = file, newest - time
        newest = max(newest, time + shift)
        yield newest, file, _shifted(item, shift) if shift else item


def _shifted(item: Item, by: float) -> Item:
    """The same, later by so many seconds."""
    match item:
        case Reply(value=FrameRef() | RobotState() as value):
            return replace(item, time=item.time + by, value=replace(value, time=value.time + by))
        case MotionEnded(final=RobotState() as final):
            return replace(item, time=item.time + by, final=replace(final, time=final.time + by))
        case Arrived(state=state):
            return replace(item, time=item.time + by, state=replace(state, time=state.time + by))
        case JointReading() | Picture():
            return item
    return replace(item, time=item.time + by)
