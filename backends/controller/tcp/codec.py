"""ROS-Industrial's simple message as bytes: pure functions, no wire. REP I0006 (layout) and I0004 (ids) are normative.

A frame is what a message's length counts, header and body; a packet is the length and the frame. What is no message
raises a CodecError and nothing else.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from functools import cache
from typing import Any, ClassVar, Literal

ByteOrder = Literal["big", "little"]
Real = Literal["f32", "f64"]
Body = tuple[tuple[str, str], ...]
Ten = tuple[float, ...]
"""A joint array, which has 10 entries however many joints there are."""

SHORTEST, LONGEST = 12, 4096
"""Bytes that a frame may have: at least a header."""
LARGEST_ID = 65535
"""The largest id that REP I0004 has assigned to anything."""
ENTRIES = 10
STATUS_UNKNOWN = -1
START_DOWNLOAD, END_DOWNLOAD, STOP = -1, -3, -4
"""Sequence numbers that are none."""


class CodecError(ValueError):
    """Bytes that are no message, or a message that cannot be bytes."""


class FrameError(CodecError):
    """A length that no message has: where the next message begins is not known any more."""


class LengthError(CodecError):
    """A message whose length is not that of its kind."""


class ValueRefused(CodecError):
    """A message that carries a value which none may have."""


class Comm(IntEnum):
    """What a message is to its receiver."""

    TOPIC = 1
    REQUEST = 2
    REPLY = 3


class Code(IntEnum):
    """What a reply says: whether a request was taken, never that a point was reached."""

    UNUSED = 0
    SUCCESS = 1
    FAILURE = 2


class Valid(IntFlag):
    """Which fields of a message hold data."""

    TIME = 1
    POSITION = 2
    VELOCITY = 4
    ACCELERATION = 8


@dataclass(frozen=True, slots=True)
class Wire:
    """How a server writes numbers."""

    byte_order: ByteOrder
    real: Real

    def __str__(self) -> str:
        return _in_words(self.byte_order, self.real)


@dataclass(frozen=True, slots=True, kw_only=True)
class Message:
    """ID and BODY are its kind's: of each field the name and the layout, a count and ``i`` (int32) or ``r`` (real)."""

    ID: ClassVar[int]
    BODY: ClassVar[Body]
    comm: Comm = Comm.TOPIC
    code: Code = Code.UNUSED


@dataclass(frozen=True, slots=True, kw_only=True)
class Ping(Message):
    """Asks whether the server is there."""

    ID: ClassVar[int] = 1
    BODY: ClassVar[Body] = (("data", "10i"),)
    comm: Comm = Comm.REQUEST
    data: tuple[int, ...] = (0,) * ENTRIES


@dataclass(frozen=True, slots=True, kw_only=True)
class JointPosition(Message):
    """Joint angles, rad; as a reply (fanuc) that of the point whose sequence number it bears."""

    ID: ClassVar[int] = 10
    BODY: ClassVar[Body] = (("sequence", "i"), ("positions", "10r"))
    sequence: int = 0
    positions: Ten


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTrajPt(Message):
    """A point to go to. positions: rad; velocity: a fraction (0, 1] of the largest; duration: of its segment, s."""

    ID: ClassVar[int] = 11
    BODY: ClassVar[Body] = (("sequence", "i"), ("positions", "10r"), ("velocity", "r"), ("duration", "r"))
    comm: Comm = Comm.REQUEST
    sequence: int
    positions: Ten
    velocity: float
    duration: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Status(Message):
    """The controller's. All but error_code: -1 unknown, 0 no, 1 yes; mode: 1 manual, 2 automatic."""

    ID: ClassVar[int] = 13
    BODY: ClassVar[Body] = tuple(
        (name, "i")
        for name in (
            *("drives_powered", "e_stopped", "error_code", "in_error"),
            *("in_motion", "mode", "motion_possible"),
        )
    )
    drives_powered: int
    e_stopped: int
    error_code: int
    in_error: int
    in_motion: int
    mode: int
    motion_possible: int


@dataclass(frozen=True, slots=True, kw_only=True)
class JointTrajPtFull(Message):
    """A point to pass. time: s since the start; positions, velocities, accelerations: rad, rad/s, rad/s^2."""

    ID: ClassVar[int] = 14
    BODY: ClassVar[Body] = (
        *(("group", "i"), ("sequence", "i"), ("valid", "i"), ("time", "r")),
        *(("positions", "10r"), ("velocities", "10r"), ("accelerations", "10r")),
    )
    comm: Comm = Comm.REQUEST
    group: int
    sequence: int
    valid: int
    time: float
    positions: Ten
    velocities: Ten
    accelerations: Ten = (0.0,) * ENTRIES


@dataclass(frozen=True, slots=True, kw_only=True)
class JointFeedback(Message):
    """Where a group's joints are, as JointTrajPtFull; time: s, of the controller's clock."""

    ID: ClassVar[int] = 15
    BODY: ClassVar[Body] = (
        *(("group", "i"), ("valid", "i"), ("time", "r")),
        *(("positions", "10r"), ("velocities", "10r"), ("accelerations", "10r")),
    )
    group: int
    valid: int
    time: float
    positions: Ten
    velocities: Ten
    accelerations: Ten = (0.0,) * ENTRIES


@dataclass(frozen=True, slots=True, kw_only=True)
class MotoMotionCtrl(Message):
    """A command to a Motoman controller."""

    ID: ClassVar[int] = 2001
    BODY: ClassVar[Body] = (("group", "i"), ("sequence", "i"), ("command", "i"), ("data", "10r"))
    comm: Comm = Comm.REQUEST
    group: int
    sequence: int
    command: int
    data: Ten = (0.0,) * ENTRIES


@dataclass(frozen=True, slots=True, kw_only=True)
class MotoMotionReply(Message):
    """What a Motoman controller answers. command: that of the request, or its id; result, subcode: the verdict."""

    ID: ClassVar[int] = 2002
    BODY: ClassVar[Body] = (
        *(("group", "i"), ("sequence", "i"), ("command", "i"), ("result", "i"), ("subcode", "i")),
        ("data", "10r"),
    )
    comm: Comm = Comm.REPLY
    code: Code = Code.SUCCESS
    group: int
    sequence: int
    command: int
    result: int
    subcode: int
    data: Ten = (0.0,) * ENTRIES


@dataclass(frozen=True, slots=True, kw_only=True)
class Acknowledgement(Message):
    """A reply that says no more than its code, with or without a body; ``id`` is the request's."""

    comm: Comm = Comm.REPLY
    code: Code = Code.SUCCESS
    id: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Unknown(Message):
    """A message of a kind that is not spoken of here."""

    id: int
    body: bytes


KINDS: dict[int, type[Message]] = {
    kind.ID: kind
    for kind in (
        *(Ping, JointPosition, JointTrajPt, Status, JointTrajPtFull, JointFeedback),
        *(MotoMotionCtrl, MotoMotionReply),
    )
}

# Replies whose body is ten dummies, that of the request once more, as the peers' library has it, or is left out; some
# servers with f64 have integers for dummies.
_DUMMY_REPLIES = {JointTrajPt.ID, JointTrajPtFull.ID, Ping.ID}
_DUMMY_SIZES = {0, 40, 80}
_SIGN = {"big": ">", "little": "<"}
_LETTER = {"f32": "f", "f64": "d"}


def ten(values: Iterable[float]) -> Ten:
    """A joint array: what there is, then zeros. At most 10 values."""
    given = tuple(map(float, values))
    return given + (0.0,) * (ENTRIES - len(given))


def frame_length(kind: type[Message], real: Real) -> int:
    """Bytes of a frame of that kind."""
    return SHORTEST + _layout(kind.BODY, Wire("big", real)).size


def encode(message: Message, wire: Wire) -> bytes:
    """The packet of a message; CodecError if a value of it cannot be sent."""
    values: list[float] = []
    if isinstance(message, Acknowledgement | Unknown):
        identity = message.id
        body = message.body if isinstance(message, Unknown) else b""
    else:
        identity = message.ID
        for name, layout in message.BODY:
            values += _checked(type(message).__name__, name, layout, getattr(message, name))
        body = _packed(_layout(message.BODY, wire), values)
    header = struct.Struct(_SIGN[wire.byte_order] + "4i")
    _check_header(identity, message.comm, message.code)
    length = SHORTEST + len(body)
    if length > LONGEST:
        raise LengthError(f"a message of {length} bytes is longer than {LONGEST}")
    return _packed(header, [length, identity, message.comm, message.code]) + body


def decode(frame: bytes, wire: Wire) -> Message:
    """The message that a frame is; CodecError if it is none."""
    if not SHORTEST <= len(frame) <= LONGEST:
        raise LengthError(f"a frame has {SHORTEST} to {LONGEST} bytes, not {len(frame)}")
    identity, comm, code = struct.unpack_from(_SIGN[wire.byte_order] + "3i", frame)
    _check_header(identity, comm, code)
    body = frame[SHORTEST:]
    header: dict[str, Any] = {"comm": Comm(comm), "code": Code(code)}
    kind = KINDS.get(identity)
    if kind is None:
        return Unknown(id=identity, body=body, **header)
    if comm == Comm.REPLY and (code == Code.FAILURE or not body or identity in _DUMMY_REPLIES):
        # A failure's body may be anything, and dummies say nothing.
        if code == Code.SUCCESS and len(body) not in (*_DUMMY_SIZES, _layout(kind.BODY, wire).size):
            raise LengthError(f"a reply to {kind.__name__} has no body of {len(body)} bytes")
        return Acknowledgement(id=identity, **header)
    layout = _layout(kind.BODY, wire)
    if len(body) != layout.size:
        raise LengthError(_wrong_length(kind, len(frame), wire))
    return kind(**header, **_fields(kind, layout.unpack(body)))


def _fields(kind: type[Message], values: tuple[Any, ...]) -> dict[str, Any]:
    fields: dict[str, Any] = {}
    place = 0
    for name, layout in kind.BODY:
        count = int(layout[:-1] or 1)
        part = values[place : place + count]
        if layout[-1] == "r" and not all(map(math.isfinite, part)):
            raise ValueRefused(f"{kind.__name__}: {name} holds a number that is not finite")
        fields[name] = part if count > 1 else part[0]
        place += count
    return fields


def _checked(kind: str, name: str, layout: str, value: Any) -> Sequence[float]:
    """The values of one field, if they can be sent."""
    count = int(layout[:-1] or 1)
    values: Sequence[float] = value if count > 1 else (value,)
    if len(values) != count:
        raise LengthError(f"{kind}: {name} has {count} entries, not {len(values)}")
    if layout[-1] == "r" and not all(map(math.isfinite, values)):
        raise ValueRefused(f"{kind}: {name} holds a number that is not finite")
    return values


def _packed(layout: struct.Struct, values: Sequence[float]) -> bytes:
    try:
        return layout.pack(*values)
    except (struct.error, OverflowError) as error:
        raise ValueRefused(f"a number does not fit the wire: {error}") from error


def _check_header(identity: int, comm: int, code: int) -> None:
    if comm not in _COMMS or code not in _CODES:
        raise ValueRefused(f"message {identity}: there is no comm_type {comm} with reply_code {code}")
    if (code != Code.UNUSED) != (comm == Comm.REPLY):
        raise ValueRefused(
            f"message {identity}: reply_code {code} with comm_type {comm}: replies have one, others none"
        )


_COMMS, _CODES = set(map(int, Comm)), set(map(int, Code))


@cache
def _layout(body: Body, wire: Wire) -> struct.Struct:
    fields = "".join(layout for _, layout in body)
    return struct.Struct(_SIGN[wire.byte_order] + fields.replace("r", _LETTER[wire.real]))


def _wrong_length(kind: type[Message], length: int, wire: Wire) -> str:
    right = {real: frame_length(kind, real) for real in ("f32", "f64")}
    said = f"{kind.__name__} of {length} bytes; it has {right[wire.real]} with {wire.real}"
    if length in right.values():
        said += f": the sender's reals are not {wire.real}"
    return said


class FrameSplitter:
    """Frames out of a stream that may be cut anywhere. It holds no more than one frame that is not complete."""

    def __init__(self, byte_order: ByteOrder) -> None:
        self._order = byte_order
        self._held = bytearray()

    @property
    def held(self) -> int:
        """Bytes that wait for the rest of their frame."""
        return len(self._held)

    def feed(self, data: bytes) -> Iterator[bytes]:
        """The frames that are complete with ``data``; to be used up. FrameError at a length that none has, and then
        for ever: nothing marks where a message begins."""
        view = memoryview(data)
        while view:
            wanted = self._wanted()
            self._held += view[:wanted]
            view = view[wanted:]
            if len(self._held) >= 4 and not self._wanted():
                frame = bytes(self._held[4:])
                self._held.clear()
                yield frame

    def _wanted(self) -> int:
        """How many bytes are missing: of the length, or of the frame."""
        if len(self._held) < 4:
            return 4 - len(self._held)
        length = int.from_bytes(self._held[:4], self._order, signed=True)
        if not SHORTEST <= length <= LONGEST:
            raise FrameError(f"a message has {SHORTEST} to {LONGEST} bytes, not {length}")
        return 4 + length - len(self._held)


@dataclass(frozen=True, slots=True)
class Judgement:
    """How a server writes, by what it has sent; real: None as long as no message with reals has come."""

    byte_order: ByteOrder
    real: Real | None

    def __str__(self) -> str:
        return _in_words(self.byte_order, self.real)


def judge(first: bytes) -> Judgement:
    """The byte order and the size of reals, by the first packet of a state port; its first 8 bytes are enough.

    CodecError if it is no message in either byte order.
    """
    if len(first) < 8:
        raise LengthError(f"8 bytes tell the byte order, not {len(first)}")
    for order in ("big", "little"):
        length, identity = struct.unpack_from(_SIGN[order] + "2i", first)
        # No length within bounds is within them when its bytes are swapped.
        if SHORTEST <= length <= LONGEST and 0 < identity <= LARGEST_ID:
            return Judgement(order, _judge_real(identity, length))
    raise FrameError(f"{first[:8].hex(' ')} begins no simple message in either byte order: is this the state port?")


def _judge_real(identity: int, length: int) -> Real | None:
    kind = KINDS.get(identity)
    if kind not in (JointPosition, JointFeedback):
        return None
    for real in ("f32", "f64"):
        if length == frame_length(kind, real):
            return real
    raise LengthError(f"{kind.__name__} of {length} bytes: neither with 32-bit reals nor with 64-bit ones")


def _in_words(byte_order: ByteOrder, real: Real | None) -> str:
    size = {"f32": "32-bit reals (f32)", "f64": "64-bit reals (f64)", None: "reals of a size not known yet"}[real]
    return f"{byte_order}-endian, {size}"
