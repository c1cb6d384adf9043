"""What the command line shows of a refined result."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dualcal_hal.session.accuracy import Accuracy, AlternativeRecord, KnownRecord
from dualcal_hal.session.result import Result
from dualcal_hal.transforms import vector_from_rotation
from procedures.analysis import Choices, analyse
from procedures.report import error_table, outcome, result_tables
from procedures.report.accuracy_tables import MOST_HIDDEN, MOST_KNOWNS
from tests.reference_run import TRUTH, cell
from tests.refined_run import noisy_captures, refined_result, with_some_off
from tests.test_tables import MINE, printed, row

FAILED = 0.003  # rad, of a wrong joint


def accuracy(result: Result) -> Accuracy:
    assert result.accuracy is not None
    return result.accuracy


def changed(**fields: Any) -> Result:
    """The refined result with other fields of its accuracy."""
    return replace(refined_result(), accuracy=accuracy(refined_result()).model_copy(update=fields))


def tables(result: Result) -> str:
    return printed(result_tables(MINE, result))


# -- transforms --------------------------------------------------------------------------------------------------------


def test_both_transforms_are_shown_in_mm_and_degrees() -> None:
    text, found = tables(refined_result()), refined_result()
    text = text.split("sigma, base")[0]
    for name, T in (("T_P_A", found.T_P_A), ("T_H_E", found.T_H_E)):
        values = [float(value) for value in row(text, name)]
        np.testing.assert_allclose(values[:3], 1e3 * T[:3, 3], atol=6e-4)
        np.testing.assert_allclose(values[3:], np.degrees(vector_from_rotation(T[:3, :3])), atol=6e-5)


def test_below_them_stand_the_sigmas_of_all_twelve_directions() -> None:
    text = tables(refined_result())
    sigmas = np.sqrt(np.diag(accuracy(refined_result()).covariance)) * np.tile([1e3] * 3 + [np.degrees(1)] * 3, 2)
    shown = [float(value) for name in ("sigma, base", "sigma, camera") for value in row(text, name)]
    np.testing.assert_allclose(shown, sigmas, atol=6e-4)


def test_a_direction_that_is_not_observable_is_marked_with_the_limit_and_what_would_help() -> None:
    directions = list(accuracy(refined_result()).directions)
    directions[8] = directions[8].model_copy(update={"sigma_mm": 17.5, "observable": False})
    text = tables(changed(directions=tuple(directions), would_help=("turn the active flange by 30 deg or more",)))
    assert row(text, "sigma, camera")[2] == "17.500*"
    assert text.count("17.500*") == 1
    assert "* Not observable: a sigma above 5 mm or 1 deg; not to be relied on." in text
    assert "would help: turn the active flange by 30 deg or more" in text


def test_what_is_observed_is_not_marked() -> None:
    text = printed(result_tables(cell(), refined_result(), TRUTH))
    assert "*" not in text
    assert "nominal by construction" not in text


def test_another_solution_is_shown_with_its_transforms_and_cost() -> None:
    T = refined_result().T_P_A.copy()
    T[:3, 3] = [0.1, 0.2, 0.3]
    other = AlternativeRecord(
        active_base_in_passive_base=T.tolist(),
        camera_in_active_flange=refined_result().T_H_E.tolist(),
        cost_ratio=1.234,
    )
    text = tables(changed(alternatives=(other,)))
    assert row(text, "T_P_A (2)")[:3] == ["100.000", "200.000", "300.000"]
    assert row(text, "T_H_E (2)") == row(text.split("sigma, base")[0], "T_H_E")
    assert "(2): another solution, which costs 1.23 times as much" in text


# -- accuracy ----------------------------------------------------------------------------------------------------------


def test_the_error_of_a_point_stands_beside_what_is_required() -> None:
    text, space = tables(refined_result()), accuracy(refined_result()).error_3d
    assert "where 1 mm is required" in text
    assert f"in the region at most {space.p95_mm:.3f} mm (1 sigma: {space.rms_mm:.3f} mm)" in text
    assert f"workspace {min(space.map.p95_mm):.3f} to {max(space.map.p95_mm):.3f} mm" in text
    assert f"region: x {space.region.low_mm[0]:.0f} to {space.region.high_mm[0]:.0f}, y" in text


def test_the_budget_has_each_input_the_largest_first() -> None:
    text, parts = tables(refined_result()), accuracy(refined_result()).budget
    ordered = sorted(parts, key=lambda part: part.error_mm, reverse=True)
    assert [text.index(f" {part.input} ") for part in ordered] == sorted(text.index(f" {p.input} ") for p in parts)
    for part in parts:
        assert row(text, f"{part.input}  ")[-1] == f"{part.error_mm:.3f}"


def test_captures_that_fit_and_that_do_not_are_told_in_words() -> None:
    assert "Calibration captures fit the noise (chi-square" in tables(refined_result())
    assert "Calibration captures do not fit the noise (chi-square" in tables(refined_result(FAILED))


def test_noise_that_is_stated_too_large_is_told() -> None:
    fit = accuracy(refined_result()).fit.model_copy(update={"chi_square": 101.0})
    text = tables(changed(fit=fit))
    assert f"fit better than the noise allows (chi-square 101 of {fit.degrees_of_freedom})" in text
    assert "some of it is less than stated; --noise estimate says which." in text


def test_noise_that_was_found_stands_beside_the_stated() -> None:
    result = refined_result(choices=Choices(find_noise=True))
    noise, found = accuracy(result).noise, accuracy(result).found_noise
    assert found is not None
    text = tables(result)
    assert row(text, "stated") == ["0.02", "0.0302", "0.0302"]
    assert row(text, "found") == [f"{sigma.value:.3g}" for sigma in found]
    assert row(text, "95 %")[:3] == [f"{found[0].lower:.3g}", "to", f"{found[0].upper:.3g}"]
    assert row(text, "reckoned with")[0] == f"{noise.pixel_px:.3g}"
    unknown = (found[0], *(sigma.model_copy(update={"identified": False}) for sigma in found[1:]))
    bounded = tables(replace(result, accuracy=accuracy(result).model_copy(update={"found_noise": unknown})))
    assert row(bounded, "found")[1:] == ["-", "-"]
    assert row(bounded, "95 %")[3:6] == ["at", "most", f"{found[1].upper:.3g}"]


def test_stated_noise_that_was_taken_as_it_is_needs_one_line() -> None:
    assert "Noise as stated, 1 sigma: corners 0.02 px, joints 0.0302 and 0.0302 mrad." in tables(refined_result())


def test_corners_that_were_turned_are_named() -> None:
    captures, result = with_some_off()
    text = tables(result)
    assert f"Corners listed from the other end, and turned: {captures.captures[20].id}." in text


# -- knowns ------------------------------------------------------------------------------------------------------------


def known(name: str, value: float, unit: str = "m", *, prior: float | None = 1e-3, seen: bool = True) -> KnownRecord:
    return KnownRecord(name=name, unit=unit, value=value, prior_sigma=prior, sigma=2e-4, seen=seen)


def test_inexact_knowns_are_shown_in_mm_and_degrees_those_farthest_off_first() -> None:
    knowns = (
        known("near", 1e-4),
        known("far", -3e-3),
        known("angle", 2e-3, "rad"),
        known("freed", 2e-2, "px", prior=None),
        known("hidden", 0.0, seen=False),
    )
    text = tables(changed(knowns=knowns))
    assert row(text, "far") == ["mm", "-3", "1", "0.2"]
    assert row(text, "angle") == ["deg", "0.115", "0.0573", "0.0115"]
    assert row(text, "freed") == ["px", "0.02", "free", "0.0002"]
    assert row(text, "hidden")[-2:] == ["not", "seen"]
    assert text.index("far ") < text.index("angle ") < text.index("near ")


def test_a_long_list_of_knowns_is_shortened_with_a_count() -> None:
    knowns = [known(f"known {i}", i * 1e-4, seen=i > 2) for i in range(36)]
    text = tables(changed(knowns=tuple(knowns)))
    assert text.count(" known ") == MOST_KNOWNS
    assert "known 35" in text
    assert f"and {36 - MOST_KNOWNS} more, 3 of them not seen; all are in" in text


def test_what_cannot_be_seen_is_listed_with_its_effect_the_largest_first() -> None:
    hidden = accuracy(refined_result()).cannot_be_seen
    text = tables(refined_result())
    largest = max(hidden, key=lambda one: one.error_mm)
    (first, *_) = text.split("Cannot be seen in any capture, and puts a point off by:\n")[1].splitlines()
    assert first.strip().startswith(f"{largest.error_mm:.2f} mm: {largest.by} of ")
    assert f"and {len(hidden) - MOST_HIDDEN} more" in text
    few = tables(changed(cannot_be_seen=hidden[:1]))
    assert " more" not in few


# -- outcome -----------------------------------------------------------------------------------------------------------


def test_a_result_that_fails_says_what_to_look_at_in_order() -> None:
    result = refined_result(FAILED)
    assert result.verdict == "fail"
    assert result.verification is not None
    told = " ".join(printed(outcome(result)).split())
    assert told.startswith("Verdict: fail the verification captures are not where they are predicted")
    assert "look next at, in this order: 1. " in told
    for number, words in enumerate(result.verification.look_at, start=1):
        assert told.count(words) == 1
        assert f"{number}. {words}" in told


def test_a_result_that_holds_says_its_error_first_and_nothing_to_look_at() -> None:
    told = " ".join(printed(outcome(refined_result())).split())
    assert told.startswith("Verdict: ok predicted 3D error of at most 0.0")
    assert "look next" not in told


def test_dropped_captures_are_named_with_their_reason() -> None:
    _, result = with_some_off()
    told = " ".join(printed(outcome(result)).split())
    assert (
        "left out calibration/02/0, calibration/02/1, calibration/02/2, calibration/02/3: all captures of its"
        " arrival are off" in told
    )
    assert "left out calibration/00/1: " in told


@pytest.mark.parametrize("verdict", ["coarse", "unverified"])
def test_a_result_that_is_neither_good_nor_bad_is_yellow(verdict: Any) -> None:
    text = outcome(replace(refined_result(), verdict=verdict))
    assert [span.style for span in text.spans] == ["bold yellow"]


# -- in all ------------------------------------------------------------------------------------------------------------


def test_errors_of_the_nominal_are_shown_only_where_they_are_compared_with_something() -> None:
    assert "Tables 3 and 4" not in tables(refined_result())
    assert "Tables 3 and 4" in printed(result_tables(MINE, refined_result(), TRUTH))
    assert "Tables 3 and 4" in printed(result_tables(cell(), refined_result()))


def test_the_truth_is_compared_with_the_full_hand_eye() -> None:
    error = refined_result().truth_error
    assert error is not None
    assert error.camera_rotation is not None
    assert error.camera_translation is not None
    text = printed(error_table(cell(), refined_result(), TRUTH))
    assert row(text, "T_H_E rotation") == ["deg", f"{np.degrees(error.camera_rotation):.4f}"]
    assert row(text, "T_H_E translation") == ["mm", f"{1e3 * error.camera_translation:.3f}"]


def test_a_result_of_a_real_cell_is_no_longer_than_a_page() -> None:
    assert len(tables(refined_result(FAILED)).splitlines()) <= 66


def test_the_tables_fit_into_80_columns_without_losing_a_character() -> None:
    names = ("zero of joint 5 of the passive arm", "target mount, about y", "alpha of row 6 of the passive arm", "k1")
    knowns = tuple(known(name, 3e-3, "rad") for name in names)
    full = changed(knowns=knowns, alternatives=_two_others(), **_found_noise())
    for result in (refined_result(), refined_result(FAILED), with_some_off()[1], full):
        table = result_tables(cell(), result, TRUTH)
        wide, narrow = printed(table, width=200), printed(table, width=80)
        assert max(map(len, narrow.splitlines())) <= 80
        assert narrow.split() == wide.split()


def _two_others() -> tuple[AlternativeRecord, ...]:
    T = tuple(map(tuple, refined_result().T_P_A.tolist()))
    return tuple(
        AlternativeRecord(active_base_in_passive_base=T, camera_in_active_flange=T, cost_ratio=1.5) for _ in range(2)
    )


def _found_noise() -> dict[str, Any]:
    with_noise = accuracy(refined_result(choices=Choices(find_noise=True)))
    return {"found_noise": with_noise.found_noise, "noise": with_noise.noise}


def test_unverified_results_have_tables_too() -> None:
    calibration = tuple(capture for capture in noisy_captures().captures if capture.use == "calibration")
    unverified = analyse(replace(noisy_captures(), captures=calibration), cell(), "refined")
    text = tables(unverified)
    assert "Fig. 8" not in text
    assert "Verdict: unverified" in text
    assert "Predicted 3D error of a point (95 %)" in text


def test_the_tables_can_be_written_where_only_ascii_is_known() -> None:
    assert printed(result_tables(cell(), refined_result(FAILED), TRUTH), encoding="ascii").isascii()
