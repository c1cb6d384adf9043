"""`dualcal intrinsics import`: cameras that other programs have written down."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ruamel.yaml import YAML

from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import FormatError
from procedures.intrinsics.camera_files import CameraFile, read_camera_file
from tests.cells import PAPER, TINY
from tests.command_line import dualcal

MATRIX = [[801.25, 0.0, 509.5], [0.0, 802.75, 380.125], [0.0, 0.0, 1.0]]
DISTORTION = [-0.11, 0.042, 0.0007, -0.0002, 0.003]

ROS = """image_width: 1024
image_height: 768
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [801.25, 0, 509.5, 0, 802.75, 380.125, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.11, 0.042, 0.0007, -0.0002, 0.003]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [780, 0, 508, 0, 0, 790, 381, 0, 0, 0, 1, 0]
"""


def opencv_file(path, *, matrix=MATRIX, distortion=DISTORTION, size=(1024, 768), **entries):
    """Written by OpenCV itself."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon 30 Nov 2026 09:00:00 AM UTC")
    if size is not None:
        storage.write("image_width", size[0])
        storage.write("image_height", size[1])
    for name, value in entries.items():
        storage.write(name, value)
    storage.write("camera_matrix", np.array(matrix))
    storage.write("distortion_coefficients", np.array(distortion))
    storage.write("per_view_reprojection_errors", np.array([[0.1], [0.2]], dtype=np.float32))
    storage.release()
    return path


def ros_file(path, old="", new=""):
    assert old in ROS
    path.write_text(ROS.replace(old, new) if old else ROS)
    return path


def imported(file, *options, cell=PAPER):
    return dualcal("intrinsics", "import", file, "--cell", cell, *options)


def refusal(file, cell=PAPER):
    result = imported(file, cell=cell)
    assert result.exit_code == 2, result.output
    assert not result.stdout
    return result.stderr


@pytest.mark.parametrize("name", ["camera.yml", "camera.json", "ros.yaml"])
def test_matrix_and_distortion_come_through_exactly(tmp_path, name):
    file = ros_file(tmp_path / name) if name.startswith("ros") else opencv_file(tmp_path / name)
    result = imported(file)
    assert result.exit_code == 0, result.output
    assert (
        f"# The camera of {name} ({'ROS' if name.startswith('ros') else 'OpenCV'}), for cell 'paper'." in result.stdout
    )
    # The whole of it is YAML: what is said beside is a comment.
    assert YAML(typ="safe").load(result.stdout) == {"camera": {"matrix": MATRIX, "distortion": DISTORTION}}


def test_the_options_that_are_printed_make_it_the_cells_camera(tmp_path):
    result = imported(ros_file(tmp_path / "ros.yaml"), "--out", tmp_path / "camera.patch.yaml")
    assert result.exit_code == 0
    options = result.stdout.split("for one run: ")[1].strip()
    settings = [part.strip("' ") for part in options.split("--set")[1:]]
    camera = load_cell(PAPER, settings).cell.camera.intrinsics
    np.testing.assert_array_equal(camera.matrix, MATRIX)
    np.testing.assert_array_equal(camera.distortion, DISTORTION)
    assert "matrix: [[801.25" in (tmp_path / "camera.patch.yaml").read_text()


@pytest.mark.parametrize("name", ["cell.yaml", "ros.yaml"])
def test_neither_the_cell_file_nor_the_cameras_is_written_over(tmp_path, name):
    cell, file = tmp_path / "cell.yaml", ros_file(tmp_path / "ros.yaml")
    cell.write_text(PAPER.read_text())
    before = (tmp_path / name).read_text()
    result = imported(file, "--out", tmp_path / name, cell=cell)
    assert result.exit_code == 2
    assert f"{name}: the lines would take the place of" in result.stderr
    assert (tmp_path / name).read_text() == before


def test_four_coefficients_are_without_k3(tmp_path):
    camera = read_camera_file(opencv_file(tmp_path / "camera.yml", distortion=DISTORTION[:4]))
    np.testing.assert_array_equal(camera.distortion, [*DISTORTION[:4], 0.0])


def test_more_coefficients_are_fine_while_they_are_zero(tmp_path):
    camera = read_camera_file(opencv_file(tmp_path / "camera.yml", distortion=[*DISTORTION, 0.0, 0.0, 0.0]))
    np.testing.assert_array_equal(camera.distortion, DISTORTION)
    rational = ros_file(tmp_path / "ros.yaml", "plumb_bob", "rational_polynomial")
    np.testing.assert_array_equal(read_camera_file(rational).distortion, DISTORTION)


def test_more_coefficients_that_are_not_zero_are_named(tmp_path):
    said = refusal(opencv_file(tmp_path / "camera.yml", distortion=[*DISTORTION, 0.25, 0.0, -0.5]))
    assert "has k4 0.25, k6 -0.5; a cell file has k1, k2, p1, p2, k3 alone" in said


def test_names_of_other_programs_of_opencv_are_known(tmp_path):
    text = opencv_file(tmp_path / "camera.yml").read_text()
    (tmp_path / "old.yml").write_text(
        text.replace("camera_matrix", "Camera_Matrix").replace("distortion_coefficients", "Distortion_Coefficients")
    )
    (tmp_path / "short.yml").write_text(
        text.replace("camera_matrix", "cameraMatrix").replace("distortion_coefficients", "distCoeffs")
    )
    for name in ("old.yml", "short.yml"):
        np.testing.assert_array_equal(read_camera_file(tmp_path / name).matrix, MATRIX)


def test_images_of_another_size_are_refused(tmp_path):
    said = refusal(ros_file(tmp_path / "ros.yaml"), cell=TINY)
    assert "it is for images of 1024 x 768 px, the cell's camera.size_px is 512 x 384" in said


def test_a_file_that_does_not_say_its_size_is_taken_with_a_warning_if_it_may_be_this_camera(tmp_path):
    file = opencv_file(tmp_path / "camera.yml", size=None)
    assert "# The file says nothing of the size of its images" in imported(file).stdout
    assert "principal point (509.5, 380.1) px is outside" not in imported(file).stderr
    other = opencv_file(tmp_path / "other.yml", size=None, matrix=[[800, 0, 1100.0], [0, 800, 380], [0, 0, 1]])
    assert "principal point (1100.0, 380.0) px is outside the cell's images of 1024 x 768 px" in refusal(other)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("plumb_bob", "equidistant", "distortion_model 'equidistant'"),
        ("plumb_bob", "7", "distortion_model '7'"),
        ("camera_matrix:", "camera:", "has no camera_matrix"),
        ("distortion_coefficients:", "distortion:", "has no distortion_coefficients"),
        ("[801.25, 0, 509.5", "[801.25, 0.5, 509.5", "has a skew of 0.5"),
        ("[801.25, 0, 509.5", "[-801.25, 0, 509.5", "with fx and fy above 0"),
        ("[801.25, 0, 509.5", "[.nan, 0, 509.5", "camera_matrix.data is no finite number"),
        ("[801.25, 0, 509.5", "[true, 0, 509.5", "camera_matrix.data is no finite number"),
        ("[801.25, 0, 509.5, ", "[", "has 6 numbers where 3 x 3 are said"),
        ("380.125, 0, 0, 1]", "380.125, 0, 0, 2]", "camera_matrix is none"),
        ("  cols: 5\n  data: [-0.11,", "  data: [0.1, -0.11,", "has 6 numbers; there are models with"),
        ("image_width: 1024", "image_width: wide", "image_width is no number of pixels"),
        ("image_height: 768\n", "", "image_height is no number of pixels"),
        ("camera_name: left", "camera_name: [", "is neither YAML nor JSON"),
        ("camera_name: left", "image_width: 7", "is neither YAML nor JSON"),
        ("  data: [801.25, 0, 509.5, 0, 802.75, 380.125, 0, 0, 1]\n", "", "camera_matrix has no data"),
    ],
)
def test_what_is_no_camera_is_refused_with_the_reason(tmp_path, old, new, said):
    file = ros_file(tmp_path / "ros.yaml", old, new)
    text = refusal(file)
    assert str(file) in text
    assert said in text


def test_a_fisheye_of_opencv_is_refused(tmp_path):
    assert "is a fisheye's" in refusal(opencv_file(tmp_path / "camera.yml", fisheye_model=1))
    assert read_camera_file(opencv_file(tmp_path / "other.yml", fisheye_model=0)).kind == "OpenCV"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "has no entries"),
        (b"[1, 2]", "has no entries"),
        (b'<?xml version="1.0"?>\n<opencv_storage/>', "is XML; let OpenCV write it as YAML or JSON"),
        (b"\xff\xfe\x00", "utf-8"),
        (b"a: " + b"[" * 1500, "is neither YAML nor JSON"),
        (b"a: " + b"1" * 1_000_001, "far too large"),
    ],
)
def test_files_that_are_no_cameras_are_refused(tmp_path, content, said):
    (tmp_path / "file").write_bytes(content)
    assert said in refusal(tmp_path / "file")


def test_a_file_that_is_not_there_is_said_so(tmp_path):
    assert "cannot be read: No such file" in refusal(tmp_path / "none.yaml")


@given(place=st.integers(0, len(ROS)), end=st.integers(0, 12), other=st.text(max_size=12))
def test_whatever_a_file_says_it_is_a_camera_or_refused(tmp_path_factory, place, end, other):
    file = tmp_path_factory.getbasetemp() / "mutated.yaml"
    file.write_text(ROS[:place] + other + ROS[place + end :], encoding="utf-8")
    try:
        camera = read_camera_file(file)
    except FormatError:
        return
    assert isinstance(camera, CameraFile)
    assert np.all(np.isfinite(camera.matrix))
    assert camera.distortion.shape == (5,)
    json.dumps(camera.matrix.tolist(), allow_nan=False)
