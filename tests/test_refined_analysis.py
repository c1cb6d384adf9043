"""From captures to a refined result: what it says of its accuracy, and the verdict."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from dualcal_hal.cellfile import load_cell
from dualcal_hal.config import CellConfig
from dualcal_hal.errors import DegenerateCaptures, FormatError, UsageError
from dualcal_hal.session.accuracy import Accuracy
from dualcal_hal.session.captures import BoardPose, CaptureRecord, Captures, read_captures, write_captures
from dualcal_hal.session.comparison import compare_results
from dualcal_hal.session.result import Result, read_result, with_truth_error, write_result
from dualcal_hal.transforms import Array, inverse
from procedures.analysis import Choices, analyse
from procedures.analysis.board_poses import with_corners
from procedures.analysis.knowns import arrays, given_knowns, stated_noise
from procedures.estimation.refined import refined
from procedures.estimation.refined.motion import logarithm, moved
from procedures.estimation.refined.verification import LEAST_PROBABILITY, verify
from tests.reference_cell import REFERENCE, T_H_E, T_P_A

CELL = Path(__file__).parent.parent / "cells" / "paper.yaml"
TRUTH = {"active_base_in_passive_base": T_P_A, "camera_in_active_flange": T_H_E}
MOUNT = "robots.right.target_mount.translation_mm"


@cache
def cell(*overrides: str) -> CellConfig:
    return load_cell(CELL, list(overrides)).cell


@cache
def exact() -> Captures:
    return read_captures(REFERENCE)


def noisy(seed: int, size: float = 1.0) -> Captures:
    """The reference captures with the noise that the cell file states, or ``size`` times as much of it."""
    rng = np.random.default_rng(seed)
    noise = stated_noise(cell())
    active: dict[int, Array] = {}

    def read(capture: CaptureRecord) -> CaptureRecord:
        error = active.setdefault(capture.active_arrival, rng.normal(0, size * noise.active, 6))
        assert capture.corners is not None
        corners = np.array(capture.corners) + rng.normal(0, size * noise.pixel, (len(capture.corners), 2))
        return replace(
            capture,
            active_joints=tuple((capture.active_joints + error).tolist()),
            passive_joints=tuple((capture.passive_joints + rng.normal(0, size * noise.passive, 6)).tolist()),
            corners=tuple(map(tuple, corners.tolist())),
            feature=tuple(corners[len(corners) // 2].tolist()),
        )

    return replace(exact(), captures=tuple(map(read, exact().captures)))


def changed(captures: Captures, start: str, change: Callable[[CaptureRecord], CaptureRecord]) -> Captures:
    return replace(captures, captures=tuple(change(c) if c.id.startswith(start) else c for c in captures.captures))


def accuracy(result: Result) -> Accuracy:
    assert result.accuracy is not None
    return result.accuracy


@pytest.fixture(scope="module")
def result() -> Result:
    return analyse(noisy(1), cell(), "refined")


class TestVerdict:
    def test_captures_as_they_should_be_are_ok(self, result: Result) -> None:
        assert result.verdict == "ok"
        assert "within the 1 mm required" in result.reasons[0]
        assert accuracy(result).error_3d.p95_mm < 1.0
        assert result.captures_rejected == ()

    def test_a_model_that_fits_but_is_not_exact_enough_is_coarse(self) -> None:
        found = analyse(noisy(1), cell("procedure.verification.required_accuracy_mm=0.01"), "refined")
        assert found.verdict == "coarse"
        assert "above the 0.01 mm required" in found.reasons[0]

    def test_a_region_far_away_is_less_exact(self, result: Result) -> None:
        far = cell("procedure.verification.region={low_mm: [3000, 0, 0], high_mm: [4000, 0, 3000]}")
        found = accuracy(analyse(noisy(1), far, "refined")).error_3d
        assert found.region.low_mm == (3000.0, 0.0, 0.0)
        assert found.p95_mm > 2 * accuracy(result).error_3d.p95_mm

    def test_a_target_that_sits_elsewhere_fails_and_its_mount_is_named_first(self) -> None:
        found = analyse(noisy(1), cell(f"{MOUNT}=[0.5, -0.5, 2.8]"), "refined")
        assert found.verdict == "fail"
        assert found.verification is not None
        assert found.verification.probability < LEAST_PROBABILITY
        assert found.verification.look_at[0].startswith("the target's mount on its flange: 0.5 mm and 0.0")
        assert any("look next at the target's mount" in reason for reason in found.reasons)

    def test_a_joint_zero_that_is_wrong_fails_and_is_named_first(self) -> None:
        def misread(capture: CaptureRecord) -> CaptureRecord:
            joints = np.array(capture.passive_joints)
            joints[2] += 2e-3
            return replace(capture, passive_joints=tuple(joints.tolist()))

        turned = changed(noisy(1), "", misread)
        found = analyse(turned, cell(), "refined")
        assert found.verdict == "fail"
        assert found.verification is not None
        assert "zero of joint 3 of the passive arm off by 0.11 deg" in found.verification.look_at[0]

    def test_what_nothing_explains_is_looseness_and_then_what_is_most_often_wrong(self) -> None:
        found = analyse(noisy(1, size=8.0), cell(), "refined")
        assert found.verdict == "fail"
        assert found.verification is not None
        words = ("the corners", "looseness", "the target's mount", "the zeros", "the calibration of the arms")
        assert all(map(str.startswith, found.verification.look_at, words))
        assert "nothing else alone explains" in found.verification.look_at[1]

    def test_both_parts_are_told_and_can_be_checked_with_a_table_of_chi_squares(self, tmp_path: Path) -> None:
        for found in (analyse(noisy(2), cell(), "refined"), analyse(noisy(1), cell(f"{MOUNT}=[0.3, 0, 2]"), "refined")):
            write_result(tmp_path / "result.json", found)
            seen = json.loads((tmp_path / "result.json").read_text())["verification"]
            chances = []
            for part, freedom, words in (("poses", 84, "boards"), ("corners", 168, "corners on their boards")):
                numbers = seen[part]
                assert numbers["degrees_of_freedom"] == freedom
                chances.append(stats.chi2.sf(numbers["chi_square"], freedom))
                assert numbers["probability"] == pytest.approx(chances[-1])
                told = f"{words} chi-square {numbers['chi_square']:.1f} of {freedom}, probability "
                assert any(told in reason for reason in found.reasons)
            assert seen["probability"] == pytest.approx(min(1.0, 2 * min(chances)))

    def test_what_one_cell_explains_together_with_the_calibration_is_coarse_and_no_failure(self) -> None:
        """Captures that scatter a little less than stated, and others that scatter a little more."""
        rough = {c.id: c for c in noisy(4, size=1.35).captures}
        found = analyse(changed(noisy(4, size=0.6), "verification", lambda c: rough[c.id]), cell(), "refined")
        assert found.verification is not None
        assert found.verification.probability < LEAST_PROBABILITY
        assert found.verdict == "coarse"
        assert "farther from where they are predicted than chance explains" in found.reasons[0]
        assert "all captures together fit one cell, so calibrate with more" in found.reasons[1]

    def test_files_of_before_both_parts_were_told_apart_are_read(self, result: Result, tmp_path: Path) -> None:
        write_result(tmp_path / "result.json", result)
        document = json.loads((tmp_path / "result.json").read_text())
        seen = document["verification"]
        del seen["poses"], seen["corners"], seen["arrivals"]
        seen |= {"chi_square": 250.0, "degrees_of_freedom": 252.0, "probability": 0.5}
        (tmp_path / "result.json").write_text(json.dumps(document))
        again = read_result(tmp_path / "result.json").verification
        assert again is not None
        assert (again.poses, again.corners, again.probability) == (None, None, 0.5)

    @pytest.mark.parametrize(
        ("kept", "words"),
        [
            (
                ("00/",),
                "7 verification captures at 1 arrival of the active arm prove little: verify at several arrivals",
            ),
            (
                ("00/0",),
                "1 verification capture at 1 arrival of the active arm proves little: verify at several arrivals",
            ),
            (
                ("00/0", "01/0"),
                "2 verification captures at 2 arrivals of the active arm prove little: verify at several arrivals",
            ),
        ],
    )
    def test_few_verification_captures_are_said_to_prove_little(
        self, kept: tuple[str, ...], words: str, result: Result
    ) -> None:
        assert not any("little" in reason for reason in result.reasons)
        names = tuple(f"verification/{name}" for name in kept)
        few = tuple(c for c in noisy(1).captures if c.use == "calibration" or c.id.startswith(names))
        assert words in analyse(replace(noisy(1), captures=few), cell(), "refined").reasons

    def test_calibration_captures_that_do_not_fit_are_told_of_where_the_others_do(self, result: Result) -> None:
        assert not any("calibration captures themselves" in reason for reason in result.reasons)
        rough = {c.id: c for c in noisy(3, size=1.6).captures if c.use == "calibration"}
        mixed = changed(noisy(3), "calibration", lambda c: rough[c.id])
        found = analyse(mixed, cell(), "refined")
        assert found.verdict == "ok"
        told = "yet the calibration captures themselves do not fit the stated noise (chi-square "
        assert any(told in reason and "something is off that these do not show" in reason for reason in found.reasons)

    def test_without_verification_it_is_unverified_and_says_what_is_predicted(self) -> None:
        captures = noisy(1)
        alone = replace(captures, captures=tuple(c for c in captures.captures if c.use == "calibration"))
        found = analyse(alone, cell(), "refined")
        assert (found.verdict, found.verification, found.mismatch_after) == ("unverified", None, None)
        assert "predicted 3D error of at most" in found.reasons[1]

    def test_verification_on_what_was_calibrated_with_proves_nothing(self) -> None:
        captures = changed(noisy(1), "verification", lambda c: replace(c, active_arrival=3))
        found = analyse(captures, cell(), "refined")
        assert found.verdict == "unverified"
        assert len(found.captures_rejected) == 14

    def test_the_probability_is_even_for_captures_as_they_should_be(self) -> None:
        drawn = []
        for seed in range(100):
            captures = noisy(seed)
            estimate = refined(arrays(_of(captures, "calibration"), cell()), *_given())
            drawn.append(verify(estimate, arrays(_of(captures, "verification"), cell())))
        for squares, freedom in (
            ([one.poses.squares for one in drawn], drawn[0].poses.freedom),
            ([one.corners.squares for one in drawn], drawn[0].corners.freedom),
        ):
            assert stats.kstest(stats.chi2.cdf(squares, freedom), "uniform").pvalue > 0.01
        assert all(one.fits for one in drawn)
        singly = np.array([stats.chi2.cdf(one.captures, one.freedoms) for one in drawn])
        assert 0.47 < singly.mean() < 0.53


def _of(captures: Captures, use: str) -> list[CaptureRecord]:
    return [capture for capture in captures.captures if capture.use == use]


def _given():
    return given_knowns(cell()), stated_noise(cell())


class TestAccuracy:
    def test_the_covariance_is_that_of_the_error_as_it_is_described(self) -> None:
        squares = []
        for seed in range(60):
            found = analyse(noisy(seed), cell(), "refined")
            error = np.concatenate([logarithm(found.T_P_A, T_P_A), logarithm(found.T_H_E, T_H_E)])
            squares.append(error @ np.linalg.solve(np.array(accuracy(found).covariance), error))
        assert stats.kstest(stats.chi2.cdf(squares, 12), "uniform").pvalue > 0.01

    def test_the_file_says_all_of_it_and_is_read_back(self, result: Result, tmp_path: Path) -> None:
        write_result(tmp_path / "result.json", with_truth_error(result, TRUTH))
        again = read_result(tmp_path / "result.json")
        assert again.accuracy == result.accuracy
        assert again.verification == result.verification
        assert compare_results(with_truth_error(result, TRUTH), again).identical
        document = json.loads((tmp_path / "result.json").read_text())
        assert document["accuracy"]["order"][0] == "active_base_in_passive_base: translation x"
        assert "log(estimate^-1 truth)" in document["accuracy"]["error"]
        assert document["truth_error"]["camera_in_active_flange"]["translation_mm"] < 0.1

    def test_the_inputs_add_up_to_the_covariance(self, result: Result) -> None:
        covariance = np.array(accuracy(result).covariance)
        total = np.sqrt(np.diag(covariance).reshape(4, 3).sum(axis=1))
        budget = accuracy(result).budget
        assert [one.input for one in budget] == ["pixels", "active joints", "passive joints"]
        assert np.hypot.reduce([one.base_translation_mm for one in budget]) == pytest.approx(1e3 * total[0])
        assert np.hypot.reduce([one.camera_rotation_deg for one in budget]) == pytest.approx(np.degrees(total[3]))

    def test_each_capture_has_its_residuals_in_sigmas(self, result: Result) -> None:
        captures = accuracy(result).captures
        assert [one.id for one in captures] == [c.id for c in _of(noisy(1), "calibration")]
        residuals = np.array([one.residuals_sigma for one in captures])
        assert 0.7 < np.sqrt(np.mean(residuals**2)) < 1.1

    def test_a_capture_that_does_not_belong_is_dropped_by_name_or_kept_by_choice(self) -> None:
        def shifted(capture: CaptureRecord) -> CaptureRecord:
            assert capture.corners is not None
            return replace(capture, corners=tuple((u + 9.0, v) for u, v in capture.corners))

        captures = changed(noisy(1), "calibration/03/1", shifted)
        found = analyse(captures, cell(), "refined")
        assert [one.id for one in found.captures_rejected] == ["calibration/03/1"]
        assert "sigma" in found.captures_rejected[0].reason
        assert found.verdict == "ok"
        kept = analyse(captures, cell(), "refined", Choices(keep_all=True))
        assert kept.captures_rejected == ()
        assert "calibration/03/1" in kept.captures_used

    def test_noise_can_be_found(self) -> None:
        found = accuracy(analyse(noisy(1), cell("camera.sigma_px=0.1"), "refined", Choices(find_noise=True)))
        assert found.stated_noise.pixel_px == 0.1
        assert found.noise.pixel_px == pytest.approx(0.02, rel=0.15)
        assert found.found_noise is not None
        pixel = found.found_noise[0]
        assert (pixel.name, pixel.identified) == ("pixel_px", True)
        assert pixel.lower < 0.02 < pixel.upper

    def test_what_is_not_seen_says_what_captures_would_help(self) -> None:
        coarse = [
            "camera.sigma_px=8.0",
            "robots.left.joint_sigma_mrad=4.0",
            "robots.right.joint_sigma_mrad=4.0",
        ]
        found = analyse(noisy(1), cell(*coarse), "refined")
        hidden = [one.name for one in accuracy(found).directions if not one.observable]
        assert hidden
        assert {entry.what for entry in found.unobservable} == set(hidden)
        assert accuracy(found).would_help
        assert all(any(name in line for line in accuracy(found).would_help) for name in hidden)

    def test_what_no_capture_can_show_is_listed_with_its_effect(self, result: Result) -> None:
        listed = {one.what: one.error_mm for one in accuracy(result).cannot_be_seen}
        scale = next(error for what, error in listed.items() if "scale" in what)
        assert 0.1 < scale < 2.0
        turned = next(error for what, error in listed.items() if "joint 1 of the passive arm" in what)
        points = np.array(accuracy(result).error_3d.map.points_mm)
        assert turned <= np.radians(0.1) * np.linalg.norm(points[:, :2], axis=1).max() + 1e-9

    def test_the_map_covers_the_points_of_all_captures(self, result: Result) -> None:
        grid = accuracy(result).error_3d.map
        assert len(grid.points_mm) == len(grid.rms_mm) == len(grid.p95_mm)
        assert all(p95 > rms > 0 for rms, p95 in zip(grid.rms_mm, grid.p95_mm, strict=True))


class TestKnowns:
    def test_a_mount_with_a_sigma_is_estimated(self) -> None:
        off = f"{MOUNT}=[0.5, -0.5, 2.8]"
        sigma = "robots.right.target_mount_sigma={translation_mm: 1.0}"
        found = analyse(noisy(1), cell(off, sigma), "refined")
        assert found.verdict == "ok"
        knowns = {one.name: one for one in accuracy(found).knowns}
        along = knowns["target mount, along y"]
        assert (along.unit, along.prior_sigma) == ("m", 1e-3)
        assert abs(along.value + 0.5e-3) < 4 * along.sigma < 0.5e-3
        assert "target mount" in [one.input for one in accuracy(found).budget]

    def test_or_only_reckoned_with(self) -> None:
        sigma = "robots.right.target_mount_sigma={translation_mm: 1.0}"
        given = analyse(noisy(1), cell(), "refined")
        wider = analyse(noisy(1), cell(sigma, "procedure.knowns=propagate"), "refined")
        np.testing.assert_allclose(wider.T_P_A, given.T_P_A, atol=1e-9)
        assert accuracy(wider).error_3d.p95_mm > 3 * accuracy(given).error_3d.p95_mm

    def test_a_mount_can_be_free(self) -> None:
        found = analyse(noisy(1), cell(f"{MOUNT}=[9.5, -6.5, 2.8]"), "refined", Choices(free=("target_mount",)))
        assert found.verdict == "ok"
        assert all(one.prior_sigma is None for one in accuracy(found).knowns)
        assert found.mismatch_after is not None
        assert 1e3 * found.mismatch_after.mean < 0.2  # the mount found, not the one that was given
        total = np.diag(np.array(accuracy(found).covariance)).reshape(4, 3).sum(axis=1)
        told = [one.base_translation_mm for one in accuracy(found).budget]
        assert np.hypot.reduce(told) == pytest.approx(1e3 * np.sqrt(total[0]), rel=0.05)

    def test_zeros_links_squares_and_lens_carry_sigmas_too(self) -> None:
        found = analyse(
            noisy(1),
            cell(
                "robots.right.kinematics.joint_zero_sigma_deg=[0.02, 0.02, 0.02, 0.02, 0.02, 0.02]",
                "robots.left.kinematics.dh_sigma={length_mm: 0.05, angle_deg: 0.01}",
                "target.square_sigma_mm=0.02",
                "camera.intrinsics_sigma={focal_px: 0.5}",
            ),
            "refined",
        )
        names = {one.name for one in accuracy(found).knowns}
        assert {"zero of joint 2 of the passive arm", "alpha of row 6 of the active arm", "square size", "fx"} <= names
        seen = {one.name: one.seen for one in accuracy(found).knowns}
        assert not seen["zero of joint 1 of the passive arm"]
        assert any("cannot be seen" in reason for reason in found.reasons)

    def test_what_cannot_be_free_is_refused(self) -> None:
        with pytest.raises(UsageError, match="only target_mount and intrinsics can be free"):
            Choices(free=("joint_zeros",))

    def test_choices_are_of_the_refined_method(self) -> None:
        with pytest.raises(UsageError, match="are for method refined"):
            analyse(noisy(1), cell(), "paper", Choices(keep_all=True))

    def test_corners_that_are_said_to_be_exact_are_refused(self) -> None:
        with pytest.raises(UsageError, match="sigma_px"):
            analyse(noisy(1), cell("camera.sigma_px=0.0"), "refined")

    def test_captures_that_determine_nothing_are_refused(self) -> None:
        captures = noisy(1)
        few = replace(captures, captures=tuple(c for c in captures.captures if c.constraint.endswith(("00", "01"))))
        with pytest.raises(DegenerateCaptures, match="do not determine the transforms"):
            analyse(few, cell(), "refined")


class TestWhatIsOdd:
    def test_captures_without_corners_are_for_the_other_method(self) -> None:
        captures = changed(noisy(1), "", lambda c: replace(c, corners=None))
        with pytest.raises(DegenerateCaptures, match="lie on one line"):
            analyse(captures, cell(), "refined")
        assert analyse(captures, cell(), "paper").verdict == "ok"

    def test_a_board_that_should_be_behind_the_camera_fails(self, tmp_path: Path) -> None:
        def turned(capture: CaptureRecord) -> CaptureRecord:
            joints = np.array(capture.active_joints)
            joints[4] += 2.6
            return replace(capture, active_joints=tuple(joints.tolist()))

        found = analyse(changed(noisy(1), "verification/00", turned), cell(), "refined")
        assert found.verdict == "fail"
        write_result(tmp_path / "result.json", found)
        again = read_result(tmp_path / "result.json").verification
        assert again is not None
        assert again.probability == 0.0


class TestBoardPoses:
    """Captures of another program that says where it saw the target."""

    COVARIANCE = np.diag([5e-5, 5e-5, 3e-4, 1e-3, 1e-3, 3e-4]) ** 2

    def poses(self, seed: int, *, covariance: bool) -> Captures:
        rng = np.random.default_rng(seed)
        root = np.linalg.cholesky(self.COVARIANCE)

        def seen(capture: CaptureRecord) -> CaptureRecord:
            active, passive = cell().active.chain, cell().passive.chain
            T_P_E = T_P_A @ active.forward(capture.active_joints) @ T_H_E
            T_E_T = inverse(T_P_E) @ passive.forward(capture.passive_joints) @ cell().passive.target_mount_transform
            measured = moved(T_E_T, root @ rng.normal(size=6)) if covariance else T_E_T
            given = tuple(map(tuple, self.COVARIANCE.tolist())) if covariance else None
            pose = BoardPose(tuple(map(tuple, measured.tolist())), given)
            return replace(capture, corners=None, feature=(np.nan, np.nan), board_pose=pose)

        return replace(exact(), captures=tuple(map(seen, exact().captures)))

    def test_exact_poses_give_the_exact_cell(self) -> None:
        found = analyse(with_corners(self.poses(1, covariance=False), cell()), cell(), "refined")
        np.testing.assert_allclose(found.T_P_A, T_P_A, atol=1e-8)
        np.testing.assert_allclose(found.T_H_E, T_H_E, atol=1e-8)

    def test_a_covariance_is_what_they_are_weighed_by(self) -> None:
        squares = []
        for seed in range(40):
            captures = with_corners(self.poses(seed, covariance=True), cell())
            found = analyse(
                captures,
                cell(
                    "robots.left.joint_sigma_mrad=0.0001",
                    "robots.left.encoder_sigma_mrad=0.0",
                    "robots.right.joint_sigma_mrad=0.0001",
                    "robots.right.encoder_sigma_mrad=0.0",
                ),
                "refined",
            )
            assert found.verdict == "ok"
            assert accuracy(found).fit.degrees_of_freedom == 28 * 6 - 12
            error = np.concatenate([logarithm(found.T_P_A, T_P_A), logarithm(found.T_H_E, T_H_E)])
            squares.append(error @ np.linalg.solve(np.array(accuracy(found).covariance), error))
        assert stats.kstest(stats.chi2.cdf(squares, 12), "uniform").pvalue > 0.01

    def test_they_are_read_from_the_file_without_pixels(self, tmp_path: Path) -> None:
        captures = with_corners(self.poses(1, covariance=True), cell())
        write_captures(tmp_path / "captures.json", captures)
        document = json.loads((tmp_path / "captures.json").read_text())
        assert not any({"feature_px", "corners_px"} & entry.keys() for entry in document["captures"])
        again = with_corners(read_captures(tmp_path / "captures.json"), cell())
        assert len(again.captures) == len(captures.captures)
        for one, other in zip(again.captures, captures.captures, strict=True):
            assert one.board_pose is not None
            assert other.board_pose is not None
            np.testing.assert_allclose(one.board_pose.matrix, other.board_pose.matrix, atol=1e-12)
            assert one.board_pose.covariance == other.board_pose.covariance
            np.testing.assert_allclose(np.array(one.corners), np.array(other.corners), atol=1e-9)

    def test_the_paper_takes_them_too_by_their_feature_point(self) -> None:
        found = analyse(with_corners(self.poses(1, covariance=False), cell()), cell(), "paper")
        np.testing.assert_allclose(found.T_P_A, T_P_A, atol=1e-8)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda pose: pose["matrix"].pop(), "target_in_camera: matrix is no list of 4 rows"),
            (lambda pose: pose["matrix"][0].__setitem__(0, 2.0), "target_in_camera: the matrix has no rotation"),
            (
                lambda pose: pose["covariance"][0].__setitem__(0, -1.0),
                "target_in_camera: the covariance is not symmetric with variances from 0 up",
            ),
            (lambda pose: pose.clear(), "target_in_camera: needs one of matrix, "),
        ],
    )
    def test_one_that_is_none_is_told(self, tmp_path: Path, change, words: str) -> None:
        write_captures(tmp_path / "captures.json", with_corners(self.poses(1, covariance=True), cell()))
        document = json.loads((tmp_path / "captures.json").read_text())
        change(document["captures"][2]["target_in_camera"])
        (tmp_path / "captures.json").write_text(json.dumps(document))
        with pytest.raises(FormatError) as told:
            read_captures(tmp_path / "captures.json")
        assert words in str(told.value)
