"""What is taken from a socket is a frame, or refused in words, whatever comes."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

msgspec = pytest.importorskip("msgspec", reason="the zmq camera is an extra: pip install 'dualcal[zmq]'")

from backends.cameras.wire import (  # noqa: E402 - what it needs may be missing
    LARGEST_HEADER,
    LARGEST_SIDE,
    MOST_MARKS,
    Header,
    Malformed,
    decode,
    encode,
    is_mark,
    new_mark,
)

IMAGE = np.arange(12, dtype=np.uint8).reshape(3, 4)
HEADER = Header("lens", b"one", 7, 12.5, 0.004, "host", "boot", 4, 3, [(new_mark(), 12.0)])


def parts(**changes: Any) -> list[memoryview]:
    """A frame whose header says something else here and there."""
    header, raw = encode(HEADER, IMAGE)
    document = {**msgspec.msgpack.decode(header), **changes}
    return [memoryview(msgspec.msgpack.encode(document)), raw]


def test_a_frame_comes_back_as_it_was_and_read_only() -> None:
    header, image = decode([memoryview(part) for part in encode(HEADER, IMAGE)])
    assert header == HEADER
    np.testing.assert_array_equal(image, IMAGE)
    assert not image.flags.writeable


def test_an_image_that_is_a_part_of_another_is_sent_as_it_is_seen() -> None:
    part = np.arange(48, dtype=np.uint8).reshape(6, 8)[::2, ::2]
    _, image = decode([memoryview(p) for p in encode(HEADER, part)])
    np.testing.assert_array_equal(image, part)


@pytest.mark.parametrize("image", [IMAGE.astype(np.uint16), IMAGE[:2], np.stack([IMAGE] * 3, axis=2)])
def test_what_is_no_grey_image_of_the_headers_size_is_not_sent(image: Any) -> None:
    with pytest.raises(ValueError, match="no grey image"):
        encode(HEADER, image)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"format": "dualcal.frame/2"}, "format"),
        ({"dtype": "uint16"}, "dtype"),
        ({"camera": 5}, "camera"),
        ({"camera": "x" * 300}, "camera"),
        ({"sequence": -1}, "sequence"),
        ({"sequence": 1 << 63}, "sequence|range"),
        ({"exposed_at": float("nan")}, "not finite"),
        ({"exposed_at": float("inf")}, "not finite"),
        ({"exposure": -1.0}, "exposure"),
        ({"exposure": float("nan")}, "exposure"),
        ({"width": 0}, "width"),
        ({"width": LARGEST_SIDE + 1}, "width"),
        ({"width": LARGEST_SIDE, "height": LARGEST_SIDE}, "more than any camera"),
        ({"width": 5}, "12 bytes for 5 x 3"),
        ({"marks": [(new_mark(), float("nan"))]}, "not finite"),
        ({"marks": [(b"short", 1.0)]}, "marks"),
        ({"marks": [(new_mark(), 1.0)] * (MOST_MARKS + 1)}, "marks"),
        ({"more": 1}, "more"),
    ],
)
def test_a_header_that_says_what_cannot_be_is_refused_by_what_it_says(changes: dict[str, Any], why: str) -> None:
    with pytest.raises(Malformed, match=why):
        decode(parts(**changes))


def test_a_message_of_other_parts_is_no_frame() -> None:
    header, raw = parts()
    for message in ([], [header], [header, raw, raw], [raw, header], [header, memoryview(b"")]):
        with pytest.raises(Malformed):
            decode(message)


def test_a_header_is_not_read_before_its_size_is_known() -> None:
    _, raw = parts()
    with pytest.raises(Malformed, match="header of"):
        decode([memoryview(bytes(LARGEST_HEADER + 1)), raw])
    with pytest.raises(Malformed, match="cannot be read"):  # nested deeper than any reader can go
        decode([memoryview(b"\x91" * LARGEST_HEADER), raw])


@given(st.lists(st.binary(max_size=200), max_size=3))
def test_bytes_at_random_are_no_frame(message: list[bytes]) -> None:
    with pytest.raises(Malformed):
        decode([memoryview(part) for part in message])


@given(st.data())
def test_a_header_with_bytes_changed_is_refused_or_is_one(data: st.DataObject) -> None:
    header, raw = parts()
    changed = bytearray(header)
    for _ in range(data.draw(st.integers(1, 4))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    with suppress(Malformed):
        decoded, image = decode([memoryview(changed), raw])
        assert image.shape == (decoded.height, decoded.width)


def test_no_two_marks_are_the_same_and_none_is_a_subscription_to_frames() -> None:
    marks = {new_mark() for _ in range(100)}
    assert len(marks) == 100
    assert all(map(is_mark, marks))
    assert not is_mark(b"")
    assert not is_mark(b"lens")
