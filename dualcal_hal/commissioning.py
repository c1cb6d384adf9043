"""What was proven of a cell before its arms may move by themselves, kept beside the cell file.

``<cell file's stem>.commissioning.json``, the format ``dualcal.commissioning/1``. Each entry carries a digest of what
decides how the arms move, so that a changed joint map voids it and a changed tolerance or comment does not.
"""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, Self

from dualcal_hal.cellfile import CellFile
from dualcal_hal.clock import utc_now
from dualcal_hal.config import CellConfig
from dualcal_hal.errors import FormatError, Problem, UsageError
from dualcal_hal.session.files import read_document, write_document
from dualcal_hal.session.plain import Fields

FORMAT = "dualcal.commissioning/1"

Check = Literal["flange", "wiggle"]
CHECKS: tuple[Check, ...] = ("flange", "wiggle")

_IN_WORDS = {"flange": "the flange check", "wiggle": "the wiggle of the joints"}


@dataclass(frozen=True)
class Entry:
    """One check and what came of it.

    key: digest of what it holds for; time: ISO 8601, UTC; good: whether it was passed; said: its result in words.
    """

    key: str
    time: str
    good: bool
    said: str


@dataclass(frozen=True)
class _Content:
    """What a record's file says; copy_of: the cell file of which this one is a session's copy."""

    copy_of: Path | None
    checks: Mapping[Check, Mapping[str, Entry]]
    verified: Entry | None

    def with_newer(self, other: _Content) -> _Content:
        """The newer entry of both for each check; whose copy it is stays."""
        checks = {check: _newer_of_each(self.checks[check], other.checks[check]) for check in CHECKS}
        return _Content(self.copy_of, checks, _newer(self.verified, other.verified))

    def with_made(self, made: _Content) -> _Content:
        """What was made now in place of what there is, whatever the calendar says."""
        checks = {check: {**self.checks[check], **made.checks[check]} for check in CHECKS}
        return _Content(self.copy_of, checks, made.verified or self.verified)

    def to_document(self, copy_of: Path | None) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "copy_of": None if copy_of is None else str(copy_of),
            **{check: {arm: asdict(entry) for arm, entry in self.checks[check].items()} for check in CHECKS},
            "verified": None if self.verified is None else asdict(self.verified),
        }


class Commissioning:
    """The record of one cell file. A record that is not there yet is an empty one."""

    def __init__(self, cell_file: Path, file: CellFile) -> None:
        """As :meth:`of`."""
        self.path = _beside(cell_file)
        self._cell_file = cell_file
        self._arms = tuple(file.cell.arms)
        self._arms_key, self._cell_key = arms_key(file.cell), cell_key(file.cell)
        self._content = self._read()

    @classmethod
    def of(cls, path: Path, file: CellFile) -> Self:
        """The record beside the cell file at ``path``, which holds ``file``; FormatError for one that is damaged.

        In a session's folder it is a copy; what the original has learnt since then counts, too.
        """
        return cls(path, file)

    def flange_checked(self, arm: str) -> bool:
        """Whether the flange of that arm was found where the kinematics have it."""
        return self._holds("flange", arm)

    def wiggled(self, arm: str) -> bool:
        """Whether each joint of that arm was seen to turn as the kinematics have it."""
        return self._holds("wiggle", arm)

    @property
    def verified(self) -> bool:
        """Whether a calibration of this cell, its camera and its target was verified."""
        entry = self._content.verified
        return entry is not None and entry.good and entry.key == self._cell_key

    def missing(self) -> list[str]:
        """What is to be done before the first motion, one sentence each; empty if nothing is."""
        return [self._lack(check, arm) for arm in self._arms for check in CHECKS if not self._holds(check, arm)]

    def record_flange(self, arm: str, good: bool, said: str) -> None:
        """Keep the result of a flange check; UsageError if it cannot be written."""
        self._record("flange", arm, good, said)

    def record_wiggle(self, arm: str, good: bool, said: str) -> None:
        """Keep the result of a wiggle; UsageError if it cannot be written."""
        self._record("wiggle", arm, good, said)

    def record_verified(self, said: str) -> None:
        """Keep that a calibration of this cell was verified; UsageError if it cannot be written."""
        self._keep(_content({}, _made(self._cell_key, True, said)))

    def copy_beside(self, cell_file: Path) -> None:
        """Write a copy for the cell file of a session, which knows whose copy it is; UsageError."""
        _write(_beside(cell_file), self._content.to_document(self._original.absolute()))

    @property
    def _original(self) -> Path:
        return self._content.copy_of or self._cell_file

    def _holds(self, check: Check, arm: str) -> bool:
        entry = self._content.checks[check].get(arm)
        return entry is not None and entry.good and entry.key == self._arms_key

    def _lack(self, check: Check, arm: str) -> str:
        entry, what = self._content.checks[check].get(arm), f"{_IN_WORDS[check]} of '{arm}'"
        if entry is None:
            why = "was not done yet"
        elif entry.key != self._arms_key:
            why = f"of {entry.time} was for other backends or robots than the cell file has now"
        else:
            why = f"of {entry.time} was not passed: {entry.said}"
        return f"{what} {why}; do it by: dualcal doctor {shlex.quote(str(self._original))} --{check} --arm {arm}"

    def _record(self, check: Check, arm: str, good: bool, said: str) -> None:
        if arm not in self._arms:
            raise UsageError(f"there is no arm '{arm}'; there are: {', '.join(self._arms)}")
        self._keep(_content({check: {arm: _made(self._arms_key, good, said)}}))

    def _read(self) -> _Content:
        own = _read(self.path)
        return own if own.copy_of is None else own.with_newer(_read(_beside(own.copy_of)))

    def _keep(self, made: _Content) -> None:
        """Write what was made beside what is there by now: here, and where this is a copy in the original too."""
        self._content = self._read().with_made(made)
        original = self._content.copy_of
        if original is not None and original.parent.is_dir():  # a session may have been carried to another machine
            _write(_beside(original), self._content.to_document(None))
        _write(self.path, self._content.to_document(original))


def arms_key(cell: CellConfig) -> str:
    """Digest of what decides how the arms move: the robots and the backends that they are reached through."""
    return _digest(_robots(cell, {robot.backend for robot in cell.arms.values()}))


def cell_key(cell: CellConfig) -> str:
    """Digest of what a calibration's verification holds for: all devices, the camera and the target."""
    camera, target = (part.model_dump(mode="json") for part in (cell.camera, cell.target))
    return _digest({**_robots(cell, set(cell.backends)), "camera": camera, "target": target})


def _robots(cell: CellConfig, backends: set[str]) -> dict[str, Any]:
    reached = {name: cell.backends[name] for name in backends}
    return {
        "robots": {name: robot.model_dump(mode="json") for name, robot in cell.arms.items()},
        "backends": {
            name: {"type": entry.type, "options": entry.checked.model_dump(mode="json")}
            for name, entry in reached.items()
        },
    }


def _digest(parts: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True, allow_nan=False).encode()).hexdigest()


def _beside(cell_file: Path) -> Path:
    return cell_file.with_name(f"{cell_file.stem}.commissioning.json")


def _made(key: str, good: bool, said: str) -> Entry:
    return Entry(key, utc_now().isoformat(timespec="milliseconds"), good, said)


def _content(checks: Mapping[Check, Mapping[str, Entry]], verified: Entry | None = None) -> _Content:
    return _Content(None, {check: checks.get(check, {}) for check in CHECKS}, verified)


def _newer(one: Entry | None, other: Entry | None) -> Entry | None:
    return max((entry for entry in (one, other) if entry is not None), key=lambda entry: entry.time, default=None)


def _newer_of_each(one: Mapping[str, Entry], other: Mapping[str, Entry]) -> dict[str, Entry]:
    both = {arm: _newer(one.get(arm), other.get(arm)) for arm in (*one, *other)}
    return {arm: entry for arm, entry in both.items() if entry is not None}


def _read(path: Path) -> _Content:
    """All that the file says; nothing if it is not there."""
    if not path.exists():
        return _content({})
    document = read_document(path, FORMAT)
    try:
        fields = Fields(document, "the record")
        checks: dict[Check, dict[str, Entry]] = {}
        for check in CHECKS:
            arms = fields.part(check)
            checks[check] = {arm: _entry(arms.part(arm)) for arm in arms.content}
        verified = fields.part_or_none("verified")
        copy_of = None if fields.is_null("copy_of") else Path(fields.text("copy_of"))
        return _Content(copy_of, checks, None if verified is None else _entry(verified))
    except ValueError as error:
        why = f"is no record of a commissioning: {error}; move it away and do the checks anew"
        raise FormatError([Problem(str(path), why)]) from error


def _entry(fields: Fields) -> Entry:
    return Entry(fields.text("key"), fields.text("time"), fields.flag("good"), fields.text("said"))


def _write(path: Path, document: dict[str, Any]) -> None:
    try:
        write_document(path, document)
    except OSError as error:
        raise UsageError(f"{path}: the commissioning cannot be recorded: {error.strerror}") from error
