"""Images as bytes, and back with distrust: what is read may come from anywhere."""

from __future__ import annotations

import struct
import zlib
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
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}


def encode(image: Image, image_format: ImageFormat) -> bytes:
    """A grey image (height, width) as a file's bytes: without loss as ``png``, with as ``jpeg``."""
    return encode_png(image) if image_format == "png" else _encode_jpeg(image)


def encode_png(image: Image) -> bytes:
    """Without loss and quickly."""
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
    try:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error as error:
        raise ValueError(f"is no readable {image_format} image: {error}") from error
    if image is None or image.shape != (height, width):
        raise ValueError(f"is no readable {image_format} image")
    return image.astype(np.uint8, copy=False)


def image_size(data: bytes, image_format: str) -> tuple[int, int]:
    """Width and height (px) as the header has them, of a grey image that may be decoded; ValueError otherwise.

    Of a PNG all checksums are compared, which the decoder does not insist on.
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


def _png_size(data: bytes) -> tuple[int, int]:
    if not data.startswith(_PNG_MAGIC):
        raise ValueError("is no PNG image")
    view, position, header = memoryview(data), len(_PNG_MAGIC), None
    while True:
        if position + 12 > len(data):
            raise ValueError("the PNG image is cut off")
        length, kind = _PNG_BLOCK.unpack_from(data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            raise ValueError("the PNG image is cut off")
        if zlib.crc32(view[position + 4 : end]) != int.from_bytes(view[end : end + 4], "big"):
            raise ValueError("a checksum of the PNG image does not fit")
        if header is None:
            if kind != b"IHDR" or length != _PNG_HEADER.size:
                raise ValueError("the PNG image has no header")
            header = _PNG_HEADER.unpack_from(data, position + 8)
        position = end + 4
        if kind == b"IEND":
            break
    width, height, depth, colour = header[:4]
    if (depth, colour) != (8, 0):
        raise ValueError("is no grey PNG image of 8 bits")
    return width, height


def _jpeg_size(data: bytes) -> tuple[int, int]:
    if not data.startswith(b"\xff\xd8"):
        raise ValueError("is no JPEG image")
    position = 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4], "big")
        if marker in _JPEG_FRAMES:
            if length < 9 or position + 10 > len(data):
                break
            if data[position + 9] != 1:
                raise ValueError("is no grey JPEG image")
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        position += 2 + max(length, 2)
    raise ValueError("the JPEG image has no header")
