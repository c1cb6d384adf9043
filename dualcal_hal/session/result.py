"""``result.json``: what was found, how well it holds, and from what.

The public format ``dualcal.result/1``. Metres and radians here; in the file the unit is in the key's name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np

from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.accuracy import Accuracy, Verification
from dualcal_hal.session.files import read_document, read_object, write_document
from dualcal_hal.transforms import Array, is_rotation, quaternion_from_rotation, rotation_angle, vector_from_rotation

FORMAT = "dualcal.result/1"
T_P_A_NAME = "active_base_in_passive_base"
T_H_E_NAME = "camera_in_active_flange"

Verdict = Literal["ok", "coarse", "fail", "unverified"]


@dataclass(frozen=True)
class Mismatch:
    """Distances of the feature point from the predicted optical axis, m; values by verification capture."""

    mean: float
    rms: float
    p95: float
    max: float
    values: tuple[float, ...]


@dataclass(frozen=True)
class Unobservable:
    """A direction in which the transform ``of`` is not determined, and with method paper keeps its nominal value: unit
    6-vector [translation; rotation] in that transform's child frame.
    """

    what: str
    direction: tuple[float, ...]
    of: str


@dataclass(frozen=True)
class Rejected:
    """A capture that was not used, and why."""

    id: str
    reason: str


@dataclass(frozen=True)
class TruthError:
    """Against a known truth: of T_P_A the angle (rad) and the distance (m); of T_H_E the angle between the optical
    axes (rad) and the position's error across the true axis (m), and, of a method that finds all of it, the angle and
    the distance.
    """

    base_rotation: float
    base_translation: float
    camera_axis: float
    camera_sideways: float
    camera_rotation: float | None = None
    camera_translation: float | None = None


@dataclass(frozen=True, eq=False)
class Result:
    """One analysis.

    T_P_A, T_H_E (4, 4); optical_axis: z_H_E (3,); iterations: JSON records with at least ``rotation_update``;
    mismatch_before and mismatch_after: with the nominal and the found transforms, None without verification;
    captures_used: ids of the captures estimated from; accuracy, verification: of the refined method alone.
    """

    method: str
    T_P_A: Array
    T_H_E: Array
    optical_axis: Array
    unobservable: tuple[Unobservable, ...]
    iterations: tuple[Mapping[str, Any], ...]
    mismatch_before: Mismatch | None
    mismatch_after: Mismatch | None
    captures_used: tuple[str, ...]
    captures_rejected: tuple[Rejected, ...]
    verdict: Verdict
    reasons: tuple[str, ...]
    truth_error: TruthError | None = None
    accuracy: Accuracy | None = None
    verification: Verification | None = None

    def to_document(self) -> dict[str, Any]:
        """The public document."""
        document = {
            "format": FORMAT,
            "method": self.method,
            "transforms": {T_P_A_NAME: transform_document(self.T_P_A), T_H_E_NAME: transform_document(self.T_H_E)},
            "optical_axis_in_active_flange": self.optical_axis.tolist(),
            "unobservable": [{"what": u.what, "direction": list(u.direction), "of": u.of} for u in self.unobservable],
            "iterations": [dict(iteration) for iteration in self.iterations],
            "mismatch_mm": _mismatches(self.mismatch_before, self.mismatch_after),
            "truth_error": None if self.truth_error is None else _truth_error(self.truth_error),
            "captures_used": list(self.captures_used),
            "captures_rejected": [asdict(rejected) for rejected in self.captures_rejected],
            "verdict": self.verdict,
            "reasons": list(self.reasons),
        }
        for key, part in (("accuracy", self.accuracy), ("verification", self.verification)):
            if part is not None:
                document[key] = part.model_dump(mode="json")
        return document


def write_result(path: Path, result: Result) -> None:
    """Write the public file atomically."""
    write_document(path, result.to_document())


def read_result(path: Path) -> Result:
    """Read the public file; FormatError if it is not one, of another version or incomplete."""
    document = read_document(path, FORMAT)
    try:
        return _from_document(document)
    except KeyError as error:
        raise FormatError([Problem(str(path), f"key {error} is missing")]) from error
    except (ArithmeticError, AttributeError, TypeError, ValueError) as error:
        raise FormatError([Problem(str(path), f"is not a result: {error}")]) from error


def read_truth(path: Path, names: tuple[str, str] = (T_P_A_NAME, T_H_E_NAME)) -> dict[str, Array]:
    """True transforms by name, (4, 4) in m, from a JSON object that has both; FormatError otherwise."""
    document, truth = read_object(path), {}
    unknown = sorted(set(document) - set(names))
    problems = [Problem(str(path), f"{name}: unknown transform") for name in unknown]
    for name in names:
        if name not in document:
            problems.append(Problem(str(path), f"{name}: missing"))
            continue
        try:
            T = np.array(document[name], dtype=float)
        except (TypeError, ValueError):
            T = np.empty(0)
        if T.shape != (4, 4) or not is_rotation(T[:3, :3]) or not np.isfinite(T).all() or T[3].tolist() != [0, 0, 0, 1]:
            problems.append(Problem(str(path), f"{name}: is no rigid transform (4 rows of 4 numbers, m)"))
        truth[name] = T
    if problems:
        raise FormatError(problems)
    return truth


def with_truth_error(result: Result, truth: Mapping[str, Array]) -> Result:
    """The same result with its error against true transforms (4, 4), m, by their names in the file."""
    T_P_A, T_H_E = truth[T_P_A_NAME], truth[T_H_E_NAME]
    axis = T_H_E[:3, 2]
    shift = result.T_H_E[:3, 3] - T_H_E[:3, 3]
    sine = np.linalg.norm(np.cross(result.optical_axis, axis))
    nominal = result.accuracy is None  # the paper's method leaves a part of it as it was given
    error = TruthError(
        base_rotation=float(rotation_angle(result.T_P_A[:3, :3], T_P_A[:3, :3])),
        base_translation=float(np.linalg.norm(result.T_P_A[:3, 3] - T_P_A[:3, 3])),
        camera_axis=float(np.arctan2(sine, result.optical_axis @ axis)),
        camera_sideways=float(np.linalg.norm(shift - (shift @ axis) * axis)),
        camera_rotation=None if nominal else float(rotation_angle(result.T_H_E[:3, :3], T_H_E[:3, :3])),
        camera_translation=None if nominal else float(np.linalg.norm(shift)),
    )
    return replace(result, truth_error=error)


def transform_document(T: Array) -> dict[str, Any]:
    """A transform (4, 4), m, as public files have it."""
    return {
        "matrix": T.tolist(),
        "translation_mm": (1e3 * T[:3, 3]).tolist(),
        "quaternion_xyzw": quaternion_from_rotation(T[:3, :3]).tolist(),
        "rotation_vector_deg": np.degrees(vector_from_rotation(T[:3, :3])).tolist(),
    }


def _mismatches(before: Mismatch | None, after: Mismatch | None) -> dict[str, Any] | None:
    if before is None or after is None:
        return None
    return {"before": _in_mm(before), "after": _in_mm(after)}


def _in_mm(mismatch: Mismatch) -> dict[str, Any]:
    return {
        "mean": 1e3 * mismatch.mean,
        "rms": 1e3 * mismatch.rms,
        "p95": 1e3 * mismatch.p95,
        "max": 1e3 * mismatch.max,
        "values": [1e3 * value for value in mismatch.values],
    }


def _truth_error(error: TruthError) -> dict[str, Any]:
    return {
        T_P_A_NAME: {
            "rotation_deg": float(np.degrees(error.base_rotation)),
            "translation_mm": 1e3 * error.base_translation,
        },
        T_H_E_NAME: {
            "axis_deg": float(np.degrees(error.camera_axis)),
            "sideways_mm": 1e3 * error.camera_sideways,
            **({} if error.camera_rotation is None else {"rotation_deg": float(np.degrees(error.camera_rotation))}),
            **({} if error.camera_translation is None else {"translation_mm": 1e3 * error.camera_translation}),
        },
    }


def _from_document(document: Mapping[str, Any]) -> Result:
    transforms, mismatch, truth = document["transforms"], document["mismatch_mm"], document["truth_error"]
    return Result(
        method=_text(document["method"]),
        T_P_A=_matrix(transforms[T_P_A_NAME]["matrix"]),
        T_H_E=_matrix(transforms[T_H_E_NAME]["matrix"]),
        optical_axis=_array(document["optical_axis_in_active_flange"], (3,)),
        unobservable=tuple(
            Unobservable(_text(u["what"]), tuple(map(float, u["direction"])), _text(u["of"]))
            for u in document["unobservable"]
        ),
        iterations=tuple(map(_record, document["iterations"])),
        mismatch_before=None if mismatch is None else _in_m(mismatch["before"]),
        mismatch_after=None if mismatch is None else _in_m(mismatch["after"]),
        captures_used=tuple(map(_text, document["captures_used"])),
        captures_rejected=tuple(Rejected(_text(r["id"]), _text(r["reason"])) for r in document["captures_rejected"]),
        verdict=_verdict(document["verdict"]),
        reasons=tuple(map(_text, document["reasons"])),
        truth_error=None if truth is None else _truth_error_from(truth),
        accuracy=Accuracy.model_validate(document["accuracy"]) if "accuracy" in document else None,
        verification=Verification.model_validate(document["verification"]) if "verification" in document else None,
    )


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{str(value)[:60]} where text is needed")
    return value


def _verdict(value: Any) -> Verdict:
    if value not in get_args(Verdict):
        raise ValueError(f"there is no verdict {str(value)[:60]}")
    return cast(Verdict, value)


def _record(value: Any) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise ValueError(f"{str(value)[:60]} where an object is needed")
    return value


def _matrix(rows: Any) -> Array:
    return _array(rows, (4, 4))


def _array(values: Any, shape: tuple[int, ...]) -> Array:
    array = np.array(values, dtype=float)
    if array.shape != shape:
        needed = " x ".join(map(str, shape))
        raise ValueError(f"an array of shape {array.shape} where {needed} is needed")
    return array


def _in_m(mismatch: Mapping[str, Any]) -> Mismatch:
    mean, rms, p95, largest = (float(mismatch[key]) / 1e3 for key in ("mean", "rms", "p95", "max"))
    return Mismatch(mean, rms, p95, largest, tuple(float(value) / 1e3 for value in mismatch["values"]))


def _truth_error_from(truth: Mapping[str, Any]) -> TruthError:
    base, camera = truth[T_P_A_NAME], truth[T_H_E_NAME]
    return TruthError(
        base_rotation=float(np.radians(base["rotation_deg"])),
        base_translation=float(base["translation_mm"]) / 1e3,
        camera_axis=float(np.radians(camera["axis_deg"])),
        camera_sideways=float(camera["sideways_mm"]) / 1e3,
        camera_rotation=float(np.radians(camera["rotation_deg"])) if "rotation_deg" in camera else None,
        camera_translation=float(camera["translation_mm"]) / 1e3 if "translation_mm" in camera else None,
    )
