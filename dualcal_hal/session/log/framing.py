"""The bytes of an MCAP file taken apart with distrust: every length is held against what is there before it is used.

Beyond what the mcap package's reader does, it says at which byte something is wrong, and finds the way on behind it.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import IO, TypeVar

from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Footer, Header, McapRecord, MessageIndex, Metadata, Statistics

from dualcal_hal.session.log.layout import LARGEST_RECORD

MAGIC = b"\x89MCAP0\r\n"

_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_SIZE = struct.Struct("<Q")
_CHUNK_HEAD = _CHUNK.size + _SIZE.size
_WINDOW = 1 << 22

# An uncompressed chunk: sizes below 4 GiB have zeros in their upper halves, and so has the absent compression's name.
_CHUNK_PATTERN = re.compile(rb"\x06.{4}\0{4}.{16}.{4}\0{4}.{4}\0{4}.{4}\0{4}", re.DOTALL)
_PATTERN_LENGTH = _HEAD.size + _CHUNK_HEAD

_SUMMARY = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.STATISTICS,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.SUMMARY_OFFSET,
    }
)
_DATA = frozenset(
    {
        Opcode.HEADER,
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    }
)

R = TypeVar("R", bound=McapRecord)


class Malformed(ValueError):
    """Bytes that are not what they should be; ``offset`` counts from the beginning of the file."""

    def __init__(self, offset: int, why: str) -> None:
        self.offset = offset
        self.why = why
        super().__init__(f"at byte {offset}: {why}")


@dataclass(frozen=True, slots=True)
class Piece:
    """A record of the file: its content begins at ``offset + 9`` and is ``length`` bytes long."""

    offset: int
    opcode: int
    length: int

    @property
    def start(self) -> int:
        return self.offset + _HEAD.size

    @property
    def end(self) -> int:
        return self.start + self.length


@dataclass(frozen=True, slots=True)
class Damage:
    """From ``offset`` to ``end`` there is nothing that can be read."""

    offset: int
    end: int
    why: str


@dataclass(frozen=True, slots=True)
class CutOff:
    """The file ends here without the end of a finished file; a record that was being written begins at ``offset``."""

    offset: int
    opcode: int | None


@dataclass(frozen=True, slots=True)
class Message:
    """A message: its channel's number, its place, its times in ns since 1970, and what it says."""

    channel: int
    sequence: int
    log_time: int
    publish_time: int
    data: bytes
    offset: int


class RawFile:
    """An open file of which its size is known; whoever opened it closes it."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self.size = file.seek(0, 2)

    def read(self, offset: int, length: int) -> bytes:
        """Exactly so many bytes, else Malformed."""
        if length > LARGEST_RECORD:
            raise Malformed(offset, f"{length} bytes at once are not read")
        if offset + length > self.size:
            raise Malformed(offset, "the file ends here")
        self._file.seek(offset)
        data = self._file.read(length)
        if len(data) < length:
            raise Malformed(offset, "the file has become shorter")
        return data

    def content(self, piece: Piece) -> bytes:
        return self.read(piece.start, piece.length)

    def magic(self) -> bytes:
        """The first bytes, as many as there are up to a magic's length."""
        return self.read(0, min(self.size, len(MAGIC)))

    def checksum(self, start: int, end: int, value: int = 0) -> int:
        """CRC32 of a part of the file, in bounded memory."""
        while start < end:
            data = self.read(start, min(_WINDOW, end - start))
            value, start = zlib.crc32(data, value), start + len(data)
        return value

    def pieces(self, position: int = len(MAGIC)) -> Iterator[Piece | Damage | CutOff]:
        """The records from ``position`` on, by their heads alone.

        What is damaged is passed over, to the next chunk with a right checksum. Ends behind the footer, or with CutOff.
        """
        in_summary = False
        while position < self.size:
            piece, why = self._piece(position, in_summary)
            if piece is not None:
                yield piece
                if piece.opcode == Opcode.FOOTER:
                    yield from self._after_footer(piece.end)
                    return
                in_summary = in_summary or piece.opcode == Opcode.DATA_END
                position = piece.end
                continue
            following = self.next_chunk(position + 1)
            if following is None and self._may_be_cut(position):
                yield CutOff(position, self._opcode_at(position))
                return
            yield Damage(position, self.size if following is None else following, why)
            if following is None:
                return
            position, in_summary = following, False
        yield CutOff(position, None)

    def _piece(self, position: int, in_summary: bool) -> tuple[Piece | None, str]:
        if position + _HEAD.size > self.size:
            return None, "a record is cut off"
        opcode, length = _HEAD.unpack(self.read(position, _HEAD.size))
        piece = Piece(position, opcode, length)
        if opcode == Opcode.FOOTER:
            return (piece, "") if length == 20 and piece.end <= self.size else (None, "the footer is damaged")
        if opcode not in (_SUMMARY if in_summary else _DATA):
            return None, f"no record begins with {opcode}"
        if piece.end > self.size:
            return None, "a record is longer than the file"
        if length > LARGEST_RECORD:
            return None, f"a record of {length} bytes is not read"
        return piece, ""

    def _opcode_at(self, position: int) -> int:
        return self.read(position, 1)[0]

    def _may_be_cut(self, position: int) -> bool:
        """Whether what is here looks like the beginning of a record that was never finished."""
        finished = self.size >= 2 * len(MAGIC) and self.read(self.size - len(MAGIC), len(MAGIC)) == MAGIC
        return not finished and self._opcode_at(position) in _DATA | _SUMMARY | {Opcode.FOOTER}

    def _after_footer(self, position: int) -> Iterator[Damage | CutOff]:
        rest = self.read(position, min(self.size - position, len(MAGIC)))
        if rest == MAGIC and position + len(MAGIC) == self.size:
            return
        if len(rest) < len(MAGIC) and MAGIC.startswith(rest):
            yield CutOff(position, None)
        else:
            yield Damage(position, self.size, "something else follows the footer than the end of the file")

    def next_chunk(self, position: int, end: int | None = None) -> int | None:
        """Where, from ``position`` on and before ``end``, a whole chunk with a right checksum begins, or None."""
        end = self.size if end is None else end
        while position < end:
            window = self.read(position, min(_WINDOW + _PATTERN_LENGTH, self.size - position))
            found = 0
            while (match := _CHUNK_PATTERN.search(window, found)) is not None:
                if position + match.start() >= end:
                    return None
                if self._is_chunk(position + match.start()):
                    return position + match.start()
                found = match.start() + 1
            position += _WINDOW
        return None

    def _is_chunk(self, position: int) -> bool:
        piece, _ = self._piece(position, in_summary=False)
        if piece is None or piece.length < _CHUNK_HEAD:
            return False
        _, _, uncompressed, crc, _ = _CHUNK.unpack(self.read(piece.start, _CHUNK.size))
        size = piece.length - _CHUNK_HEAD
        stored = _SIZE.unpack(self.read(piece.start + _CHUNK.size, _SIZE.size))[0]
        return bool(uncompressed == stored == size) and self.checksum(piece.end - size, piece.end) == crc


def chunk_records(content: bytes, offset: int) -> memoryview:
    """The records of a chunk whose content begins at ``offset``; Malformed if they are not as they were written."""
    if len(content) < _CHUNK_HEAD:
        raise Malformed(offset, "the chunk is too short")
    _, _, uncompressed, crc, name_length = _CHUNK.unpack_from(content)
    if name_length:
        name = content[_CHUNK.size : _CHUNK.size + min(name_length, 16)].decode("ascii", "replace")
        raise Malformed(offset, f"the chunk is compressed ({name!r}), which no log of this program is")
    stored = _SIZE.unpack_from(content, _CHUNK.size)[0]
    records = memoryview(content)[_CHUNK_HEAD:]
    if not uncompressed == stored == len(records):
        raise Malformed(offset, "the sizes of the chunk do not fit each other")
    if zlib.crc32(records) != crc:
        raise Malformed(offset, "the checksum of the chunk does not fit")
    return records


def cut_chunk_records(content: bytes) -> memoryview:
    """What is there of a chunk that the end of the file cuts off; nothing vouches for it but its form."""
    return memoryview(content)[_CHUNK_HEAD:]


def records_in(records: memoryview, offset: int) -> Iterator[Message | Channel]:
    """Messages and channels among a chunk's records, which begin at ``offset``; Malformed at the first that is none."""
    position = 0
    while position < len(records):
        if position + _HEAD.size > len(records):
            raise Malformed(offset + position, "a record is cut off")
        opcode, length = _HEAD.unpack_from(records, position)
        start, where = position + _HEAD.size, offset + position
        if start + length > len(records):
            raise Malformed(where, "a record is cut off")
        content = records[start : start + length]
        if opcode == Opcode.MESSAGE:
            if length < _MESSAGE.size:
                raise Malformed(where, "a message is too short")
            channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(content)
            yield Message(channel, sequence, log_time, publish_time, bytes(content[_MESSAGE.size :]), where)
        elif opcode == Opcode.CHANNEL:
            yield parse(Channel, bytes(content), where)
        elif opcode != Opcode.SCHEMA:
            raise Malformed(where, f"a chunk has no records of kind {opcode}")
        position = start + length


class _Content(ReadDataStream):
    """A record's content, of which no more is read than is there."""

    def read(self, length: int) -> bytes:
        data = super().read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def parse(kind: type[R], content: bytes, offset: int) -> R:
    """The content of a record whose head is at ``offset``; Malformed if it is none."""
    try:
        record: R = kind.read(_Content(BytesIO(content)))  # type: ignore[attr-defined]
    except (McapError, ValueError) as error:
        raise Malformed(offset, f"the {kind.__name__} record is damaged") from error
    return record


def parse_attachment(content: bytes, offset: int) -> Attachment:
    """An attachment whose checksum is right, else Malformed."""
    if len(content) < 4 or zlib.crc32(memoryview(content)[:-4]) != int.from_bytes(content[-4:], "little"):
        raise Malformed(offset, "the checksum of an attachment does not fit")
    return parse(Attachment, content, offset)


__all__ = [
    "MAGIC",
    "Channel",
    "CutOff",
    "Damage",
    "DataEnd",
    "Footer",
    "Header",
    "Malformed",
    "Message",
    "MessageIndex",
    "Metadata",
    "Opcode",
    "Piece",
    "RawFile",
    "Statistics",
    "chunk_records",
    "cut_chunk_records",
    "parse",
    "parse_attachment",
    "records_in",
]
