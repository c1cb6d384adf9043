"""What came of photographs with flange poses: the public format ``dualcal.views-result/1``.

Metres and radians here; in the file the unit is in the key's name, and covariances are in m and rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.camera import Intrinsics
from dualcal_hal.session.files import write_document
from dualcal_hal.session.triples_result import FRAME, ORDER, UNITS, Found, found_document
from dualcal_hal.transforms import Array

FORMAT = "dualcal.views-result/1"

COEFFICIENTS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")


@dataclass(frozen=True)
class PlacementFound:
    """ratio: how many times farther off the corners were with the other placement, None where the file states it or
    the other explains nothing at all.
    """

    name: str
    stated: bool
    ratio: float | None


@dataclass(frozen=True, eq=False)
class ViewResult:
    """One view. missed: why its image gave no corners; dropped: why it was not used; both None for one that was.

    corners (n, 2) px, NaN where not seen; residuals (n, 2) px: where the estimate puts them minus corners. rms: px per
    axis. left_out: the same, px per axis and m at the target, by an estimate without this view. distance: from where
    the others put it, in sigmas rms.
    """

    name: str
    image: str
    missed: str | None
    dropped: str | None
    corners: Array
    residuals: Array
    left_out_px: float
    left_out: float
    distance: float

    @property
    def used(self) -> bool:
        return self.missed is None and self.dropped is None

    @property
    def seen(self) -> int:
        """Corners."""
        return int(np.isfinite(self.residuals[:, 0]).sum())

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.nanmean(self.residuals**2))) if self.seen else float("nan")


@dataclass(frozen=True)
class NoiseUsed:
    """Sigmas per axis: of a corner, px, of a flange pose along (m) and about (rad) its axes; found: from the views,
    else as stated; identified: by name, whether what was found can be told from none.
    """

    pixel: float
    translation: float
    rotation: float
    found: bool
    identified: Mapping[str, bool]


@dataclass(frozen=True)
class Attempt:
    """One of the fits that were compared: its rms over all corners, px per axis, and that of left-out views, px per
    axis and m at the target.
    """

    rms: float
    left_out_px: float
    left_out: float


@dataclass(frozen=True)
class Residue:
    """Sigma of the corners as more is left to the images, px per axis (``Breakdown``); None: not to be told."""

    given: float
    lens_free: float | None
    poses_free: float | None
    corners_free: float | None
    off_places: tuple[float, float] | None

    @property
    def shares(self) -> dict[str, float]:
        """px per axis: what ``lens``, ``arm`` and ``board`` add to the noise of the corners, in squares, as far as it
        can be told.
        """
        steps = (self.given, self.lens_free, self.poses_free, self.corners_free)
        between = zip(("lens", "arm", "board"), steps, steps[1:], strict=False)
        return {
            name: float(np.sqrt(max(0.0, more**2 - less**2)))
            for name, more, less in between
            if more is not None and less is not None
        }


@dataclass(frozen=True)
class Predicted:
    """3D error: root mean square and 95 %, m."""

    rms: float
    p95: float


@dataclass(frozen=True, eq=False)
class ViewsResult:
    """transforms: camera's, then target's, by their names in the file; covariance (12, 12): of both in this order.

    poses: ``as read``, the corners fit best with the arm where it was read, or ``with errors``, the most likely with
    the arm off by its noise; attempts: of both by these names, or of the one there was. rms: of corners of used views,
    px per axis, with the arm where it was read. camera_error: of where the camera is; point_error: of a point where the
    targets were. moved_by_lens, m: by how much the camera moves if the lens, which does not fit, is left to the images;
    it is part of the covariance; None where the lens fits or was freed. intrinsics_sigmas: of freed ones, by
    COEFFICIENTS. feature: row and column of the target's origin.
    """

    placement: PlacementFound
    transforms: Mapping[str, Found]
    covariance: Array
    poses: str
    attempts: Mapping[str, Attempt]
    noise: NoiseUsed
    rms: float
    residue: Residue
    camera_error: Predicted
    point_error: Predicted
    moved_by_lens: float | None
    views: tuple[ViewResult, ...]
    intrinsics_given: Intrinsics
    distortion_known: bool
    intrinsics: Intrinsics
    intrinsics_sigmas: Mapping[str, float]
    corners: Array
    feature: tuple[int, int]
    verdict: str
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def used(self) -> tuple[ViewResult, ...]:
        return tuple(view for view in self.views if view.used)

    def to_document(self) -> dict[str, Any]:
        """The public document."""
        row, column = self.feature
        return {
            "format": FORMAT,
            "placement": asdict(self.placement),
            "target_frame": f"origin in the inner corner of row {row} and column {column} from the top left, both from"
            " 0; x right and y up as its front is looked at, z towards the viewer",
            "transforms": {name: found_document(found) for name, found in self.transforms.items()},
            "covariance": {
                "of": [f"{name}: {component}" for name in self.transforms for component in ORDER],
                "frame": FRAME,
                "units": UNITS,
                "matrix": self.covariance.tolist(),
            },
            "predicted_error": {
                "camera_position_mm": _predicted(self.camera_error),
                "point_at_target_mm": _predicted(self.point_error),
                "camera_moves_with_lens_freed_mm": None if self.moved_by_lens is None else 1e3 * self.moved_by_lens,
            },
            "residuals": {
                "what": "px per axis, rms over all corners of the used views, flange poses taken as they were read",
                "rms_px": self.rms,
                "corners": sum(view.seen for view in self.used),
                "poses": self.poses,
                "attempts": {name: _attempt(attempt) for name, attempt in self.attempts.items()},
            },
            "breakdown": _residue(self.residue),
            "noise": {
                "from": "the views" if self.noise.found else "stated",
                "pixel_sigma_px": self.noise.pixel,
                "flange_sigma_mm": 1e3 * self.noise.translation,
                "flange_sigma_deg": float(np.degrees(self.noise.rotation)),
                "identified": dict(self.noise.identified),
            },
            "intrinsics": {
                "freed": bool(self.intrinsics_sigmas),
                "given": _intrinsics(self.intrinsics_given),
                "distortion_known": self.distortion_known,
                "used": _intrinsics(self.intrinsics),
                "sigma": dict(self.intrinsics_sigmas),
            },
            "views": [_view(view) for view in self.views],
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "warnings": list(self.warnings),
        }


def write_views_result(path: Path, result: ViewsResult) -> None:
    """Write the public file atomically."""
    write_document(path, result.to_document())


def _predicted(error: Predicted) -> dict[str, float]:
    return {"rms": 1e3 * error.rms, "p95": 1e3 * error.p95}


def _attempt(attempt: Attempt) -> dict[str, float]:
    return {"rms_px": attempt.rms, "left_out_px": attempt.left_out_px, "left_out_mm": 1e3 * attempt.left_out}


def _residue(residue: Residue) -> dict[str, Any]:
    off = residue.off_places
    return {
        "what": "sigma of the corners, px per axis, as more and more is left to the images",
        "as_given_px": residue.given,
        "lens_free_px": residue.lens_free,
        "and_poses_free_px": residue.poses_free,
        "and_corners_free_px": residue.corners_free,
        "corners_off_their_places_mm": None
        if off is None
        else {"in_plane": 1e3 * off[0], "out_of_plane": 1e3 * off[1]},
    }


def _intrinsics(intrinsics: Intrinsics) -> dict[str, Any]:
    return {
        "matrix": intrinsics.matrix.tolist(),
        "distortion": intrinsics.distortion.tolist(),
        "size_px": list(intrinsics.size),
    }


def _view(view: ViewResult) -> dict[str, Any]:
    return {
        "id": view.name,
        "image": view.image,
        "used": view.used,
        "reason": view.missed or view.dropped,
        "corners": view.seen,
        "rms_px": _number(view.rms),
        "left_out_px": _number(view.left_out_px),
        "left_out_mm": _number(1e3 * view.left_out),
        "distance_sigma": _number(view.distance),
        "corners_px": _points(view.corners),
        "residuals_px": _points(view.residuals),
    }


def _number(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _points(points: Array) -> list[list[float] | None]:
    return [point.tolist() if np.isfinite(point).all() else None for point in points]
