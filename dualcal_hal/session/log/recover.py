"""A new log from what can be read of a damaged one, and the list of what cannot."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from dualcal_hal.errors import LogDamaged, LogNotWritten
from dualcal_hal.session.log.framing import (
    MAGIC,
    Channel,
    CutOff,
    Damage,
    Malformed,
    Message,
    MessageIndex,
    Metadata,
    Opcode,
    Piece,
    RawFile,
    Statistics,
    chunk_records,
    cut_chunk_records,
    parse,
    parse_attachment,
    records_in,
)
from dualcal_hal.session.log.layout import (
    METADATA_NAME,
    PROFILE,
    RECORD_TOPICS,
    SEQUENCES,
    Layout,
    camera_of,
    image_topic,
)
from dualcal_hal.session.log.reader import LogReader, item_of
from dualcal_hal.session.log.records import FrameRef, Reply, from_json
from dualcal_hal.session.log.writer import FileWriter

_MOST_TOPICS = 1000


@dataclass(frozen=True)
class Loss:
    """Bytes of the old file that have no place in the new one, and why."""

    offset: int
    length: int
    why: str


@dataclass(frozen=True)
class Recovered:
    """The new file, how many messages it has by topic, and what was lost. ``missing``: messages by topic that were
    there, as far as the file tells: by its summary, the indexes behind its chunks, the messages' own numbers, and
    replies that speak of an image.
    """

    path: Path
    messages: dict[str, int]
    losses: tuple[Loss, ...]
    missing: dict[str, int]


def recover_log(source: Path, target: Path) -> Recovered:
    """Write ``target``, which must not exist, from all that is readable in ``source``, which is only read.

    Raises LogMissing, LogTooNew, LogDamaged where nothing can be read, and LogNotWritten.
    """
    try:
        with LogReader(source) as reader:
            return _recover(reader.raw, source, target)
    except LogDamaged:
        # The beginning is damaged; there may still be chunks behind it.
        with source.open("rb") as file:
            return _recover(RawFile(file), source, target)


def _recover(raw: RawFile, source: Path, target: Path) -> Recovered:
    layout = _layout(raw)
    if layout is None:
        raise LogDamaged(str(source), None, "there is nothing in it that can be saved")
    rescue = _Rescue(raw, layout)
    with _created(target) as file:
        writer = FileWriter(file, layout)
        rescue.copy(writer, source.name)
        writer.finish()
    return Recovered(target, dict(rescue.counts), tuple(rescue.losses), rescue.missing)


@contextmanager
def _created(target: Path) -> Iterator[IO[bytes]]:
    """A new file that is there whole or not at all; LogNotWritten."""
    try:
        with target.open("xb") as file:
            try:
                yield file
            except BaseException:
                target.unlink()
                raise
    except FileExistsError as error:
        advice = "it was recovered before? Name another folder with --out, or move it away"
        raise LogNotWritten(f"{target}: {error.strerror}: {advice}") from error
    except OSError as error:
        raise LogNotWritten(f"{target}: the log cannot be written: {error.strerror}") from error


class _Rescue:
    """Copies messages, metadata and attachments, and keeps account."""

    def __init__(self, raw: RawFile, layout: Layout) -> None:
        self._raw = raw
        self._topics = {channel.number: channel.topic for channel in layout.channels()}
        self._known = frozenset(self._topics.values())
        self._counted = frozenset(topic for topic in self._known if topic.startswith("/dualcal/"))
        self._about: dict[str, str] | None = None
        self._due: Counter[str] = Counter()
        self._skipped: Counter[str] = Counter()
        self._indexed: Counter[int] = Counter()
        self._summed: Counter[int] = Counter()
        self._pictures: dict[str, int] = {}
        self.counts: Counter[str] = Counter()
        self.losses: list[Loss] = []
        self._layout = layout

    @property
    def missing(self) -> dict[str, int]:
        """Messages by topic that the file had and that are not saved."""
        missing = dict(self._skipped)
        for there in (self._indexed, self._summed):
            for channel, count in there.items():
                topic = self._topics.get(channel)
                if topic in self._known:
                    missing[topic] = max(missing.get(topic, 0), count - self.counts[topic])
        return {topic: count for topic, count in missing.items() if count > 0}

    def copy(self, writer: FileWriter, source: str) -> None:
        """All that can be read, in its order."""
        position: int | None = len(MAGIC)
        while position is not None:
            position = self._copy_from(position, writer, source)
        if self._about is None:
            self._write_about(writer, {}, source)

    def _copy_from(self, position: int, writer: FileWriter, source: str) -> int | None:
        """Up to the end, or to where a chunk of a wrong length turns out to have another one in it."""
        for piece in self._raw.pieces(position):
            try:
                self._piece(piece, writer, source)
            except Malformed as error:
                within = None
                if isinstance(piece, Piece) and piece.opcode == Opcode.CHUNK:
                    within = self._raw.next_chunk(piece.start, piece.end)
                end = within or (self._raw.size if isinstance(piece, CutOff) else piece.end)
                self.losses.append(Loss(error.offset, end - error.offset, error.why))
                if within is not None:
                    return within
        return None

    def _piece(self, piece: Piece | Damage | CutOff, writer: FileWriter, source: str) -> None:
        match piece:
            case Damage(offset, end, why):
                self.losses.append(Loss(offset, end - offset, why))
            case CutOff(offset, opcode):
                self._cut_off(offset, opcode, writer)
            case Piece(offset, Opcode.CHUNK):
                records = chunk_records(self._raw.content(piece), offset)
                self._messages(records_in(records, piece.end - len(records)), writer)
            case Piece(offset, Opcode.METADATA):
                group = parse(Metadata, self._raw.content(piece), offset)
                if group.name == METADATA_NAME:
                    self._write_about(writer, group.metadata, source)
                else:
                    writer.write_metadata(group.name, group.metadata)
            case Piece(offset, Opcode.ATTACHMENT):
                kept = parse_attachment(self._raw.content(piece), offset)
                writer.write_attachment(kept.name, kept.media_type, kept.data, kept.log_time)
            case Piece(offset, Opcode.MESSAGE_INDEX):
                index = parse(MessageIndex, self._raw.content(piece), offset)
                self._indexed[index.channel_id] += len(index.records)
            case Piece(offset, Opcode.STATISTICS):
                self._summed.update(parse(Statistics, self._raw.content(piece), offset).channel_message_counts)

    def _write_about(self, writer: FileWriter, content: dict[str, str], source: str) -> None:
        if self._about is None:
            self._about = {**content, "format": PROFILE, "devices": self._layout.to_text(), "recovered_from": source}
            writer.write_metadata(METADATA_NAME, self._about)

    def _cut_off(self, offset: int, opcode: int | None, writer: FileWriter) -> None:
        """The whole messages of a chunk that was being written when the file ended; they are the last ones."""
        size = self._raw.size
        if opcode != Opcode.CHUNK or size - offset <= 9:
            if size > offset:
                self.losses.append(Loss(offset, size - offset, "cut off"))
            return
        records = cut_chunk_records(self._raw.read(offset + 9, size - offset - 9))
        self._messages(records_in(records, size - len(records)), writer, unchecked=True)

    def _require_readable(self, topic: str, message: Message) -> None:
        try:
            item_of(topic, message, "")
        except ValueError as error:
            raise Malformed(message.offset, f"{topic}: {error}") from error

    def _messages(self, records: Iterator[Message | Channel], writer: FileWriter, *, unchecked: bool = False) -> None:
        for record in records:
            if isinstance(record, Channel):
                self._topics[record.id] = record.topic
                continue
            topic = self._topics.get(record.channel)
            if topic not in self._known:
                raise Malformed(record.offset, f"a message is on channel {record.channel}, which is not known")
            if unchecked:
                self._require_readable(topic, record)
            if topic in self._counted:
                self._skipped[topic] += max(0, record.sequence - self._due[topic])
                self._due[topic] = record.sequence + 1
            self.counts[topic] += 1
            self._follow_pictures(topic, record)
            writer.write(topic, record.publish_time, record.data, record.sequence)

    def _follow_pictures(self, topic: str, message: Message) -> None:
        """An image comes before the reply that speaks of it."""
        if (camera := camera_of(topic)) is not None:
            self._pictures[camera] = message.sequence
        elif topic == RECORD_TOPICS[Reply] and b'"frame"' in message.data:
            with suppress(ValueError):  # it is saved as it is: check tells what is wrong with it
                reply = from_json(Reply, message.data)
                frame = reply.value if isinstance(reply, Reply) else None
                if isinstance(frame, FrameRef) and self._pictures.get(frame.camera) != frame.sequence % SEQUENCES:
                    self._skipped[image_topic(frame.camera)] += 1


def _layout(raw: RawFile) -> Layout | None:
    """From the list of channels in the first chunk or at the end; where both are lost, from what the log says of its
    devices.
    """
    at_end: list[str] = []
    stated: Layout | None = None
    for piece in raw.pieces():
        if not isinstance(piece, Piece):
            continue
        try:
            if piece.opcode == Opcode.CHUNK:
                topics = _topics_in(raw, piece)
                if topics:
                    return Layout.of_topics(topics)
            elif piece.opcode == Opcode.CHANNEL and len(at_end) < _MOST_TOPICS:
                at_end.append(parse(Channel, raw.content(piece), piece.offset).topic)
            elif piece.opcode == Opcode.METADATA and stated is None:
                group = parse(Metadata, raw.content(piece), piece.offset)
                stated = Layout.from_text(group.metadata.get("devices", ""))
        except ValueError:
            continue
    try:
        return Layout.of_topics(at_end) if at_end else stated
    except ValueError:
        return stated


def _topics_in(raw: RawFile, piece: Piece) -> list[str]:
    records = chunk_records(raw.content(piece), piece.offset)
    return [record.topic for record in records_in(records, piece.offset) if isinstance(record, Channel)]
