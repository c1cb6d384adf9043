"""From captures to the public result file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.config import CellConfig
from dualcal_hal.errors import DegenerateCaptures, FormatError, UsageError
from dualcal_hal.session.captures import Captures, read_captures
from dualcal_hal.session.result import Result, read_result, read_truth, with_truth_error, write_result
from dualcal_hal.transforms import rotation_from_vector, transform
from procedures.analysis import analyse
from tests.reference_cell import EXPECTED, REFERENCE, T_H_E, T_P_A

CELL = Path(__file__).parent.parent / "cells" / "paper.yaml"
TRUTH = {"active_base_in_passive_base": T_P_A, "camera_in_active_flange": T_H_E}


@pytest.fixture(scope="module")
def cell() -> CellConfig:
    return load_cell(CELL).cell


@pytest.fixture(scope="module")
def captures() -> Captures:
    return read_captures(REFERENCE)


@pytest.fixture(scope="module")
def result(captures: Captures, cell: CellConfig) -> Result:
    return analyse(captures, cell, "paper")


def changed(captures: Captures, start: str, **changes: Any) -> Captures:
    """With those captures changed whose id starts with ``start``."""
    return replace(
        captures,
        captures=tuple(replace(c, **changes) if c.id.startswith(start) else c for c in captures.captures),
    )


def only(captures: Captures, *uses: str) -> Captures:
    return replace(captures, captures=tuple(c for c in captures.captures if c.use in uses))


class TestAnalysis:
    def test_the_paper_cell_and_the_reference_captures_give_the_expected_result(self, result: Result) -> None:
        error = with_truth_error(result, TRUTH).truth_error
        assert error is not None
        assert np.degrees(error.base_rotation) < 1e-6
        assert 1e3 * error.base_translation < 1e-6
        assert np.degrees(error.camera_axis) < 1e-6
        assert 1e3 * error.camera_sideways < 1e-6
        assert result.mismatch_before is not None
        assert 1e3 * result.mismatch_before.mean == pytest.approx(EXPECTED["mismatch_before_mm"]["mean"], abs=1e-6)
        assert result.mismatch_after is not None
        assert 1e3 * result.mismatch_after.max < 1e-6
        assert result.verdict == "ok"
        assert len(result.captures_used) == 28
        assert result.captures_rejected == ()

    def test_the_estimate_does_not_look_at_verification_captures(
        self, captures: Captures, cell: CellConfig, result: Result
    ) -> None:
        alone = analyse(only(captures, "calibration"), cell, "paper")
        np.testing.assert_array_equal(alone.T_P_A, result.T_P_A)
        assert alone.verdict == "unverified"
        assert (alone.mismatch_before, alone.mismatch_after) == (None, None)

    def test_verification_on_a_calibrated_constraint_is_rejected(self, captures: Captures, cell: CellConfig) -> None:
        found = analyse(changed(captures, "verification/00", constraint="calibration/00"), cell, "paper")
        assert found.mismatch_after is not None
        assert len(found.mismatch_after.values) == 7
        assert {r.id for r in found.captures_rejected} == {f"verification/00/{i}" for i in range(7)}
        assert "calibrated with" in found.captures_rejected[0].reason

    def test_verification_on_an_arrival_that_was_calibrated_with_is_rejected(
        self, captures: Captures, cell: CellConfig
    ) -> None:
        found = analyse(changed(captures, "verification", active_arrival=3), cell, "paper")
        assert found.verdict == "unverified"
        assert len(found.captures_rejected) == 14
        assert "14 captures rejected" in found.reasons[-1]

    def test_a_capture_far_from_the_optical_axis_is_rejected(self, captures: Captures, cell: CellConfig) -> None:
        found = analyse(changed(captures, "calibration/03/1", feature=(511.5, 385.0)), cell, "paper")
        assert [r.id for r in found.captures_rejected] == ["calibration/03/1"]
        assert "0.00 and 1.50 px off the optical axis" in found.captures_rejected[0].reason
        assert "calibration/03/1" not in found.captures_used
        assert len(found.captures_used) == 27

    def test_a_capture_marked_as_not_aligned_but_near_is_used(self, captures: Captures, cell: CellConfig) -> None:
        found = analyse(changed(captures, "calibration/03/1", aligned=False, feature=(511.9, 383.5)), cell, "paper")
        assert found.captures_rejected == ()

    def test_a_mismatch_above_the_limit_fails(self, captures: Captures, cell: CellConfig) -> None:
        verification = [c for c in captures.captures if c.use == "verification"]
        bent = {
            c.id: replace(c, passive_joints=(c.passive_joints[0] + 0.002, *c.passive_joints[1:])) for c in verification
        }
        moved = replace(captures, captures=tuple(bent.get(c.id, c) for c in captures.captures))
        found = analyse(moved, cell, "paper")
        assert found.verdict == "fail"
        assert "above the limit of 0.5 mm" in found.reasons[0]

    def test_degenerate_captures_are_refused_with_the_reason(self, captures: Captures, cell: CellConfig) -> None:
        few = tuple(c for c in captures.captures if c.constraint in {"calibration/00", "calibration/01"})
        with pytest.raises(DegenerateCaptures, match="2 constraints, at least 3"):
            analyse(replace(captures, captures=few), cell, "paper")

    def test_captures_without_calibration_are_refused(self, captures: Captures, cell: CellConfig) -> None:
        with pytest.raises(DegenerateCaptures, match="0 constraints"):
            analyse(only(captures, "verification"), cell, "paper")

    def test_a_refusal_names_what_was_rejected_before(self, captures: Captures, cell: CellConfig) -> None:
        with pytest.raises(DegenerateCaptures, match="28 captures rejected, the first calibration/00/0"):
            analyse(changed(captures, "calibration", feature=(100.0, 100.0)), cell, "paper")

    def test_an_unknown_method_is_refused_with_those_there_are(self, captures: Captures, cell: CellConfig) -> None:
        with pytest.raises(UsageError, match="unknown method 'magic'; there are: refined, paper"):
            analyse(captures, cell, "magic")


class TestFile:
    def test_it_has_the_keys_of_the_public_format(self, result: Result) -> None:
        document = result.to_document()
        assert list(document) == [
            "format",
            "method",
            "transforms",
            "optical_axis_in_active_flange",
            "unobservable",
            "iterations",
            "mismatch_mm",
            "truth_error",
            "captures_used",
            "captures_rejected",
            "verdict",
            "reasons",
        ]
        assert document["format"] == "dualcal.result/1"
        transforms = document["transforms"]
        assert set(transforms) == {"active_base_in_passive_base", "camera_in_active_flange"}
        for entry in transforms.values():
            assert set(entry) == {"matrix", "translation_mm", "quaternion_xyzw", "rotation_vector_deg"}
        assert transforms["active_base_in_passive_base"]["translation_mm"] == pytest.approx([1218.2, 113.0, 11.5])
        assert set(document["mismatch_mm"]["before"]) == {"mean", "rms", "p95", "max", "values"}
        assert document["mismatch_mm"]["before"]["mean"] == pytest.approx(79.6120113216396)
        assert {entry["of"] for entry in document["unobservable"]} == {"camera_in_active_flange"}
        assert all(len(entry["direction"]) == 6 for entry in document["unobservable"])
        assert all("rotation_update" in entry for entry in document["iterations"])
        assert document["truth_error"] is None

    def test_what_is_written_is_read_back(self, result: Result, tmp_path: Path) -> None:
        path = tmp_path / "result.json"
        told = with_truth_error(result, TRUTH)
        write_result(path, told)
        back = read_result(path)
        assert json.loads(path.read_text()) == told.to_document()
        np.testing.assert_array_equal(back.T_P_A, told.T_P_A)
        np.testing.assert_array_equal(back.T_H_E, told.T_H_E)
        assert back.unobservable == told.unobservable
        assert back.captures_used == told.captures_used
        assert back.mismatch_before is not None
        assert told.mismatch_before is not None
        assert back.mismatch_before.values == pytest.approx(told.mismatch_before.values, rel=1e-15)
        assert back.truth_error is not None

    def test_an_unverified_result_is_read_back(self, captures: Captures, cell: CellConfig, tmp_path: Path) -> None:
        write_result(tmp_path / "result.json", analyse(only(captures, "calibration"), cell, "paper"))
        document = json.loads((tmp_path / "result.json").read_text())
        assert document["mismatch_mm"] is None
        assert read_result(tmp_path / "result.json").verdict == "unverified"

    def test_an_unknown_version_is_refused(self, result: Result, tmp_path: Path) -> None:
        path = tmp_path / "result.json"
        path.write_text(json.dumps(result.to_document() | {"format": "dualcal.result/2"}))
        with pytest.raises(
            FormatError, match=r"'dualcal\.result/2' is not known; this version reads 'dualcal\.result/1'"
        ):
            read_result(path)

    @pytest.mark.parametrize(
        ("key", "value", "what"),
        [
            ("transforms", {}, "active_base_in_passive_base"),
            ("optical_axis_in_active_flange", ["x"], "is not a result"),
        ],
    )
    def test_an_incomplete_file_is_refused(
        self, result: Result, tmp_path: Path, key: str, value: Any, what: str
    ) -> None:
        path = tmp_path / "result.json"
        path.write_text(json.dumps(result.to_document() | {key: value}))
        with pytest.raises(FormatError, match=what):
            read_result(path)


class TestTruthError:
    def test_it_is_added_to_a_copy(self, result: Result) -> None:
        told = with_truth_error(result, TRUTH)
        assert result.truth_error is None
        assert told.to_document() | {"truth_error": None} == result.to_document()

    def test_it_has_angle_and_distance_of_the_base_and_axis_and_sideways_of_the_camera(self, result: Result) -> None:
        turned = transform(rotation_from_vector([0, np.radians(2), 0]), [0.003, 0, 0.1])
        rolled = transform(rotation_from_vector([0, 0, 1.0]), [0, 0, 0])
        off_base = transform(rotation_from_vector([np.radians(0.5), 0, 0]), [0.003, 0.004, 0])
        perfect = replace(result, T_P_A=T_P_A, T_H_E=T_H_E, optical_axis=T_H_E[:3, 2])
        moved_T_H_E = T_H_E @ turned @ rolled
        moved = replace(perfect, T_P_A=T_P_A @ off_base, T_H_E=moved_T_H_E, optical_axis=moved_T_H_E[:3, 2])
        error = with_truth_error(moved, TRUTH).to_document()["truth_error"]
        assert error["active_base_in_passive_base"] == pytest.approx({"rotation_deg": 0.5, "translation_mm": 5.0})
        assert error["camera_in_active_flange"] == pytest.approx({"axis_deg": 2.0, "sideways_mm": 3.0})

    def test_a_truth_file_is_read(self, tmp_path: Path) -> None:
        path = tmp_path / "truth.json"
        path.write_text(json.dumps({name: T.tolist() for name, T in TRUTH.items()}))
        np.testing.assert_array_equal(read_truth(path)["camera_in_active_flange"], T_H_E)

    def test_all_that_is_wrong_with_a_truth_file_is_said(self, tmp_path: Path) -> None:
        path = tmp_path / "truth.json"
        path.write_text(json.dumps({"camera_in_active_flange": (2 * np.eye(4)).tolist()}))
        with pytest.raises(FormatError) as caught:
            read_truth(path)
        assert [problem.what.split(":")[0] for problem in caught.value.problems] == [
            "active_base_in_passive_base",
            "camera_in_active_flange",
        ]
