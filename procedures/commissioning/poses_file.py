"""Poses of a flange written down at a pendant: a JSON or CSV file."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from dualcal_hal.config.values import Number, Section, TransformConfig
from dualcal_hal.errors import FormatError, Problem
from dualcal_hal.session.files import read_object
from dualcal_hal.transforms import Array
from procedures.commissioning.readout import FORMS, numbers_of, pose_of

_LENGTH_TOLERANCE = 0.01
"""By which a quaternion's length may differ from 1 before it is normalised: pendants show few digits."""


@dataclass(frozen=True, eq=False)
class Posed:
    """flange: (4, 4) in the base, m; joints: (n,) rad as this program read them, None where they are to be read."""

    flange: Array
    joints: Array | None


class _Pose(Section):
    flange_in_base: TransformConfig
    joints_deg: tuple[Number, ...] | None = None


class _Document(Section):
    arm: str | None = None
    poses: tuple[_Pose, ...]


def read_poses(path: Path) -> tuple[str | None, list[Posed]]:
    """The arm's name, where the file says it, and its poses; FormatError.

    JSON: ``{"arm": "left", "poses": [{"flange_in_base": {"translation_mm": ..., "rotation_vector_deg": ...},
    "joints_deg": [...]}]}`` with all forms of a transform in a cell file. CSV: a line of names first, which are those
    that :data:`FORMS` has, as ``x,y,z,W,P,R``, and where joints are given ``j1,j2,...`` in degrees.
    """
    if path.suffix.lower() == ".csv":
        return None, _from_csv(path)
    document = read_object(path)
    try:
        read = _Document.model_validate(_normalised(document))
    except ValidationError as error:
        raise FormatError([Problem(str(path), _in_words(details)) for details in error.errors()]) from error
    return read.arm, [Posed(pose.flange_in_base.T, _radians(pose.joints_deg)) for pose in read.poses]


def _in_words(details: Any) -> str:
    where = ".".join(map(str, details["loc"]))
    return f"{where}: {details['msg'].removeprefix('Value error, ')}"


def _normalised(document: dict[str, Any]) -> dict[str, Any]:
    """The same with quaternions of length 1; what is none is left for the check to find."""
    poses = document.get("poses")
    for pose in poses if isinstance(poses, list) else ():
        flange = pose.get("flange_in_base") if isinstance(pose, dict) else None
        if isinstance(flange, dict) and "quaternion_xyzw" in flange:
            flange["quaternion_xyzw"] = _of_length_1(flange["quaternion_xyzw"])
    return document


def _of_length_1(quaternion: Any) -> Any:
    if not isinstance(quaternion, list) or not all(type(each) in (int, float) for each in quaternion):
        return quaternion
    length = float(np.linalg.norm(quaternion))
    return [each / length for each in quaternion] if abs(length - 1.0) <= _LENGTH_TOLERANCE else quaternion


def _radians(degrees: tuple[float, ...] | None) -> Array | None:
    return None if degrees is None else np.radians(degrees)


def _from_csv(path: Path) -> list[Posed]:
    try:
        rows = [row for row in csv.reader(path.read_text().splitlines()) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FormatError([Problem(str(path), f"cannot be read: {error}")]) from error
    names = [name.strip() for name in rows[0]] if rows else []
    form = next((form for form in FORMS if tuple(names[: len(numbers_of(form))]) == numbers_of(form)), None)
    if form is None:
        known = "; ".join(f"{form}: {','.join(numbers_of(form))}" for form in FORMS)
        raise FormatError([Problem(f"{path}:1", f"must name its columns ({known}), and joints as j1,j2,... behind")])
    count = len(numbers_of(form))
    joints = names[count:]
    if joints != [f"j{i}" for i in range(1, len(joints) + 1)]:
        raise FormatError([Problem(f"{path}:1", f"after {names[count - 1]} come j1,j2,..., not {','.join(joints)}")])
    poses = []
    for line, row in enumerate(rows[1:], start=2):
        try:
            if len(row) != len(names):
                raise ValueError(f"{len(row)} values where there are {len(names)} columns")
            numbers = [float(value) for value in row]
            if not np.all(np.isfinite(numbers)):
                raise ValueError("a number is not finite")
            poses.append(Posed(pose_of(form, numbers[:count]), np.radians(numbers[count:]) if joints else None))
        except ValueError as error:
            raise FormatError([Problem(f"{path}:{line}", str(error))]) from error
    return poses
