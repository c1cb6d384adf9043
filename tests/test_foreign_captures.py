"""Captures that another program wrote, as ``dualcal estimate`` takes them: a result, or words for what is wrong."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.session.captures import write_captures
from dualcal_hal.transforms import inverse, vector_from_rotation
from procedures.one_arm.rehearsal import rehearse_views
from tests.cells import PAPER
from tests.command_line import dualcal
from tests.one_arm_cells import EYE_IN_HAND, SMALL
from tests.reference_cell import DOCUMENT, EXPECTED, T_H_E, T_P_A, reference
from tools.benchmarks.one_arm import draw_captures

TCP = PAPER.parent / "paper-tcp.yaml"
SIGMA = [1e-4, 1e-4, 3e-4, 1e-3, 1e-3, 5e-4]

Entry = dict[str, Any]


def entries(*, posed: bool = False) -> list[Entry]:
    """The reference captures, with their corners or with where the target truly was in the camera."""
    captures = json.loads(json.dumps(DOCUMENT["captures"]))
    if posed:
        for use in ("calibration", "verification"):
            data = reference(use)
            T_E_T = inverse(T_P_A @ data.T_A_H @ T_H_E) @ data.T_P_T
            for capture, T in zip((c for c in captures if c["use"] == use), T_E_T, strict=True):
                del capture["feature_px"], capture["corners_px"]
                capture["target_in_camera"] = {"matrix": T.tolist(), "covariance": np.diag(np.square(SIGMA)).tolist()}
    return captures


def written(folder: Path, captures: list[Entry]) -> Path:
    path = folder / "captures.json"
    path.write_text(json.dumps({"format": "dualcal.captures/1", "captures": captures}))
    return path


def estimated(folder: Path, captures: list[Entry], *options: object, cell: Path = PAPER) -> dict[str, Any]:
    """The result file."""
    out = folder / "result.json"
    path = written(folder, captures)
    done = dualcal("estimate", path, "--cell", cell, "--method", "refined", "--out", out, *options)
    assert done.exit_code == 0, done.stderr
    found: dict[str, Any] = json.loads(out.read_text())
    return found


def refusal(folder: Path, captures: list[Entry], *options: object, cell: Path = PAPER) -> str:
    """What is said of captures, or of a call, that cannot be used."""
    done = dualcal("estimate", written(folder, captures), "--cell", cell, "--method", "refined", *options)
    assert done.exit_code == 2
    assert done.stdout == ""
    return done.stderr


def changed_cell(folder: Path, original: Path, *changes: tuple[str, str]) -> Path:
    text = original.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "cell.yaml"
    path.write_text(text)
    return path


def line_of(original: Path, key: str) -> str:
    return next(line for line in original.read_text().splitlines(keepends=True) if line.strip().startswith(key))


class TestRequiredAccuracy:
    """A result is ok or coarse against what somebody has said."""

    def cell(self, folder: Path, original: Path) -> Path:
        """One of a run with method paper, which has no use for it."""
        required = line_of(original, "required_accuracy_mm")
        return changed_cell(folder, original, (required, ""), ("method: refined", "method: paper"))

    def test_of_real_arms_nobody_has_to_guess_it(self, tmp_path: Path) -> None:
        said = refusal(tmp_path, entries(), cell=self.cell(tmp_path, TCP))
        assert said.startswith("dualcal: procedure.verification.required_accuracy_mm: missing")
        assert "--cell" in said

    def test_nor_of_arms_whose_backend_is_not_installed_here(self, tmp_path: Path) -> None:
        cell = self.cell(tmp_path, TCP)
        cell.write_text(cell.read_text().replace("type: controller", "type: ours"))
        assert "required_accuracy_mm: missing" in refusal(tmp_path, entries(), cell=cell)

    def test_nor_where_there_is_one_arm(self, tmp_path: Path) -> None:
        file = load_cell(EYE_IN_HAND, SMALL)
        write_captures(tmp_path / "captures.json", draw_captures(file, rehearse_views(file.cell).plan, seed=1))
        text = file.text.replace("type: simulator", "type: ours")
        for required, code in ((True, 0), (False, 2)):
            kept = [line for line in text.splitlines() if required or "required_accuracy_mm" not in line]
            (tmp_path / "cell.yaml").write_text("\n".join(kept))
            done = dualcal("estimate", tmp_path)
            assert done.exit_code == code
            assert ("required_accuracy_mm: missing" in done.stderr) is not required

    def test_where_it_is_said_the_region_is_that_of_the_verification_captures(self, tmp_path: Path) -> None:
        cell = changed_cell(tmp_path, TCP, (line_of(TCP, "required_accuracy_mm"), "    required_accuracy_mm: 2.5\n"))
        space = estimated(tmp_path, entries(), cell=cell)["accuracy"]["error_3d"]
        assert space["required_mm"] == 2.5
        points = 1e3 * reference("verification").p_P_T
        assert space["region"]["low_mm"] == pytest.approx(points.min(axis=0))
        assert space["region"]["high_mm"] == pytest.approx(points.max(axis=0))

    def test_of_a_simulated_cell_it_is_1_mm(self, tmp_path: Path) -> None:
        found = estimated(tmp_path, entries(), cell=self.cell(tmp_path, PAPER))
        assert found["accuracy"]["error_3d"]["required_mm"] == 1.0


class TestPosesInPlaceOfCorners:
    def test_they_give_the_cell(self, tmp_path: Path) -> None:
        found = estimated(tmp_path, entries(posed=True))
        for name in ("active_base_in_passive_base", "camera_in_active_flange"):
            np.testing.assert_allclose(found["transforms"][name]["matrix"], EXPECTED[name], atol=1e-6)
        assert found["accuracy"]["fit"]["degrees_of_freedom"] == 28 * 6 - 12

    @pytest.mark.parametrize(
        ("change", "option", "named"),
        [
            ((), ("--free", "intrinsics"), "--free intrinsics"),
            (("  sigma_px:", "  intrinsics_sigma: {focal_px: 1.0}\n  sigma_px:"), (), "camera.intrinsics_sigma"),
            (("  square_mm:", "  square_sigma_mm: 0.05\n  square_mm:"), (), "target.square_sigma_mm"),
        ],
    )
    @pytest.mark.parametrize("posed", [1, 42])
    def test_lens_and_squares_are_not_sought_in_them(
        self, tmp_path: Path, change: tuple[str, str], option: tuple[str, ...], named: str, posed: int
    ) -> None:
        """One among corners is enough: it was made with a lens and squares that are taken for true there."""
        cell = changed_cell(tmp_path, PAPER, *([change] if change else []))
        captures = [*entries(posed=True)[:posed], *entries()[posed:]]
        said = refusal(tmp_path, captures, *option, cell=cell)
        assert said.startswith(f"dualcal: {named}: {posed} captures, the first calibration/00/0, have target_in_camera")
        estimated(tmp_path, entries()[:posed] + entries()[posed:], *option, cell=cell)

    def test_corners_count_before_a_pose_that_was_made_from_them(self, tmp_path: Path) -> None:
        both = [{**corners, **posed} for corners, posed in zip(entries(), entries(posed=True), strict=True)]
        for capture in both:
            capture["target_in_camera"]["matrix"][0][3] += 0.05
        found, alone = estimated(tmp_path, both), estimated(tmp_path, entries())
        assert found["transforms"] == alone["transforms"]
        assert found["accuracy"]["fit"] == alone["accuracy"]["fit"]

    def test_corners_come_with_their_feature_point(self, tmp_path: Path) -> None:
        both = [{**corners, **posed} for corners, posed in zip(entries(), entries(posed=True), strict=True)]
        del both[3]["feature_px"]
        assert "calibration/00/3: feature_px: missing" in refusal(tmp_path, both)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (lambda T: np.diag([1, -1, -1, 1]) @ T, "behind the camera"),
            (lambda T: T @ np.diag([1, -1, -1, 1]), "seen from behind"),
            (lambda T: T * np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]]), "lengths are in metres"),
            (lambda T: T * np.array([[-1, 1, 1, 1]] * 4), "right-handed"),
        ],
        ids=["camera's z backward", "target's z away from the viewer", "in mm", "left-handed"],
    )
    def test_one_that_no_camera_sees_is_refused(self, tmp_path: Path, change: Callable[[Any], Any], words: str) -> None:
        captures = entries(posed=True)
        captures[5]["target_in_camera"]["matrix"] = change(np.array(captures[5]["target_in_camera"]["matrix"])).tolist()
        said = refusal(tmp_path, captures)
        assert said.startswith("dualcal: calibration/01/1: target_in_camera")
        assert words in said
        assert said.count("\n") == 1

    def test_a_few_digits_of_a_rotation_are_enough(self, tmp_path: Path) -> None:
        captures = entries(posed=True)
        for capture in captures:
            capture["target_in_camera"]["matrix"] = np.round(capture["target_in_camera"]["matrix"], 5).tolist()
        found = estimated(tmp_path, captures)
        assert found["verdict"] == "ok"
        np.testing.assert_allclose(
            found["transforms"]["camera_in_active_flange"]["matrix"], EXPECTED["camera_in_active_flange"], atol=1e-4
        )

    def test_a_pose_may_have_any_of_the_forms_of_a_pose(self, tmp_path: Path) -> None:
        captures = entries(posed=True)
        for capture in captures:
            T = np.array(capture["target_in_camera"].pop("matrix"))
            capture["target_in_camera"]["translation_m"] = T[:3, 3].tolist()
            capture["target_in_camera"]["rotation_vector_rad"] = vector_from_rotation(T[:3, :3]).tolist()
        found, same = estimated(tmp_path, captures), estimated(tmp_path, entries(posed=True))
        for name, transform in same["transforms"].items():
            np.testing.assert_allclose(found["transforms"][name]["matrix"], transform["matrix"], atol=1e-8)

    def test_the_noise_of_poses_that_say_it_themselves_is_found_as_one_factor(self, tmp_path: Path) -> None:
        """Exact poses that are said to be uncertain."""
        found = estimated(tmp_path, entries(posed=True), "--noise", "estimate")["accuracy"]
        assert found["noise"]["pixel_px"] < 0.01 * found["stated_noise"]["pixel_px"]

    @pytest.mark.parametrize("others", ["corners", "poses alone"])
    def test_but_not_of_others_as_well(self, tmp_path: Path, others: str) -> None:
        captures = entries(posed=True)
        if others == "corners":
            captures[20:] = entries()[20:]
        for capture in captures[20:]:
            capture.get("target_in_camera", {}).pop("covariance", None)
        said = refusal(tmp_path, captures, "--noise", "estimate")
        assert said.startswith("dualcal: --noise estimate: 20 of 42 captures, the first calibration/00/0, say")
        estimated(tmp_path, captures)


def with_pose(**changes: Any) -> Entry:
    (entry, *_) = entries(posed=True)
    return entry | {"target_in_camera": entry["target_in_camera"] | changes}


ODD: dict[str, tuple[Entry, str]] = {
    "degrees": ({"active_joints_rad": [10.0, -30.0, 95.0, 0.0, 45.0, 170.0]}, "angles are in radians"),
    "a corner beside the image": (
        {"corners_px": [[1511.5, 383.5], *[[511.5, 383.5]] * 8]},
        "is outside the image of 1024 x 768 px",
    ),
    "text for a number": ({"passive_joints_rad": [*[0.1] * 5, "0.1"]}, "must be a number, not 0.1"),
    "no number": ({"feature_px": [float("nan"), 383.5]}, "must be a finite number, not nan"),
    "a 3 x 3 matrix": (with_pose(matrix=np.eye(3).tolist()), "target_in_camera: matrix is no list of 4 rows"),
    "a 3 x 4 matrix": (with_pose(matrix=np.eye(4)[:3].tolist()), "target_in_camera: matrix is no list of 4 rows"),
    "a matrix in a row": (
        with_pose(matrix=np.eye(4).ravel().tolist()),
        "target_in_camera: matrix is no list of 4 rows",
    ),
    "a list for a pose": ({"target_in_camera": np.eye(4).tolist(), "corners_px": None}, "target_in_camera: must be an"),
    "no rotation": (with_pose(matrix=np.diag([2.0, 1.0, 1.0, 1.0]).tolist()), "the matrix has no rotation"),
    "a covariance of translations": (with_pose(covariance=np.eye(3).tolist()), "covariance is no list of 6 rows"),
    "sigmas for a covariance": (with_pose(covariance=SIGMA), "covariance[0] is no list"),
    "a negative covariance": (with_pose(covariance=(-np.eye(6)).tolist()), "with variances from 0 up"),
    "a covariance of an exact pose": (with_pose(covariance=np.zeros((6, 6)).tolist()), "has a direction that is exact"),
    "one too small to count with": (
        with_pose(covariance=(1e-38 * np.eye(6)).tolist()),
        "has a direction that is exact",
    ),
    "a singular covariance": (with_pose(covariance=np.full((6, 6), 1e-8).tolist()), "has a direction that is exact"),
}


@pytest.mark.parametrize("what", ODD)
def test_what_is_odd_is_told_in_one_line_that_names_the_capture(tmp_path: Path, what: str) -> None:
    change, words = ODD[what]
    captures = entries()
    captures[0] |= change
    if "target_in_camera" in change:
        del captures[0]["corners_px"]
    said = refusal(tmp_path, captures)
    assert said.startswith("dualcal: calibration/00/0: ")
    assert words in said
    assert said.count("\n") == 1


@pytest.mark.parametrize("least", [1.1e-9, 1e3])
def test_covariances_however_small_or_large_are_reckoned_with(tmp_path: Path, least: float) -> None:
    captures = entries(posed=True)
    captures[0] |= with_pose(covariance=(least**2 * np.eye(6)).tolist())
    assert estimated(tmp_path, captures)["verdict"] == "ok"
