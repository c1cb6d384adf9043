"""A session's log without what did not count: of a step that was interrupted and done anew, the finished attempt."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from dualcal_hal.errors import LogMissing
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.log.framing import Opcode
from dualcal_hal.session.log.layout import RECORD_TOPICS, arm_of
from dualcal_hal.session.log.reader import Item, LogReader, begins, segment_paths
from dualcal_hal.session.log.records import RunEnded, StepBegun, StepFinished

_MARKS = {RECORD_TOPICS[kind] for kind in (StepBegun, StepFinished, RunEnded)}


def begun_segments(path: Path) -> list[Path]:
    """The files of a session's log, or the file itself, without those of attempts that ended before anything of them
    was on the disk; LogMissing if none is left."""
    paths = segment_paths(path)
    begun = [each for each in paths if _has_begun(each)]
    if not begun:
        names = ", ".join(each.name for each in paths)
        raise LogMissing(f"{path}: its log holds nothing ({names}): the run ended before its first step")
    return begun


def _has_begun(path: Path) -> bool:
    if not begins(path):
        return False
    with LogReader(path) as reader:
        return any(piece.opcode in (Opcode.CHUNK, Opcode.DATA_END) for piece in reader.pieces())


@dataclass(frozen=True)
class _Attempt:
    """The ``number``-th step that begins in a file."""

    file: int
    number: int


class FinishedAttempts:
    """What happened in the files of a session's log, in order.

    Of a step's attempts the last finished one is kept, and in the last file also what no step finished: there the run
    ended. What happened outside of steps counts in the last file alone.

    finished: the steps that are. ended: how the run ended; None if it was cut off.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Reads the files once; LogDamaged."""
        self._paths = paths
        self._finished: dict[StepKey, _Attempt] = {}
        self.ended: RunEnded | None = None
        for number, path in enumerate(paths):
            steps = _Steps(number)
            self.ended = None
            with LogReader(path) as reader:
                for item in reader.items(_MARKS.__contains__):
                    if isinstance(item, RunEnded):
                        self.ended = item
                    finished = steps.follow(item)
                    if finished is not None:
                        self._finished[finished[0]] = finished[1]

    @property
    def finished(self) -> frozenset[StepKey]:
        return frozenset(self._finished)

    def items(self, wants_states_of: Callable[[str], bool] = lambda arm: False) -> Iterator[tuple[int, Item]]:
        """Items with the number of their file, from 0; with the joint states, for viewers, of the arms asked for.

        It is asked anew for each of these.
        """

        def wanted(topic: str) -> bool:
            arm = arm_of(topic)
            return arm is None or wants_states_of(arm)

        for number, path in enumerate(self._paths):
            is_last = number == len(self._paths) - 1
            steps = _Steps(number)
            with LogReader(path) as reader:
                for item in reader.items(wanted):
                    current = steps.current
                    finished = steps.follow(item)
                    step = finished or steps.current or current
                    if self._counts(step, is_last):
                        yield number, item

    def _counts(self, step: tuple[StepKey, _Attempt] | None, is_last: bool) -> bool:
        if step is None:
            return is_last
        key, attempt = step
        return self._finished.get(key, attempt if is_last else None) == attempt


class _Steps:
    """The steps that are open while a file is read."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._count = 0
        self._open: list[tuple[StepKey, _Attempt]] = []

    @property
    def current(self) -> tuple[StepKey, _Attempt] | None:
        """The innermost open step."""
        return self._open[-1] if self._open else None

    def follow(self, item: Item) -> tuple[StepKey, _Attempt] | None:
        """Take note of an item; the step that it finishes."""
        match item:
            case StepBegun(key):
                self._open.append((key, _Attempt(self._file, self._count)))
                self._count += 1
            case StepFinished(key):
                for place in range(len(self._open) - 1, -1, -1):
                    if self._open[place][0] == key:
                        return self._open.pop(place)
        return None
