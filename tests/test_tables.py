"""The tables for the command line."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console, RenderableType
from scipy.spatial.transform import Rotation

from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, Rejected
from dualcal_hal.transforms import rotation_from_vector, transform
from procedures.analysis import analyse
from procedures.planning.ways import Leg
from procedures.report import error_table, mismatch_table, outcome, plan_table, result_tables, way_table
from tests.reference_cell import NOMINAL_T_H_E, NOMINAL_T_P_A, T_H_E, T_P_A
from tests.reference_run import TRUTH, captures, cell, plan, result

FAR = [Leg("left", ((-3.0, -2.0, -2.1, -3.2, -2.1, -6.1),)), Leg("right", ((0.0,) * 6,))]
MINE = cell().model_copy(update={"name": "mine"})


def printed(renderable: RenderableType, width: int = 80, encoding: str = "utf-8") -> str:
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    Console(file=stream, width=width).print(renderable)
    stream.seek(0)
    return stream.read()


def row(text: str, name: str) -> list[str]:
    """What stands in the row of that name, after the name."""
    (line,) = [line for line in text.splitlines() if line.strip().startswith(name)]
    return line.strip().removeprefix(name).split()


# -- errors of the nominal transforms ----------------------------------------------------------------------------------


def test_the_papers_values_stand_beside_what_was_found_and_the_truth() -> None:
    text = printed(error_table(cell(), result(), TRUTH))
    for name, paper, truth in (
        ("w_x", -0.0122, -0.0122),
        ("w_y", 0.0805, 0.0805),
        ("w_z", -0.1579, -0.1579),
        ("dz_x", -0.0978, -0.0973),
        ("dz_y", -0.0076, -0.0076),
        ("dz_z", -0.0001, -0.0048),
        ("dp_P_A_x     mm", 18.2, 18.2),
        ("dp_P_A_y     mm", 113.0, 113.0),
        ("dp_P_A_z     mm", 11.5, 11.5),
        ("dp_H_E_x*    mm", 7.3, 7.3),
        ("dp_H_E_y*    mm", -6.8, -6.8),
        ("dp_H_E_z*    mm", -0.57, -0.57),
    ):
        label, *unit = name.split()
        values = row(text, label)
        assert values[: len(unit)] == unit
        assert [float(values[len(unit)]), float(values[len(unit) + 2])] == [paper, truth], label


def test_found_values_follow_from_the_transforms_found() -> None:
    text = printed(error_table(cell(), result(), TRUTH))
    turn = Rotation.from_matrix(NOMINAL_T_P_A[:3, :3] @ result().T_P_A[:3, :3].T).as_rotvec()
    w = turn * np.sin(np.linalg.norm(turn)) / np.linalg.norm(turn)
    dz = result().optical_axis - NOMINAL_T_H_E[:3, 2]
    dp_P_A = 1e3 * (result().T_P_A - NOMINAL_T_P_A)[:3, 3]
    dp_H_E = 1e3 * (result().T_H_E - NOMINAL_T_H_E)[:3, 3]
    for name, vector, half_digit, mark in (
        ("w", w, 5e-5, ""),
        ("dz", dz, 5e-5, ""),
        ("dp_P_A", dp_P_A, 5e-3, ""),
        ("dp_H_E", dp_H_E, 5e-3, "*"),
    ):
        for letter, expected in zip("xyz", vector, strict=True):
            found = [value for value in row(text, f"{name}_{letter}{mark}") if value != "mm"][1]
            assert float(found) == pytest.approx(expected, abs=1.001 * half_digit)


def test_the_shift_along_the_axis_is_marked_as_nominal_by_construction() -> None:
    text = printed(error_table(cell(), result(), TRUTH))
    unit, _, found, truth, _ = row(text, "dp_H_E along the axis*")
    assert unit == "mm"
    assert abs(float(found)) < 0.01
    shift = 1e3 * (T_H_E - NOMINAL_T_H_E)[:3, 3] @ result().optical_axis
    assert float(truth) == pytest.approx(shift, abs=0.006)
    assert shift < -1
    assert "* Not observable, nominal by construction" in text


def test_the_roll_is_marked_as_nominal_by_construction_and_the_paper_says_nothing_of_it() -> None:
    rolled = {T_P_A_NAME: T_P_A, T_H_E_NAME: T_H_E @ transform(rotation_from_vector([0, 0, np.radians(3)]), [0, 0, 0])}
    text = printed(error_table(cell(), result(), rolled))
    assert row(text, "roll about the axis*") == ["deg", "-", "0.0000", "3.0000", "-3.0000"]
    assert "the camera's depth and roll" in text


def test_a_shift_that_was_observed_is_not_marked() -> None:
    text = printed(error_table(cell(), replace(result(), unobservable=()), TRUTH))
    assert "*" not in text
    assert "along the axis" in text


def test_the_results_errors_against_the_truth_come_below() -> None:
    text = printed(error_table(cell(), result(), TRUTH))
    error = result().truth_error
    assert error is not None
    assert row(text, "T_P_A rotation") == ["deg", f"{np.degrees(error.base_rotation):.4f}"]
    assert row(text, "T_P_A translation") == ["mm", f"{1e3 * error.base_translation:.3f}"]
    assert row(text, "optical axis direction") == ["deg", f"{np.degrees(error.camera_axis):.4f}"]
    assert row(text, "camera across the axis") == ["mm", f"{1e3 * error.camera_sideways:.3f}"]


def test_a_zero_has_no_sign() -> None:
    none = {T_P_A_NAME: result().T_P_A + 1e-9, T_H_E_NAME: result().T_H_E + 1e-9}
    text = printed(error_table(MINE, result(), none))
    assert row(text, "dp_P_A_x")[-1] == "0.00"
    assert row(text, "w_x")[-1] == "0.0000"


def test_without_a_truth_nothing_is_said_of_it() -> None:
    text = printed(error_table(cell(), replace(result(), truth_error=None)))
    assert "truth" not in text
    assert "rotation" not in text


def test_another_cells_table_does_not_speak_of_the_papers_values() -> None:
    text = printed(error_table(MINE, result(), TRUTH))
    assert "paper" not in text
    assert "-0.1579" in text  # the truth's
    assert "-0.0978" not in text


# -- mismatch ----------------------------------------------------------------------------------------------------------


def test_mismatch_statistics_follow_from_the_values_beside_the_papers() -> None:
    before, after = result().mismatch_before, result().mismatch_after
    assert before is not None
    assert after is not None
    text = printed(mismatch_table(cell(), before, after))
    old, new = 1e3 * np.array(before.values), 1e3 * np.array(after.values)
    for name, statistic in (("mean", np.mean), ("rms", _rms), ("p95", _p95), ("max", np.max)):
        values = row(text, name)
        assert float(values[0]) == pytest.approx(statistic(old), abs=6e-4)
        assert float(values[1]) == pytest.approx(statistic(new), abs=6e-4)
        assert float(values[2]) == pytest.approx(100 * (1 - statistic(new) / statistic(old)), abs=0.06)
    assert row(text, "mean")[4:] == ["60.8", "6.2", "89.8", "%"]
    assert row(text, "max")[4:] == ["106.1", "11.3", "89.3", "%"]
    assert row(text, "rms")[4:] == ["-", "-", "-"]


def _rms(values: np.ndarray) -> float:  # type: ignore[type-arg]
    return float(np.sqrt(np.mean(np.square(values))))


def _p95(values: np.ndarray) -> float:  # type: ignore[type-arg]
    return float(np.percentile(values, 95))


def test_another_cells_mismatch_stands_alone() -> None:
    before, after = result().mismatch_before, result().mismatch_after
    assert before is not None
    assert after is not None
    text = printed(mismatch_table(MINE, before, after))
    assert "paper" not in text
    assert "60.8" not in text


# -- outcome -----------------------------------------------------------------------------------------------------------


def test_the_verdict_comes_with_its_reasons_warnings_and_what_was_left_out() -> None:
    given = replace(
        result(),
        verdict="fail",
        reasons=("too far [off]", "weak conditioning 0.03"),
        captures_rejected=(Rejected("calibration/02/1", "not aligned"),),
    )
    assert printed(outcome(given)).splitlines() == [
        "Verdict: fail",
        "  too far [off]",
        "  weak conditioning 0.03",
        "  left out calibration/02/1: not aligned",
    ]


def test_captures_left_out_for_one_reason_share_a_line_and_many_reasons_are_counted() -> None:
    of_one = [Rejected(f"calibration/02/{i}", "the arm stood elsewhere") for i in range(7)]
    others = [Rejected(f"calibration/03/{i}", f"{i + 5} sigma off") for i in range(6)]
    text = printed(outcome(replace(result(), captures_rejected=(*of_one, *others))))
    told = " ".join(text.split())
    assert "left out calibration/02/0, calibration/02/1, calibration/02/2, calibration/02/3 and 3 more: the arm" in told
    assert "left out calibration/03/2: 7 sigma off" in told
    assert "8 sigma off" not in told
    assert "left out 3 more captures; result.json has them all" in told


def test_a_reason_that_is_told_with_its_captures_is_not_told_twice() -> None:
    rejected = Rejected("calibration/02/1", "not aligned")
    given = replace(
        result(),
        reasons=("good", "1 captures rejected, the first calibration/02/1: not aligned"),
        captures_rejected=(rejected,),
    )
    assert printed(outcome(given)).splitlines()[1:] == ["  good", "  left out calibration/02/1: not aligned"]


def test_unverified_results_have_no_mismatch_table() -> None:
    calibration = tuple(capture for capture in captures().captures if capture.use == "calibration")
    unverified = analyse(replace(captures(), captures=calibration), cell(), "paper")
    text = printed(result_tables(cell(), unverified))
    assert "Fig. 8" not in text
    assert "Verdict: unverified" in text
    assert "no verification captures" in text


# -- plan and way ------------------------------------------------------------------------------------------------------


def test_a_plan_shows_what_it_says_of_each_constraint() -> None:
    text = printed(plan_table(plan()))
    assert "Plan, from 5 first looks" in text
    assert row(text, "calibration/06") == ["4", "500-440", "0-17", "70", "12.3", "20", "6.5"]
    assert row(text, "verification/01") == ["7", "500-380", "0-34", "40", "12.3", "20", "6.5"]
    assert len([line for line in text.splitlines() if "calibration/" in line]) == 7


def test_below_a_plan_stand_its_time_and_the_spread_of_its_axes() -> None:
    text = printed(plan_table(plan()))
    assert f"About {9 * 6.5:.0f} s in all" in text
    assert "Spread of the axes 0.123: least eigenvalue of mean(z z^T), at least 0.1." in text
    assert "Spread" not in printed(plan_table(replace(plan(), axis_spread=None)))


def test_a_provisional_plan_is_marked_so() -> None:
    assert "Provisional plan" in printed(plan_table(replace(plan(), provisional=True)))


def test_a_way_shows_its_moves_in_order_with_joints_in_degrees() -> None:
    legs = [Leg("left", ((0.1, -0.2, 0.3, 0, 0.5, np.pi),)), Leg("right", ((-1.0, 0, 0, 0, 0, 0),))]
    text = printed(way_table(legs))
    assert row(text, "1") == ["left", "5.7", "-11.5", "17.2", "0.0", "28.6", "180.0"]
    assert row(text, "2") == ["right", "-57.3", "0.0", "0.0", "0.0", "0.0", "0.0"]


def test_a_move_through_waypoints_shows_each_of_them() -> None:
    text = printed(way_table([Leg("left", ((0.1,) * 6, (0.2,) * 6)), Leg("right", ((0.3,) * 6,))]))
    assert row(text, "1") == ["left", *["5.7"] * 6]
    assert row(text, "left") == ["11.5"] * 6
    assert row(text, "2") == ["right", *["17.2"] * 6]


def test_an_arm_named_in_brackets_keeps_its_name() -> None:
    assert "[bold]" in printed(way_table([Leg("[bold]", ((0.0,) * 6,))]))


# -- where it is shown -------------------------------------------------------------------------------------------------


def test_tables_fit_into_80_columns_without_losing_a_character() -> None:
    for table in (result_tables(cell(), result(), TRUTH), plan_table(plan()), way_table(FAR)):
        wide, narrow = printed(table, width=200), printed(table, width=80)
        assert max(map(len, narrow.splitlines())) <= 80
        assert narrow.split() == wide.split()  # a cell that is cut or wrapped changes the words or their order


def test_tables_can_be_written_where_only_ascii_is_known() -> None:
    text = printed(result_tables(cell(), result(), TRUTH), encoding="ascii")
    assert text.isascii()
    assert "dp_H_E_x" in text
    assert "\x1b" not in text
