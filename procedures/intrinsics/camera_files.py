"""Intrinsics from files that other programs have written: OpenCV's FileStorage (YAML, JSON) and ROS's camera_info YAML.

Both have ``camera_matrix`` and ``distortion_coefficients``, each with rows, columns and data. What this program's model
of a lens cannot say, such as a fisheye's, is refused in words and never left out.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.plain import expect, finites
from dualcal_hal.transforms import Array

LARGEST_FILE = 500_000
"""Bytes; a camera takes a few hundred."""

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""OpenCV's order; the first five are those of a cell file."""

_KNOWN = 5
_COUNTS = (4, 5, 8, 12, 14)
_MODELS = ("plumb_bob", "rational_polynomial")
_NAMES = {
    "matrix": ("camera_matrix", "cameramatrix"),
    "distortion": ("distortion_coefficients", "distcoeffs", "dist_coeffs"),
    "width": ("image_width",),
    "height": ("image_height",),
    "model": ("distortion_model",),
    "fisheye": ("fisheye_model",),
}
"""What they are called, in lower case: OpenCV's samples have not always agreed on it."""


@dataclass(frozen=True, eq=False)
class CameraFile:
    """matrix: (3, 3) px; distortion: (5,) k1, k2, p1, p2, k3; size: (width, height) px, None where the file says
    nothing of it; kind: of file, in words."""

    matrix: Array
    distortion: Array
    size: tuple[int, int] | None
    kind: str

    def intrinsics_for(self, size: tuple[int, int]) -> Intrinsics:
        """For images of this (width, height); ValueError if they are of another size than the file's."""
        if self.size is not None and self.size != size:
            (width, height), (own_width, own_height) = self.size, size
            raise ValueError(
                f"it is for images of {width} x {height} px, the cell's camera.size_px is {own_width} x {own_height}; "
                "a camera that is cropped or binned otherwise has another matrix: calibrate it as it is used"
            )
        centre = self.matrix[:2, 2]
        if not np.all((centre >= 0) & (centre <= np.array(size) - 1)):
            raise ValueError(
                f"its principal point ({centre[0]:.1f}, {centre[1]:.1f}) px is outside the cell's images of "
                f"{size[0]} x {size[1]} px"
            )
        return Intrinsics(self.matrix, self.distortion, size)


def read_camera_file(path: Path) -> CameraFile:
    """The camera of a file; FormatError, with the reason, for anything that is none or that this program cannot say."""
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise ValueError("is far too large for a camera")
        return _camera(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FormatError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error
    except (YAMLError, RecursionError) as error:
        raise FormatError([Problem(str(path), f"is neither YAML nor JSON: {_first_line(error)}")]) from error
    except ValueError as error:
        raise FormatError([Problem(str(path), str(error))]) from error


def _camera(text: str) -> CameraFile:
    if text.lstrip().startswith("<?xml"):
        raise ValueError("is XML; let OpenCV write it as YAML or JSON, the file's name decides")
    # OpenCV's own header and tags are no YAML that others take.
    plain = re.sub(r"!!opencv-[a-z-]+", "", re.sub(r"\A%YAML:[^\n]*\n", "", text))
    document = YAML(typ="safe", pure=True).load(plain)
    if not isinstance(document, Mapping):
        raise ValueError("has no entries such as camera_matrix")
    entries = {key.lower(): value for key, value in document.items() if isinstance(key, str)}
    kind = "OpenCV" if text.startswith("%YAML:") or _is_from_opencv(entries) else "ROS"
    _require_pinhole(entries)
    return CameraFile(_matrix(_entry(entries, "matrix")), _distortion(entries), _size(entries), kind)


def _is_from_opencv(entries: Mapping[str, Any]) -> bool:
    return any(isinstance(value, Mapping) and ("dt" in value or "type_id" in value) for value in entries.values())


def _named(entries: Mapping[str, Any], what: str) -> Iterator[Any]:
    return (entries[name] for name in _NAMES[what] if name in entries)


def _entry(entries: Mapping[str, Any], what: str) -> Any:
    value = next(_named(entries, what), None)
    if value is None:
        raise ValueError(f"has no {_NAMES[what][0]}")
    return value


def _require_pinhole(entries: Mapping[str, Any]) -> None:
    if next(_named(entries, "fisheye"), 0) not in (0, False):
        raise ValueError("is a fisheye's (fisheye_model); a cell file has k1, k2, p1, p2, k3 of a pinhole's lens")
    model = next(_named(entries, "model"), "plumb_bob")
    if model not in _MODELS:
        raise ValueError(
            f"has distortion_model {str(model)[:40]!r}; a cell file has k1, k2, p1, p2, k3 of a pinhole's lens "
            f"({' or '.join(_MODELS)})"
        )


def _matrix(entry: Any) -> Array:
    values = _numbers(entry, "camera_matrix")
    if len(values) != 9:
        raise ValueError(f"camera_matrix has {len(values)} numbers, not 9")
    matrix: Array = np.array(values).reshape(3, 3)
    fx, fy = matrix[0, 0], matrix[1, 1]
    if not (fx > 0 and fy > 0) or matrix[1, 0] != 0 or np.any(matrix[2] != (0, 0, 1)):
        raise ValueError("camera_matrix is none: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    if matrix[0, 1] != 0:
        raise ValueError(f"camera_matrix has a skew of {matrix[0, 1]:g}; a cell file has none")
    return matrix


def _distortion(entries: Mapping[str, Any]) -> Array:
    values = _numbers(_entry(entries, "distortion"), "distortion_coefficients")
    if len(values) not in _COUNTS:
        counts = ", ".join(map(str, _COUNTS))
        raise ValueError(f"distortion_coefficients has {len(values)} numbers; there are models with {counts}")
    beyond = zip(COEFFICIENTS[_KNOWN:], values[_KNOWN:], strict=False)
    unknown = [f"{name} {value:g}" for name, value in beyond if value != 0]
    if unknown:
        raise ValueError(
            f"distortion_coefficients has {', '.join(unknown)}; a cell file has k1, k2, p1, p2, k3 alone: "
            "calibrate again without these"
        )
    return np.array([*values, 0.0][:_KNOWN])


def _size(entries: Mapping[str, Any]) -> tuple[int, int] | None:
    width, height = (next(_named(entries, side), None) for side in ("width", "height"))
    if width is None and height is None:
        return None
    return _side(width, "image_width"), _side(height, "image_height")


def _side(pixels: Any, name: str) -> int:
    if isinstance(pixels, bool) or not isinstance(pixels, int) or pixels < 1:
        raise ValueError(f"{name} is no number of pixels: {str(pixels)[:40]!r}")
    return pixels


def _numbers(entry: Any, name: str) -> Sequence[float]:
    """Of a matrix with rows, cols and data."""
    if not isinstance(entry, Mapping) or "data" not in entry:
        raise ValueError(f"{name} has no data")
    data = expect(entry["data"], list, f"{name}.data")
    if "rows" in entry and "cols" in entry:
        rows, columns = entry["rows"], entry["cols"]
        if not (isinstance(rows, int) and isinstance(columns, int) and rows * columns == len(data)):
            raise ValueError(f"{name} has {len(data)} numbers where {rows} x {columns} are said")
    return finites(data, f"{name}.data")


def _first_line(error: Exception) -> str:
    return (str(getattr(error, "problem", None) or error) or type(error).__name__).splitlines()[0]
