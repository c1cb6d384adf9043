"""Cells with one arm, from the cell file to the result."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import load_cell
from dualcal_hal.config import STAND
from dualcal_hal.errors import CellFileError, CommandRefused, LinkLost
from dualcal_hal.guard import GuardedRobot
from dualcal_hal.robot import JointPath
from dualcal_hal.session.captures import read_captures
from dualcal_hal.session.one_arm_result import OneArmResult, read_one_arm_result
from dualcal_hal.transforms import inverse, rotation_angle, vector_from_rotation
from procedures.one_arm.known import Known
from procedures.one_arm.procedure import looks_request, ways_of
from procedures.one_arm.rehearsal import rehearse_views
from procedures.one_arm.views import ViewPlanner
from procedures.planning.choice import LEAST_TURN, turned_about_two_axes
from procedures.report.plan_picture import plan_figure
from tests.command_line import dualcal
from tests.one_arm_cells import BOTH, EYE_IN_HAND, EYE_TO_HAND, KINEMATIC, SMALL

NAMES = {"eye-in-hand": ("camera_in_flange", "target_in_base"), "eye-to-hand": ("camera_in_base", "target_in_flange")}
SLIP = "simulation.errors={target_slip: {translation_mm: 1, at_s: 6}}"


def sets(*overrides: str) -> list[str]:
    return [part for override in overrides for part in ("--set", override)]


def run(cell: Path, folder: Path, *overrides: str):
    return dualcal("run", cell, "--out", folder, *sets(*SMALL, *overrides))


@pytest.fixture(scope="module", params=BOTH, ids=lambda path: path.stem)
def session(request, tmp_path_factory) -> Path:
    """A run that nothing has interrupted."""
    folder = tmp_path_factory.mktemp(request.param.stem) / request.param.stem
    ended = run(request.param, folder)
    assert ended.exit_code == 0, ended.output
    (folder / "output.txt").write_text(ended.output)
    return folder


@pytest.fixture
def result(session) -> OneArmResult:
    return read_one_arm_result(session / "result.json")


def refused(cell: Path, *overrides: str) -> list[str]:
    with pytest.raises(CellFileError) as caught:
        load_cell(cell, overrides)
    return [str(problem) for problem in caught.value.problems]


class TestRun:
    def test_it_is_verified_and_within_three_sigma_of_the_truth(self, session, result):
        assert result.verdict == "ok"
        assert tuple(result.transforms) == NAMES[session.name]
        truth = load_cell(session / "cell.yaml").simulation.truth.transforms
        covariance = np.array(result.covariance.matrix)
        for number, (found, true) in enumerate(
            zip(result.transforms.values(), (truth.camera, truth.target), strict=True)
        ):
            off = inverse(found.T) @ true
            error = np.concatenate([off[:3, 3], vector_from_rotation(off[:3, :3])])
            sigma = np.sqrt(np.diag(covariance))[6 * number : 6 * number + 6]
            assert np.all(np.abs(error) <= 3 * sigma)

    def test_it_names_its_views_and_how_far_each_is_off_where_the_others_put_it(self, result):
        assert result.captures_used == tuple(f"calibration/{i:02d}/0" for i in range(6))
        assert [view.id for view in result.verification.views] == [f"verification/{i:02d}/0" for i in range(3)]
        assert all(0 < view.left_out.rms_px < 0.3 and 0 < view.left_out.rms_mm < 0.2 for view in result.views)
        assert result.verification.nominal.rms_px > 100 * result.verification.found.rms_px

    def test_the_error_against_the_truth_is_added_to_the_result(self, session, result):
        truth = load_cell(session / "cell.yaml").simulation.truth.transforms
        for name, true in zip(result.transforms, (truth.camera, truth.target), strict=True):
            found = result.transforms[name].T
            error = result.truth_error[name]
            assert error.translation_mm == pytest.approx(1e3 * np.linalg.norm(found[:3, 3] - true[:3, 3]))
            assert error.rotation_deg == pytest.approx(np.degrees(rotation_angle(found[:3, :3], true[:3, :3])))

    def test_captures_have_no_joints_of_the_stand(self, session):
        captures = read_captures(session / "captures.json").captures
        of_arm, of_stand = ("active", "passive") if session.name == "eye-in-hand" else ("passive", "active")
        for capture in captures:
            assert len(getattr(capture, f"{of_arm}_joints")) == 6
            assert getattr(capture, f"{of_stand}_joints") == ()

    def test_the_flange_is_turned_by_30_deg_about_two_axes(self, session):
        arm = load_cell(session / "cell.yaml").one_arm.arm
        captures = [c for c in read_captures(session / "captures.json").captures if c.use == "calibration"]
        flanges = arm.chain.forward([c.active_joints or c.passive_joints for c in captures])
        assert turned_about_two_axes(flanges[:, :3, :3]) >= LEAST_TURN

    def test_its_tables_tell_both_transforms_and_its_picture_is_drawn(self, session):
        output = (session / "output.txt").read_text()
        for name in NAMES[session.name]:
            assert name in output
        assert "Verdict: ok" in output
        assert "each view predicted by the others" in " ".join(output.split())
        assert (session / "summary.png").stat().st_size > 10_000

    def test_a_finished_session_is_reported_again(self, session):
        again = dualcal("run", "--resume", session)
        assert again.exit_code == 0
        assert "Verdict: ok" in again.output

    def test_it_is_replayed_to_the_same_result(self, session):
        replayed = dualcal("replay", session)
        assert replayed.exit_code == 0
        assert "The result is the same to the last bit." in replayed.output

    def test_its_log_is_whole(self, session):
        checked = dualcal("log", "check", session)
        assert checked.exit_code == 0, checked.output


class TestEstimate:
    def test_a_session_is_estimated_to_the_same(self, session, result, tmp_path):
        ended = dualcal("estimate", session, "--out", tmp_path / "result.json")
        assert ended.exit_code == 0, ended.output
        assert read_one_arm_result(tmp_path / "result.json") == result

    def test_its_images_show_the_same(self, session):
        ended = dualcal("estimate", session, "--redetect")
        assert ended.exit_code == 0
        assert "the same corners to the last bit" in ended.output

    def test_its_noise_can_be_found(self, session, tmp_path):
        dualcal("estimate", session, "--noise", "estimate", "--out", tmp_path / "result.json")
        found = read_one_arm_result(tmp_path / "result.json")
        assert {sigma.name for sigma in found.found_noise} == {"pixel_px", "joint_mrad"}
        assert 0.003 < found.noise.pixel_px < 0.03

    def test_free_intrinsics_are_found_near_what_they_are(self, session, tmp_path):
        dualcal("estimate", session, "--free", "intrinsics", "--out", tmp_path / "result.json")
        found = read_one_arm_result(tmp_path / "result.json")
        assert {known.name for known in found.knowns} >= {"fx", "fy", "cx", "cy"}
        assert all(abs(known.value) <= 4 * known.sigma for known in found.knowns if known.name in ("fx", "fy"))

    @pytest.mark.parametrize(
        ("option", "said"),
        [
            (["--method", "paper"], "needs two arms"),
            (["--free", "target_mount"], "the target is sought anyway"),
        ],
    )
    def test_what_needs_two_arms_is_refused(self, session, option, said):
        ended = dualcal("estimate", session, *option)
        assert ended.exit_code == 2
        assert said in ended.output

    def test_the_truth_is_asked_for_by_the_names_of_one_arm(self, session, tmp_path):
        truth = {name: np.eye(4).tolist() for name in ("active_base_in_passive_base", "camera_in_active_flange")}
        (tmp_path / "truth.json").write_text(json.dumps(truth))
        ended = dualcal("estimate", session, "--truth", tmp_path / "truth.json")
        assert ended.exit_code == 2
        assert NAMES[session.name][0] in ended.output


class TestResume:
    @pytest.mark.parametrize("steps", [pytest.param(2, marks=pytest.mark.slow), 7])
    def test_a_run_that_was_cut_off_comes_to_the_same_result(self, session, result, tmp_path, steps):
        folder = tmp_path / "cut"
        shutil.copytree(session, folder)
        for name in ("result.json", "summary.png", "captures.json"):
            (folder / name).unlink()
        lines = (session / "journal.jsonl").read_bytes().splitlines(keepends=True)
        (folder / "journal.jsonl").write_bytes(b"".join(lines[: 1 + steps]))
        ended = dualcal("run", "--resume", folder)
        assert ended.exit_code == 0, ended.output
        assert read_one_arm_result(folder / "result.json") == result

    @pytest.mark.slow
    def test_a_lost_link_leaves_a_session_that_goes_on(self, tmp_path, monkeypatch):
        start, moves = GuardedRobot.start, []

        def lossy(self, path):
            moves.append(self.name)
            if len(moves) == 6:
                raise LinkLost(self.name, "move", "gone", "")
            return start(self, path)

        monkeypatch.setattr(GuardedRobot, "start", lossy)
        assert run(EYE_IN_HAND, tmp_path / "session").exit_code == 1
        monkeypatch.undo()
        ended = dualcal("run", "--resume", tmp_path / "session")
        assert ended.exit_code == 0, ended.output
        assert set(moves) == {"arm"}


class TestWhatIsWrong:
    def test_a_target_that_slips_on_the_arm_makes_it_fail(self, tmp_path):
        ended = run(EYE_TO_HAND, tmp_path / "session", SLIP)
        assert ended.exit_code == 1
        assert read_one_arm_result(tmp_path / "session" / "result.json").verdict == "fail"

    @pytest.mark.parametrize(("at", "said"), [(4, "the views up to"), (6, "the views from")])
    def test_views_before_or_after_something_moved_are_named_and_make_it_fail(self, tmp_path, at, said):
        slip = f"simulation.errors={{target_slip: {{translation_mm: 1, at_s: {at}}}}}"
        ended = run(EYE_IN_HAND, tmp_path / "session", slip, "procedure.views=8")
        assert ended.exit_code == 1
        result = read_one_arm_result(tmp_path / "session" / "result.json")
        assert result.verdict == "fail"
        assert result.reasons[0].startswith(said)

    @pytest.mark.slow
    def test_a_target_far_from_its_nominal_place_is_found_and_told_of(self, tmp_path):
        moved = "nominal.target_in_base.translation_mm=[560, 100, 100]"
        ended = run(EYE_IN_HAND, tmp_path / "session", moved)
        assert ended.exit_code == 0
        assert "warning: the looks found target_in_base" in ended.output

    def test_a_target_that_is_not_there_ends_the_looks(self, tmp_path):
        ended = run(EYE_IN_HAND, tmp_path / "session", "nominal.target_in_base.translation_mm=[100, 550, 100]")
        assert ended.exit_code == 2
        assert "found the target, 3 are needed" in " ".join(ended.output.split())
        assert list((tmp_path / "session" / "images").glob("looks-*.png"))

    @pytest.mark.slow
    def test_noise_above_what_is_stated_makes_it_fail(self, tmp_path):
        ended = run(EYE_TO_HAND, tmp_path / "session", "simulation.noise.joint_mrad=0.3")
        assert ended.exit_code == 1
        result = read_one_arm_result(tmp_path / "session" / "result.json")
        assert result.verdict == "fail"
        assert any("look at whether target and camera are tight" in reason for reason in result.reasons)

    def test_more_accuracy_than_is_reached_makes_it_coarse(self, session, tmp_path):
        shutil.copytree(session, tmp_path / "session")
        cell = tmp_path / "session" / "cell.yaml"
        cell.write_text(cell.read_text().replace("required_accuracy_mm: 1.0", "required_accuracy_mm: 0.001"))
        dualcal("estimate", tmp_path / "session", "--out", tmp_path / "result.json")
        result = read_one_arm_result(tmp_path / "result.json")
        assert result.verdict == "coarse"
        assert "above the 0.001 mm required" in result.reasons[0]

    def test_without_verification_it_is_unverified_and_views_are_predicted_by_the_others(self, tmp_path):
        ended = run(EYE_IN_HAND, tmp_path / "session", "procedure.verification.views=0")
        assert ended.exit_code == 1
        result = read_one_arm_result(tmp_path / "session" / "result.json")
        assert result.verdict == "unverified"
        assert result.left_out.rms_mm < 0.2


class TestSafety:
    @pytest.mark.parametrize("cell", BOTH, ids=lambda path: path.stem)
    def test_views_keep_clear_and_show_the_target_whatever_the_error_of_the_nominal(self, cell):
        file = load_cell(cell, SMALL)
        known = Known.nominal(file.one_arm)
        plan = ViewPlanner(known, ways_of(known), [1]).plan([looks_request(3)], known.joints(known.model.home))
        truth = file.simulation.truth.transforms
        true = Known(file.one_arm.known_as(truth.camera, truth.target, (0.0, 0.0), (0.0, 0.0)), "truth")
        for view in plan.constraints:
            q_a, q_p = np.array([view.active]), np.array([view.positions[0].passive])
            seen = true.model.camera_in_passive(q_a, true.belief), true.model.target_in_passive(q_p)
            assert true.model.in_view(inverse(seen[0]) @ seen[1]).all()
            clearance = true.model.geometry.clearance(q_a, q_p, true.belief.placement)[0]
            assert clearance >= view.clearance - 1e-9 >= file.cell.clearance - 1e-9

    def test_more_uncertainty_leaves_less_clearance(self):
        def clearance(millimetres: float) -> float:
            override = f"nominal.uncertainty={{translation_mm: {millimetres}, rotation_deg: 0}}"
            known = Known.nominal(load_cell(EYE_IN_HAND, [override]).one_arm)
            q = np.array([[0.0, 0.75, 1.0, 0.0, 0.6, 0.0]])
            return float(known.model.geometry.between(q, np.zeros((1, 0)), known.belief.placement)[0])

        assert clearance(10) - clearance(60) == pytest.approx(0.05, abs=1e-9)

    def test_the_guard_refuses_a_path_into_what_stands(self):
        file = load_cell(EYE_IN_HAND, [KINEMATIC])
        known = Known.nominal(file.one_arm)
        arm = known.arm
        target = known.config.nominal.target[:3, 3]
        flange = arm.chain.forward(arm.home).copy()
        flange[:3, 3] = target
        flange[:3, :3] = np.diag([1.0, -1.0, -1.0])
        into, reached = arm.chain.inverse(flange, [arm.home], arm.lower, arm.upper)
        assert reached[0]
        with Cell(file) as cell:
            limits = cell.active.limits
            path = JointPath((tuple(into[0].tolist()),), tuple(limits.speed), tuple(limits.acceleration))
            with pytest.raises(CommandRefused):
                cell.active.robot.start(path)

    def test_a_stand_is_not_moved(self):
        with Cell(load_cell(EYE_IN_HAND, [KINEMATIC])) as cell:
            stand = cell.arm(STAND).robot
            assert stand.joints == 0
            with pytest.raises(CommandRefused):
                stand.start(JointPath(((),), (), ()))
            assert stand.stop("in a test").confirmed


class TestDryRun:
    @pytest.mark.parametrize("cell", BOTH, ids=lambda path: path.stem)
    def test_it_shows_looks_and_a_provisional_plan(self, cell, tmp_path):
        ended = dualcal("run", cell, "--dry-run", "--out", tmp_path / "plan", *sets(*SMALL))
        assert ended.exit_code == 0, ended.output
        for view in ("looks/00", "calibration/05", "verification/02"):
            assert view in ended.output
        plan = json.loads((tmp_path / "plan" / "plan.json").read_text())
        assert plan["provisional"]
        assert len(plan["constraints"]) == 9
        picture = cv2.imread(str(tmp_path / "plan" / "plan.png"))
        assert picture.shape == (900, 1600, 3)
        assert picture.std() > 10

    @pytest.mark.parametrize("cell", BOTH, ids=lambda path: path.stem)
    def test_its_picture_has_one_arm_and_what_stands(self, cell):
        file = load_cell(cell, SMALL).cell
        rehearsed = rehearse_views(file)
        figure = plan_figure(file, rehearsed.home, rehearsed.plan)
        side = figure.axes[0]
        carried, stands = ("camera", "target") if cell == EYE_IN_HAND else ("target", "camera")
        labels = [line.get_label() for line in side.get_lines()]
        assert f"'arm' with the {carried}" in labels
        assert f"the {stands}, which stands" in labels
        assert [text.get_text() for text in side.texts].count("floor") == 1
        assert f"'{STAND}'" not in " ".join([*labels, side.get_xlabel(), figure.texts[0].get_text()])
        assert "9 views" in figure.texts[0].get_text()

    def test_no_plan_says_what_was_refused(self):
        ended = dualcal("run", EYE_IN_HAND, "--dry-run", *sets(*SMALL, "procedure.distance_mm=[1700, 1800]"))
        assert ended.exit_code == 2
        assert "the arm does not reach the pose" in ended.output

    def test_the_same_seed_gives_the_same_plan(self):
        cell = load_cell(EYE_TO_HAND, SMALL).cell
        assert rehearse_views(cell).plan == rehearse_views(cell).plan

    def test_without_looks_it_is_planned_from_the_nominal(self):
        rehearsed = rehearse_views(load_cell(EYE_TO_HAND, [*SMALL, "procedure.first_looks=0"]).cell)
        assert rehearsed.looks is None
        assert len(rehearsed.plan.constraints) == 9


class TestCellFile:
    def test_what_stands_takes_the_other_arms_place(self):
        hand, to = (load_cell(cell).cell for cell in BOTH)
        assert (hand.active_name, hand.passive_name) == ("arm", STAND)
        assert (to.active_name, to.passive_name) == (STAND, "arm")
        assert list(hand.arms) == list(to.arms) == ["arm"]

    def test_the_truth_is_not_in_the_cell(self):
        assert not hasattr(load_cell(EYE_IN_HAND).one_arm, "simulation")

    @pytest.mark.parametrize(
        ("change", "line", "said"),
        [
            (("target_in_base:", "target_in_bas:"), "  target_in_bas:", "did you mean 'target_in_base'?"),
            (("  views: 12", "  views: 2"), "  views: 2", "must be at least 3, not 2"),
            (("mount: arm  #", "mount: hand  #"), "  mount: hand", "must be the arm (arm) or fixed, not 'hand'"),
            (("  arm:\n", "  stand:\n"), "    backend: sim", "must have another name: 'stand'"),
            (("  arm:\n    backend: sim", "  arm:\n    backend: sin"), "    backend: sin", "no backend 'sin'"),
            (("  tilt_max_deg: 45", "  tilt_max_deg: 95"), "  tilt_max_deg: 95", "must be less than 90, not 95"),
        ],
    )
    def test_errors_are_cited_by_line(self, tmp_path, change, line, said):
        text = EYE_IN_HAND.read_text()
        assert change[0] in text
        text = text.replace(*change)
        (tmp_path / "cell.yaml").write_text(text)
        number = 1 + next(i for i, each in enumerate(text.splitlines()) if each.startswith(line))
        problems = refused(tmp_path / "cell.yaml")
        assert any(f"cell.yaml:{number}:" in problem and said in problem for problem in problems), problems

    def test_the_transforms_are_those_of_where_the_camera_is(self, tmp_path):
        (tmp_path / "cell.yaml").write_text(EYE_IN_HAND.read_text().replace("mount: arm  #", "mount: fixed  #"))
        problems = refused(tmp_path / "cell.yaml")
        for section in ("nominal", "simulation.truth"):
            told = [problem for problem in problems if f" {section}." in problem]
            assert any("camera_in_base: missing key: the camera stands" in problem for problem in told)
            assert any("target_in_base: must be left out: the camera stands" in problem for problem in told)

    def test_one_arm_with_a_role_is_one_of_two(self):
        assert any(
            "must be two arms, one active and one passive, not 1" in problem
            for problem in refused(EYE_IN_HAND, "robots.arm.role=active")
        )

    def test_intrinsics_need_two_arms(self):
        ended = dualcal("run", EYE_IN_HAND, "--procedure", "intrinsics")
        assert ended.exit_code == 2
        assert "needs two arms" in ended.output

    def test_fixtures_stand_in_the_arms_base(self):
        at = "{translation_mm: [0, 600, 500], rotation_vector_deg: [0, 0, 0]}"
        post = f"fixtures={{post: {{at: {at}, box_mm: [50, 50, 1000]}}}}"
        for cell in BOTH:
            file = load_cell(cell, [post])
            geometry = Known.nominal(file.one_arm).model.geometry
            assert [fixture.name for body in (geometry.active, geometry.passive) for fixture in body.fixtures] == [
                "post"
            ]


class TestDoctor:
    @pytest.mark.parametrize("cell", BOTH, ids=lambda path: path.stem)
    def test_it_looks_at_arm_and_camera(self, cell):
        ended = dualcal("doctor", cell, *sets(KINEMATIC))
        assert ended.exit_code == 0, ended.output
        assert "arm, by simulator" in ended.output
        assert STAND not in ended.output


@pytest.mark.slow
@pytest.mark.parametrize("cell", BOTH, ids=lambda path: path.stem)
def test_the_examples_run_with_weight_and_contact_and_replay_the_same(cell, tmp_path):
    """About a quarter of a minute each."""
    ended = dualcal("run", cell, "--out", tmp_path / "session")
    assert ended.exit_code == 0, ended.output
    assert "least distance between arm and stand" in ended.output
    assert dualcal("replay", tmp_path / "session").exit_code == 0
