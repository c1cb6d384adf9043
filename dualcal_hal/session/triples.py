"""Pose triples A, B, C of AXB = YCZ from other programs: the public format ``dualcal.triples/1``, or CSV.

A is flange 1 in base 1, B the target in the camera, C flange 2 in base 2, each taking coordinates in the one frame to
coordinates in the other. Metres and radians.

JSON: ``{"format": "dualcal.triples/1", "triples": [{"id": "1", "A": POSE, "B": POSE, "C": POSE}]}`` where a POSE is
``{"matrix": 4 x 4}``, ``{"translation_m": [x, y, z], "quaternion_xyzw": [...]}`` or ``{"translation_m": [...],
"rotation_vector_rad": [...]}``, each with a ``"covariance"`` (6 x 6, translation then rotation in the child frame) if
it is known. Keys that are not known are ignored.

CSV, with commas or semicolons: a line of names first, in any order. For A, and likewise for B and C, either
``A_00,A_01,A_02,A_03,A_10,...,A_23`` (the upper three rows of the matrix), or ``A_x_m,A_y_m,A_z_m`` with
``A_qx,A_qy,A_qz,A_qw`` or with ``A_rx_rad,A_ry_rad,A_rz_rad`` (a rotation vector). ``A_sigma_m,A_sigma_rad`` (per axis)
and ``id`` may be added. Columns that do not begin with ``A_``, ``B_`` or ``C_`` are ignored.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.files import read_document
from dualcal_hal.session.plain import finite, finites
from dualcal_hal.transforms import (
    Array,
    is_rotation,
    nearest_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    transform,
)

FORMAT = "dualcal.triples/1"

LARGEST_FILE = 50_000_000
"""Bytes; a triple takes some hundred."""

MOST_TRIPLES = 20_000

FARTHEST = 100.0
"""m; what is farther is in other units."""

_MOST_PROBLEMS = 50
_ROUNDED = 1e-3  # what the entries of a rotation, or a quaternion's length, may be off by: some write few digits
_POSES = ("A", "B", "C")
_MATRIX = tuple(f"{row}{column}" for row in range(3) for column in range(4))
_TRANSLATION = ("x_m", "y_m", "z_m")
_QUATERNION = ("qx", "qy", "qz", "qw")
_VECTOR = ("rx_rad", "ry_rad", "rz_rad")
_SIGMAS = ("sigma_m", "sigma_rad")
_FORMS = (_MATRIX, _TRANSLATION + _QUATERNION, _TRANSLATION + _VECTOR)


@dataclass(frozen=True, eq=False)
class PoseTriples:
    """A, B, C (n, 4, 4), m; names (n) as the file has them, else the line or the place in the list.

    covariances: of A, B, C by name (n, 6, 6), [translation; rotation] in the child frame, m and rad; None where the
    file has none for that pose.
    """

    A: Array
    B: Array
    C: Array
    names: tuple[str, ...]
    covariances: Mapping[str, Array | None]


@dataclass(frozen=True, eq=False)
class Pose:
    """T (4, 4), m; covariance (6, 6) where it is known."""

    T: Array
    covariance: Array | None


@dataclass(frozen=True, eq=False)
class _Triple:
    name: str
    where: str
    poses: Mapping[str, Pose]


def read_triples(path: Path) -> PoseTriples:
    """The triples of a ``.csv`` file or, of any other name, JSON; FormatError with all problems, each at its line."""
    _require_size(path)
    triples, problems = _from_csv(path) if path.suffix.lower() == ".csv" else _from_json(path)
    problems += _duplicates(triples)
    covariances: dict[str, Array | None] = {}
    for name in _POSES:
        given = [triple.poses[name].covariance for triple in triples]
        known = [each for each in given if each is not None]
        covariances[name] = np.stack(known) if known else None
        if known and len(known) < len(given):
            lacking = next(triple.where for triple in triples if triple.poses[name].covariance is None)
            problems.append(Problem(lacking, f"{name} has no covariance where others have one"))
    if not triples and not problems:
        problems.append(Problem(str(path), "has no triples"))
    if problems:
        left = len(problems) - _MOST_PROBLEMS
        more = [Problem(str(path), f"{left} more problems of this kind")] if left > 0 else []
        raise FormatError([*problems[:_MOST_PROBLEMS], *more])
    A, B, C = (np.stack([triple.poses[name].T for triple in triples]) for name in _POSES)
    return PoseTriples(A, B, C, tuple(triple.name for triple in triples), covariances)


def _require_size(path: Path) -> None:
    try:
        if (size := path.stat().st_size) > LARGEST_FILE:
            raise FormatError([Problem(str(path), f"has {size} bytes, at most {LARGEST_FILE} are read")])
    except OSError as error:
        raise FormatError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error


def _require_count(path: Path, count: int) -> None:
    if count > MOST_TRIPLES:
        raise FormatError([Problem(str(path), f"has {count} triples, at most {MOST_TRIPLES} are read")])


def _duplicates(triples: Sequence[_Triple]) -> Iterator[Problem]:
    first: dict[str, str] = {}
    for triple in triples:
        if triple.name in first:
            yield Problem(triple.where, f"id {triple.name!r} is that of {first[triple.name]}, too")
        first.setdefault(triple.name, triple.where)


def _from_json(path: Path) -> tuple[list[_Triple], list[Problem]]:
    raw = read_document(path, FORMAT).get("triples")
    if not isinstance(raw, list):
        raise FormatError([Problem(str(path), "triples: must be a list")])
    _require_count(path, len(raw))
    lines = lines_of_entries(path.read_bytes(), "triples")
    triples: list[_Triple] = []
    problems: list[Problem] = []
    for index, record in enumerate(raw):
        where = f"{path}:{lines[index]}"
        try:
            name = _name(record, f"triples[{index}]")
        except ValueError as error:
            problems.append(Problem(where, str(error)))
            continue
        poses, wrong = _poses(record)
        problems += [Problem(where, f"{name}: {what}") for what in wrong]
        if not wrong:
            triples.append(_Triple(name, where, poses))
    return triples, problems


def _name(record: Any, otherwise: str) -> str:
    if not isinstance(record, dict):
        raise ValueError(f"{otherwise} is not a JSON object")
    name = record.get("id", otherwise)
    if isinstance(name, bool) or not isinstance(name, str | int) or name == "":
        raise ValueError(f"{otherwise}: id must be a text")
    return str(name)


def _poses(record: Mapping[str, Any]) -> tuple[dict[str, Pose], list[str]]:
    poses, wrong = {}, []
    for key in _POSES:
        try:
            if not isinstance(record.get(key), dict):
                raise ValueError("is missing" if key not in record else "is not a JSON object")
            poses[key] = pose_of(record[key])
        except ValueError as error:
            wrong.append(f"{key}: {error}")
    return poses, wrong


def pose_of(entry: Mapping[str, Any]) -> Pose:
    """A POSE as the file has it; ValueError for what is none."""
    rotations = [key for key in ("matrix", "quaternion_xyzw", "rotation_vector_rad") if key in entry]
    if len(rotations) != 1:
        raise ValueError("needs one of matrix, quaternion_xyzw and rotation_vector_rad")
    if rotations == ["matrix"]:
        if "translation_m" in entry:
            raise ValueError("has a translation_m besides its matrix")
        T = _from_matrix(_table(entry["matrix"], "matrix", 4))
    elif "translation_m" not in entry:
        raise ValueError("translation_m is missing")
    else:
        translation = finites(entry["translation_m"], "translation_m", 3)
        count = 4 if rotations == ["quaternion_xyzw"] else 3
        T = _from_parts(translation, finites(entry[rotations[0]], rotations[0], count))
    if entry.get("covariance") is None:
        return Pose(T, None)
    return Pose(T, _covariance(_table(entry["covariance"], "covariance", 6)))


def _table(value: Any, name: str, size: int) -> Array:
    if not isinstance(value, list) or len(value) != size:
        raise ValueError(f"{name} is no list of {size} rows")
    return np.array([finites(row, f"{name}[{i}]", size) for i, row in enumerate(value)])


def _from_matrix(T: Array) -> Array:
    """A matrix (3 or 4, 4) as (4, 4), what its rounding spoils repaired."""
    R = T[:3, :3]
    if len(T) == 4 and np.any(T[3] != [0.0, 0.0, 0.0, 1.0]):
        raise ValueError("the last row of the matrix must be 0, 0, 0, 1")
    if not is_rotation(R, _ROUNDED):
        raise ValueError("the matrix has no rotation: its columns must be orthonormal and right-handed")
    return transform(nearest_rotation(R), _near(T[:3, 3]))


def _from_parts(translation: Sequence[float], rotation: Sequence[float]) -> Array:
    """From a quaternion (x, y, z, w) or a rotation vector in rad."""
    values = np.asarray(rotation, dtype=float)
    if len(values) == 3:
        if np.linalg.norm(values) > 4 * np.pi:
            raise ValueError(f"a rotation vector of length {np.linalg.norm(values):.3g}: angles are in radians")
        return transform(rotation_from_vector(values), _near(translation))
    length = float(np.linalg.norm(values))
    if abs(length - 1) > 10 * _ROUNDED:
        raise ValueError(f"the quaternion has length {length:.4g}, not 1")
    return transform(rotation_from_quaternion(values), _near(translation))


def _near(translation: Sequence[float] | Array) -> Array:
    p = np.asarray(translation, dtype=float)
    if np.abs(p).max() > FARTHEST:
        raise ValueError(f"a translation of {np.abs(p).max():g} m: lengths are in metres")
    return p


def _covariance(covariance: Array) -> Array:
    scale = np.sqrt(np.abs(np.diag(covariance)))
    symmetric = np.allclose(covariance, covariance.T, rtol=0.0, atol=1e-9 * scale.max() ** 2)
    if np.any(np.diag(covariance) < 0) or not symmetric:
        raise ValueError("the covariance is not symmetric with variances from 0 up")
    correlations = covariance / np.outer(np.where(scale > 0, scale, 1.0), np.where(scale > 0, scale, 1.0))
    if np.linalg.eigvalsh(correlations)[0] < -1e-9:
        raise ValueError("the covariance has a direction with a negative variance")
    return np.asarray((covariance + covariance.T) / 2)


def lines_of_entries(data: bytes, name: str) -> list[int]:
    """The line, from 1, on which each entry of the list ``name`` begins, in a text that is known to be an object."""
    text = data.decode(json.detect_encoding(data))
    decoder = json.JSONDecoder()
    at = _next(text, 0) + 1
    while text[at := _next(text, at)] != "}":
        key, at = decoder.raw_decode(text, at)
        at = _next(text, at)
        if key == name:
            return list(_lines_of_items(text, at, decoder))
        at = decoder.raw_decode(text, at)[1]
    return []


def _lines_of_items(text: str, at: int, decoder: json.JSONDecoder) -> Iterator[int]:
    line, counted = 1, 0
    at = _next(text, at + 1)
    while text[at] != "]":
        line, counted = line + text.count("\n", counted, at), at
        yield line
        at = _next(text, decoder.raw_decode(text, at)[1])


def _next(text: str, at: int) -> int:
    """Past whitespace, commas and colons."""
    while text[at] in " \t\r\n,:":
        at += 1
    return at


def _from_csv(path: Path) -> tuple[list[_Triple], list[Problem]]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FormatError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error
    except UnicodeDecodeError as error:
        raise FormatError([Problem(str(path), "is no text in UTF-8")]) from error
    first = text.split("\n", 1)[0]
    reader = csv.reader(io.StringIO(text), delimiter=";" if ";" in first and "," not in first else ",")
    columns: _Columns | None = None
    triples: list[_Triple] = []
    problems: list[Problem] = []
    try:
        for row in reader:
            where = f"{path}:{reader.line_num}"
            if not any(value.strip() for value in row):
                continue
            if columns is None:
                columns = _Columns.named([name.strip() for name in row], where)
                continue
            _require_count(path, len(triples) + 1)
            triple, wrong = columns.triple(row, where, f"line {reader.line_num}")
            problems += [Problem(where, what) for what in wrong]
            if triple is not None:
                triples.append(triple)
    except csv.Error as error:
        raise FormatError([Problem(f"{path}:{reader.line_num}", f"is no CSV: {error}")]) from error
    return triples, problems


@dataclass(frozen=True)
class _Columns:
    """names: of all columns; forms: of A, B, C each, which of :data:`_FORMS` it has."""

    names: tuple[str, ...]
    forms: Mapping[str, tuple[str, ...]]

    @classmethod
    def named(cls, names: Sequence[str], where: str) -> _Columns:
        problems = [f"column {name!r} is there twice" for name in dict.fromkeys(names) if names.count(name) > 1]
        forms = {}
        for key in _POSES:
            own = {name.removeprefix(f"{key}_") for name in names if name.startswith(f"{key}_")}
            given = own - set(_SIGMAS)
            form = next((form for form in _FORMS if given == set(form)), None)
            if form is None:
                known = "; ".join(",".join(f"{key}_{name}" for name in form) for form in _FORMS)
                found = ",".join(sorted(f"{key}_{name}" for name in given)) or "none"
                problems.append(f"the columns of {key} must be one of: {known}; not {found}")
            elif own & set(_SIGMAS) not in (set(), set(_SIGMAS)):
                problems.append(f"{key}_sigma_m and {key}_sigma_rad go together")
            else:
                forms[key] = form
        if problems:
            raise FormatError([Problem(where, problem) for problem in problems])
        return cls(tuple(names), forms)

    def triple(self, row: Sequence[str], where: str, otherwise: str) -> tuple[_Triple | None, list[str]]:
        if len(row) != len(self.names):
            return None, [f"{len(row)} values where there are {len(self.names)} columns"]
        values = dict(zip(self.names, row, strict=True))
        poses, wrong = {}, []
        for key, form in self.forms.items():
            try:
                poses[key] = _pose_in_row(values, key, form)
            except ValueError as error:
                wrong.append(f"{key}: {error}")
        if wrong:
            return None, wrong
        return _Triple(values.get("id", "").strip() or otherwise, where, poses), []


def _pose_in_row(values: Mapping[str, str], key: str, form: Sequence[str]) -> Pose:
    numbers = [_number(values[f"{key}_{name}"], f"{key}_{name}") for name in form]
    T = _from_matrix(np.reshape(numbers, (3, 4))) if form == _MATRIX else _from_parts(numbers[:3], numbers[3:])
    if f"{key}_{_SIGMAS[0]}" not in values:
        return Pose(T, None)
    sigmas = [_number(values[f"{key}_{name}"], f"{key}_{name}") for name in _SIGMAS]
    if min(sigmas) < 0:
        raise ValueError("a sigma is negative")
    return Pose(T, np.diag(np.repeat(np.square(sigmas), 3)))


def _number(text: str, name: str) -> float:
    try:
        return finite(float(text), name)
    except ValueError:
        raise ValueError(f"{name} is no finite number: {text.strip()[:40]!r}") from None
