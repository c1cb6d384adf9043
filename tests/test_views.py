"""``dualcal estimate`` on photographs with flange poses: file, detection, result, table and pictures."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dualcal_hal.errors import FormatError
from dualcal_hal.session.views import read_views
from dualcal_hal.target import Charuco, Checkerboard, Target
from dualcal_hal.transforms import (
    Array,
    inverse,
    quaternion_from_rotation,
    rotation_angle,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from tests.board_images import Scene, intrinsics, random_view
from tests.command_line import dualcal

ABB = Path(__file__).parents[2] / "shared/data/abb-charuco/views.json"
with_photographs = pytest.mark.skipif(not ABB.exists(), reason=f"the photographs are not at {ABB}")

CAMERA = intrinsics((640, 480))
CHARUCO = Charuco(4, 5, 0.025, 7, 0.018, "DICT_4X4_50")
CHECKERBOARD = Checkerboard(5, 4, 0.025, 9)
ON_FLANGE = transform(rotation_from_vector([0.3, -0.2, 1.1]), [0.05, -0.03, 0.11])
IN_BASE = transform(rotation_from_vector([-0.4, 2.0, 0.5]), [0.9, 0.2, 0.6])
VIEWS = 8

Change = Callable[[dict[str, Any]], object]


def target_entry(board: Target) -> dict[str, Any]:
    entry: dict[str, Any] = {"squares_x": board.columns + 1, "squares_y": board.rows + 1, "square_mm": 25.0}
    if isinstance(board, Charuco):
        return {"kind": "charuco", **entry, "marker_mm": 18.0, "dictionary": board.dictionary}
    return {"kind": "checkerboard", **entry}


def pose_entry(T: Array, number: int) -> dict[str, Any]:
    """In one form after the other."""
    if number % 3 == 0:
        return {"matrix": T.tolist()}
    translation = {"translation_m": T[:3, 3].tolist()}
    if number % 3 == 1:
        return translation | {"quaternion_xyzw": quaternion_from_rotation(T[:3, :3]).tolist()}
    return translation | {"rotation_vector_rad": vector_from_rotation(T[:3, :3]).tolist()}


def photographed(folder: Path, board: Target, placement: str) -> Path:
    """Images of a board whose camera and target are at ON_FLANGE and IN_BASE, and the views file beside them."""
    rng = np.random.default_rng(3)
    scene = Scene(board, CAMERA, rng)
    entries = []
    (folder / "images").mkdir()
    for number in range(VIEWS):
        T_E_T = random_view(rng, board, CAMERA)
        name = f"images/{number}.png"
        cv2.imwrite(str(folder / name), scene.image(T_E_T))
        if placement == "eye-to-hand":
            flange = IN_BASE @ T_E_T @ inverse(ON_FLANGE)
        else:
            flange = IN_BASE @ inverse(T_E_T) @ inverse(ON_FLANGE)
        entries.append({"image": name, "flange_in_base": pose_entry(flange, number)})
    camera = {"matrix": CAMERA.matrix.tolist(), "distortion": CAMERA.distortion.tolist(), "size_px": [640, 480]}
    path = folder / "views.json"
    path.write_text(json.dumps({"camera": camera, "target": target_entry(board), "views": entries}, indent=1))
    return path


@pytest.fixture(scope="module")
def fixed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photographed(tmp_path_factory.mktemp("fixed"), CHARUCO, "eye-to-hand")


@pytest.fixture(scope="module")
def on_arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return photographed(tmp_path_factory.mktemp("on_arm"), CHECKERBOARD, "eye-in-hand")


@pytest.fixture
def changed(fixed: Path, tmp_path: Path) -> Callable[[Change], Path]:
    """The views of the fixed camera, with a change."""

    def make(change: Change) -> Path:
        document = json.loads(fixed.read_text())
        for view in document["views"]:
            view["image"] = str(fixed.parent / view["image"])
        change(document)
        path = tmp_path / "changed.json"
        path.write_text(json.dumps(document, indent=1))
        return path

    return make


def estimated(path: Path, *options: str) -> dict[str, Any]:
    result = dualcal("estimate", path, "--json", *options)
    assert result.exit_code == 0, result.output
    document: dict[str, Any] = json.loads(result.stdout)
    return document


def matrix(document: dict[str, Any], name: str) -> Array:
    return np.array(document["transforms"][name]["matrix"])


def assert_near(T: Array, expected: Array) -> None:
    np.testing.assert_allclose(T[:3, 3], expected[:3, 3], atol=3e-4)
    assert rotation_angle(T[:3, :3], expected[:3, :3]) < 1e-3


class TestRendered:
    def test_a_fixed_camera_is_found_with_the_target_on_the_flange(self, fixed: Path) -> None:
        document = estimated(fixed)
        assert document["format"] == "dualcal.views-result/1"
        assert document["placement"]["name"] == "eye-to-hand"
        assert not document["placement"]["stated"]
        assert_near(matrix(document, "camera_in_base"), IN_BASE)
        assert_near(matrix(document, "target_in_flange"), ON_FLANGE)
        assert document["verdict"] == "ok"
        assert document["residuals"]["rms_px"] < 0.05
        assert all(view["used"] and view["left_out_mm"] < 0.1 for view in document["views"])

    def test_a_camera_on_the_arm_is_found_with_a_plain_checkerboard(self, on_arm: Path) -> None:
        """Which of its ends is up does not show: it is the same in all views."""
        document = estimated(on_arm)
        assert document["placement"]["name"] == "eye-in-hand"
        assert_near(matrix(document, "camera_in_flange"), ON_FLANGE)
        # Turned by half a turn about its middle, which between the rows lies beside the origin.
        found, half = matrix(document, "target_in_base"), transform(np.diag([-1.0, -1.0, 1.0]), [0.025, 0.0, 0.0])
        way = found if rotation_angle(found[:3, :3], IN_BASE[:3, :3]) < 1 else found @ half
        assert_near(way, IN_BASE)
        assert not any("second solution" in warning for warning in document["warnings"])

    @pytest.mark.slow
    @pytest.mark.parametrize("side", [3, 4])
    def test_a_square_checkerboard_is_read_from_the_same_side_in_all_views(self, tmp_path: Path, side: int) -> None:
        board = Checkerboard(side, side, 0.025, (side - 1) // 2 * (side + 1))
        document = estimated(photographed(tmp_path, board, "eye-to-hand"))
        assert all(view["used"] for view in document["views"])
        assert_near(matrix(document, "camera_in_base"), IN_BASE)
        assert document["residuals"]["rms_px"] < 0.05

    @pytest.mark.slow
    def test_the_placement_may_be_stated_and_a_wrong_one_explains_nothing(
        self, changed: Callable[[Change], Path]
    ) -> None:
        document = estimated(changed(lambda document: document.update(placement="eye-to-hand")))
        assert document["placement"] == {"name": "eye-to-hand", "stated": True, "ratio": None}
        result = dualcal("estimate", changed(lambda document: document.update(placement="eye-in-hand")))
        assert result.exit_code == 2
        assert "views agree with each other" in " ".join(result.stderr.split())

    def test_a_view_with_the_pose_of_another_is_dropped_and_named(self, changed: Callable[[Change], Path]) -> None:
        def mislabel(document: dict[str, Any]) -> None:
            document["views"][3] |= {"flange_in_base": document["views"][6]["flange_in_base"], "id": "the third"}

        path = changed(mislabel)
        document = estimated(path)
        dropped = [view for view in document["views"] if not view["used"]]
        assert [view["id"] for view in dropped] == ["the third"]
        assert "from where the other views put it" in dropped[0]["reason"]
        assert_near(matrix(document, "camera_in_base"), IN_BASE)
        shown = dualcal("estimate", path).stdout
        assert "not used, the third:" in shown

    @pytest.mark.slow
    def test_a_view_with_the_pose_of_another_is_kept_where_all_are_and_makes_it_fail(
        self, changed: Callable[[Change], Path]
    ) -> None:
        path = changed(
            lambda document: document["views"][3].update(flange_in_base=document["views"][6]["flange_in_base"])
        )
        kept = estimated(path, "--keep-all", "--sigma-flange", "0.5,0.05")
        assert all(view["used"] for view in kept["views"])
        assert kept["verdict"] == "fail"

    @pytest.mark.slow
    def test_an_image_without_the_target_is_named_and_the_rest_is_used(
        self, changed: Callable[[Change], Path], tmp_path: Path
    ) -> None:
        cv2.imwrite(str(tmp_path / "empty.png"), np.full((480, 640), 128, np.uint8))
        document = estimated(changed(lambda document: document["views"][2].update(image="empty.png")))
        assert [view["used"] for view in document["views"]].count(False) == 1
        assert document["views"][2]["reason"]
        assert document["views"][2]["rms_px"] is None
        assert_near(matrix(document, "camera_in_base"), IN_BASE)

    @pytest.mark.slow
    def test_a_part_of_the_board_is_enough(
        self, fixed: Path, changed: Callable[[Change], Path], tmp_path: Path
    ) -> None:
        image = cv2.imread(str(fixed.parent / "images/1.png"), cv2.IMREAD_GRAYSCALE)
        corners = np.array([point for point in estimated(fixed)["views"][1]["corners_px"] if point])
        image[:, int(np.median(corners[:, 0])) :] = 128
        cv2.imwrite(str(tmp_path / "half.png"), image)
        document = estimated(changed(lambda document: document["views"][1].update(image="half.png")))
        assert 4 <= document["views"][1]["corners"] < len(corners)
        assert document["views"][1]["used"]
        assert_near(matrix(document, "camera_in_base"), IN_BASE)

    def test_intrinsics_are_freed(self, changed: Callable[[Change], Path]) -> None:
        def forget_the_lens(document: dict[str, Any]) -> None:
            document["camera"] = {"matrix": document["camera"]["matrix"], "distortion_known": False}

        path = changed(forget_the_lens)
        assert any("not known" in warning for warning in estimated(path)["warnings"])
        document = estimated(path, "--free", "intrinsics")
        found, sigma = document["intrinsics"]["used"], document["intrinsics"]["sigma"]
        assert document["intrinsics"]["given"]["distortion"] == [0.0] * 5
        assert found["size_px"] == [640, 480]
        assert abs(found["distortion"][0] - CAMERA.distortion[0]) < 4 * sigma["k1"]
        assert abs(found["matrix"][0][0] - CAMERA.matrix[0, 0]) < 4 * sigma["fx"]
        assert document["residuals"]["rms_px"] < 0.05

    @pytest.mark.slow
    def test_stated_noise_that_does_not_fit_fails(self, changed: Callable[[Change], Path]) -> None:
        def shake(document: dict[str, Any]) -> None:
            for number, view in enumerate(document["views"]):
                T = np.array(pose_of(view["flange_in_base"]))
                T[:3, 3] += 1e-3 * np.random.default_rng(number).standard_normal(3)
                view["flange_in_base"] = {"matrix": T.tolist()}

        path = changed(shake)
        assert estimated(path, "--sigma-flange", "1,0.05")["verdict"] != "fail"
        document = estimated(path, "--sigma-flange", "0.05,0.003", "--sigma-pixel", "0.05", "--keep-all")
        assert document["verdict"] == "fail"
        assert document["noise"]["from"] == "stated"
        assert "do not fit the stated noise" in document["reasons"][0]


def pose_of(entry: dict[str, Any]) -> Array:
    if "matrix" in entry:
        return np.array(entry["matrix"])
    if "quaternion_xyzw" in entry:
        from dualcal_hal.transforms import rotation_from_quaternion

        return transform(rotation_from_quaternion(entry["quaternion_xyzw"]), entry["translation_m"])
    return transform(rotation_from_vector(entry["rotation_vector_rad"]), entry["translation_m"])


class TestOutput:
    def test_result_and_pictures_are_written(self, fixed: Path, tmp_path: Path) -> None:
        result = dualcal("estimate", fixed, "--out", tmp_path / "found.json")
        assert result.exit_code == 0, result.output
        document = json.loads((tmp_path / "found.json").read_text())
        covariance = document["covariance"]
        assert covariance["of"][0] == "camera_in_base: translation x"
        assert covariance["of"][9] == "target_in_flange: rotation x"
        assert np.all(np.linalg.eigvalsh(np.array(covariance["matrix"])) > 0)
        assert set(document["transforms"]["camera_in_base"]) >= {"matrix", "translation_mm", "quaternion_xyzw"}
        for name in ("found-residuals.png", "found-views.png"):
            picture = cv2.imread(str(tmp_path / name))
            assert picture is not None
            assert picture.shape == (1200, 1600, 3)
            assert picture.std() > 10

    def test_the_table_fits_into_80_columns(self, fixed: Path) -> None:
        result = dualcal("estimate", fixed)
        assert max(map(len, result.stdout.splitlines())) <= 80
        for said in ("camera_in_base", "target_in_flange", "images/7.png", "left out", "Verdict: ok", "found so"):
            assert said in result.stdout

    def test_no_image_is_replaced(self, fixed: Path) -> None:
        image = fixed.parent / "images/1.png"
        before = image.read_bytes()
        result = dualcal("estimate", fixed, "--out", image)
        assert result.exit_code == 2
        assert "is one of the images" in result.stderr
        assert image.read_bytes() == before

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (("--cell", "cell.yaml"), "has views; leave out what is for captures: --cell"),
            (("--sigma-a", "1,1"), "has views; leave out what is for pose triples: --sigma-a"),
            (("--free", "target_mount"), "only intrinsics can be left to them"),
            (("--noise", "stated"), "needs --sigma-flange"),
            (("--sigma-flange", "1"), "must be MM,DEG"),
            (("--sigma-flange", "0,1"), "two numbers above 0"),
            (("--sigma-pixel", "0"), "must be above 0 px"),
        ],
    )
    def test_options_that_do_not_fit_are_refused(self, fixed: Path, options: tuple[str, ...], said: str) -> None:
        result = dualcal("estimate", fixed, *options)
        assert result.exit_code == 2
        assert said in " ".join(result.stderr.split())


class TestFile:
    @pytest.mark.parametrize(
        ("change", "said"),
        [
            (lambda d: d.pop("camera"), "camera: is missing"),
            (lambda d: d.update(lens=1), "lens: unknown key"),
            (lambda d: d.update(format="dualcal.views/2"), "format: must be 'dualcal.views/1'"),
            (lambda d: d.update(placement="on the arm"), "placement: must be 'eye-in-hand' or 'eye-to-hand'"),
            (lambda d: d.update(views=[]), "views: list should have at least 1 item"),
            (
                lambda d: d["camera"].update(matrix=[[1, 0, 0], [0, -1, 0], [0, 0, 1]]),
                "camera.matrix: is no camera matrix",
            ),
            (lambda d: d["camera"].update(size_px=[100, 100]), "camera.matrix: its principal point is outside"),
            (lambda d: d["camera"].update(distortion_known=False), "camera.distortion_known: is false, but"),
            (
                lambda d: d["target"].update(square_mm=0.025, marker_mm=0.018),
                "a square of 0.025 mm: its side is in milli",
            ),
            (lambda d: d["target"].pop("marker_mm"), "target.marker_mm: missing key"),
            (lambda d: d["target"].update(kind="checkerboard"), "target.marker_mm: must be left out"),
            (lambda d: d["target"].update(squares_x=3), "target.squares_x: must be greater than or equal to 4"),
            (lambda d: d["target"].update(feature_corner=[9, 0]), "target.feature_corner: is outside"),
            (lambda d: d["views"][1].update(pose=1), ": views[1].pose: unknown key"),
            (lambda d: d["views"][1].pop("image"), "views[1].image: is missing"),
            (lambda d: d["views"][1].update(image="none.png"), "image: there is no file"),
            (lambda d: d["views"][1].update(image=d["views"][2]["image"]), "image: 2.png is that of another view, too"),
            (lambda d: d["views"][1].update(id="a") or d["views"][2].update(id="a"), "id: 'a' is that of another"),
            (lambda d: d["views"][1]["flange_in_base"].update(translation_m=[1000, 0, 0]), "lengths are in metres"),
            (lambda d: d["views"][1]["flange_in_base"].pop("translation_m"), "translation_m is missing"),
            (lambda d: d["views"][1]["flange_in_base"].update(unit="mm"), "unknown key 'unit'"),
        ],
    )
    def test_what_is_wrong_is_said_with_its_key(
        self, changed: Callable[[Change], Path], change: Change, said: str
    ) -> None:
        path = changed(change)
        with pytest.raises(FormatError) as caught:
            read_views(path)
        assert said in str(caught.value)

    def test_all_problems_are_told_at_once(self, changed: Callable[[Change], Path]) -> None:
        path = changed(lambda d: d["views"][1].update(pose=1) or d["views"][4].pop("flange_in_base"))
        with pytest.raises(FormatError) as caught:
            read_views(path)
        lines = path.read_text().splitlines()
        wheres = [int(problem.where.rpartition(":")[2]) for problem in caught.value.problems]
        assert len(wheres) == 2
        begun = [number for number, line in enumerate(lines, start=1) if line == "  {"]
        assert sorted(wheres) == [begun[1], begun[4]]

    def test_views_that_are_all_wrong_are_not_told_to_be_none(self, changed: Callable[[Change], Path]) -> None:
        path = changed(lambda d: [view.pop("flange_in_base") for view in d["views"]])
        with pytest.raises(FormatError) as caught:
            read_views(path)
        assert all("flange_in_base: is missing" in problem.what for problem in caught.value.problems)
        with pytest.raises(FormatError, match="at least 1"):
            read_views(changed(lambda d: d["views"].clear()))

    def test_an_image_of_another_size_is_refused(self, changed: Callable[[Change], Path], tmp_path: Path) -> None:
        cv2.imwrite(str(tmp_path / "small.png"), np.zeros((48, 64), np.uint8))
        result = dualcal("estimate", changed(lambda d: d["views"][1].update(image="small.png")))
        assert result.exit_code == 2
        assert "has 64 x 48 px, the camera's size_px is 640 x 480" in " ".join(result.stderr.split())

    def test_a_camera_of_another_size_than_all_images_is_told_once(self, changed: Callable[[Change], Path]) -> None:
        result = dualcal("estimate", changed(lambda d: d["camera"].update(size_px=[800, 600])))
        assert result.exit_code == 2
        assert "camera.size_px: is 800 x 600, all images have 640 x 480 px" in " ".join(result.stderr.split())
        assert result.stderr.count("640 x 480") == 1

    def test_what_is_no_image_is_refused(self, changed: Callable[[Change], Path], tmp_path: Path) -> None:
        (tmp_path / "text.png").write_text("no image")
        result = dualcal("estimate", changed(lambda d: d["views"][1].update(image="text.png")))
        assert result.exit_code == 2
        assert "is no image that can be read" in " ".join(result.stderr.split())

    def test_a_board_of_another_dictionary_is_in_no_image(self, changed: Callable[[Change], Path]) -> None:
        result = dualcal("estimate", changed(lambda d: d["target"].update(dictionary="DICT_7X7_50")))
        assert result.exit_code == 2
        said = " ".join(result.stderr.split())
        assert "the target is in none of 8 images (" in said
        assert "see that target.kind, squares and dictionary are those of the board" in said

    def test_views_that_do_not_tell_are_refused_with_the_reason(self, changed: Callable[[Change], Path]) -> None:
        result = dualcal("estimate", changed(lambda d: d.update(views=d["views"][:2])))
        assert result.exit_code == 2
        assert "2 views with at least 4 corners seen" in " ".join(result.stderr.split())


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    return estimated(ABB)


@pytest.fixture(scope="module")
def freed() -> dict[str, Any]:
    return estimated(ABB, "--free", "intrinsics")


@with_photographs
class TestPhotographs:
    def test_corners_are_off_by_no_more_than_a_fit_to_them_all_leaves(
        self, given: dict[str, Any], freed: dict[str, Any]
    ) -> None:
        assert given["placement"]["name"] == "eye-to-hand"
        assert given["residuals"]["rms_px"] <= 1.85
        assert freed["residuals"]["rms_px"] <= 0.78
        assert all(document["residuals"]["corners"] > 225 for document in (given, freed))
        assert all(view["used"] for view in freed["views"])

    def test_left_out_views_are_predicted(self, freed: dict[str, Any]) -> None:
        assert all(0 < view["left_out_mm"] < 2 for view in freed["views"])
        attempts = freed["residuals"]["attempts"]
        taken = attempts[freed["residuals"]["poses"]]
        assert taken["left_out_px"] == min(attempt["left_out_px"] for attempt in attempts.values())

    def test_it_says_what_is_far_above_corner_noise_and_what_to_look_at(
        self, given: dict[str, Any], freed: dict[str, Any]
    ) -> None:
        assert given["verdict"] == freed["verdict"] == "coarse"
        said = "; ".join(given["reasons"])
        for words in ("times the 0.06", "camera's position is uncertain by", "intrinsics", "the robot", "the board"):
            assert words in said
        assert "--free intrinsics" not in "; ".join(freed["reasons"])
        assert freed["breakdown"]["and_corners_free_px"] < 0.1 < freed["breakdown"]["and_poses_free_px"]

    def test_the_camera_moves_by_less_than_the_given_lens_left_uncertain(
        self, given: dict[str, Any], freed: dict[str, Any]
    ) -> None:
        moved = np.linalg.norm(matrix(given, "camera_in_base")[:3, 3] - matrix(freed, "camera_in_base")[:3, 3])
        assert 0.005 < moved < 0.012
        assert 1e3 * moved < given["predicted_error"]["camera_position_mm"]["p95"]

    @pytest.mark.slow
    def test_it_needs_no_guess(self, given: dict[str, Any], tmp_path: Path) -> None:
        document = json.loads(ABB.read_text())
        del document["guess"]
        for view in document["views"]:
            view["image"] = str(ABB.parent / view["image"])
        (tmp_path / "views.json").write_text(json.dumps(document))
        again = estimated(tmp_path / "views.json")
        np.testing.assert_allclose(matrix(again, "camera_in_base"), matrix(given, "camera_in_base"), atol=1e-12)
