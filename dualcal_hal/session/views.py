"""Photographs with the flange poses at which they were taken, from any robot: the public format ``dualcal.views/1``.

``{"format": "dualcal.views/1", "camera": CAMERA, "target": TARGET, "views": [VIEW, VIEW, ...]}``; format may be left
out. ``placement``: ``"eye-in-hand"``, the camera on the arm before a target that stays, or ``"eye-to-hand"``, a camera
that stays and the target on the arm; where it is left out the views tell. ``about`` (text) and ``guess`` (anything)
are let through and not used; any other key is an error.

CAMERA: ``matrix`` ([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px; pixel centres are integers), ``distortion`` (k1, k2, p1,
p2 and, if there is one, k3; left out: none), ``distortion_known`` (false: left out because it is not known),
``size_px`` (width and height; left out: that of the images).

TARGET: ``kind`` (``charuco`` or ``checkerboard``), ``squares_x`` and ``squares_y`` (across and down, when its text is
read), ``square_mm``; of charuco ``marker_mm``, ``dictionary`` (OpenCV's name) and, for boards made before OpenCV 4.6,
``legacy``. ``feature_corner`` ([row, column] of an inner corner from the top left, from 0): the origin of the target's
frame; the middlemost corner where left out, of two the upper or left one.

VIEW: ``image`` (a file, from the views file's folder), ``flange_in_base`` (a POSE as in ``dualcal.triples/1``: matrix,
or translation_m with quaternion_xyzw or rotation_vector_rad), ``id`` (left out: the image's name).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationError

from dualcal_hal.camera import Intrinsics
from dualcal_hal.config.target import TargetConfig
from dualcal_hal.config.values import AtLeast1, Matrix3, Natural, Number, Positive, Section
from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.files import read_object
from dualcal_hal.session.triples import lines_of_entries, pose_of
from dualcal_hal.target import Charuco, Checkerboard
from dualcal_hal.transforms import Array

FORMAT = "dualcal.views/1"

LARGEST_FILE = 20_000_000
"""Bytes; a view takes some hundred."""

MOST_VIEWS = 2000

SMALLEST_SQUARE_MM = 1.0
"""A smaller one is in other units."""

_MOST_PROBLEMS = 50

PlacementName = Literal["eye-in-hand", "eye-to-hand"]


@dataclass(frozen=True, eq=False)
class View:
    """name: as the file has it; image: its path; flange (4, 4): in the base, m."""

    name: str
    image: Path
    flange: Array


@dataclass(frozen=True, eq=False)
class ViewsFile:
    """placement: None where the file leaves it to the views; intrinsics.size: (0, 0) where it leaves that to the
    images; distortion_known: whether the distortion is more than an assumption.
    """

    path: Path
    placement: PlacementName | None
    intrinsics: Intrinsics
    distortion_known: bool
    board: Checkerboard | Charuco
    views: tuple[View, ...]

    @property
    def flanges(self) -> Array:
        """(k, 4, 4)."""
        return np.stack([view.flange for view in self.views])


def _pose(entry: Any) -> Array:
    if not isinstance(entry, dict):
        raise ValueError("is not a JSON object")
    if unknown := set(entry) - {"matrix", "translation_m", "quaternion_xyzw", "rotation_vector_rad"}:
        raise ValueError(f"unknown key {sorted(unknown)[0]!r}")
    return pose_of(entry).T


def _camera_matrix(matrix: Matrix3) -> Matrix3:
    (fx, skew, _), (below, fy, _), last = matrix
    if not (fx > 0 and fy > 0 and skew == below == 0 and last == (0.0, 0.0, 1.0)):
        raise ValueError("is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    return matrix


def _side(square_mm: float) -> float:
    if square_mm < SMALLEST_SQUARE_MM:
        raise ValueError(f"a square of {square_mm:g} mm: its side is in millimetres")
    return square_mm


class _Camera(Section):
    matrix: Annotated[Matrix3, AfterValidator(_camera_matrix)]
    distortion: Annotated[tuple[Number, ...], Field(min_length=4, max_length=5)] | None = None
    distortion_known: bool = True
    size_px: tuple[AtLeast1, AtLeast1] | None = None


class _Target(Section):
    kind: Literal["charuco", "checkerboard"]
    squares_x: Annotated[Natural, Field(ge=4)]
    squares_y: Annotated[Natural, Field(ge=4)]
    square_mm: Annotated[Positive, AfterValidator(_side)]
    marker_mm: Positive | None = None
    dictionary: str | None = None
    legacy: bool = False
    feature_corner: tuple[Natural, Natural] | None = None


class _View(Section, arbitrary_types_allowed=True):
    image: Annotated[str, Field(min_length=1)]
    flange_in_base: Annotated[Any, BeforeValidator(_pose)]
    id: Annotated[str, Field(min_length=1)] | None = None


class _Document(Section):
    format: Literal["dualcal.views/1"] = "dualcal.views/1"
    about: str = ""
    guess: Any = None
    placement: PlacementName | None = None
    camera: _Camera
    target: _Target
    views: Annotated[tuple[_View, ...], Field(min_length=1, max_length=MOST_VIEWS)]


def read_views(path: Path) -> ViewsFile:
    """FormatError with all problems, those of a view at its line; images are not opened but must be there."""
    _require_size(path)
    raw = read_object(path)
    lines = lines_of_entries(path.read_bytes(), "views") if isinstance(raw.get("views"), list) else []
    try:
        document = _Document.model_validate(raw)
    except ValidationError as error:
        told = [details for details in error.errors(include_url=False) if not _follows(details, raw)]
        raise _refused([_problem(path, lines, details) for details in told], path) from error
    board, wrong = _board(path, document.target)
    wrong += _of_camera(path, document.camera)
    views = tuple(View(view.id or view.image, path.parent / view.image, view.flange_in_base) for view in document.views)
    wrong += _of_views(path, lines, views)
    if wrong or board is None:
        raise _refused(wrong, path)
    camera = document.camera
    distortion = np.zeros(5)
    distortion[: len(camera.distortion or ())] = camera.distortion or ()
    intrinsics = Intrinsics(np.array(camera.matrix), distortion, camera.size_px or (0, 0))
    return ViewsFile(path, document.placement, intrinsics, camera.distortion_known, board, views)


def _require_size(path: Path) -> None:
    try:
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise FormatError([Problem(str(path), f"has {size} bytes, at most {LARGEST_FILE} are read")])
    except OSError as error:
        raise FormatError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error


def _refused(problems: Sequence[Problem], path: Path) -> FormatError:
    left = len(problems) - _MOST_PROBLEMS
    more = [Problem(str(path), f"{left} more problems of this kind")] if left > 0 else []
    return FormatError([*problems[:_MOST_PROBLEMS], *more])


def _follows(details: Any, raw: Mapping[str, Any]) -> bool:
    """Whether it is only said because all views that there are have problems of their own."""
    return details["type"] == "too_short" and details["loc"] == ("views",) and bool(raw["views"])


def _problem(path: Path, lines: Sequence[int], details: Any) -> Problem:
    location = details["loc"]
    of_view = len(location) > 1 and location[0] == "views" and isinstance(location[1], int)
    where = f"{path}:{lines[location[1]]}" if of_view and location[1] < len(lines) else str(path)
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
    if details["type"] == "extra_forbidden":
        return Problem(where, f"{name}: unknown key")
    if details["type"] == "missing":
        return Problem(where, f"{name}: is missing")
    if details["type"] == "value_error":
        return Problem(where, f"{name}: {details['ctx']['error']}")
    said = details["msg"].replace("Input should be", "must be").replace("valid tuple", "list")
    return Problem(where, f"{name}: {said.replace('Tuple', 'list')}")


def _board(path: Path, target: _Target) -> tuple[Checkerboard | Charuco | None, list[Problem]]:
    rows, columns = target.squares_y - 1, target.squares_x - 1
    entries = {
        "kind": target.kind,
        "corners": (rows, columns),
        "square_mm": target.square_mm,
        "marker_mm": target.marker_mm,
        "dictionary": target.dictionary,
        "legacy": target.legacy,
        "feature_corner": target.feature_corner or ((rows - 1) // 2, (columns - 1) // 2),
    }
    try:
        return TargetConfig.model_validate(entries).board, []
    except ValidationError as error:
        problems = []
        for details in error.errors(include_url=False):
            problem = _problem(path, (), {**details, "loc": ("target", *details["loc"])})
            problems.append(
                Problem(problem.where, problem.what.replace("target.corners", "target.squares_x, squares_y"))
            )
        return None, problems


def _of_camera(path: Path, camera: _Camera) -> Iterator[Problem]:
    if camera.distortion is not None and not camera.distortion_known:
        yield Problem(str(path), "camera.distortion_known: is false, but there is a distortion")
    if camera.size_px is not None:
        centre = np.array(camera.matrix)[:2, 2]
        if not np.all((centre >= 0) & (centre < camera.size_px)):
            yield Problem(str(path), f"camera.matrix: its principal point is outside size_px, {list(camera.size_px)}")


def _of_views(path: Path, lines: Sequence[int], views: Sequence[View]) -> Iterator[Problem]:
    twice = {
        **{name: "id" for name, count in Counter(view.name for view in views).items() if count > 1},
        **{str(image): "image" for image, count in Counter(view.image for view in views).items() if count > 1},
    }
    for line, view in zip(lines, views, strict=True):
        if not view.image.is_file():
            yield Problem(f"{path}:{line}", f"image: there is no file {view.image}")
        elif str(view.image) in twice:
            yield Problem(f"{path}:{line}", f"image: {view.image.name} is that of another view, too")
        elif view.name in twice:
            yield Problem(f"{path}:{line}", f"id: {view.name!r} is that of another view, too")
