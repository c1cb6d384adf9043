"""A log as tables and pictures that any program reads."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from dualcal_hal.errors import LogDamaged, LogNotWritten
from dualcal_hal.session.images import encode_png
from dualcal_hal.session.log.reader import Item, JointReading, Picture, SessionLog
from dualcal_hal.session.log.records import StepBegun, StepFinished

_UNSAFE = frozenset('/\\:*?"<>|')


@dataclass
class Exported:
    """How many rows and frames were written, and the damage that ended it, if any."""

    folder: Path
    joint_states: dict[str, int] = field(default_factory=dict)
    steps: int = 0
    frames: int = 0
    damage: str | None = None


def export_log(source: Path, folder: Path) -> Exported:
    """``joint_states_<arm>.csv``, ``steps.csv`` and ``frames/*.png`` in a new or empty folder.

    What comes before damage is exported, and the damage told. Raises LogMissing, LogTooNew or LogNotWritten.
    """
    log = SessionLog(source)
    exported = Exported(folder)
    try:
        _prepare(folder)
        with _Tables(folder) as tables:
            export = _Export(exported, tables)
            try:
                for segment, item in log.items():
                    export.add(segment + 1, item)
            except LogDamaged as error:
                exported.damage = str(error)
    except OSError as error:
        if isinstance(error, LogNotWritten):
            raise
        raise LogNotWritten(f"{error.filename or folder}: cannot be written: {error.strerror}") from error
    return exported


def _prepare(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise LogNotWritten(f"{folder}: exists and is not an empty folder; name another with --out")
    (folder / "frames").mkdir(parents=True)


class _Tables:
    """CSV files that are opened when their first row comes."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._open: dict[str, tuple[IO[str], Any]] = {}

    def __enter__(self) -> _Tables:
        return self

    def __exit__(self, *_: object) -> None:
        for file, _writer in self._open.values():
            file.close()

    def write(self, name: str, header: Callable[[], list[str]], row: Sequence[object]) -> None:
        if name not in self._open:
            file = (self._folder / f"{_safe(name)}.csv").open("x", newline="", encoding="utf-8")
            self._open[name] = (file, csv.writer(file))
            self._open[name][1].writerow(header())
        self._open[name][1].writerow(row)


class _Export:
    def __init__(self, exported: Exported, tables: _Tables) -> None:
        self._exported = exported
        self._tables = tables
        self._begun: dict[tuple[int, object], float] = {}

    def add(self, segment: int, item: Item) -> None:
        match item:
            case JointReading():
                self._joints(segment, item)
            case Picture():
                name = f"{segment:04d}-{item.sequence:08d}.png"
                path = self._exported.folder / "frames" / f"{_safe(item.camera)}-{name}"
                path.write_bytes(item.data if item.lossless else encode_png(item.decode()))
                self._exported.frames += 1
            case StepBegun(key, time):
                self._begun[(segment, key)] = time
            case StepFinished(key, time):
                begun = self._begun.pop((segment, key), None)
                row = [segment, key.phase, key.constraint, key.position, key.kind, begun, time]
                self._tables.write("steps", _steps_header, row)
                self._exported.steps += 1

    def _joints(self, segment: int, reading: JointReading) -> None:
        joints = range(1, len(reading.positions) + 1)

        def header() -> list[str]:
            positions = [f"position_{joint}_rad" for joint in joints]
            return ["segment", "utc_ns", "sequence", *positions, *(f"velocity_{joint}_rad_s" for joint in joints)]

        row = [segment, reading.when, reading.sequence, *reading.positions, *reading.velocities]
        self._tables.write(f"joint_states_{reading.arm}", header, row)
        self._exported.joint_states[reading.arm] = self._exported.joint_states.get(reading.arm, 0) + 1


def _steps_header() -> list[str]:
    return ["segment", "phase", "constraint", "position", "kind", "begun_s", "finished_s"]


def _safe(name: str) -> str:
    """A name from a log as part of a file's name: it leads nowhere else."""
    return "".join("_" if letter in _UNSAFE or not letter.isprintable() else letter for letter in name)[:100]
