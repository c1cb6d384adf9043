"""Whether what is asked is what was asked in the recorded run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from dualcal_hal.robot import JointPath

TOLERANCE = 1e-7
"""By which two numbers may differ, in rad, or in proportion where they are not of a path: what is worked out anew on
another machine differs by less, and no arm moves by so little."""


def difference(expected: Any, got: Any, where: str = "") -> str | None:
    """Where and by how much they differ, in words; None if they are the same within the tolerance."""
    if isinstance(expected, JointPath) and isinstance(got, JointPath):
        return _difference(_parts(expected), _parts(got), where, in_proportion=0.0)
    return _difference(expected, got, where, in_proportion=TOLERANCE)


def _difference(expected: Any, got: Any, where: str, in_proportion: float) -> str | None:
    if isinstance(expected, Mapping) and isinstance(got, Mapping):
        return _of_mappings(expected, got, where, in_proportion)
    if _is_list(expected) and _is_list(got):
        return _of_lists(expected, got, where, in_proportion)
    if _is_number(expected) and _is_number(got):
        return (
            None if _close(expected, got, in_proportion) else f"{where} differs by {abs(got - expected):.3g}".lstrip()
        )
    return None if expected == got else f"{where} differs".lstrip()


def _parts(path: JointPath) -> dict[str, Any]:
    return {"waypoint": path.waypoints, "speed": path.speed, "acceleration": path.acceleration}


def _of_mappings(expected: Mapping[str, Any], got: Mapping[str, Any], where: str, in_proportion: float) -> str | None:
    if expected.keys() != got.keys():
        return f"{where} has other entries".lstrip()
    names = {key: f"{where} {key}".lstrip() for key in expected}
    differences = (_difference(expected[key], got[key], name, in_proportion) for key, name in names.items())
    return next((each for each in differences if each is not None), None)


def _of_lists(expected: Sequence[Any], got: Sequence[Any], where: str, in_proportion: float) -> str | None:
    if len(expected) != len(got):
        return f"{where} has {len(got)} entries instead of {len(expected)}".lstrip()
    pairs = enumerate(zip(expected, got, strict=True), start=1)
    differences = (_difference(a, b, f"{where} {number}".lstrip(), in_proportion) for number, (a, b) in pairs)
    return next((each for each in differences if each is not None), None)


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _close(expected: float, got: float, in_proportion: float) -> bool:
    if math.isnan(expected) or math.isnan(got):
        return math.isnan(expected) and math.isnan(got)
    return math.isclose(expected, got, rel_tol=in_proportion, abs_tol=TOLERANCE)
