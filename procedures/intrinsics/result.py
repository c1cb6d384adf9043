"""What a run for the camera comes to: ``intrinsics.json``, and the patch for the cell file."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.camera import Intrinsics
from dualcal_hal.config.camera import CameraConfig
from dualcal_hal.session.files import write_atomically
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array
from procedures.intrinsics.coverage import GRID, Coverage, tilts_of
from procedures.intrinsics.estimate import NAMES, Estimate, estimate, parameters
from procedures.intrinsics.procedure import SeenView, coverage_of

INTRINSICS_FORMAT = "dualcal.intrinsics/1"

WORST_NOISE = 5.0
"""An rms above so many times camera.sigma_px is none of corners' noise ..."""
WORST_RMS = 0.1
"""... if it is above this, px per axis."""
WORST_FOCAL = 0.01
"""Sigma of a focal length, in parts of it, above which it is not known."""

_DECIMALS = (4, 4, 4, 4, 7, 7, 8, 8, 7)


@dataclass(frozen=True, eq=False)
class IntrinsicsResult:
    """before: as the cell file has the camera; names: of the views; corners: (k, n, 2) px of them.

    reasons: why the camera is not known, empty where it is.
    """

    cell_sha256: str
    started: str | None
    before: Intrinsics
    names: tuple[str, ...]
    corners: Array
    estimate: Estimate
    coverage: Coverage
    reasons: tuple[str, ...]

    @property
    def verdict(self) -> str:
        return "refused" if self.reasons else "ok"

    def to_document(self) -> dict[str, Any]:
        """As ``intrinsics.json`` has it, units in the names."""
        found, coverage = self.estimate, self.coverage
        return {
            "format": INTRINSICS_FORMAT,
            "cell_sha256": self.cell_sha256,
            "started": self.started,
            "verdict": self.verdict,
            "reasons": list(self.reasons),
            "camera": camera_section(found.intrinsics),
            "size_px": list(found.intrinsics.size),
            "sigma": dict(zip(_KEYS, map(float, found.sigma), strict=True)),
            "fixed_at_zero": [name for name in NAMES if name in found.fixed],
            "rms_px": found.rms,
            "coverage": {
                "grid": list(GRID),
                "corners": coverage.cells.tolist(),
                "share": coverage.share,
                "outer_tenth": dict(zip(("left", "right", "top", "bottom"), coverage.edges, strict=True)),
                "largest_radius": coverage.radius,
                "views_tilted": dict(zip(("about_x", "about_y"), coverage.tilted, strict=True)),
            },
            "before": camera_section(self.before),
            "views": [self._view(i) for i in range(len(self.names))],
        }

    def _view(self, i: int) -> dict[str, Any]:
        found = self.estimate
        numbers: dict[str, Any] = {
            "id": self.names[i],
            "used": bool(found.used[i]),
            "corners": int(np.isfinite(self.corners[i, :, 0]).sum()),
            "rms_px": _finite(found.view_rms[i]),
        }
        if found.used[i]:
            about_x, about_y = np.rad2deg(tilts_of(found.poses[i]))
            numbers["distance_mm"] = 1e3 * float(found.poses[i, 2, 3])
            numbers["tilt_deg"] = {"about_x": float(about_x), "about_y": float(about_y)}
        numbers["residuals_px"] = [_pair(residual) for residual in found.residuals[i]]
        return numbers


def intrinsics_result(
    views: Sequence[SeenView], camera: CameraConfig, board: Target, cell_sha256: str, started: str | None
) -> IntrinsicsResult:
    """From the views of a run; DegenerateCaptures where they determine no camera at all."""
    corners = [view.corners for view in views]
    found = estimate(corners, board, camera.intrinsics)
    coverage = coverage_of(found, corners)
    reasons = (*coverage.lacking(), *_doubts(found, camera))
    names = tuple(view.name for view in views)
    return IntrinsicsResult(cell_sha256, started, camera.intrinsics, names, np.array(corners), found, coverage, reasons)


def _doubts(found: Estimate, camera: CameraConfig) -> Iterator[str]:
    limit = max(WORST_NOISE * camera.sigma_px, WORST_RMS)
    if found.rms > limit:
        yield (
            f"the residuals are {found.rms:.2f} px rms, far above the noise of corners (at most {limit:.2f} px by "
            "camera.sigma_px): check the target's corners, square_mm and flatness, the focus, and that the lens is no "
            "fisheye's"
        )
    focal = parameters(found.intrinsics)[:2]
    worst = float(np.max(found.sigma[:2] / focal))
    if worst > WORST_FOCAL:
        yield (
            f"the focal length is known to {worst:.1%} only, {WORST_FOCAL:.0%} is needed: show the target nearer "
            "(procedure.distance_mm) or use a larger one"
        )


# -- the cell file's own form ------------------------------------------------------------------------------------------


def camera_section(intrinsics: Intrinsics) -> dict[str, Any]:
    """``matrix`` and ``distortion`` as the section ``camera`` of a cell file has them, rounded below its sigma."""
    values = [round(float(value), digits) for value, digits in zip(parameters(intrinsics), _DECIMALS, strict=True)]
    fx, fy, cx, cy, *distortion = values
    return {"matrix": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], "distortion": distortion}


def settings(intrinsics: Intrinsics) -> tuple[str, ...]:
    """The values for ``--set``."""
    return tuple(f"camera.{key}={value}" for key, value in camera_section(intrinsics).items())


def set_options(intrinsics: Intrinsics) -> str:
    """The options as they are typed."""
    return " ".join(f"--set {shlex.quote(setting)}" for setting in settings(intrinsics))


def patch(intrinsics: Intrinsics, comments: Sequence[str]) -> str:
    """The lines of a cell file that are to be replaced, as YAML, below comments on where they come from."""
    section = camera_section(intrinsics)
    lines = [*(f"# {line}".rstrip() for line in comments), "camera:"]
    return "\n".join([*lines, *(f"  {key}: {value}" for key, value in section.items())]) + "\n"


def write_patch(path: Path, intrinsics: Intrinsics, comments: Sequence[str]) -> None:
    """Write :func:`patch`, all of it or nothing."""
    write_atomically(path, patch(intrinsics, comments).encode())


def findings(result: IntrinsicsResult) -> Iterator[str]:
    """What was found, a line each, as the patch has it for comments."""
    found, coverage = result.estimate, result.coverage
    yield (
        f"From {int(found.used.sum())} views, {found.rms:.3f} px rms per axis; corners in {coverage.share:.0%} of "
        f"{GRID[0]} x {GRID[1]} cells of the image,"
    )
    yield f"out to {coverage.radius:.0%} of the farthest pixel's distance from the principal point."
    sigma = dict(zip(NAMES, found.sigma, strict=True))
    yield "Sigma: " + ", ".join(f"{name} {sigma[name]:.2g} px" for name in NAMES[:4]) + ","
    yield "  " + ", ".join(f"{name} {sigma[name]:.2g}" for name in NAMES[4:]) + "."
    if found.fixed:
        names = ", ".join(name for name in NAMES if name in found.fixed)
        yield f"Not to be told from zero, and zero here: {names}."


_KEYS = tuple(f"{name}_px" if i < 4 else name for i, name in enumerate(NAMES))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _pair(residual: Array) -> list[float] | None:
    return [float(value) for value in residual] if np.all(np.isfinite(residual)) else None
