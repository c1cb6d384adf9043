"""Before arms move that are not simulated: what has to be proven, shown and agreed to, and how fast they may be.

The cell is served by an emulator that somebody else has started, so to the run it is as real as any.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.session.conduct import read_conduct
from dualcal_hal.session.folder import Session
from tests.cells import PAPER, SMALL
from tests.command_line import dualcal
from tools.cli.emulator import emulator

FAST = PAPER.with_name("paper-tcp-fast.yaml")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The text of a cell that is served, with a small plan and its ports in it."""
    path = tmp_path_factory.mktemp("served") / "cell.yaml"
    path.write_text(load_cell(FAST, SMALL).text)
    with emulator(path) as endpoints:
        arms = endpoints["cell"]["tcp"]
        ports = [
            f"backends.cell.link.tcp.arms.{arm}.{port}={arms[arm][port]}"
            for arm in arms
            for port in ("motion_port", "state_port")
        ]
        eye = f"backends.eye.endpoint={endpoints['eye']['camera']['endpoint']}"
        yield load_cell(path, (*ports, eye)).text


@pytest.fixture
def cell(served: str, tmp_path: Path) -> Path:
    path = tmp_path / "cell.yaml"
    path.write_text(served)
    return path


@pytest.fixture
def proven(cell: Path) -> Path:
    """The cell, after doctor has found all in order."""
    record = Commissioning.of(cell, load_cell(cell))
    for arm in ("left", "right"):
        record.record_flange(arm, True, "within 0.3 mm")
        record.record_wiggle(arm, True, "each joint turned as it should")
    return cell


def test_no_arm_moves_before_doctor_has_proven_both(cell, tmp_path):
    result = dualcal("run", cell, "--yes", "--out", tmp_path / "session")
    assert result.exit_code == 2
    assert "its arms must not be moved yet" in result.stderr
    for arm in ("left", "right"):
        for check in ("flange", "wiggle"):
            assert f"--{check} --arm {arm}" in result.stderr
    assert not (tmp_path / "session").exists()


def test_what_was_proven_for_other_joints_counts_for_nothing(proven, tmp_path):
    turned = "backends.cell.link.tcp.arms.left.joint_map={sign: [1, -1, 1, 1, 1, 1]}"
    result = dualcal("run", proven, "--yes", "--set", turned, "--out", tmp_path / "session")
    assert result.exit_code == 2
    assert "was for other backends or robots" in result.stderr


def test_stand_off_and_looks_are_shown_and_nothing_moves_without_a_yes(proven, tmp_path):
    result = dualcal("run", proven, "--out", tmp_path / "session", typed="n\n")
    assert result.exit_code == 2
    assert "The stand-off, where the first looks are taken from" in result.output
    assert "Both arms will move there, and take 3 looks" in result.output
    assert "not confirmed by the operator" in result.stderr
    assert "no arm was moved" in result.stderr


def test_an_end_of_the_input_is_no_yes(proven, tmp_path):
    result = dualcal("run", proven, "--out", tmp_path / "session", typed="")
    assert result.exit_code == 2
    assert "no arm was moved" in result.stderr


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_plan_is_confirmed_too_and_a_verified_calibration_lifts_the_speed_limit(proven, tmp_path):
    result = dualcal("run", proven, "--out", tmp_path / "first", typed="y\ny\n")
    assert result.exit_code == 0, result.output + result.stderr
    assert "Both arms will move by this plan" in result.output
    assert read_conduct(Session(tmp_path / "first")).pace.largest == pytest.approx(0.25)
    assert Commissioning.of(proven, load_cell(proven)).verified
    # What was simulated is nothing that such a run could know.
    assert '"truth_error": null' in (tmp_path / "first" / "result.json").read_text() or (
        "truth_error" not in (tmp_path / "first" / "result.json").read_text()
    )
    again = dualcal("run", proven, "--yes", "--speed", "0.5", "--out", tmp_path / "second")
    assert again.exit_code == 0, again.output + again.stderr
    pace = read_conduct(Session(tmp_path / "second")).pace
    assert (pace.largest, pace.share) == (None, 0.5)


def test_an_emulator_of_the_run_itself_is_for_real_wires_alone(tmp_path):
    result = dualcal("run", PAPER, "--emulate", "--out", tmp_path / "session")
    assert result.exit_code == 2
    assert "go without" in result.stderr


@pytest.mark.parametrize("share", ["0.01", "1.5", "fast"])
def test_a_share_of_the_speed_is_between_a_twentieth_and_all_of_it(share, tmp_path):
    assert dualcal("run", PAPER, "--speed", share, "--out", tmp_path / "session").exit_code == 2
