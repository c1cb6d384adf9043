"""Images as bytes, and back with distrust: what is read may come from anywhere."""

from __future__ import annotations

import re
import struct
import threading
import weakref
import zlib
from collections.abc import Iterator
from concurrent.futures import Future
from typing import Literal

import numpy as np

from dualcal_hal.camera import Image

ImageFormat = Literal["png", "jpeg"]

LARGEST_SIDE = 1 << 14
LARGEST_AREA = 1 << 26
"""px of an image that is decoded; a few bytes of PNG can ask for far more memory than there is."""

_JPEG_QUALITY = 95
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_BLOCK = struct.Struct(">I4s")
_PNG_HEADER = struct.Struct(">IIBBBBB")
_PNG_ANCILLARY = 0x20
"""Bit of the first letter of a block's kind: it may be passed over, and here it is."""
_PNG_GREY = [8, 0, 0, 0, 0]
"""Bits, colour, compression, filter and interlacing of the images here."""

_JPEG_FRAME, _JPEG_SCAN = 0xC0, 0xDA
_JPEG_SEGMENTS = frozenset({_JPEG_FRAME, 0xC4, 0xDB, 0xDD, _JPEG_SCAN, *range(0xE0, 0xF0), 0xFE})
_JPEG_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7]")
_JPEG_FRAME_HEADER = struct.Struct(">BHHBBBB")


def encode(image: Image, image_format: ImageFormat) -> bytes:
    """A grey image (height, width) as a file's bytes: without loss as ``png``, with as ``jpeg``."""
    return encode_png(image) if image_format == "png" else _encode_jpeg(image)


def encode_png(image: Image) -> bytes:
    """Without loss and quickly. An image that cannot be written to is encoded once for all who keep it.

    Those are the session's folder and its log, in different threads: who comes second waits for the first.
    """
    if image.flags.writeable:
        return _encode_png(image)
    place = id(image)
    with _encoding:
        found = _encoded.get(place)
        is_first = found is None or found[0]() is not image
        encoded = Future[bytes]() if found is None or is_first else found[1]
        if is_first:
            _encoded[place] = weakref.ref(image, lambda _: _encoded.pop(place, None)), encoded
    if is_first:
        try:
            encoded.set_result(_encode_png(image))
        except BaseException as error:
            encoded.set_exception(error)
            raise
    return encoded.result()


_encoding = threading.Lock()
_encoded: dict[int, tuple[weakref.ref[Image], Future[bytes]]] = {}
"""By the identity of images that are still in use."""


def _encode_png(image: Image) -> bytes:
    import cv2

    # Sensor noise does not repeat: to look for what does, or for the best filter of each row, takes twice as long and
    # makes the file no smaller.
    strategy = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
    filters = [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG]
    _, png = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1, *strategy, *filters])
    return png.tobytes()


def _encode_jpeg(image: Image) -> bytes:
    import cv2

    _, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return jpeg.tobytes()


def decode(data: bytes, image_format: str) -> Image:
    """The grey image (height, width), or ValueError. Nothing is allocated before its size is known to be bearable."""
    import cv2

    width, height = image_size(data, image_format)
    plain = _with_rows_alone(data, width, height) if image_format == "png" else data
    try:
        image = cv2.imdecode(np.frombuffer(plain, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise ValueError(f"is no readable {image_format} image: {error}") from error
    if image is None or image.shape != (height, width):
        raise ValueError(f"is no readable {image_format} image")
    return image.astype(np.uint8, copy=False)


def image_size(data: bytes, image_format: str) -> tuple[int, int]:
    """Width and height (px) as the header has them, of a grey image of the kind that is written here; ValueError for
    any other, and for one that is too large to be decoded.

    Of a PNG all checksums are compared, which the decoder does not insist on; of a JPEG every segment is looked at as
    the decoder does.
    """
    if image_format == "png":
        size = _png_size(data)
    elif image_format == "jpeg":
        size = _jpeg_size(data)
    else:
        raise ValueError(f"image format {image_format!r} is not known")
    require_bearable(*size)
    return size


def require_bearable(width: int, height: int) -> None:
    """ValueError for the size (px) of an image that is not decoded."""
    if not (0 < width <= LARGEST_SIDE and 0 < height <= LARGEST_SIDE and width * height <= LARGEST_AREA):
        raise ValueError(f"an image of {width} x {height} px is too large, or empty")


# PNG, by the W3C's specification (third edition)


def _png_size(data: bytes) -> tuple[int, int]:
    header = None
    for kind, content in _png_blocks(data):
        if header is None:
            if kind != b"IHDR" or len(content) != _PNG_HEADER.size:
                raise ValueError("the PNG image has no header")
            header = _PNG_HEADER.unpack(content)
        elif kind not in (b"IDAT", b"IEND") and not kind[0] & _PNG_ANCILLARY:
            raise ValueError(f"the PNG image has a block {bytes(kind)!r}, which no grey image needs")
    assert header is not None  # the blocks end with the last one, which is no header
    width, height, *form = header
    if form != _PNG_GREY:
        raise ValueError("is no grey PNG image of 8 bits")
    return width, height


def _png_blocks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Kind and content of each, to the last one, IEND."""
    if not data.startswith(_PNG_MAGIC):
        raise ValueError("is no PNG image")
    view, position, kind = memoryview(data), len(_PNG_MAGIC), b""
    while kind != b"IEND":
        if position + 12 > len(data):
            raise ValueError("the PNG image is cut off")
        length, kind = _PNG_BLOCK.unpack_from(data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise ValueError("the PNG image is cut off")
        if zlib.crc32(view[position + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise ValueError("a checksum of the PNG image does not fit")
        yield kind, view[position + 8 : end]
        position = end + 4


def _with_rows_alone(data: bytes, width: int, height: int) -> bytes:
    """A PNG with the rows of this one, uncompressed, and nothing else; ValueError unless they are as many as it says.

    The decoder would go on to unpack whatever follows the last row, a thousandfold of what the file holds.
    """
    unpacking, rows = zlib.decompressobj(), bytearray()
    size = height * (width + 1)
    try:
        for kind, content in _png_blocks(data):
            if kind == b"IDAT" and unpacking.eof:
                raise ValueError("the PNG image goes on behind its end")
            if kind == b"IDAT":
                # One byte more than there may be is enough to see that there are more.
                rows += unpacking.decompress(content, size + 1 - len(rows))
                if len(rows) > size:
                    raise ValueError("the PNG image has more rows than its header says")
    except zlib.error as error:
        raise ValueError(f"the PNG image cannot be unpacked: {error}") from error
    if len(rows) < size or not unpacking.eof:
        raise ValueError("the PNG image has fewer rows than its header says")
    header = _PNG_HEADER.pack(width, height, *_PNG_GREY)
    blocks = (b"IHDR", header), (b"IDAT", zlib.compress(rows, 0)), (b"IEND", b"")
    return _PNG_MAGIC + b"".join(_png_block(kind, content) for kind, content in blocks)


def _png_block(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(content, zlib.crc32(kind))
    return _PNG_BLOCK.pack(len(content), kind) + content + checksum.to_bytes(4, "big")


# JPEG, by ITU-T T.81, annex B


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Of a baseline image of one scan. What T.81 allows besides is refused: of it the decoder may make another size."""
    sizes, end = [], 0
    for marker, content, following in _jpeg_segments(data):
        end = following
        if marker == _JPEG_FRAME:
            sizes.append(_jpeg_frame_size(content))
    if len(sizes) != 1:
        raise ValueError(f"the JPEG image has {'two sizes' if sizes else 'no size'}")
    after = _JPEG_MARKER.search(data, end)
    if after is None or after[0] != b"\xff\xd9":
        raise ValueError("the JPEG image is cut off, or has more than one scan")
    return sizes[0]


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes, int]]:
    """Marker, content and end of each, to the one that begins the scan."""
    if not data.startswith(b"\xff\xd8"):
        raise ValueError("is no JPEG image")
    position, marker = 2, 0
    while marker != _JPEG_SCAN:
        begin = data[position : position + 4]
        if len(begin) < 4:
            raise ValueError("the JPEG image is cut off")
        if begin[0] != 0xFF or begin[1] not in _JPEG_SEGMENTS:
            raise ValueError(f"the JPEG image has {begin[:2].hex()} where a segment should begin")
        marker, length = begin[1], int.from_bytes(begin[2:], "big")
        content, position = data[position + 4 : position + 2 + length], position + 2 + length
        if length < 2 or position > len(data):
            raise ValueError("the JPEG image is cut off")
        yield marker, content, position


def _jpeg_frame_size(content: bytes) -> tuple[int, int]:
    if len(content) != _JPEG_FRAME_HEADER.size:
        raise ValueError("is no grey JPEG image")
    depth, height, width, components = _JPEG_FRAME_HEADER.unpack(content)[:4]
    if (depth, components) != (8, 1):
        raise ValueError("is no grey JPEG image")
    return width, height
