"""Whether a replay came to what was recorded: everything that a result and a capture say counts."""

from __future__ import annotations

import json
import math
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import pytest

from dualcal_hal.session.captures import read_captures
from dualcal_hal.session.comparison import MOST_LINES, compare_captures, compare_results, differences
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, read_result
from tools.golden import GOLDEN

RESULT = json.loads((GOLDEN / "result.json").read_text())
DEGREE = math.degrees(1e-9)


def compared(tmp_path: Path, *path, value):
    """The golden result against itself with one value changed, both as read from files."""
    document = deepcopy(RESULT)
    holder = document
    for key in path[:-1]:
        holder = holder[key]
    old = holder[path[-1]]
    holder[path[-1]] = value(old) if callable(value) else value
    (tmp_path / "result.json").write_text(json.dumps(document))
    return compare_results(read_result(GOLDEN / "result.json"), read_result(tmp_path / "result.json"))


def test_the_same_is_identical():
    result = read_result(GOLDEN / "result.json")
    assert compare_results(result, result).identical
    assert compare_results(result, result).differences == ()


@pytest.mark.parametrize(
    ("path", "tolerance", "unit"),
    [
        (("mismatch_mm", "before", "mean"), 1e-6, "mm"),
        (("mismatch_mm", "after", "rms"), 1e-6, "mm"),
        (("mismatch_mm", "after", "p95"), 1e-6, "mm"),
        (("mismatch_mm", "after", "max"), 1e-6, "mm"),
        (("mismatch_mm", "after", "values", 2), 1e-6, "mm"),
        (("truth_error", T_P_A_NAME, "rotation_deg"), DEGREE, "deg"),
        (("truth_error", T_P_A_NAME, "translation_mm"), 1e-6, "mm"),
        (("truth_error", T_H_E_NAME, "axis_deg"), DEGREE, "deg"),
        (("truth_error", T_H_E_NAME, "sideways_mm"), 1e-6, "mm"),
        (("optical_axis_in_active_flange", 0), 1e-9, ""),
        (("unobservable", 0, "direction", 4), 1e-9, ""),
        (("iterations", 3, "rotation_update"), 1e-9, ""),
        (("iterations", 3, "rotation_error", 1), 1e-9, ""),
    ],
)
def test_every_number_counts_within_the_tolerance_of_its_unit(tmp_path, path, tolerance, unit):
    within = compared(tmp_path, *path, value=lambda old: old + 0.4 * tolerance)
    assert within.differences == ()
    assert not within.identical
    (line,) = compared(tmp_path, *path, value=lambda old: old + 3 * tolerance).differences
    place = "".join(f"[{key}]" if isinstance(key, int) else f".{key}" for key in path)[1:]
    assert line.startswith(f"{place} differs by {3 * tolerance:.3g}{' ' * bool(unit)}{unit}: recorded ")


@pytest.mark.parametrize(
    ("path", "value", "line"),
    [
        (("verdict",), "fail", "verdict: recorded ok, now fail"),
        (("method",), "refined", "method: recorded paper, now refined"),
        (("unobservable", 0, "what"), "x", "unobservable[0].what: recorded shift along the optical axis, now x"),
        (("unobservable",), [], "unobservable: 2 recorded, now 0"),
        (("reasons", 0), "because", "reasons[0]: recorded "),
        (("captures_used", 1), "other", "captures_used[1]: recorded calibration/00/1, now other"),
        (("captures_rejected",), [{"id": "a", "reason": "b"}], "captures_rejected: 0 recorded, now 1"),
        (("truth_error",), None, 'truth_error: recorded {"active_base'),
        (("iterations", 2, "rotation_update"), None, "iterations[2].rotation_update: recorded 0.0"),
        (("mismatch_mm", "after", "max"), math.nan, "mismatch_mm.after.max differs: recorded 0."),
        (("mismatch_mm", "after", "max"), math.inf, "mismatch_mm.after.max differs: recorded 0."),
        (("transforms", T_P_A_NAME, "matrix", 0, 3), math.nan, f"{T_P_A_NAME} is not finite"),
        (("transforms", T_H_E_NAME, "matrix", 1, 3), 0.1, f"{T_H_E_NAME} differs by 47 mm and 0 rad"),
        (("transforms", T_H_E_NAME, "matrix", 3, 3), 2.0, f"{T_H_E_NAME} differs by 1 in an entry of its matrix"),
    ],
)
def test_everything_else_counts_as_it_is(tmp_path, path, value, line):
    (found,) = compared(tmp_path, *path, value=value).differences
    assert found.startswith(line)


def test_what_is_not_finite_is_the_same_as_itself_alone():
    there = {"a_mm": [math.nan, math.inf, -math.inf]}
    assert list(differences(there, deepcopy(there))) == []
    assert len(list(differences(there, {"a_mm": [math.inf, -math.inf, math.nan]}))) == 3


def test_keys_that_one_of_both_lacks_are_told():
    assert list(differences({"a": 1, "b": {"c": 2}}, {"b": {"d": 2}})) == [
        "a is missing",
        "b.c is missing",
        "b.d was not recorded",
    ]


def test_true_is_no_number_and_a_count_is_exact():
    assert list(differences({"a": 1, "b": 10**12}, {"a": True, "b": 10**12 + 1})) == [
        "a: recorded 1, now true",
        f"b differs by 1: recorded {10**12}, now {10**12 + 1}",
    ]


def test_a_flood_of_differences_is_counted(tmp_path):
    found = compared(tmp_path, "iterations", value=lambda old: [dict.fromkeys(each, "x") for each in old]).differences
    assert len(found) == MOST_LINES + 1
    assert found[-1] == f"and {4 * len(RESULT['iterations']) - MOST_LINES} more"


def test_all_of_a_capture_counts_but_the_number_of_its_arrival():
    captures = read_captures(GOLDEN / "captures.json").captures
    first, *others = captures
    assert compare_captures(captures, [replace(first, active_arrival=99), *others]).identical
    for change, line in (
        ({"active_joints": (first.active_joints[0] + 1e-6, *first.active_joints[1:])}, "active_joints_rad[0] differs"),
        ({"passive_joints": first.passive_joints[1:]}, "passive_joints_rad: 6 recorded, now 5"),
        ({"feature": (first.feature[0], first.feature[1] + 1e-3)}, "feature_px[1] differs by 0.001 px"),
        ({"corners": (None, *first.corners[1:])}, "corners_px[0]: recorded ["),
        ({"corners": None}, "corners_px: recorded ["),
        ({"constraint": "other"}, "constraint: recorded calibration/00, now other"),
        ({"image_size": (1, 2)}, "image_px[0] differs"),
        ({"aligned": False}, "aligned: recorded true, now false"),
        ({"order_known": False}, "order: recorded known, now unknown"),
    ):
        compared = compare_captures(captures, [replace(first, **change), *others])
        assert not compared.identical
        assert compared.differences[0].startswith(f"capture {first.id}: {line}")
    assert compare_captures(captures, others).differences == (f"capture {first.id} is missing",)
    assert compare_captures(others, captures).differences == (f"capture {first.id} was not recorded",)
