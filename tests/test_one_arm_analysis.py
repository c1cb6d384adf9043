"""What is made of captures of one arm, of whatever kind they are: drawn ones, without images or devices."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.session.captures import BoardPose, CaptureRecord, Captures
from dualcal_hal.session.one_arm_result import OneArmResult
from dualcal_hal.transforms import Array, inverse
from procedures.analysis import Choices
from procedures.analysis.board_poses import with_corners
from procedures.estimation.refined.verification import LEAST_PROBABILITY
from procedures.one_arm.analysis import analyse_one_arm
from procedures.one_arm.rehearsal import rehearse_views
from procedures.one_arm.sorting import joints_of
from procedures.planning.plan import Plan
from procedures.report import draw_one_arm, one_arm_tables
from tests.one_arm_cells import BOTH, CELLS, EYE_IN_HAND, SMALL
from tools.benchmarks.one_arm import draw_captures
from tools.cli.truth import told_truth

Change = Callable[[CaptureRecord], CaptureRecord]


@pytest.fixture(scope="module", params=BOTH, ids=lambda path: path.stem)
def planned(request) -> tuple[CellFile, Plan]:
    file = load_cell(request.param, [*SMALL, "procedure.views=8"])
    return file, rehearse_views(file.cell).plan


@pytest.fixture
def file(planned) -> CellFile:
    return planned[0]


@pytest.fixture
def captures(planned) -> Captures:
    return draw_captures(*planned, seed=1)


def changed(captures: Captures, changes: dict[str, Change]) -> Captures:
    return replace(
        captures,
        captures=tuple(changes.get(c.id.removesuffix("/0"), lambda same: same)(c) for c in captures.captures),
    )


def analysed(file: CellFile, captures: Captures, *overrides: str, choices: Choices | None = None) -> OneArmResult:
    cell = file.cell if not overrides else load_cell(CELLS / f"{file.cell.name}.yaml", [*SMALL, *overrides]).cell
    return analyse_one_arm(captures, cell, choices)


def sigmas(result: OneArmResult) -> Array:
    return np.sqrt(np.diag(np.array(result.covariance.matrix)))


def rejected(result: OneArmResult) -> dict[str, str]:
    return {one.id: one.reason for one in result.captures_rejected}


def turned(capture: CaptureRecord) -> CaptureRecord:
    """Read from the other end, of which the file only says that it may be so."""
    return replace(capture, corners=capture.corners[::-1], order_known=False)


def without_corners(capture: CaptureRecord) -> CaptureRecord:
    return replace(capture, corners=None)


class TestOrder:
    def test_corners_that_may_be_listed_from_the_other_end_are_turned_where_they_are(self, file, captures):
        plain = analysed(file, captures)
        again = changed(captures, dict.fromkeys(("calibration/02", "calibration/05", "verification/01"), turned))
        result = analysed(file, again)
        assert result.verdict == "ok"
        for name, found in result.transforms.items():
            np.testing.assert_allclose(found.T, plain.transforms[name].T, atol=1e-8)
        assert [view.id for view in result.views if view.turned] == ["calibration/02/0", "calibration/05/0"]
        assert result.verification.chi_square == pytest.approx(plain.verification.chi_square, rel=1e-4)

    def test_residuals_stay_those_of_the_corners_as_they_are_listed(self, file, captures):
        plain = analysed(file, captures)
        result = analysed(file, changed(captures, {"calibration/02": turned, "verification/01": turned}))
        for views, others in ((result.views, plain.views), (result.verification.views, plain.verification.views)):
            for view, other in zip(views, others, strict=True):
                is_turned = view.id in ("calibration/02/0", "verification/01/0")
                expected = other.residuals_px[::-1] if is_turned else other.residuals_px
                np.testing.assert_allclose(view.residuals_px, expected, atol=1e-5)


class TestBoardPoses:
    """Of a program that says where it saw the target, and no corners."""

    def posed(self, file: CellFile, captures: Captures, sigma: float | None) -> Captures:
        config, truth = file.one_arm, told_truth(file)
        camera, target = (truth[name] for name in config.names)

        def pose_of(capture: CaptureRecord) -> CaptureRecord:
            flange = config.arm.chain.forward(joints_of(capture))
            seen = inverse(flange @ camera) @ target if config.camera_on_arm else inverse(camera) @ flange @ target
            covariance = None if sigma is None else tuple(map(tuple, (sigma**2 * np.eye(6)).tolist()))
            pose = BoardPose(tuple(map(tuple, seen.tolist())), covariance)
            return replace(capture, corners=None, feature=(np.nan, np.nan), board_pose=pose)

        return with_corners(replace(captures, captures=tuple(map(pose_of, captures.captures))), file.cell)

    def test_their_covariances_are_those_that_are_reckoned_with(self, file, captures):
        fine, coarse = (analysed(file, self.posed(file, captures, sigma)) for sigma in (2e-3, 8e-3))
        assert len(fine.captures_used) == 8
        # The arm's own noise is far below both.
        np.testing.assert_allclose(sigmas(coarse) / sigmas(fine), 4, rtol=0.05)

    def test_without_one_their_corners_count_as_seen(self, file, captures):
        result = analysed(file, self.posed(file, captures, None))
        np.testing.assert_allclose(sigmas(result), sigmas(analysed(file, captures)), rtol=0.2)


class TestSorting:
    def test_a_capture_without_corners_is_named_with_the_reason(self, file, captures):
        result = analysed(
            file, changed(captures, {"calibration/03": without_corners, "verification/00": without_corners})
        )
        assert list(rejected(result)) == ["calibration/03/0", "verification/00/0"]
        assert all(reason.startswith("has no corners") for reason in rejected(result).values())
        assert "2 captures rejected, the first calibration/03/0" in result.reasons[-1]
        assert result.verdict == "ok"
        assert len(result.captures_used) == 7
        assert len(result.verification.views) == 2

    def test_where_none_has_corners_the_reason_is_told(self, file, captures):
        bare = replace(captures, captures=tuple(map(without_corners, captures.captures)))
        with pytest.raises(
            DegenerateCaptures, match=r"no calibration captures that can be used; calibration/.*no corners"
        ):
            analysed(file, bare)

    def test_corners_that_were_not_seen_at_the_end_are_no_sign_that_something_moved(self, file, captures):
        ids = [capture.id.removesuffix("/0") for capture in captures.captures if capture.use == "calibration"]
        unseen = dict.fromkeys(ids[-2:], lambda capture: replace(capture, corners=(None,) * len(capture.corners)))
        result = analysed(file, changed(captures, unseen))
        assert result.verdict == "ok"
        assert [*rejected(result).values()] == ["no corner was seen"] * 2

    def test_a_view_from_where_one_was_calibrated_with_proves_nothing(self, file, captures):
        """Read there again, after whole turns of the last joint: what it shows the estimate has seen."""
        there = next(capture for capture in captures.captures if capture.id == "calibration/04/0")
        turns = np.append(np.zeros(5), 2 * np.pi)

        def moved_there(capture: CaptureRecord) -> CaptureRecord:
            joints = tuple((np.array(joints_of(there)) + turns + 1e-5).tolist())
            arm = "active_joints" if capture.active_joints else "passive_joints"
            return replace(capture, corners=there.corners, feature=there.feature, **{arm: joints})

        result = analysed(file, changed(captures, {"verification/01": moved_there}))
        assert rejected(result) == {
            "verification/01/0": "verification from where calibration/04/0 was taken, which was calibrated with"
        }
        assert len(result.verification.views) == 2

    @pytest.mark.parametrize("planned", [EYE_IN_HAND], indirect=True)
    def test_a_view_of_an_arrival_that_was_calibrated_with_proves_nothing(self, file, captures):
        arrival = captures.captures[2].active_arrival
        shared = {"verification/02": lambda capture: replace(capture, active_arrival=arrival)}
        assert list(rejected(analysed(file, changed(captures, shared)))) == ["verification/02/0"]

    @pytest.mark.parametrize("planned", [EYE_IN_HAND], indirect=True)
    def test_views_of_one_stop_share_the_error_of_the_arm(self, file, planned):
        """Each view twice, with corners so exact that the arm decides: of two stops they halve its square."""
        fine = load_cell(EYE_IN_HAND, [*SMALL, "camera.sigma_px=0.001"])
        captures = draw_captures(fine, planned[1], seed=1)

        def twice(apart: int) -> OneArmResult:
            again = [
                replace(c, id=f"{c.id}'", active_arrival=c.active_arrival + apart)
                for c in captures.captures
                if c.use == "calibration"
            ]
            return analysed(fine, replace(captures, captures=(*captures.captures, *again)))

        once = sigmas(analysed(fine, captures))
        assert np.all(sigmas(twice(apart=0)) > 0.8 * once)
        assert np.all(sigmas(twice(apart=100)) < 0.72 * once)
        # Left out is what shares its error, too: else each would be predicted by its twin.
        rms = [result.left_out.rms_px for result in (analysed(fine, captures), twice(apart=0))]
        assert rms[1] == pytest.approx(rms[0], rel=0.05)


@pytest.mark.parametrize("planned", [EYE_IN_HAND], indirect=True)
class TestBehindTheCamera:
    @pytest.fixture
    def result(self, file, captures) -> OneArmResult:
        """With a verification view whose arm is read so that camera and target look away from each other."""

        def looks_away(capture: CaptureRecord) -> CaptureRecord:
            arm = "active_joints" if capture.active_joints else "passive_joints"
            joints = np.array(joints_of(capture))
            joints[4] += np.pi
            return replace(capture, **{arm: tuple(joints.tolist())})

        return analysed(file, changed(captures, {"verification/01": looks_away}))

    def test_it_fails_in_words(self, result):
        assert result.verdict == "fail"
        assert "not where they are predicted" in result.reasons[0]
        assert "the target should be behind the camera" in result.reasons[0]
        assert result.verification.found is None
        assert result.verification.probability == 0

    def test_its_document_is_json_and_it_is_shown(self, file, captures, result, tmp_path):
        document = json.loads(json.dumps(result.to_document(), allow_nan=False))
        assert OneArmResult.model_validate(document) == result
        Console(width=80, quiet=True).print(one_arm_tables(file.one_arm, result))
        draw_one_arm(tmp_path / "summary.png", file.one_arm, captures.captures, result, None)
        assert (tmp_path / "summary.png").stat().st_size > 10_000


class TestVerdict:
    def test_without_verification_it_is_unverified_however_the_views_fit(self, file, planned):
        noisy = load_cell(CELLS / f"{file.cell.name}.yaml", [*SMALL, "simulation.noise.joint_mrad=0.2"])
        captures = draw_captures(noisy, planned[1], seed=1)
        calibration = tuple(c for c in captures.captures if c.use == "calibration")
        result = analysed(file, replace(captures, captures=calibration))
        assert result.fit.scale > 1
        assert result.verdict == "unverified"
        assert any("do not fit the stated noise" in reason for reason in result.reasons)

    def test_with_verification_views_that_do_not_fit_the_noise_fail(self, file, planned):
        """Also where those to verify do: they are held against a covariance that the misfit has widened."""
        noisy = load_cell(CELLS / f"{file.cell.name}.yaml", [*SMALL, "simulation.noise.joint_mrad=0.2"])
        quiet, loud = (draw_captures(of, planned[1], seed=2).captures for of in (file, noisy))
        captures = tuple(b if b.use == "calibration" else a for a, b in zip(quiet, loud, strict=True))
        result = analysed(file, Captures(None, None, captures))
        assert result.verification.probability > result.verification.least_probability
        assert result.fit.probability < 5e-4
        assert result.verdict == "fail"
        assert result.reasons[0].startswith("the views do not fit the stated noise")

    def test_a_verification_view_that_alone_is_off_is_named(self, file, captures):
        def shifted(capture: CaptureRecord) -> CaptureRecord:
            return replace(capture, corners=tuple((u + 8.0, v) for u, v in capture.corners))

        result = analysed(file, changed(captures, {"verification/01": shifted}))
        assert result.verdict == "fail"
        assert "not where they are predicted" in result.reasons[0]
        assert result.reasons[1].startswith("it is verification/01/0 alone that is off")
        assert "stood still" in result.reasons[1]
        both = analysed(file, changed(captures, dict.fromkeys(("verification/01", "verification/02"), shifted)))
        assert both.verdict == "fail"
        assert not any("alone" in reason for reason in both.reasons)

    def test_where_it_is_but_listed_from_the_other_end_it_says_so(self, file, captures):
        def listed(capture: CaptureRecord) -> CaptureRecord:
            return replace(capture, corners=capture.corners[::-1])

        result = analysed(file, changed(captures, {"verification/02": listed}))
        assert result.verdict == "fail"
        assert result.reasons[1].startswith("it is verification/02/0 alone that is off")
        assert result.reasons[1].endswith("so is this one with its corners listed from the other end")

    def test_all_tests_together_have_the_level(self, file, captures):
        """Verification and misfit each have half of it."""
        result = analysed(file, captures)
        assert result.verification.least_probability == pytest.approx(LEAST_PROBABILITY / 2)


class TestKnowns:
    SIGMA = "camera.intrinsics_sigma={focal_px: 0.5, centre_px: 0.5, distortion: [0, 0, 0, 0, 0]}"

    def test_what_is_propagated_stays_as_it_is_and_is_reckoned_with(self, file, captures):
        exact = analysed(file, captures)
        result = analysed(file, captures, self.SIGMA, "procedure.knowns=propagate")
        assert {known.name for known in result.knowns} == {"fx", "fy", "cx", "cy"}
        assert all(known.value == 0 and known.sigma == 0.5 for known in result.knowns)
        for name, found in result.transforms.items():
            np.testing.assert_allclose(found.T, exact.transforms[name].T, atol=1e-6)
        assert np.all(sigmas(result)[:3] > 1.5 * sigmas(exact)[:3])
        assert result.left_out.rms_px == pytest.approx(exact.left_out.rms_px, rel=1e-3)

    def test_what_is_estimated_is_not(self, file, captures):
        result = analysed(file, captures, self.SIGMA)
        assert all(known.value != 0 and known.sigma < 0.5 for known in result.knowns)

    def test_what_is_free_is_estimated_all_the_same_and_nothing_else(self, file, captures):
        size = "target.square_sigma_mm=0.01"
        result = analysed(file, captures, size, "procedure.knowns=propagate", choices=Choices(free=("intrinsics",)))
        found = {known.name: known.value != 0 for known in result.knowns}
        assert {name for name in found if not found[name]} == {"square size"}
        assert len(found) == 10


def test_what_no_view_can_show_is_told_with_its_size(file, captures):
    hidden = {one.what: one.error_mm for one in analysed(file, captures).cannot_be_seen}
    assert set(hidden) == {
        "the zero of joint 1 of the arm, against its base",
        "the d of row 1 of the arm, against its base",
        "the zero of joint 6 of the arm, against its flange",
        "the alpha of row 6 of the arm, against its flange",
        "the d of row 6 of the arm, against its flange",
        "the a of row 6 of the arm, against its flange",
        "the scale of the arm's lengths and the target's squares together",
    }
    # The target is some 0.6 m from the first axis, and 0.1 deg are told of.
    assert 0.5 < hidden["the zero of joint 1 of the arm, against its base"] < 1.5
