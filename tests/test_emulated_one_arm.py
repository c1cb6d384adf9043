"""A cell with one arm over wires: the emulator stands behind them, and what stands is watched as what does not move."""

from __future__ import annotations

from pathlib import Path

import pytest

from dualcal_hal.session.one_arm_result import read_one_arm_result
from tests.command_line import dualcal
from tests.one_arm_cells import BOTH

WIRES = """  cell:
    type: controller
    link:
      tcp:
        dialect: rep
        arms:
          arm: {host: 127.0.0.1, motion_port: 11000, state_port: 11002}
  eye: {type: zmq, endpoint: "tcp://127.0.0.1:11020", camera: eye}
"""
FAST = (
    "procedure.views=4",
    "procedure.first_looks=3",
    "procedure.verification.views=2",
    "robots.arm.speed_deg_s=[600, 600, 600, 1000, 1000, 1200]",
    "robots.arm.acceleration_deg_s2=[2000, 2000, 2000, 2500, 2500, 3000]",
)


@pytest.mark.slow
@pytest.mark.parametrize("cell", BOTH, ids=lambda path: path.stem)
def test_it_runs_at_an_emulator_and_is_replayed_the_same(cell: Path, tmp_path: Path) -> None:
    """About a quarter of a minute each."""
    text = cell.read_text().replace("  sim: {type: simulator}\n", WIRES)
    text = text.replace("    backend: sim", "    backend: cell").replace("  backend: sim", "  backend: eye")
    (tmp_path / "cell.yaml").write_text(text)
    settings = [part for setting in FAST for part in ("--set", setting)]
    ended = dualcal("run", tmp_path / "cell.yaml", "--emulate", "--out", tmp_path / "session", *settings)
    assert ended.exit_code == 0, ended.output
    assert read_one_arm_result(tmp_path / "session" / "result.json").truth_error is not None
    assert dualcal("replay", tmp_path / "session").exit_code == 0
