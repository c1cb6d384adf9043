"""Whole runs on the simulator: whether errors are what the refined result says, and whether it tells if not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.errors import UsageError
from tests.cells import PAPER
from tools.benchmarks import sessions
from tools.benchmarks.accuracy import Ended
from tools.benchmarks.sessions import Run, attempt, row, run, summary

CELLS = PAPER.parent
KINEMATIC = ["simulation.stepper=kinematic"]
GOOD = Run(
    seed=7,
    errors=np.array([0.5, -2.5, *[0.1] * 10]),
    squares=11.0,
    depth=2e-5,
    roll=np.radians(0.003),
    actual=4e-5,
    predicted=6e-5,
    scale=1.0,
    probability=0.4,
    verdict="ok",
)


def test_a_seed_is_a_row_with_its_largest_error_and_verdict() -> None:
    assert " ".join(row(GOOD).split()) == "7 11.0 2.50 P_A ty 0.020 0.0030 0.040 0.060 1.0 0.4 ok"
    assert row(replace(GOOD, errors=GOOD.errors[::-1])).split()[2:5] == ["2.50", "H_E", "ry"]


def test_errors_that_are_not_explained_are_silent_unless_the_verdict_is_fail() -> None:
    far = replace(GOOD, squares=40.0)
    assert far.silent
    assert row(far).endswith("SILENT")
    assert not replace(far, verdict="fail").silent
    assert not GOOD.silent


def test_the_summary_counts_what_holds() -> None:
    text = summary([GOOD, replace(GOOD, squares=40.0, actual=1e-4, errors=GOOD.errors * 2), Ended(8, "NoPlan: none")])
    assert "2 of 3 with a result: 2 ok" in text
    assert "within the 95 % region 50%" in text
    assert "within 3 sigma 95.8%, all twelve 50%" in text
    assert "95 % value at the worst point 50%" in text
    assert text.endswith("no fail: 1")
    assert summary([Ended(8, "NoPlan: none")]) == "no result"


def test_a_run_that_comes_to_nothing_is_told_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_plan(*_: object) -> object:
        raise sessions.NoPlan("no stand-off:\n the floor")

    monkeypatch.setattr(sessions, "calibrated", no_plan)
    assert row(attempt(PAPER, [], 3)) == "   3  NoPlan: no stand-off: the floor"


def test_a_wrong_call_is_no_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    def wrong(*_: object) -> object:
        raise UsageError("no such key")

    monkeypatch.setattr(sessions, "calibrated", wrong)
    with pytest.raises(UsageError):
        attempt(PAPER, [], 3)


@pytest.mark.slow
def test_roll_and_depth_of_the_full_cell_are_recovered_within_three_sigma() -> None:
    """The nominal camera is off by 3 degrees about its axis and 8 mm along it."""
    for seed in (1, 2, 3):
        one = run(CELLS / "paper-full.yaml", seed, KINEMATIC)
        assert np.all(np.abs(one.errors) <= 3.0)
        assert abs(one.depth) < 2e-4
        assert abs(one.roll) < np.radians(0.02)
        assert one.verdict == "ok"


@pytest.mark.slow
def test_a_cell_whose_knowns_are_wrong_is_not_passed_over_in_silence() -> None:
    for seed in (1, 2):
        one = run(CELLS / "realistic.yaml", seed, KINEMATIC)
        assert one.verdict == "fail"
        assert one.scale > 10
        assert not one.silent
