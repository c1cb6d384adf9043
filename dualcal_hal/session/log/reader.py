"""A log as it is read: in order, in flat memory, with distrust.

Nothing that a log holds is executed, and no size that it states is believed before it is held against what is there.
Whatever is wrong is LogMissing, LogDamaged or LogTooNew.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import IO, Self

from google.protobuf.message import DecodeError

from dualcal_hal.camera import Image
from dualcal_hal.errors import LogDamaged, LogMissing, LogTooNew
from dualcal_hal.robot import Joints
from dualcal_hal.session.images import decode, image_size
from dualcal_hal.session.log import foxglove
from dualcal_hal.session.log.framing import (
    MAGIC,
    Channel,
    CutOff,
    Damage,
    Header,
    Malformed,
    Message,
    Metadata,
    Opcode,
    Piece,
    RawFile,
    chunk_records,
    parse,
    parse_attachment,
    records_in,
)
from dualcal_hal.session.log.layout import (
    FORMAT_NAME,
    FORMAT_VERSION,
    LARGEST_JOINT_STATES,
    METADATA_NAME,
    RECORD_KINDS,
    Layout,
    arm_of,
    camera_of,
)
from dualcal_hal.session.log.records import Record, from_json

_PROFILE = re.compile(rf"{re.escape(FORMAT_NAME)}/(\d{{1,9}})")


@dataclass(frozen=True, eq=False)
class Picture:
    """An image as it is stored. ``sequence`` and the camera are those of a FrameRef (the sequence modulo 2**32)."""

    camera: str
    sequence: int
    format: str
    data: bytes = field(repr=False)
    when: int
    """ns since 1970, UTC."""
    file: str
    offset: int

    @property
    def lossless(self) -> bool:
        return self.format == "png"

    def decode(self) -> Image:
        """The pixels; LogDamaged if they cannot be had."""
        try:
            return decode(self.data, self.format)
        except ValueError as error:
            raise LogDamaged(self.file, self.offset, str(error)) from error


@dataclass(frozen=True)
class JointReading:
    """What an arm reported: rad, rad/s; ``when`` in ns since 1970, UTC; ``sequence`` modulo 2**32."""

    arm: str
    sequence: int
    positions: Joints
    velocities: Joints
    when: int


@dataclass(frozen=True)
class Attached:
    """A file that the log carries."""

    name: str
    media_type: str
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Ending:
    """Where a file ends, and whether its writer finished it."""

    offset: int
    finished: bool


Item = Record | Picture | JointReading


class LogReader:
    """One file. A context manager; every iteration begins anew.

    A file that was never finished, or is cut off, is read up to there: ``ending`` says where. Anything else that is
    not as it was written raises LogDamaged at the place where it is met.
    """

    def __init__(self, path: Path) -> None:
        """LogMissing, LogDamaged or LogTooNew for a file that is no log."""
        self.path = path
        self.ending: Ending | None = None
        """Known once an iteration has come to the end."""
        self._file = _open(path)
        try:
            self.raw = RawFile(self._file)
            self._check_beginning()
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Any number of times."""
        self._file.close()

    def items(self, wanted: Callable[[str], bool] = lambda topic: True) -> Iterator[Item]:
        """Records, images and joint states in the order in which they were written; those of the wanted topics."""
        for topic, message in self.messages():
            if wanted(topic) and (item := self.item(topic, message)) is not None:
                yield item

    def item(self, topic: str, message: Message) -> Item | None:
        """What a message says, None for what is there for viewers alone; LogDamaged if it cannot be read."""
        try:
            return item_of(topic, message, str(self.path))
        except ValueError as error:
            raise LogDamaged(str(self.path), message.offset, f"{topic}: {error}") from error

    def messages(self) -> Iterator[tuple[str, Message]]:
        """Every message with its topic, of whatever kind."""
        topics: dict[int, str] = {}
        for piece, content in self._contents(Opcode.CHUNK):
            try:
                records = chunk_records(content, piece.offset)
                for record in records_in(records, piece.end - len(records)):
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif record.channel in topics:
                        yield topics[record.channel], record
                    else:
                        raise Malformed(record.offset, f"a message is on channel {record.channel}, which is not known")
            except Malformed as error:
                raise self.damaged(error) from error

    def metadata(self) -> dict[str, Mapping[str, str]]:
        """Texts by name, by the name of their group."""
        groups: dict[str, Mapping[str, str]] = {}
        for piece, content in self._contents(Opcode.METADATA):
            try:
                group = parse(Metadata, content, piece.offset)
            except Malformed as error:
                raise self.damaged(error) from error
            groups[group.name] = group.metadata
        return groups

    def attachments(self) -> Iterator[Attached]:
        """The files that the log carries; one that was attached twice comes twice, the newer later."""
        for piece, content in self._contents(Opcode.ATTACHMENT):
            try:
                attachment = parse_attachment(content, piece.offset)
            except Malformed as error:
                raise self.damaged(error) from error
            yield Attached(attachment.name, attachment.media_type, attachment.data)

    def about(self) -> Mapping[str, str]:
        """What the writer said of the log at its beginning; LogDamaged if that is missing."""
        for piece, content in self._contents(Opcode.METADATA):
            try:
                group = parse(Metadata, content, piece.offset)
            except Malformed as error:
                raise self.damaged(error) from error
            if group.name == METADATA_NAME:
                return group.metadata
        raise LogDamaged(str(self.path), None, "does not say what it is a log of")

    def layout(self) -> Layout:
        """The devices of the log."""
        try:
            return Layout.from_text(self.about().get("devices", ""))
        except ValueError as error:
            raise LogDamaged(str(self.path), None, str(error)) from error

    def pieces(self) -> Iterator[Piece]:
        """The file's records by their heads, to the end or to where it is cut off."""
        try:
            for piece in self.raw.pieces():
                match piece:
                    case Piece():
                        yield piece
                    case Damage(offset, _, why):
                        raise LogDamaged(str(self.path), offset, why)
                    case CutOff(offset):
                        self.ending = Ending(offset, finished=False)
                        return
        except Malformed as error:
            raise self.damaged(error) from error
        self.ending = Ending(self.raw.size, finished=True)

    def damaged(self, error: Malformed) -> LogDamaged:
        """The same with the file's name."""
        return LogDamaged(str(self.path), error.offset, error.why)

    def _contents(self, opcode: Opcode) -> Iterator[tuple[Piece, bytes]]:
        for piece in self.pieces():
            if piece.opcode != opcode:
                continue
            try:
                content = self.raw.content(piece)
            except Malformed as error:
                raise self.damaged(error) from error
            yield piece, content

    def _check_beginning(self) -> None:
        if not self.raw.size:
            raise LogDamaged(str(self.path), 0, "the file is empty")
        magic = self.raw.magic()
        if magic != MAGIC:
            if len(magic) == len(MAGIC) and magic[:5] == MAGIC[:5] and magic[6:] == MAGIC[6:]:
                raise LogTooNew(f"{self.path}: is MCAP of version {chr(magic[5])!r}; this version reads '0'")
            what = "the file ends here" if MAGIC.startswith(magic) else "is no log: it does not begin as MCAP does"
            raise LogDamaged(str(self.path), 0, what)
        first = next(self.pieces(), None)
        if first is None:
            return
        if first.opcode != Opcode.HEADER:
            raise LogDamaged(str(self.path), first.offset, "a log begins with a header")
        try:
            profile = parse(Header, self.raw.content(first), first.offset).profile
        except Malformed as error:
            raise self.damaged(error) from error
        self._check_profile(profile, first.offset)

    def _check_profile(self, profile: str, offset: int) -> None:
        match = _PROFILE.fullmatch(profile)
        if match is None:
            raise LogDamaged(str(self.path), offset, f"is no log of dualcal: its profile is {profile[:40]!r}")
        if int(match[1]) > FORMAT_VERSION:
            raise LogTooNew(
                f"{self.path}: is a log of format {match[1]}, and this version reads up to {FORMAT_VERSION}: update it"
            )


def begins(path: Path) -> bool:
    """Whether the file is longer than what a log begins with; LogMissing if it cannot be read."""
    with _open(path) as file:
        magic = file.read(len(MAGIC) + 1)
    return len(magic) > len(MAGIC) or not MAGIC.startswith(magic)


class SessionLog:
    """The log of a session's folder: its files ``log-0001.mcap``, ``log-0002.mcap`` and so on, one for each attempt."""

    def __init__(self, path: Path) -> None:
        """LogMissing if the folder has none. ``path`` may be a file, then it alone is read."""
        self.paths = segment_paths(path)

    def items(self) -> Iterator[tuple[int, Item]]:
        """The items of all files in order, each with the number of its file, from 0."""
        for number, path in enumerate(self.paths):
            with LogReader(path) as reader:
                for item in reader.items():
                    yield number, item


def segment_paths(path: Path) -> list[Path]:
    """The files of a session's log in the order of their numbers, or the file itself; LogMissing if there is none."""
    try:
        if path.is_file():
            return [path]
        if not path.is_dir():
            raise LogMissing(f"{path}: does not exist")
        found = sorted((int(match[1]), each) for each in path.iterdir() if (match := _SEGMENT.fullmatch(each.name)))
    except OSError as error:
        raise LogMissing(f"{path}: cannot be read: {error.strerror}") from error
    if not found:
        raise LogMissing(f"{path}: has no log (no file like {segment_name(1)})")
    return [each for _, each in found]


def segment_name(number: int) -> str:
    """Of the file of an attempt, from 1."""
    return f"log-{number:04d}.mcap"


def next_segment(folder: Path) -> Path:
    """Where the next attempt's log belongs: no file of an earlier one is ever touched."""
    try:
        numbers = [int(match[1]) for each in folder.iterdir() if (match := _SEGMENT.fullmatch(each.name))]
    except OSError as error:
        raise LogMissing(f"{folder}: cannot be read: {error.strerror}") from error
    return folder / segment_name(max(numbers, default=0) + 1)


_SEGMENT = re.compile(r"log-(\d{4,9})\.mcap", re.ASCII)


def _open(path: Path) -> IO[bytes]:
    try:
        return path.open("rb")
    except OSError as error:
        raise LogMissing(f"{path}: cannot be read: {error.strerror}") from error


def item_of(topic: str, message: Message, file: str) -> Item | None:
    """What a message of the named file says, None for what is there for viewers alone; ValueError if it is damaged."""
    if (kind := RECORD_KINDS.get(topic)) is not None:
        return from_json(kind, message.data)
    try:
        if (camera := camera_of(topic)) is not None:
            image = foxglove.CompressedImage.FromString(message.data)
            image_size(image.data, image.format)
            when = message.publish_time
            return Picture(camera, message.sequence, image.format, image.data, when, file, message.offset)
        if (arm := arm_of(topic)) is not None:
            if len(message.data) > LARGEST_JOINT_STATES:
                raise ValueError(f"{len(message.data)} bytes are too many for the joints of an arm")
            states = foxglove.JointStates.FromString(message.data)
            positions = tuple(joint.position for joint in states.joints)
            velocities = tuple(joint.velocity for joint in states.joints)
            return JointReading(arm, message.sequence, positions, velocities, message.publish_time)
    except DecodeError as error:
        raise ValueError("the message is damaged") from error
    return None
