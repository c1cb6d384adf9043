"""The cell file: what it says in SI, and how it is refused."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, PositiveInt
from ruamel.yaml import YAML

from dualcal_hal import registry
from dualcal_hal.cellfile import CellFile, cell_schema, load_cell
from dualcal_hal.errors import CellFileError
from dualcal_hal.transforms import is_rotation, rotation_from_vector, smallest_rotation, transform

ROOT = Path(__file__).parents[1]
PAPER = ROOT / "cells" / "paper.yaml"
REFERENCE = json.loads((ROOT / "tests" / "data" / "reference-7x4.json").read_text())

CELL = """\
# A small cell
name: small
backends:
  sim: {type: simulator}
robots:
  left:
    backend: sim
    role: active
    kinematics:
      dh:
        - {theta_deg: 10, d_mm: 100, a_mm: 20, alpha_deg: 90}
        - {theta_deg: 0, a_mm: 300, alpha_deg: 0.5, beta_deg: 1}
    limits_deg: [[-170, 170], [-90, 90]]
    speed_deg_s: [120, 90]
    acceleration_deg_s2: [400, 300]
    home_deg: [0, 45]  # chosen
    encoder_sigma_mrad: 0.005
    joint_sigma_mrad: 0.03
    repeatability_mm: 0.1
  right:
    backend: sim
    role: passive
    kinematics: {dh: [{theta_deg: 0, d_mm: 50, a_mm: 0, alpha_deg: 0}]}
    limits_deg: [[-100, 100]]
    speed_deg_s: [60]
    acceleration_deg_s2: [100]
    home_deg: [-5]
    encoder_sigma_mrad: 0
    joint_sigma_mrad: 0
    repeatability_mm: 0
    target_mount: {translation_mm: [0, 0, 3], rotation_vector_deg: [0, 0, -90]}
camera:
  backend: sim
  mount: left
  matrix: [[800, 0, 320], [0, 810, 240], [0, 0, 1]]
  distortion: [0.1, 0, 0, 0, 0]
  size_px: [640, 480]
  sigma_px: 0.02
target:
  kind: checkerboard
  corners: [3, 5]
  square_mm: 25
nominal:
  active_base_in_passive_base: {translation_mm: [1200, 0, 0], rotation_vector_deg: [0, 0, 180]}
  camera_in_active_flange: {translation_mm: [-60, 60, 26], rotation_vector_deg: [0, 0, 0]}
procedure:
  seed: 1
  method: paper
  constraints: 7
  positions: 4
  distance_mm: [300, 500]
  tilt_max_deg: 45
  tolerance_px: 0.1
  verification: {constraints: 2, positions: 7, limit_mm: 0.5}
"""
SIMULATION = """\
simulation:
  seed: 3
  stepper: kinematic
  truth:
    active_base_in_passive_base: {translation_mm: [1210, 0, 0], rotation_vector_deg: [0, 0, 178]}
    camera_in_active_flange: {translation_mm: [-61, 60, 26], rotation_vector_deg: [1, 0, 0]}
    kinematics:
      right: {dh: [{theta_deg: 0, d_mm: 51, a_mm: 0, alpha_deg: 0}]}
  noise: {joint_mrad: 0.04, encoder_mrad: 0, image_grey: 1, blur_px: 0.5}
"""


class Options(BaseModel):
    model_config = ConfigDict(extra="forbid")

    rate: PositiveInt = 1


class Stub:
    Options = Options
    simulated = True


@pytest.fixture(autouse=True)
def simulator_with_a_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The file's own rules are the subject here, whatever backends are installed."""
    monkeypatch.setattr(registry, "backend_names", lambda: ["replay", "simulator"])
    monkeypatch.setattr(registry, "backend_class", lambda name: Stub)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cell") / "cell.yaml"


def load(path: Path, text: str, *overrides: str) -> CellFile:
    path.write_bytes(text.encode())
    return load_cell(path, overrides)


def refused(path: Path, text: str, *overrides: str) -> list[str]:
    """The problems of a cell file, the folder taken off."""
    with pytest.raises(CellFileError) as caught:
        load(path, text, *overrides)
    return [str(problem).removeprefix(f"{path.parent}/") for problem in caught.value.problems]


def changed(text: str, old: str, new: str) -> str:
    assert text.count(old) >= 1
    return text.replace(old, new, 1)


def place(text: str, needle: str) -> str:
    """``cell.yaml:LINE:COLUMN`` of the first occurrence of ``needle``."""
    before = text[: text.index(needle)].split("\n")
    return f"cell.yaml:{len(before)}:{len(before[-1]) + 1}"


# What it says


def test_values_come_out_in_metres_and_radians(path: Path) -> None:
    cell = load(path, CELL).cell
    left, right = cell.active, cell.passive
    assert (cell.name, cell.active_name, cell.passive_name, cell.floor) == ("small", "left", "right", 0.0)
    np.testing.assert_allclose(left.lower, np.radians([-170, -90]))
    np.testing.assert_allclose(left.upper, np.radians([170, 90]))
    np.testing.assert_allclose(left.speed, np.radians([120, 90]))
    np.testing.assert_allclose(left.acceleration, np.radians([400, 300]))
    np.testing.assert_allclose(left.home, np.radians([0, 45]))
    assert (left.encoder_sigma, left.joint_sigma, left.repeatability) == pytest.approx((5e-6, 3e-5, 1e-4))
    np.testing.assert_allclose(left.link_radius, [0.055, 0.055])
    assert left.chain.rows[0].beta is None
    assert left.chain.rows[1].beta == np.radians(1)
    assert (left.chain.rows[0].d, left.chain.rows[1].d, left.chain.rows[1].a) == (0.1, 0.0, 0.3)
    np.testing.assert_allclose(right.target_mount_transform[:3, 3], [0, 0, 0.003])
    np.testing.assert_allclose(right.target_mount_transform[:3, 0], [0, -1, 0], atol=1e-15)
    np.testing.assert_allclose(cell.camera.intrinsics.principal_point, [320, 240])
    assert (cell.camera.body_radius, cell.camera.body_length) == pytest.approx((0.035, 0.02))
    assert (cell.target.board.square, cell.target.board.feature, cell.target.margin) == (0.025, 7, 0.01)
    procedure = cell.procedure
    assert (procedure.distance, procedure.clearance, procedure.first_looks) == ((0.3, 0.5), 0.02, 5)
    assert (procedure.tilt_max, procedure.verification.limit) == (np.radians(45), 0.0005)


def test_the_truth_is_apart_from_what_planner_and_estimator_get(path: Path) -> None:
    file = load(path, CELL + SIMULATION)
    assert not hasattr(file.cell, "simulation")
    assert file.cell == load(path, CELL).cell
    assert file.simulation is not None
    np.testing.assert_allclose(file.simulation.truth.T_P_A[:3, 3], [1.21, 0, 0])
    chains = file.simulation.truth.chains(file.cell)
    assert chains["left"] == file.cell.active.chain
    assert chains["right"].rows[0].d == 0.051
    noise = file.simulation.noise
    assert (noise.joint, noise.encoder, noise.image_grey, noise.blur_px) == (4e-5, 0.0, 1.0, 0.5)


def test_a_cell_without_a_simulator_needs_no_simulation(path: Path) -> None:
    assert load(path, CELL).simulation is None


def test_without_overrides_the_text_is_the_file_byte_for_byte(path: Path) -> None:
    text = CELL.replace("\n", "\r\n")
    file = load(path, text)
    assert file.text == text
    assert file.sha256 == hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.parametrize(
    "rotation",
    [
        "rotation_vector_deg: [0, 90, 0]",
        "quaternion_xyzw: [0, 0.7071067811865476, 0, 0.7071067811865476]",
        "rotation_matrix: [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]",
    ],
)
def test_a_rotation_is_given_by_vector_quaternion_or_matrix(path: Path, rotation: str) -> None:
    cell = load(path, changed(CELL, "rotation_vector_deg: [0, 0, 0]", rotation)).cell
    expected = transform(rotation_from_vector([0, np.pi / 2, 0]), [-0.06, 0.06, 0.026])
    np.testing.assert_allclose(cell.nominal.T_H_E, expected, atol=1e-15)


def test_a_matrix_in_metres_alone_is_a_transform(path: Path) -> None:
    matrix = "[[0, 0, 1, 0.1], [0, 1, 0, 0.2], [-1, 0, 0, 0.3], [0, 0, 0, 1]]"
    cell = load(path, CELL, f"nominal.camera_in_active_flange={{matrix: {matrix}}}").cell
    np.testing.assert_allclose(cell.nominal.T_H_E, json.loads(matrix), atol=1e-15)


@settings(max_examples=25, deadline=None)
@given(st.tuples(*[st.floats(-4, 4)] * 3), st.floats(-3e-7, 3e-7))
def test_an_accepted_rotation_matrix_is_made_exact(
    path: Path, vector: tuple[float, float, float], error: float
) -> None:
    R = rotation_from_vector(vector)
    R[0, 0] += error
    value = f"{{translation_mm: [0, 0, 0], rotation_matrix: {R.tolist()}}}"
    T = load(path, CELL, f"nominal.camera_in_active_flange={value}").cell.nominal.T_H_E
    assert is_rotation(T[:3, :3], tolerance=1e-14)
    np.testing.assert_allclose(T[:3, :3], R, atol=1e-6)


def test_a_number_may_be_written_with_or_without_a_point(path: Path) -> None:
    text = changed(changed(CELL, "square_mm: 25", "square_mm: 25.0"), "constraints: 7", "constraints: 7.0")
    assert load(path, text).cell == load(path, CELL).cell


def test_an_even_board_has_the_feature_corner_that_was_named(path: Path) -> None:
    text = changed(CELL, "corners: [3, 5]", "corners: [4, 5]\n  feature_corner: [1, 2]")
    assert load(path, text).cell.target.board.feature == 7


def test_the_floor_and_the_tolerance_have_values_that_are_no_numbers(path: Path) -> None:
    cell = load(path, CELL, "floor_mm=null", "procedure.tolerance_px=auto").cell
    assert cell.floor is None
    assert cell.procedure.tolerance_px == "auto"


# How it is refused: (old, new, what is cited, the words)

BAD = {
    "a misspelt key, with the nearest known one": (
        "home_deg", "hme_deg", "hme_deg", "robots.left.hme_deg: unknown key; did you mean 'home_deg'?",
    ),
    "a misspelt key of the top level": ("name:", "nam:", "nam:", "nam: unknown key; did you mean 'name'?"),
    "a misspelt key in a list": (
        "theta_deg: 0, a_mm", "theta_deg: 0, a: 1, a_mm", "a: 1,", "robots.left.kinematics.dh.1.a: unknown key",
    ),
    "a missing key, at the section that lacks it": (
        "    repeatability_mm: 0.1\n", "", "left:", "robots.left.repeatability_mm: missing key",
    ),
    "a number in quotes": (
        "square_mm: 25", "square_mm: '25'", "'25'", "target.square_mm: must be a number, not '25'",
    ),
    "a word for a number": ("sigma_px: 0.02", "sigma_px: yes", "yes", "camera.sigma_px: must be a number, not 'yes'"),
    "a truth value for a number": (
        "sigma_px: 0.02", "sigma_px: true", "true", "camera.sigma_px: must be a number, not True",
    ),
    "nothing for a number": (
        "square_mm: 25", "square_mm: ~", "~", "target.square_mm: must be a number, not null",
    ),
    "a fraction for a count": (
        "constraints: 7", "constraints: 7.5", "7.5", "procedure.constraints: must be a whole number, not 7.5",
    ),
    "a date for text": ("name: small", "name: 2020-01-02", "2020", "name: must be text, not 2020-01-02"),
    "a number for text": ("name: small", "name: 012", "012", "name: must be text, not 12"),
    "a number for a section": ("sim: {type: simulator}", "sim: 3", "3\n", "backends.sim: must be a mapping, not 3"),
    "a number for a list": ("[120, 90]", "120", "120", "robots.left.speed_deg_s: must be a list, not 120"),
    "a negative size": (
        "square_mm: 25", "square_mm: -25", "-25", "target.square_mm: must be greater than 0, not -25",
    ),
    "a speed of zero": (
        "[120, 90]", "[120, 0]", "0]\n    acc", "robots.left.speed_deg_s.1: must be greater than 0, not 0",
    ),
    "a negative sigma": (
        "joint_sigma_mrad: 0.03", "joint_sigma_mrad: -1", "-1\n",
        "robots.left.joint_sigma_mrad: must be at least 0, not -1",
    ),
    "a number that is none": (
        "[0, 45]", "[0, .nan]", ".nan", "robots.left.home_deg.1: must be a finite number, not nan",
    ),
    "an infinite number": (
        "square_mm: 25", "square_mm: .inf", ".inf", "target.square_mm: must be a finite number, not inf",
    ),
    "a vector that is too short": (
        "[1200, 0, 0]", "[1200]", "[1200]",
        "nominal.active_base_in_passive_base.translation_mm: has too few entries: 1",
    ),
    "a vector that is too long": (
        "[1200, 0, 0]", "[1200, 0, 0, 0]", "[1200",
        "nominal.active_base_in_passive_base.translation_mm: must have 3 entries, has 4",
    ),
    "a list without an entry for each joint": (
        "[400, 300]", "[400]", "[400]", "robots.left.acceleration_deg_s2: must have 2 entries, one a joint, has 1",
    ),
    "limits upside down": (
        "[-90, 90]", "[90, -90]", "[90, -90]",
        "robots.left.limits_deg.1: the lower value 90 must be below the upper one -90",
    ),
    "a home outside the limits": (
        "[0, 45]", "[0, 95]", "[0, 95]", "robots.left.home_deg: joint 2: 95 is outside -90 to 90",
    ),
    "a row with neither d nor beta": (
        "d_mm: 100, ", "", "{theta_deg: 10",
        "robots.left.kinematics.dh.0.d_mm: missing key; only a row with beta_deg goes without",
    ),
    "a row with both d and beta": (
        "beta_deg: 1}", "beta_deg: 1, d_mm: 5}", "5}\n    limits",
        "robots.left.kinematics.dh.1.d_mm: must be left out: a row with beta_deg has no d_mm",
    ),
    "a role that is none": (
        "role: passive", "role: idle", "idle", "robots.right.role: must be 'active' or 'passive', not 'idle'",
    ),
    "a passive arm without a target": (
        "    target_mount: {translation_mm: [0, 0, 3], rotation_vector_deg: [0, 0, -90]}\n", "", "right:",
        "robots.right.target_mount: missing key: the passive arm carries the target",
    ),
    "an active arm with a target": (
        "    repeatability_mm: 0.1\n",
        "    repeatability_mm: 0.1\n    target_mount: {translation_mm: [0, 0, 3], rotation_vector_deg: [0, 0, 9]}\n",
        "{translation_mm: [0, 0, 3], rotation_vector_deg: [0, 0, 9]}",
        "robots.left.target_mount: must be left out: the active arm carries the camera",
    ),
    "a camera on the passive arm": (
        "mount: left", "mount: right", "right\n  matrix", "camera.mount: must be the active arm (left), not 'right'",
    ),
    "a device of no backend": (
        "  backend: sim\n  mount", "  backend: sam\n  mount", "sam",
        "camera.backend: no backend 'sam' in this file; there are: sim",
    ),
    "an unknown backend, with those there are": (
        "type: simulator", "type: simulater", "simulater",
        "backends.sim.type: unknown backend 'simulater'; there are: replay, simulator",
    ),
    "an option its backend does not know": (
        "type: simulator", "type: simulator, bitrat: 5", "bitrat", "backends.sim.bitrat: unknown key",
    ),
    "an option its backend cannot take": (
        "type: simulator", "type: simulator, rate: 0", "0}", "backends.sim.rate: must be greater than 0, not 0",
    ),
    "a skewed camera matrix": (
        "[800, 0, 320]", "[800, 1, 320]", "[[800",
        "camera.matrix: is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0",
    ),
    "a mirrored camera matrix": (
        "[0, 810, 240]", "[0, -810, 240]", "[[800",
        "camera.matrix: is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0",
    ),
    "a stretched rotation matrix": (
        "rotation_vector_deg: [0, 0, 0]", "rotation_matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 1.001]]", "[[1, 0",
        "nominal.camera_in_active_flange.rotation_matrix: "
        "is no rotation: its columns must be orthonormal and right-handed to 1e-6",
    ),
    "a mirror for a rotation": (
        "{translation_mm: [-60, 60, 26], rotation_vector_deg: [0, 0, 0]}",
        "{matrix: [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}", "[[-1, 0",
        "nominal.camera_in_active_flange.matrix: "
        "is no rotation: its columns must be orthonormal and right-handed to 1e-6",
    ),
    "a matrix with a wrong last row": (
        "{translation_mm: [-60, 60, 26], rotation_vector_deg: [0, 0, 0]}",
        "{matrix: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1]]}", "[[1, 0",
        "nominal.camera_in_active_flange.matrix: is no rigid transform: its last row must be 0 0 0 1",
    ),
    "a quaternion of another length": (
        "rotation_vector_deg: [0, 0, 0]", "quaternion_xyzw: [0, 0, 0, 2]", "[0, 0, 0, 2]",
        "nominal.camera_in_active_flange.quaternion_xyzw: "
        "is no rotation: a quaternion must have length 1 to 1e-6",
    ),
    "a transform with two rotations": (
        "rotation_vector_deg: [0, 0, 0]", "rotation_vector_deg: [0, 0, 0], quaternion_xyzw: [0, 0, 0, 1]",
        "{translation_mm: [-60",
        "nominal.camera_in_active_flange: must have translation_mm and one of rotation_vector_deg, "
        "quaternion_xyzw, rotation_matrix; or matrix alone",
    ),
    "an even board without a feature corner": (
        "[3, 5]", "[4, 5]", "target:", "target.feature_corner: missing key: 4 x 5 corners have no middlemost one",
    ),
    "a feature corner off the board": (
        "[3, 5]", "[3, 5]\n  feature_corner: [3, 0]", "[3, 0]",
        "target.feature_corner: is outside rows 0 to 2 and columns 0 to 4",
    ),
    "too few constraints": (
        "constraints: 7", "constraints: 2", "2\n  pos", "procedure.constraints: must be at least 3, not 2",
    ),
    "two first looks": (
        "seed: 1", "first_looks: 2\n  seed: 1", "2\n  seed", "procedure.first_looks: must be 0 or at least 3, not 2",
    ),
    "no positions to verify on": (
        "positions: 7", "positions: 0", "0, limit", "procedure.verification.positions: must be at least 1, not 0",
    ),
    "distances upside down": (
        "[300, 500]", "[500, 300]", "[500, 300]",
        "procedure.distance_mm: the lower value 500 must be below the upper one 300",
    ),
    "a distance of zero": (
        "[300, 500]", "[0, 500]", "[0, 500]", "procedure.distance_mm: must be greater than 0, not 0",
    ),
    "a tilt of 90 degrees": (
        "tilt_max_deg: 45", "tilt_max_deg: 90", "90\n  tol", "procedure.tilt_max_deg: must be less than 90, not 90",
    ),
    "an unknown method": (
        "method: paper", "method: papr", "papr", "procedure.method: unknown method 'papr'; there are: refined, paper",
    ),
    "a tolerance that is neither a number nor auto": (
        "tolerance_px: 0.1", "tolerance_px: tight", "tight",
        "procedure.tolerance_px: must be a number greater than 0, or auto, not 'tight'",
    ),
    "a true arm that is not in the cell": (
        "right: {dh: [{theta_deg: 0, d_mm: 51", "up: {dh: [{theta_deg: 0, d_mm: 51", "{dh: [{theta_deg: 0, d_mm: 51",
        "simulation.truth.kinematics.up: no arm of that name; there are: left, right",
    ),
    "a true arm with another number of joints": (
        "      right: {dh: [", "      left: {dh: [", "[{theta_deg: 0, d_mm: 51",
        "simulation.truth.kinematics.left.dh: must have 2 entries, as the arm's own, has 1",
    ),
    "an unknown stepper": (
        "stepper: kinematic",
        "stepper: magic",
        "magic",
        "simulation.stepper: must be 'kinematic' or 'bullet', not 'magic'",
    ),
    "a key given twice": (
        "name: small", "name: small\nname: large", "name: large", "name: duplicate key, first in line 2",
    ),
    "a key given twice on one line": (
        "limit_mm: 0.5", "limit_mm: 0.5, positions: 3", "positions: 3",
        f"procedure.verification.positions: duplicate key, first in line {CELL.count(chr(10))}",
    ),
    "a key that is no text": ("name: small", "name: small\n5: five", "5: five", "a key must be text"),
}  # fmt: skip


@pytest.mark.parametrize(("old", "new", "needle", "words"), BAD.values(), ids=BAD.keys())
def test_one_mistake_is_told_once_with_its_line_and_column(
    path: Path, old: str, new: str, needle: str, words: str
) -> None:
    text = changed(CELL + SIMULATION, old, new)
    told = f"{place(text, needle)}: {words}"
    problems = refused(path, text)
    assert told in problems
    # A misspelt key is also one that is missing.
    assert [problem for problem in problems if "missing key" not in problem or problem == told] == [told]


def test_all_mistakes_of_a_file_are_told_at_once_in_its_order(path: Path) -> None:
    text = CELL
    for old, new in [
        ("name: small", "name: small\nname: large"),
        ("type: simulator", "type: simulater"),
        ("[0, 45]", "[0, 95]"),
        ("repeatability_mm: 0.1", "repeatability: 0.1"),
        ("mount: left", "mount: up"),
        ("square_mm: 25", "square_mm: -25"),
        ("rotation_vector_deg: [0, 0, 0]", "rotation_matrix: [[1, 0, 0], [0, 1, 0], [0, 0, 2]]"),
        ("seed: 1", "seed: one"),
    ]:
        text = changed(text, old, new)
    assert [problem.split(": ")[1] for problem in refused(path, text)] == [
        "name",
        "backends.sim.type",
        "robots.left.repeatability_mm",
        "robots.left.home_deg",
        "robots.left.repeatability",
        "camera.mount",
        "target.square_mm",
        "nominal.camera_in_active_flange.rotation_matrix",
        "procedure.seed",
    ]


def test_two_active_arms_are_one_too_many(path: Path) -> None:
    text = changed(CELL, "role: passive", "role: active")
    role, mount = "active\n    kinematics: {", "{translation_mm: [0, 0, 3]"
    assert refused(path, text) == [
        f"{place(text, role)}: robots.right.role: 'left' is the active arm already",
        f"{place(text, mount)}: robots.right.target_mount: must be left out: the active arm carries the camera",
    ]


def test_an_arm_has_at_least_one_joint(path: Path) -> None:
    text = changed(CELL, "[{theta_deg: 0, d_mm: 50, a_mm: 0, alpha_deg: 0}]", "[]")
    told = f"{place(text, '[]}')}: robots.right.kinematics.dh: must have at least 1 entry, has 0"
    assert refused(path, text) == [told]


def test_no_arms_are_too_few(path: Path) -> None:
    assert refused(path, CELL, "robots={}")[0] == ("--set robots: must be two arms, one active and one passive, not 0")


@pytest.mark.parametrize("arms", [1, 3])
def test_a_cell_has_two_arms(path: Path, arms: int) -> None:
    start, end = CELL.index("  right:"), CELL.index("camera:")
    text = CELL[:start] + CELL[end:] if arms == 1 else CELL[:end] + "  third: 0\n" + CELL[end:]
    told = f"{place(text, '  left:').split(':')[0]}:6:3: robots: must be two arms"
    assert any(problem.startswith(told) for problem in refused(path, text))


def test_a_backend_that_cannot_be_imported_is_a_mistake_of_the_file(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_its_library(name: str) -> type:
        raise ModuleNotFoundError("No module named 'bus'")

    monkeypatch.setattr(registry, "backend_class", without_its_library)
    told = f"{place(CELL, '{type')}: backends.sim: backend 'simulator' cannot be imported: No module named 'bus'"
    assert refused(path, CELL) == [told]


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"", "cell.yaml:1:1: the file is empty"),
        (b"# nothing\n", "cell.yaml:1:1: the file is empty"),
        (b"- a\n", "cell.yaml:1:1: must be a mapping of keys to values"),
        (b"name: a\nx: b: c\n", "cell.yaml:2:5: is no YAML: mapping values are not allowed here"),
        (b"name: [1,\nb: 2", "cell.yaml:2:5: is no YAML: while parsing a flow sequence; expected ',' or ']'"),
        (b"name: a\n---\nname: b\n", "cell.yaml:2:1: is no YAML: expected a single document"),
        (b"name: \x00", "cell.yaml:1:7: is no YAML: character 0x00 is not allowed"),
        (b"name: a\nx: \xc3\xa4\xff", "cell.yaml:2:5: is not UTF-8: byte 0xff"),
        (b"name: &a [*a]\n", "cell.yaml:1:7: the alias stands for what it is part of"),
        (b"name: 2020-13-45\n", "cell.yaml: is no YAML: month must be in 1..12"),
    ],
)
def test_a_file_that_is_no_cell_file_at_all(path: Path, data: bytes, told: str) -> None:
    path.write_bytes(data)
    with pytest.raises(CellFileError) as caught:
        load_cell(path)
    (problem,) = caught.value.problems
    assert str(problem).removeprefix(f"{path.parent}/").startswith(told)


def test_a_missing_file_and_a_folder_are_named(tmp_path: Path) -> None:
    with pytest.raises(CellFileError, match=r"none\.yaml: cannot be read: No such file"):
        load_cell(tmp_path / "none.yaml")
    with pytest.raises(CellFileError, match="cannot be read: Is a directory"):
        load_cell(tmp_path)


# Values set from the command line


def test_what_is_set_is_in_the_text_with_the_comments_kept(path: Path) -> None:
    file = load(path, CELL, "robots.left.home_deg.1=50", "procedure.tolerance_px=1e-2", "target.margin_mm=7")
    expected = changed(CELL, "home_deg: [0, 45]  # chosen", "home_deg: [0, 50]  # chosen")
    expected = changed(expected, "tolerance_px: 0.1", "tolerance_px: 0.01")
    expected = changed(expected, "target:\n", "target:\n  margin_mm: 7\n")
    assert file.text == expected
    assert file.sha256 == hashlib.sha256(expected.encode()).hexdigest()
    assert file.cell == load(path, expected).cell
    assert (file.cell.procedure.tolerance_px, file.cell.target.margin) == (0.01, 0.007)


def test_a_section_can_be_set_whole_or_made_for_one_key(path: Path) -> None:
    cell = load(path, CELL, "procedure.verification={constraints: 0, positions: 1, limit_mm: 2}").cell
    assert cell.procedure.verification.constraints == 0
    assert load(path, CELL, "camera.body.radius_mm=60").cell.camera.body_radius == 0.06


def test_the_last_of_two_settings_counts(path: Path) -> None:
    assert load(path, CELL, "procedure.seed=5", "procedure.seed=6").cell.procedure.seed == 6


def test_a_setting_can_mend_the_file(path: Path) -> None:
    text = changed(CELL, "square_mm: 25", "square_mm: -25")
    assert load(path, text, "target.square_mm=20").cell.target.board.square == 0.02


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("procedure.tolerence_px=1", "procedure.tolerence_px: unknown key; did you mean 'tolerance_px'?"),
        ("procedure.a.b=1", "procedure.a.b: procedure.a: unknown key"),
        ("target.square_mm=big", "target.square_mm: must be a number, not 'big'"),
        ("target.square_mm=", "target.square_mm: must be a number, not null"),
        (
            "robots.left.home_deg.1=95",
            "robots.left.home_deg.1: robots.left.home_deg: joint 2: 95 is outside -90 to 90",
        ),
        (
            "robots.left.home_deg.2=5",
            "robots.left.home_deg.2: robots.left.home_deg is a list of 2: '2' is no index of it",
        ),
        (
            "robots.left.home_deg.-1=5",
            "robots.left.home_deg.-1: robots.left.home_deg is a list of 2: '-1' is no index of it",
        ),
        (
            "robots.left.home_deg=[1, yes]",
            "robots.left.home_deg: robots.left.home_deg.1: must be a number, not 'yes'",
        ),
        ("name.x=1", "name.x: name is neither a mapping nor a list"),
        ("procedure.seed", "procedure.seed: must read PATH=VALUE"),
        ("procedure.seed=[", "procedure.seed: '[' is no YAML value"),
        ("procedure.seed=a: 1", "procedure.seed: 'a: 1' is no YAML scalar or flow value"),
        ("backends.sim.type=real", "backends.sim.type: unknown backend 'real'; there are: replay, simulator"),
        (
            "target.corners=[4, 5]",
            "target.corners: target.feature_corner: missing key: 4 x 5 corners have no middlemost one",
        ),
    ],
)  # fmt: skip
def test_a_wrong_setting_is_cited_as_such(path: Path, override: str, told: str) -> None:
    assert refused(path, CELL, override) == [f"--set {told}"]


def test_mistakes_of_file_and_settings_are_told_together(path: Path) -> None:
    text = changed(CELL, "square_mm: 25", "square_mm: -25")
    assert refused(path, text, "procedure.seed=-1", "name", "procedure.positions=4") == [
        f"{place(text, '-25')}: target.square_mm: must be greater than 0, not -25",
        "--set procedure.seed: must be at least 0, not -1",
        "--set name: must read PATH=VALUE",
    ]


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-87, 87),
    st.from_regex(re.compile(r"\w[\w .-]*", re.ASCII), fullmatch=True),
)
def test_a_text_with_settings_reads_back_as_the_same_cell(path: Path, home: float, name: str) -> None:
    file = load(path, CELL, f"robots.left.home_deg.1={home!r}", f"name={json.dumps(name, ensure_ascii=False)}")
    assert (file.cell.active.home_deg[1], file.cell.name) == (home, name)
    again = load(path, file.text)
    assert (again.cell, again.sha256) == (file.cell, file.sha256)


# The schema and the paper's cell


def test_the_schema_beside_the_example_is_the_one_the_code_has() -> None:
    assert json.loads((PAPER.parent / "cell.schema.json").read_text()) == cell_schema()
    assert PAPER.read_text().startswith("# yaml-language-server: $schema=cell.schema.json\n")


def test_the_schema_bounds_sizes_and_counts() -> None:
    sections = cell_schema()["$defs"]
    assert sections["TargetConfig"]["properties"]["square_mm"]["exclusiveMinimum"] == 0
    assert sections["ProcedureConfig"]["properties"]["constraints"]["minimum"] == 3


def test_every_number_in_the_schema_says_what_it_is_with_its_unit() -> None:
    units = {"mm": "mm", "deg": "degrees", "s": "seconds", "deg_s": "degrees per second", "mrad": "mrad", "px": "px"}
    for section in cell_schema()["$defs"].values():
        for key, value in section["properties"].items():
            assert value.get("description") or "$ref" in value, key
            unit = next((unit for tail, unit in reversed(units.items()) if key.endswith(f"_{tail}")), None)
            assert unit is None or "$ref" in value or unit in value["description"], key


def test_the_paper_cell_is_the_reference_cell() -> None:
    file = load_cell(PAPER)
    assert file.simulation is not None
    expected = REFERENCE["expected"]
    for T, name in [
        (file.simulation.truth.T_P_A, "active_base_in_passive_base"),
        (file.simulation.truth.T_H_E, "camera_in_active_flange"),
    ]:
        np.testing.assert_allclose(T, expected[name], rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        file.cell.passive.target_mount_transform, expected["target_in_passive_flange"], rtol=0, atol=1e-12
    )
    nominal = expected["nominal"]
    np.testing.assert_allclose(file.cell.nominal.T_P_A, nominal["active_base_in_passive_base"], atol=1e-12)
    np.testing.assert_allclose(file.cell.nominal.T_H_E, nominal["camera_in_active_flange"], atol=1e-12)
    camera, target = REFERENCE["camera"], REFERENCE["target"]
    intrinsics, board = file.cell.camera.intrinsics, file.cell.target.board
    assert intrinsics.matrix.tolist() == camera["matrix"]
    assert intrinsics.distortion.tolist() == camera["distortion"]
    assert [*intrinsics.size] == camera["size_px"]
    assert ([board.rows, board.columns], board.square) == (target["corners"], target["square_mm"] / 1000)


def test_the_paper_cell_is_out_by_the_errors_the_paper_found() -> None:
    file = load_cell(PAPER)
    assert file.simulation is not None
    nominal, truth = file.cell.nominal, file.simulation.truth
    w, dz = np.array([-0.0122, 0.0805, -0.1579]), np.array([-0.0978, -0.0076, -0.0001])
    size = np.linalg.norm(w)
    R_A_P = nominal.T_P_A[:3, :3].T @ rotation_from_vector(w / size * np.arcsin(size))
    T_P_A = transform(R_A_P.T, nominal.T_P_A[:3, 3] + np.array([18.2, 113.0, 11.5]) / 1000)
    R_H_E = smallest_rotation([0, 0, 1], np.array([0, 0, 1]) + dz) @ nominal.T_H_E[:3, :3]
    T_H_E = transform(R_H_E, nominal.T_H_E[:3, 3] + np.array([7.3, -6.8, -0.57]) / 1000)
    np.testing.assert_allclose(truth.T_P_A, T_P_A, rtol=0, atol=1e-12)
    np.testing.assert_allclose(truth.T_H_E, T_H_E, rtol=0, atol=1e-12)


def test_the_paper_cell_has_the_arms_of_the_reference_captures() -> None:
    cell = load_cell(PAPER).cell
    first, first_poses = REFERENCE["captures"][0], REFERENCE["expected"]["first_capture"]
    for arm, joints, pose in [
        (cell.active, "active_joints_rad", "active_flange_in_active_base"),
        (cell.passive, "passive_joints_rad", "passive_flange_in_passive_base"),
    ]:
        np.testing.assert_allclose(arm.chain.forward(first[joints]), first_poses[pose], rtol=0, atol=1e-12)
        q = np.array([capture[joints] for capture in REFERENCE["captures"]])
        assert np.all(q - arm.lower > np.radians(5))
        assert np.all(arm.upper - q > np.radians(5))


def test_the_paper_cell_keeps_its_layout_when_something_is_set() -> None:
    text = load_cell(PAPER, ["procedure.seed=7"]).text
    assert text == changed(PAPER.read_text(), "seed: 1  # chosen", "seed: 7  # chosen")


def test_the_paper_cell_marks_what_was_chosen() -> None:
    document = YAML().load(PAPER.read_text())
    for arm in document["robots"].values():
        for key in ("limits_deg", "speed_deg_s", "acceleration_deg_s2", "home_deg", "joint_sigma_mrad"):
            assert "chosen" in arm.ca.items[key][2].value, key


# Aliases


def test_an_alias_is_the_value_it_stands_for(path: Path) -> None:
    text = changed(CELL, "speed_deg_s: [120, 90]", "speed_deg_s: &two [120, 90]")
    text = changed(text, "acceleration_deg_s2: [400, 300]", "acceleration_deg_s2: *two")
    file = load(path, text)
    np.testing.assert_allclose(file.cell.active.acceleration, np.radians([120, 90]))
    assert file.text == text


def test_setting_one_of_two_aliased_values_leaves_the_other(path: Path) -> None:
    text = changed(CELL, "speed_deg_s: [120, 90]", "speed_deg_s: &two [120, 90]")
    text = changed(text, "acceleration_deg_s2: [400, 300]", "acceleration_deg_s2: *two")
    file = load(path, text, "robots.left.acceleration_deg_s2.0=500")
    np.testing.assert_allclose(file.cell.active.speed, np.radians([120, 90]))
    np.testing.assert_allclose(file.cell.active.acceleration, np.radians([500, 90]))
    again = load(path, file.text)
    assert again.cell == file.cell


def test_aliases_of_aliases_that_stand_for_more_than_a_memory_holds_are_refused(path: Path) -> None:
    levels = ["l0: &l0 [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]"]
    levels += [f"l{i}: &l{i} [{', '.join([f'*l{i - 1}'] * 10)}]" for i in range(1, 10)]
    path.write_text("\n".join(levels))
    with pytest.raises(CellFileError, match="more than 100000 values"):
        load_cell(path)


# What a cell with real arms must say


@pytest.fixture
def real_arms(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Stub, "simulated", False)


@pytest.mark.usefixtures("real_arms")
def test_a_cell_with_real_arms_must_say_how_wrong_its_nominal_may_be(path: Path) -> None:
    assert any("nominal.uncertainty: missing key" in problem for problem in refused(path, CELL))
    given = changed(CELL, "nominal:\n", "nominal:\n  uncertainty: {translation_mm: 50, rotation_deg: 5}\n")
    uncertainty = load(path, given).cell.nominal.uncertainty
    assert (uncertainty.translation, uncertainty.rotation) == pytest.approx((0.05, np.radians(5)))


@pytest.mark.usefixtures("real_arms")
def test_a_cell_with_real_arms_takes_its_looks(path: Path) -> None:
    problems = refused(path, CELL, "procedure.first_looks=0")
    assert any("only a cell that is simulated goes without looks" in problem for problem in problems)


def test_a_stand_off_has_an_entry_a_joint(path: Path) -> None:
    problems = refused(path, CELL, "procedure.stand_off={active_deg: [0, 0], passive_deg: [0, 0, 0, 0, 0]}")
    assert [problem for problem in problems if "entries, one a joint, has 5" in problem]


def test_home_keeps_the_procedures_margin_to_the_limits(path: Path) -> None:
    problems = refused(path, CELL, "robots.left.limit_margin_deg=[0, 100]")
    assert [problem for problem in problems if "is less than limit_margin_deg, 100, inside -90 to 90" in problem]


def test_home_keeps_the_margin_that_is_taken_where_none_is_given(path: Path) -> None:
    problems = refused(path, CELL, "robots.left.home_deg=[0, 89]")
    assert [problem for problem in problems if "home_deg: joint 2: 89 is less than limit_margin_deg, 3," in problem]
    assert load_cell(path, ["robots.left.home_deg=[0, 89]", "robots.left.limit_margin_deg=[0, 1]"])
