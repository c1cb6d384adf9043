"""What a frame is on the wire: a header in MessagePack, and the image's raw bytes as a second part.

A subscriber that cannot compare the sender's clock with its own asks the sender to note when it hears of it: it
subscribes to a mark, some bytes that nobody else has, and the headers from then on say at what time of the sender's
clock that was heard. What was exposed later than that was exposed later than the mark was sent.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Annotated, Literal

import msgspec
import numpy as np

from backends.cameras.whose_clock import ClockId
from dualcal_hal.camera import Image

FORMAT = "dualcal.frame/1"

LARGEST_SIDE = 1 << 14
LARGEST_AREA = 1 << 26
"""Bounds of an image, px and px^2: nothing larger is taken from a socket."""
LARGEST_HEADER = 1 << 14
MOST_MARKS = 64

_MARK = b"dualcal.mark/1:"
MARK_LENGTH = len(_MARK) + 16

_Name = Annotated[str, msgspec.Meta(max_length=256)]
_Side = Annotated[int, msgspec.Meta(ge=1, le=LARGEST_SIDE)]
_Mark = Annotated[bytes, msgspec.Meta(min_length=MARK_LENGTH, max_length=MARK_LENGTH)]


class Malformed(ValueError):
    """What came is no frame; the message says why."""


class Header(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Of one frame.

    camera: its name; publisher: what no other publisher has, also not the same one begun anew; sequence: grows with
    every frame of a publisher; exposed_at: seconds of the sender's clock at the start of the exposure, or not later
    than that; exposure: s, None where not known; host, boot: whose clock that is; marks: what was heard, and when, in
    seconds of the sender's clock.
    """

    camera: _Name
    publisher: Annotated[bytes, msgspec.Meta(max_length=32)]
    sequence: Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
    exposed_at: float
    exposure: float | None
    host: _Name
    boot: _Name
    width: _Side
    height: _Side
    marks: Annotated[list[tuple[_Mark, float]], msgspec.Meta(max_length=MOST_MARKS)] = []
    dtype: Literal["uint8"] = "uint8"
    format: Literal["dualcal.frame/1"] = "dualcal.frame/1"

    @property
    def clock(self) -> ClockId:
        return ClockId(self.host, self.boot)

    def heard(self, mark: bytes) -> float | None:
        """When the sender heard of a mark, seconds of its clock; None if it has not."""
        return next((when for heard, when in self.marks if heard == mark), None)


def new_mark() -> bytes:
    """To be subscribed to."""
    return _MARK + os.urandom(16)


def is_mark(topic: bytes) -> bool:
    """Whether a subscription is a mark and not one to frames."""
    return topic.startswith(_MARK) and len(topic) == MARK_LENGTH


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(Header)


def encode(header: Header, image: Image) -> tuple[bytes, memoryview]:
    """Both parts; the image's bytes are not copied. ValueError for an image (height, width) that fits no frame."""
    if image.dtype != np.uint8 or image.shape != (header.height, header.width) or image.size > LARGEST_AREA:
        raise ValueError(f"{image.dtype} {image.shape} is no grey image of {header.width} x {header.height}")
    return _encoder.encode(header), np.ascontiguousarray(image).data.cast("B")


def decode(parts: Sequence[memoryview]) -> tuple[Header, Image]:
    """Header and image (height, width), read-only and not copied; Malformed for all that is not both."""
    if len(parts) != 2:
        raise Malformed(f"a message of {len(parts)} parts, not of header and image")
    packed, raw = parts
    if packed.nbytes > LARGEST_HEADER:
        raise Malformed(f"a header of {packed.nbytes} bytes")
    try:
        header = _decoder.decode(packed)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise Malformed(f"its header cannot be read: {error}") from error
    _require_finite(header)
    if header.width * header.height > LARGEST_AREA:
        raise Malformed(f"{header.width} x {header.height} px is more than any camera has")
    if raw.nbytes != header.width * header.height:
        raise Malformed(f"{raw.nbytes} bytes for {header.width} x {header.height} px")
    image: Image = np.frombuffer(raw, np.uint8).reshape(header.height, header.width)
    image.setflags(write=False)
    return header, image


def _require_finite(header: Header) -> None:
    times = [header.exposed_at, *(when for _, when in header.marks)]
    if not all(map(math.isfinite, times)):
        raise Malformed("a time that is not finite")
    if header.exposure is not None and not 0 <= header.exposure < math.inf:
        raise Malformed(f"an exposure of {header.exposure} s")
