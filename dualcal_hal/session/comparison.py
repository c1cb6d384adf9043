"""Whether two runs came to the same: what a replay gives against what was recorded."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.one_arm_result import OneArmResult
from dualcal_hal.session.result import Result
from dualcal_hal.transforms import rotation_angle

TOLERANCE_MM, TOLERANCE_RAD = 1e-6, 1e-9
"""Within which the same run on another machine agrees."""

TOLERANCE_PX = 1e-6

TOLERANCE = 1e-9
"""Of numbers without a unit: of their size, or of 1 where they are smaller, such as the parts of a unit vector."""

MOST_LINES = 20
"""Differences that are told; of the others their number."""

_TOLERANCES = {
    "mm": TOLERANCE_MM,
    "m": TOLERANCE_MM / 1e3,
    "rad": TOLERANCE_RAD,
    "deg": math.degrees(TOLERANCE_RAD),
    "px": TOLERANCE_PX,
}
"""By the unit that ends a key's name, which holds for all that is below it."""

_LONGEST_VALUE = 60


@dataclass(frozen=True)
class Comparison:
    """identical: to the last bit; differences: beyond the tolerances, a line for each."""

    identical: bool
    differences: tuple[str, ...]


def compare_captures(recorded: Sequence[CaptureRecord], now: Sequence[CaptureRecord]) -> Comparison:
    """By their ids; the numbers of the arrivals may differ, as an interrupted run counts others."""
    there, here = ({capture.id: _without_arrival(capture) for capture in each} for each in (recorded, now))
    lines = [f"capture {name} is missing" for name in there if name not in here]
    lines += [f"capture {name} was not recorded" for name in here if name not in there]
    for name in sorted(there.keys() & here.keys()):
        lines += [f"capture {name}: {line}" for line in differences(there[name], here[name])]
    return Comparison(_same(there, here), _told(lines))


def compare_results(recorded: Result | OneArmResult, now: Result | OneArmResult) -> Comparison:
    """All that their files say; the transforms as such, whatever form the file gives them in besides."""
    there, here = recorded.to_document(), now.to_document()
    identical = _same(there, here)
    transforms = there.pop("transforms"), here.pop("transforms")
    lines: list[str] = []
    for name in transforms[0]:
        lines += _transform_differences(name, transforms[0][name]["matrix"], transforms[1][name]["matrix"])
    return Comparison(identical, _told([*lines, *differences(there, here)]))


def differences(recorded: Any, now: Any) -> Iterator[str]:
    """A line for each place where two JSON documents differ by more than the tolerance of the unit there.

    NaN and infinities are the same as themselves alone.
    """
    places = [("", recorded, now, "")]
    while places:
        where, there, here, unit = places.pop()
        if isinstance(there, Mapping) and isinstance(here, Mapping):
            names = dict.fromkeys((*there, *here))
            yield from (f"{_at(where, name)} is missing" for name in names if name not in here)
            yield from (f"{_at(where, name)} was not recorded" for name in names if name not in there)
            both = [name for name in names if name in there and name in here]
            places += [(_at(where, name), there[name], here[name], _unit(name) or unit) for name in reversed(both)]
        elif _is_list(there) and _is_list(here):
            if len(there) != len(here):
                yield f"{where}: {len(there)} recorded, now {len(here)}"
                continue
            pairs = list(enumerate(zip(there, here, strict=True)))
            places += [(f"{where}[{index}]", a, b, unit) for index, (a, b) in reversed(pairs)]
        elif (line := _difference(there, here, unit)) is not None:
            yield f"{where}{line}"


def _without_arrival(capture: CaptureRecord) -> dict[str, Any]:
    return {key: value for key, value in capture.to_record().items() if key != "active_arrival"}


def _same(there: Any, here: Any) -> bool:
    # As text: NaN is then the same as NaN, and minus zero another than zero.
    return json.dumps(there, sort_keys=True) == json.dumps(here, sort_keys=True)


def _told(lines: Sequence[str]) -> tuple[str, ...]:
    more = len(lines) - MOST_LINES
    return (*lines[:MOST_LINES], f"and {more} more") if more > 0 else tuple(lines)


def _at(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _unit(name: str) -> str:
    unit = name.rpartition("_")[2]
    return unit if unit in _TOLERANCES and unit != name else ""


def _is_list(value: Any) -> bool:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _difference(there: Any, here: Any, unit: str) -> str | None:
    """What is said of two values behind their place, or None."""
    if _is_number(there) and _is_number(here):
        if _is_close(there, here, unit):
            return None
        off = abs(here - there) if math.isfinite(there) and math.isfinite(here) else math.nan
        by = f" by {off:.3g}{' ' * bool(unit)}{unit}" if math.isfinite(off) else ""
        return f" differs{by}: recorded {there!r}, now {here!r}"
    if type(there) is type(here) and there == here:
        return None
    return f": recorded {_short(there)}, now {_short(here)}"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_close(there: float, here: float, unit: str) -> bool:
    if isinstance(there, int) and isinstance(here, int):
        return there == here
    if math.isnan(there) or math.isnan(here):
        return math.isnan(there) and math.isnan(here)
    if unit:
        return there == here or abs(here - there) <= _TOLERANCES[unit]
    return math.isclose(there, here, rel_tol=TOLERANCE, abs_tol=TOLERANCE)


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def _transform_differences(name: str, recorded: ArrayLike, now: ArrayLike) -> Iterator[str]:
    there, here = np.asarray(recorded, dtype=float), np.asarray(now, dtype=float)
    if not (np.all(np.isfinite(there)) and np.all(np.isfinite(here))):
        if not np.array_equal(there, here, equal_nan=True):
            yield f"{name} is not finite{' as recorded' if not np.all(np.isfinite(there)) else ''}"
        return
    shift = 1e3 * float(np.linalg.norm(there[:3, 3] - here[:3, 3]))
    turn = float(rotation_angle(there[:3, :3], here[:3, :3]))
    if shift > TOLERANCE_MM or turn > TOLERANCE_RAD:
        yield f"{name} differs by {shift:.3g} mm and {turn:.3g} rad"
    elif (off := float(np.max(np.abs(there - here)))) > 2 * TOLERANCE_RAD:
        yield f"{name} differs by {off:.3g} in an entry of its matrix, which is then no rigid transform"
