"""What a refined estimate is worth, as the result says it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.errors import UsageError
from dualcal_hal.registry import is_simulated
from dualcal_hal.session.accuracy import (
    Accuracy,
    AlternativeRecord,
    CaptureFitRecord,
    DirectionRecord,
    Error3dRecord,
    FitRecord,
    FoundSigmaRecord,
    HiddenRecord,
    KnownRecord,
    LimitsRecord,
    MapRecord,
    NoiseRecord,
    RegionRecord,
    SpreadRecord,
)
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.transforms import Array
from procedures.analysis.knowns import arrays, feature_points
from procedures.estimation.refined import Known, Limits, Noise, Refined
from procedures.estimation.refined.guidance import would_help
from procedures.estimation.refined.hidden import hidden
from procedures.estimation.refined.uncertainty import spatial_error

_DEFAULT_ACCURACY_MM = 1.0
"""What is required of a simulated cell that does not say."""

_MAP = (7, 7, 5)
"""Points of the map along x, y and z."""

_REST = 0.05
"""Of the whole sigma, from which on what no input brings in is told."""

_WITHIN = (3, 3, 3)
"""Points of the region that are looked at: the error is largest in a corner, as its square is convex."""


def required_accuracy_mm(cell: CellConfig) -> float:
    """As the cell file says, mm; of a simulated cell a default. UsageError where nobody has said it of real arms."""
    stated = cell.procedure.verification.required_accuracy_mm
    if stated is not None:
        return stated
    used = {*(arm.backend for arm in cell.arms.values()), cell.camera.backend}
    if not all(is_simulated(cell.backends[name].type) for name in used):
        raise UsageError(
            "procedure.verification.required_accuracy_mm: missing, and only a cell that is simulated goes without;"
            " write it into a copy of the cell file and name that with --cell"
        )
    return _DEFAULT_ACCURACY_MM


def region_of(cell: CellConfig, captures: Sequence[CaptureRecord]) -> Array:
    """Where the accuracy is required, (2, 3) m in P: as the cell file says, or the box of the captures' points."""
    stated = cell.procedure.verification.region
    return stated.corners if stated is not None else _box(feature_points(captures, cell))


def accuracy_record(
    found: Refined,
    cell: CellConfig,
    calibration: Sequence[CaptureRecord],
    everywhere: Sequence[CaptureRecord],
    region: Array,
    stated: Noise,
) -> Accuracy:
    """calibration: the captures estimated from, in the estimate's order; everywhere: those that show which part of the
    workspace is shared; region (2, 3): lowest and highest corner in P, m.
    """
    limits = Limits()
    return Accuracy(
        covariance=tuple(map(tuple, found.covariance.tolist())),
        directions=tuple(_directions(found)),
        limits=LimitsRecord(translation_mm=1e3 * limits.translation, rotation_deg=float(np.degrees(limits.rotation))),
        would_help=would_help(found, arrays(calibration, cell)),
        condition=found.condition if np.isfinite(found.condition) else None,
        budget=tuple(_budget(found, region.mean(axis=0))),
        noise=_noise(found.noise),
        stated_noise=_noise(stated),
        found_noise=_found_noise(found),
        fit=FitRecord(
            chi_square=found.cost,
            degrees_of_freedom=found.freedom,
            between_arrivals=found.between,
            between_arrivals_degrees_of_freedom=found.between_freedom,
            scale=found.scale,
        ),
        captures=tuple(_captures(found, calibration)),
        alternatives=tuple(
            AlternativeRecord(
                active_base_in_passive_base=tuple(map(tuple, other.T_P_A.tolist())),
                camera_in_active_flange=tuple(map(tuple, other.T_H_E.tolist())),
                cost_ratio=other.ratio,
            )
            for other in found.alternatives
        ),
        knowns=known_records(found.known),
        cannot_be_seen=tuple(
            HiddenRecord(what=one.what, by=one.by, error_mm=1e3 * one.error)
            for one in hidden(found, _grid(region, _WITHIN))
        ),
        error_3d=_error_3d(found, cell, _box(feature_points(everywhere, cell)), region),
    )


def _box(points: Array) -> Array:
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _grid(box: Array, counts: tuple[int, int, int]) -> Array:
    """(k, 3): points spread over the box (2, 3), its corners included."""
    axes = [np.linspace(low, high, count) for low, high, count in zip(*box, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _directions(found: Refined) -> Iterator[DirectionRecord]:
    for index, direction in enumerate(found.directions):
        if index % 6 < 3:
            yield DirectionRecord(name=direction.name, sigma_mm=1e3 * direction.sigma, observable=direction.observable)
        else:
            degrees = float(np.degrees(direction.sigma))
            yield DirectionRecord(name=direction.name, sigma_deg=degrees, observable=direction.observable)


def _budget(found: Refined, middle: Array) -> Iterator[SpreadRecord]:
    """The rest is what the captures lose by showing knowns besides the transforms."""
    rest = found.covariance - np.sum(list(found.contributions.values()), axis=0)
    parts_of = dict(found.contributions)
    if found.known and np.trace(rest[:3, :3]) > _REST**2 * np.trace(found.covariance[:3, :3]):
        parts_of["knowns found as well"] = rest
    for name, covariance in parts_of.items():
        parts = np.sqrt(np.maximum(np.diag(covariance).reshape(4, 3).sum(axis=1), 0.0))
        yield SpreadRecord(
            input=name,
            base_translation_mm=1e3 * float(parts[0]),
            base_rotation_deg=float(np.degrees(parts[1])),
            camera_translation_mm=1e3 * float(parts[2]),
            camera_rotation_deg=float(np.degrees(parts[3])),
            error_mm=1e3 * float(spatial_error(found.T_P_A, covariance, middle).rms),
        )


def _noise(noise: Noise) -> NoiseRecord:
    return NoiseRecord(
        pixel_px=noise.pixel, active_joint_mrad=1e3 * noise.active, passive_joint_mrad=1e3 * noise.passive
    )


def _found_noise(found: Refined) -> tuple[FoundSigmaRecord, ...] | None:
    if found.found is None:
        return None
    ratio = found.found.active_over_passive
    return tuple(
        FoundSigmaRecord(
            name=name,
            value=scale * sigma.value,
            lower=scale * sigma.lower,
            upper=scale * sigma.upper,
            identified=sigma.identified,
        )
        for name, sigma, scale in (
            ("pixel_px", found.found.pixel, 1.0),
            ("active_joint_mrad", found.found.joint, 1e3 * ratio),
            ("passive_joint_mrad", found.found.joint, 1e3),
        )
    )


def _captures(found: Refined, calibration: Sequence[CaptureRecord]) -> Iterator[CaptureFitRecord]:
    for index, capture in enumerate(calibration):
        if found.used[index]:
            residuals = found.residuals[index]
            yield CaptureFitRecord(
                id=capture.id,
                chi_square=float(found.distances[index]),
                degrees_of_freedom=float(found.freedoms[index]),
                residuals_sigma=tuple(
                    (float(u), float(v)) if np.isfinite(u) and np.isfinite(v) else None for u, v in residuals
                ),
                turned=bool(found.flipped[index]),
            )


def known_records(knowns: Sequence[Known]) -> tuple[KnownRecord, ...]:
    """Of knowns that are not exact, after an estimate."""
    return tuple(
        KnownRecord(
            name=known.name,
            unit=known.unit,
            value=known.value,
            prior_sigma=known.prior if np.isfinite(known.prior) else None,
            sigma=known.sigma,
            seen=known.seen,
        )
        for known in knowns
    )


def _error_3d(found: Refined, cell: CellConfig, shared: Array, region: Array) -> Error3dRecord:
    within = found.spatial_error(_grid(region, _WITHIN))
    points = _grid(shared, _MAP)
    over = found.spatial_error(points)
    low, high = (tuple((1e3 * corner).tolist()) for corner in region)
    return Error3dRecord(
        region=RegionRecord(low_mm=low, high_mm=high),
        rms_mm=1e3 * float(within.rms.max()),
        p95_mm=1e3 * float(within.p95.max()),
        required_mm=required_accuracy_mm(cell),
        map=MapRecord(
            points_mm=tuple(map(tuple, (1e3 * points).tolist())),
            rms_mm=tuple((1e3 * over.rms).tolist()),
            p95_mm=tuple((1e3 * over.p95).tolist()),
        ),
    )
