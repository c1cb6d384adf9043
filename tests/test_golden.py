"""A session recorded once: every later version replays it to the same result.

``python -m tools.golden --update`` makes it anew, where the procedure is meant to do something else now.
"""

from __future__ import annotations

import json
import shutil

import pytest

from tests.cells import TINY
from tests.command_line import dualcal
from tools.golden import GOLDEN, KEPT, update


def test_the_golden_session_is_replayed_to_its_result():
    result = dualcal("replay", GOLDEN)
    assert result.exit_code == 0, result.output


def test_its_images_detected_anew_give_its_result():
    document = json.loads((GOLDEN / "result.json").read_text())
    result = dualcal("estimate", GOLDEN, "--redetect", "--json")
    anew = json.loads(result.stdout)
    assert anew["verdict"] == document["verdict"] == "ok"
    assert anew["mismatch_mm"]["after"]["mean"] == pytest.approx(document["mismatch_mm"]["after"]["mean"], abs=1e-3)


def test_its_log_is_whole():
    assert dualcal("log", "check", GOLDEN).exit_code == 0


def test_it_is_of_the_tiny_cell_and_small():
    assert (GOLDEN / "cell.yaml").read_text() == TINY.read_text()
    assert sum(path.stat().st_size for path in GOLDEN.iterdir()) <= 5e6


def test_made_anew_it_holds_what_a_replay_needs(tmp_path):
    shutil.copytree(GOLDEN, tmp_path / "golden")
    (tmp_path / "golden" / "result.json").write_text("{}")
    update(tmp_path / "golden")
    assert {path.name for path in (tmp_path / "golden").iterdir()} == set(KEPT)
    assert dualcal("replay", tmp_path / "golden").exit_code == 0
