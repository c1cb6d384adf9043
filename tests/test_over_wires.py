"""The paper's calibration over real wires, against an emulator in another process."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.cells import PAPER, SMALL
from tests.command_line import dualcal

BULLET = "simulation.stepper=bullet"
PROFILE = "backends.cell.link.can.mode=profile"
UNHURRIED = "backends.cell.link.can.sync_period_ms=20"


def calibrate(cell: str, session: Path, *overrides: str):
    """A small plan, in physics."""
    settings = [part for each in (*SMALL, BULLET, *overrides) for part in ("--set", each)]
    return dualcal("run", PAPER.with_name(cell), "--emulate", "--out", session, *settings)


@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("cell", "overrides"),
    [
        pytest.param("paper-tcp-fast.yaml", [], id="rep"),
        pytest.param("paper-tcp-fast.yaml", ["backends.cell.link.tcp.dialect=abb"], id="abb", marks=pytest.mark.slow),
        pytest.param(
            "paper-tcp-fast.yaml", ["backends.cell.link.tcp.dialect=fanuc"], id="fanuc", marks=pytest.mark.slow
        ),
        pytest.param(
            "paper-tcp-fast.yaml", ["backends.cell.link.tcp.dialect=motoman"], id="motoman", marks=pytest.mark.slow
        ),
        pytest.param("paper-can-fast.yaml", [UNHURRIED], id="can", marks=pytest.mark.slow),
        pytest.param(
            "paper-can-fast.yaml",
            [UNHURRIED, "backends.cell.link.can.mode=profile"],
            id="profile",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_calibration_is_verified(cell, overrides, tmp_path, undrawn):
    result = calibrate(cell, tmp_path / "session", *overrides)
    assert result.exit_code == 0, result.output + result.stderr
    found = json.loads((tmp_path / "session" / "result.json").read_text())
    assert found["verdict"] == "ok"
    # Of three constraints with three positions each; the whole plan comes to a third of it.
    assert found["truth_error"]["active_base_in_passive_base"]["translation_mm"] < 1.5
    assert json.loads((tmp_path / "session" / "run.json").read_text())["emulated"] is True


@pytest.mark.timeout(400)
@pytest.mark.slow
def test_joints_that_are_coupled_turned_and_exchanged_come_to_the_same(tmp_path, undrawn):
    joint_map = (
        "{order: [1, 2, 3, 4, 6, 5], sign: [1, -1, 1, 1, -1, 1], offset_deg: [0, 90, 0, 0, 0, 10], "
        "coupling: [{joint: 3, from_joint: 2, factor: -1}]}"
    )
    mapped = f"backends.cell.link.tcp.arms.left.joint_map={joint_map}"
    result = calibrate("paper-tcp-fast.yaml", tmp_path / "session", mapped)
    assert result.exit_code == 0, result.output + result.stderr


@pytest.mark.timeout(400)
@pytest.mark.slow
def test_what_was_recorded_over_wires_is_replayed_to_the_same(tmp_path, undrawn):
    session = tmp_path / "session"
    assert calibrate("paper-tcp-fast.yaml", session).exit_code == 0
    replayed = dualcal("replay", session)
    assert replayed.exit_code == 0, replayed.output + replayed.stderr
