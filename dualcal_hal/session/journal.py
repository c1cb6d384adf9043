"""The journal of a run: one line for each finished step, and the only thing that going on with a run reads."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dualcal_hal.errors import FormatError, Problem

JOURNAL_FORMAT = "dualcal.journal/1"


@dataclass(frozen=True)
class StepKey:
    """What a step is about; never a counter, so that a run begun anew finds its finished steps."""

    phase: str
    constraint: str | None
    position: int | None
    kind: str


class Journal:
    """Finished steps and their results, in a file that only grows. A line is on disk before ``append`` returns."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._results: dict[StepKey, dict[str, Any]] = {}
        self._length = 0
        if path.exists():
            self._read()
        else:
            self._write_line({"format": JOURNAL_FORMAT})

    def result(self, key: StepKey) -> dict[str, Any] | None:
        """The result of a finished step, or None."""
        return self._results.get(key)

    def results(self) -> list[tuple[StepKey, dict[str, Any]]]:
        """All finished steps in the order in which they were finished."""
        return list(self._results.items())

    def append(self, key: StepKey, result: dict[str, Any]) -> None:
        """Record that a step is finished. What the result refers to must be durable already."""
        if key in self._results:
            raise ValueError(f"step {key} is finished already")
        self._write_line({"step": asdict(key), "result": result})
        self._results[key] = result

    def _write_line(self, content: dict[str, Any]) -> None:
        with self._path.open("r+b" if self._path.exists() else "xb") as file:
            # A line that a crash has cut off was never finished: it gives way.
            file.truncate(self._length)
            file.seek(self._length)
            file.write(json.dumps(content, allow_nan=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
            self._length = file.tell()

    def _read(self) -> None:
        # What follows the last newline is a line that was cut off in the writing: its step is not finished.
        content = self._path.read_bytes()
        self._length = content.rfind(b"\n") + 1
        lines = content[: self._length].split(b"\n")[:-1]
        problems = []
        for number, line in enumerate(lines, start=1):
            try:
                entry = json.loads(line)
                if number == 1:
                    if entry["format"] != JOURNAL_FORMAT:
                        raise ValueError(f"unknown format {entry['format']!r}, expected {JOURNAL_FORMAT!r}")
                    continue
                self._results[StepKey(**entry["step"])] = entry["result"]
            except (ValueError, KeyError, TypeError) as error:
                problems.append(Problem(f"{self._path}:{number}", f"not a line of a journal: {error}"))
        if problems:
            raise FormatError(problems)
