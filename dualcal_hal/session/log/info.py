"""What a log holds, from the heads of its records and its indexes: no image is read, so it is quick."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from dualcal_hal.errors import LogDamaged
from dualcal_hal.session.log.framing import Channel, Malformed, MessageIndex, Opcode, chunk_records, parse, records_in
from dualcal_hal.session.log.layout import Layout
from dualcal_hal.session.log.reader import LogReader


@dataclass
class Topic:
    """Times in ns since 1970, UTC; ``gap``: the longest time between two messages, ns, and the time it began."""

    name: str
    count: int = 0
    first: int = 0
    last: int = 0
    gap: int = 0
    gap_from: int = 0

    @property
    def rate(self) -> float | None:
        """Messages a second; None where there are fewer than two, or all at one time."""
        return (self.count - 1) / (self.last - self.first) * 1e9 if self.last > self.first else None

    def add(self, time: int) -> None:
        if not self.count:
            self.first = self.last = time
        elif time - self.last > self.gap:
            self.gap, self.gap_from = time - self.last, self.last
        self.last = max(self.last, time)
        self.count += 1


@dataclass
class Info:
    """One file. ``damage`` says why not all of it is told."""

    path: Path
    size: int
    about: Mapping[str, str] = field(default_factory=dict)
    topics: list[Topic] = field(default_factory=list)
    attachments: list[str] = field(default_factory=list)
    finished: bool = False
    end: int = 0
    damage: str | None = None

    @property
    def first(self) -> int | None:
        return min((topic.first for topic in self.topics), default=None)

    @property
    def duration(self) -> float:
        """Seconds from the first message to the last."""
        if not self.topics:
            return 0.0
        return (max(topic.last for topic in self.topics) - min(topic.first for topic in self.topics)) / 1e9


def log_info(path: Path) -> Info:
    """Of one file; LogMissing, LogTooNew or LogDamaged where it is no log, else damage is told beside what there is.

    Checksums are not compared: that takes reading all of it, which ``check`` does.
    """
    with LogReader(path) as reader:
        info = Info(path, reader.raw.size)
        survey = _Survey(reader)
        try:
            info.about = reader.about()
            survey.walk()
        except LogDamaged as error:
            info.damage = str(error)
        if reader.ending is not None:
            info.finished, info.end = reader.ending.finished, reader.ending.offset
        info.topics = sorted(survey.topics.values(), key=lambda topic: topic.name)
        info.attachments = survey.attachments
    return info


class _Survey:
    def __init__(self, reader: LogReader) -> None:
        self._reader = reader
        self._names: dict[int, str] = {}
        self.topics: dict[str, Topic] = {}
        self.attachments: list[str] = []

    def walk(self) -> None:
        raw = self._reader.raw
        for piece in self._reader.pieces():
            try:
                if piece.opcode == Opcode.CHUNK and not self._names:
                    self._read_names(chunk_records(raw.content(piece), piece.offset), piece.offset)
                elif piece.opcode == Opcode.MESSAGE_INDEX:
                    self._index(parse(MessageIndex, raw.content(piece), piece.offset))
                elif piece.opcode == Opcode.ATTACHMENT:
                    self.attachments.append(_attachment_name(raw.read(piece.start, min(piece.length, 1024))))
            except Malformed as error:
                raise self._reader.damaged(error) from error

    def _read_names(self, records: memoryview, offset: int) -> None:
        for record in records_in(records, offset):
            if isinstance(record, Channel):
                self._names[record.id] = record.topic
        if not self._names:
            self._names = {channel.number: channel.topic for channel in self._layout().channels()}

    def _layout(self) -> Layout:
        return self._reader.layout()

    def _index(self, index: MessageIndex) -> None:
        name = self._names.get(index.channel_id, f"channel {index.channel_id}")
        topic = self.topics.setdefault(name, Topic(name))
        for time, _ in index.records:
            topic.add(time)


def _attachment_name(head: bytes) -> str:
    length = int.from_bytes(head[16:20], "little")
    return head[20 : 20 + length].decode("utf-8", "replace")
