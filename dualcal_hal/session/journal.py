"""The journal of a run: one line for each finished step, and the only thing that going on with a run reads."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar

from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.robot import Joints
from dualcal_hal.session.files import write_atomically
from dualcal_hal.session.plain import Fields, parse

T = TypeVar("T")

JOURNAL_FORMAT = "dualcal.journal/1"


@dataclass(frozen=True)
class StepKey:
    """What a step is about; never a counter, so that a run begun anew finds its finished steps."""

    phase: str
    constraint: str | None
    position: int | None
    kind: str

    @classmethod
    def from_fields(cls, fields: Fields) -> StepKey:
        """As ``asdict`` wrote it; ValueError."""
        constraint = None if fields.is_null("constraint") else fields.text("constraint")
        position = None if fields.is_null("position") else fields.whole("position")
        return cls(fields.text("phase"), constraint, position, fields.text("kind"))


@dataclass(frozen=True)
class Standing:
    """An arm as a step left it: where it was sent last, rad, None if nowhere, and how often it has arrived so far."""

    target: Joints | None
    arrival: int

    def to_record(self) -> dict[str, Any]:
        """As plain JSON."""
        return {"target_rad": None if self.target is None else list(self.target), "arrival": self.arrival}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Standing:
        """And back, to the last bit; ValueError."""
        fields = Fields(record)
        return cls(None if fields.is_null("target_rad") else fields.finites("target_rad"), fields.whole("arrival"))


@dataclass(frozen=True)
class Left:
    """How the last finished step left everything.

    arms: by name; backends: what each needs to go on from there in another process, by name. Both are empty before
    the first step, and in journals that do not say.
    """

    arms: Mapping[str, Standing]
    backends: Mapping[str, Any]


class Journal:
    """Finished steps and their results, in a file that only grows. A line is on disk before ``append`` returns.

    started: when the run was begun first (ISO 8601), None if that is not known; left: how the last step left the cell.
    """

    def __init__(self, path: Path) -> None:
        """Reads what is there; writes nothing."""
        self.path = path
        self.started: str | None = None
        self.left = Left({}, {})
        self._results: dict[StepKey, dict[str, Any]] = {}
        self._length = 0
        if path.exists():
            self._read()

    def begin(self, started: str | None = None) -> None:
        """Begin the file, unless it is begun already."""
        if self._length:
            return
        header = {"format": JOURNAL_FORMAT, **({} if started is None else {"started": started})}
        line = json.dumps(header).encode() + b"\n"
        write_atomically(self.path, line)
        self._length, self.started = len(line), started

    def result(self, key: StepKey) -> dict[str, Any] | None:
        """The result of a finished step, or None."""
        return self._results.get(key)

    def read(self, key: StepKey, from_record: Callable[[dict[str, Any]], T]) -> T:
        """The result of a finished step as ``from_record`` reads it; FormatError if it cannot be read."""
        try:
            return from_record(self._results[key])
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            number = 2 + list(self._results).index(key)
            what = f"the result of step {key} cannot be read ({type(error).__name__}: {error})"
            raise FormatError([Problem(f"{self.path}:{number}", what)]) from error

    @property
    def newest_line(self) -> str:
        """The file and the number of its last line, which says how everything was left."""
        return f"{self.path}:{1 + len(self._results)}"

    def results(self) -> list[tuple[StepKey, dict[str, Any]]]:
        """All finished steps in the order in which they were finished."""
        return list(self._results.items())

    def append(self, key: StepKey, result: dict[str, Any], left: Left | None = None) -> None:
        """Record that a step is finished, and how it left the cell. What it refers to must be durable already."""
        if key in self._results:
            raise ValueError(f"step {key} is finished already")
        self.begin()
        left = left or Left({}, {})
        arms = {name: standing.to_record() for name, standing in left.arms.items()}
        self._write_line({"step": asdict(key), "result": result, "arms": arms, "backends": dict(left.backends)})
        self._results[key] = result
        self.left = left

    def _write_line(self, content: dict[str, Any]) -> None:
        line = json.dumps(content, allow_nan=False).encode() + b"\n"
        try:
            with self.path.open("r+b") as file:
                # A line that a crash has cut off was never finished: it gives way.
                file.truncate(self._length)
                file.seek(self._length)
                file.write(line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            if error.filename is None:
                error.filename = str(self.path)  # a full disk does not say which file found no room
            raise
        self._length += len(line)

    def _read(self) -> None:
        # What follows the last newline is a line that was cut off in the writing: its step is not finished.
        try:
            content = self.path.read_bytes()
        except OSError as error:
            raise FormatError([Problem(str(self.path), f"cannot be read: {error.strerror}")]) from error
        self._length = content.rfind(b"\n") + 1
        problems = []
        for number, line in enumerate(content[: self._length].split(b"\n")[:-1], start=1):
            try:
                entry = Fields(parse(line), "the line")
                if number == 1:
                    self._read_header(entry)
                else:
                    self._read_entry(entry)
            except ValueError as error:
                problems.append(Problem(f"{self.path}:{number}", f"not a line of a journal: {error}"))
        if problems:
            raise FormatError(problems)

    def _read_header(self, header: Fields) -> None:
        if header.any("format") != JOURNAL_FORMAT:
            raise ValueError(f"unknown format {header.any('format')!r}, expected {JOURNAL_FORMAT!r}")
        self.started = header.text("started") if "started" in header else None

    def _read_entry(self, entry: Fields) -> None:
        key = StepKey.from_fields(entry.part("step"))
        if key in self._results:
            raise ValueError(f"step {key} is finished already")
        arms = entry.part("arms").content if "arms" in entry else {}
        backends = entry.part("backends").content if "backends" in entry else {}
        left = Left({name: Standing.from_record(record) for name, record in arms.items()}, backends)
        self._results[key], self.left = entry.part("result").content, left
