"""``captures.json``: what a run measured, one entry for each frame that counts.

The public format ``dualcal.captures/1``. Other programs write it too: keys that are not known are ignored.

An entry tells of the target by ``feature_px`` and ``corners_px``, or by ``target_in_camera`` in place of both. Where it
has both, the corners are what was measured: ``target_in_camera``, which was made from them, is left out with its
covariance.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from dualcal_hal.config import CellConfig
from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.robot import Joints
from dualcal_hal.session.files import read_document, write_document
from dualcal_hal.session.plain import LARGEST
from dualcal_hal.session.triples import pose_of
from dualcal_hal.transforms import Array

FORMAT = "dualcal.captures/1"

FARTHEST_FEATURE = 2.0
"""px in each axis that the feature point may differ from its corner, which may have been measured in another way."""

LARGEST_ANGLE = 50.0
"""rad; no joint turns further, and degrees soon are more."""

LEAST_SIGMA = 1e-9
"""m or rad; a pose that is seen is not more exact."""

_SINGULAR = 1e-9  # of correlations, an eigenvalue

Use = Literal["calibration", "verification"]
Pixel = tuple[float, float]


@dataclass(frozen=True)
class BoardPose:
    """Where another program saw the target in the camera: matrix (4, 4), m; covariance (6, 6) or None: of
    log(seen^-1 true), translation (m) then rotation (rad), in the target's frame.
    """

    matrix: tuple[tuple[float, ...], ...]
    covariance: tuple[tuple[float, ...], ...] | None = None

    def to_record(self) -> dict[str, Any]:
        """The value as in the file."""
        matrix = [list(row) for row in self.matrix]
        if self.covariance is None:
            return {"matrix": matrix}
        return {"matrix": matrix, "covariance": [list(row) for row in self.covariance]}


@dataclass(frozen=True)
class CaptureRecord:
    """One datum.

    constraint: name of the optical axis it belongs to; active_arrival: a new number each time the active arm
    arrived anew (captures that share it share that arm's error); joints: rad, mean of the readings before and after
    the exposure; feature, corners: px in the distorted image, corners by index on the board, None for one that was not
    seen, or None altogether; image_size: width and height, px, None where there is no image; aligned: whether the
    feature was within the tolerance; order_known: False where two orientations of the pattern fitted; board_pose: of
    the target, in place of corners that another program does not tell; feature and corners are then where the camera
    would see them, NaN and None until it is known.
    """

    id: str
    use: Use
    constraint: str
    position: int
    active_arrival: int
    active_joints: Joints
    passive_joints: Joints
    feature: Pixel
    corners: tuple[Pixel | None, ...] | None
    image_size: tuple[int, int] | None
    aligned: bool = True
    order_known: bool = True
    board_pose: BoardPose | None = None

    def to_record(self) -> dict[str, Any]:
        """The entry as in the file."""
        if self.board_pose is None:
            corners = None if self.corners is None else [corner and list(corner) for corner in self.corners]
            sight: dict[str, Any] = {"feature_px": list(self.feature), "corners_px": corners}
        else:
            sight = {"target_in_camera": self.board_pose.to_record()}
        image = {} if self.image_size is None else {"image_px": list(self.image_size)}
        return {
            "id": self.id,
            "use": self.use,
            "constraint": self.constraint,
            "position": self.position,
            "active_arrival": self.active_arrival,
            "active_joints_rad": list(self.active_joints),
            "passive_joints_rad": list(self.passive_joints),
            **sight,
            **image,
            "aligned": self.aligned,
            "order": "known" if self.order_known else "unknown",
        }

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> CaptureRecord:
        """From an entry that names its arrival, as :meth:`to_record` writes it; FormatError otherwise."""
        entry, problems = _entry(record, str(record.get("id", "capture")))
        if entry is not None and entry.active_arrival is None:
            problems = [Problem(entry.id, "active_arrival: missing")]
        if entry is None or entry.active_arrival is None:
            raise FormatError(problems)
        return entry.capture(entry.active_arrival)


@dataclass(frozen=True)
class Captures:
    """The captures of a run; cell_sha256 of the cell file used and the time of starting (ISO 8601) if known."""

    cell_sha256: str | None
    started: str | None
    captures: tuple[CaptureRecord, ...]


@dataclass(frozen=True)
class CellShape:
    """What the captures of a cell have: joints of the active and the passive arm, corners and the index of the feature
    point among them, the image's width and height, px.
    """

    joints: tuple[int, int]
    corners: int
    feature: int
    image_size: tuple[int, int]

    @classmethod
    def of(cls, cell: CellConfig) -> CellShape:
        board = cell.target.board
        joints = cell.active.chain.joints, cell.passive.chain.joints
        return cls(joints, len(board.corners), board.feature, cell.camera.intrinsics.size)

    def require(self, capture: CaptureRecord) -> None:
        """FormatError for a capture that is of another cell."""
        problems = list(_mismatches(capture, self.joints, self.corners, self.image_size))
        if problems := problems or list(_stray_feature(capture, self.feature)):
            raise FormatError(problems)


def write_captures(path: Path, captures: Captures) -> None:
    """Write the public file atomically."""
    header = {"cell_sha256": captures.cell_sha256, "started": captures.started}
    known = {key: value for key, value in header.items() if value is not None}
    entries = [capture.to_record() for capture in captures.captures]
    write_document(path, {"format": FORMAT, **known, "captures": entries})


def read_captures(
    path: Path,
    *,
    joints: tuple[int, int] | None = None,
    corners: int | None = None,
    feature: int | None = None,
    image_size: tuple[int, int] | None = None,
) -> Captures:
    """Read the public file.

    joints: of the active and passive arm, corners: of the board, feature: the index of its feature point among them,
    image_size: px, where the cell is known. Raises FormatError with all problems, each at the capture's id or the file.
    Where no arrival is given a constraint is one.
    """
    document = read_document(path, FORMAT)
    problems = list(_header_problems(document, str(path)))
    raw = document.get("captures")
    entries: list[_Entry] = []
    for index, record in enumerate(raw if isinstance(raw, list) else []):
        entry, wrong = _entry(record, _name(record, index))
        problems += wrong
        if entry is not None:
            entries.append(entry)
            capture = entry.capture(entry.active_arrival or 0)
            problems += _mismatches(capture, joints, corners, image_size)
            problems += _outside(capture)
            problems += _stray_feature(capture, feature)
    problems += _duplicates([_name(record, index) for index, record in enumerate(raw)] if isinstance(raw, list) else [])
    if problems:
        raise FormatError(problems)
    return Captures(document.get("cell_sha256"), document.get("started"), tuple(_with_arrivals(entries)))


_Finite = Annotated[float, Field(strict=True, ge=-LARGEST, le=LARGEST)]
_Whole = Annotated[int, Field(strict=True)]
_Size = Annotated[int, Field(strict=True, gt=0)]


def _in_radians(angles: Joints) -> Joints:
    largest = max(map(abs, angles), default=0.0)
    if largest > LARGEST_ANGLE:
        raise ValueError(f"an angle of {largest:.4g} rad is {largest / math.tau:.0f} turns: angles are in radians")
    return angles


_Joints = Annotated[tuple[_Finite, ...], AfterValidator(_in_radians)]  # none of a stand


def _number_as_name(value: Any) -> Any:
    return str(value) if isinstance(value, int) and not isinstance(value, bool) else value


_Name = Annotated[str, Field(strict=True, min_length=1), BeforeValidator(_number_as_name)]


def _board_pose(value: Any) -> BoardPose | None:
    if value is None:
        return None
    if not isinstance(value, Mapping):
        raise ValueError("must be an object with a matrix, in m")
    pose = pose_of(value)
    if pose.covariance is None:
        return BoardPose(_rows(pose.T))
    sigmas = np.sqrt(np.diag(pose.covariance))
    if sigmas.min() < LEAST_SIGMA or np.linalg.eigvalsh(pose.covariance / np.outer(sigmas, sigmas))[0] < _SINGULAR:
        raise ValueError(f"the covariance has a direction that is exact; {LEAST_SIGMA:g} m or rad is the least sigma")
    return BoardPose(_rows(pose.T), _rows(pose.covariance))


def _rows(matrix: Array) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, matrix.tolist()))


class _Entry(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True, allow_inf_nan=False)

    id: _Name
    use: Use
    constraint: _Name
    position: Annotated[int, Field(strict=True, ge=0)]
    active_arrival: _Whole | None = None
    active_joints_rad: _Joints
    passive_joints_rad: _Joints
    target_in_camera: Annotated[BoardPose | None, BeforeValidator(_board_pose)] = None
    feature_px: tuple[_Finite, _Finite] | None = None
    corners_px: tuple[tuple[_Finite, _Finite] | None, ...] | None = None
    image_px: tuple[_Size, _Size] | None = None
    aligned: Annotated[bool, Field(strict=True)] = True
    order: Literal["known", "unknown"] = "known"

    def capture(self, arrival: int) -> CaptureRecord:
        return CaptureRecord(
            id=self.id,
            use=self.use,
            constraint=self.constraint,
            position=self.position,
            active_arrival=arrival,
            active_joints=self.active_joints_rad,
            passive_joints=self.passive_joints_rad,
            feature=self.feature_px or (np.nan, np.nan),
            corners=self.corners_px,
            image_size=self.image_px,
            aligned=self.aligned,
            order_known=self.order == "known",
            board_pose=self.target_in_camera if self.corners_px is None else None,
        )


def _entry(record: Any, name: str) -> tuple[_Entry | None, list[Problem]]:
    if not isinstance(record, Mapping):
        return None, [Problem(name, "is not a JSON object")]
    missing = list(_missing_sight(record, name))
    try:
        entry = _Entry.model_validate(record)
    except ValidationError as error:
        return None, [*missing, *(Problem(name, _words(details)) for details in error.errors())]
    return (None, missing) if missing else (entry, [])


def _missing_sight(record: Mapping[str, Any], name: str) -> Iterator[Problem]:
    """Pixels and the image's size may be left out where another program says where it saw the target."""
    if record.get("target_in_camera") is not None and record.get("corners_px") is None:
        return
    for key in ("feature_px", "corners_px", "image_px"):
        if key not in record:
            yield Problem(name, f"{key}: missing; only an entry with target_in_camera goes without")
    for key in ("feature_px", "image_px"):
        if key in record and record[key] is None:
            yield Problem(name, f"{key}: must be a list, not None")


_WORDS = {
    "tuple_type": "must be a list",
    "too_long": "must be a list of the right length",
    "too_short": "must be a list of the right length",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "string_type": "must be text",
    "finite_number": "must be a finite number",
}


def _words(details: Any) -> str:
    key, *indices = details["loc"]
    where = f"{key}{''.join(f'.{at}' if isinstance(at, str) else f'[{at}]' for at in indices)}"
    if details["type"] == "missing":
        return f"{where}: missing"
    if details["type"] == "value_error":
        return f"{where}: {details['ctx']['error']}"
    said = _WORDS.get(details["type"], f"{details['msg'][0].lower()}{details['msg'][1:]}")
    return f"{where}: {said}, not {str(details['input'])[:60]}"


def _header_problems(document: Mapping[str, Any], file: str) -> Iterator[Problem]:
    for key in ("cell_sha256", "started"):
        if not isinstance(document.get(key), str | None):
            yield Problem(file, f"{key}: must be a text")
    captures = document.get("captures")
    if "captures" not in document:
        yield Problem(file, "captures: missing")
    elif not isinstance(captures, list):
        yield Problem(file, "captures: must be a list")
    elif not captures:
        yield Problem(file, "captures: is empty")


def _name(record: Any, index: int) -> str:
    name = _number_as_name(record.get("id")) if isinstance(record, Mapping) else None
    return name if isinstance(name, str) and name else f"captures[{index}]"


def _duplicates(names: Sequence[str]) -> Iterator[Problem]:
    for name in dict.fromkeys(names):
        if (count := names.count(name)) > 1:
            yield Problem(name, f"id: used by {count} captures")


def _stray_feature(capture: CaptureRecord, feature: int | None) -> Iterator[Problem]:
    if feature is None or capture.corners is None or feature >= len(capture.corners):
        return
    corner = capture.corners[feature]
    if corner is None:
        return
    if max(abs(corner[0] - capture.feature[0]), abs(corner[1] - capture.feature[1])) > FARTHEST_FEATURE:
        yield Problem(capture.id, f"feature_px: {capture.feature} is not corner {feature} of corners_px, {corner}")


def _outside(capture: CaptureRecord) -> Iterator[Problem]:
    """A pixel that no image has; of several the first."""
    if capture.image_size is None or capture.board_pose is not None:
        return
    pixels = {"feature_px": capture.feature}
    pixels |= {f"corners_px[{i}]": corner for i, corner in enumerate(capture.corners or ()) if corner is not None}
    for where, pixel in pixels.items():
        if any(
            not -FARTHEST_FEATURE <= x <= size + FARTHEST_FEATURE
            for x, size in zip(pixel, capture.image_size, strict=True)
        ):
            yield Problem(capture.id, f"{where}: {pixel} is outside the image of {_by(capture.image_size)} px")
            return


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"


def _mismatches(
    capture: CaptureRecord, joints: tuple[int, int] | None, corners: int | None, image_size: tuple[int, int] | None
) -> Iterator[Problem]:
    if joints is not None:
        both = (capture.active_joints, capture.passive_joints)
        for key, angles, expected in zip(("active", "passive"), both, joints, strict=True):
            if len(angles) != expected:
                yield Problem(capture.id, f"{key}_joints_rad: {len(angles)} joint angles, the arm has {expected}")
    if corners is not None and capture.corners is not None and len(capture.corners) != corners:
        yield Problem(capture.id, f"corners_px: {len(capture.corners)} corners, the target has {corners}")
    if image_size is not None and capture.image_size is not None and capture.image_size != image_size:
        what = f"image_px: {_by(capture.image_size)} px, the cell's camera has {_by(image_size)}"
        yield Problem(capture.id, what)


def _with_arrivals(entries: Sequence[_Entry]) -> Iterator[CaptureRecord]:
    unused = 1 + max((entry.active_arrival for entry in entries if entry.active_arrival is not None), default=-1)
    assumed: dict[str, int] = {}
    for entry in entries:
        if entry.active_arrival is None:
            yield entry.capture(assumed.setdefault(entry.constraint, unused + len(assumed)))
        else:
            yield entry.capture(entry.active_arrival)
