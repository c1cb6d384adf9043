"""The table of whole runs over seeds: one that comes to no result is a row of it too."""

from __future__ import annotations

from pathlib import Path

import pytest

from dualcal_hal.errors import Contact, DegenerateCaptures, DualcalError, NoPlan, UsageError
from tests.cells import PAPER
from tools.benchmarks import accuracy
from tools.benchmarks.accuracy import Ended, Run, attempt, row, summary

RUN = Run(1, 0.05, 0.3, 0.02, (1, 2, 1, 1), (1,), 0, "ok")


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (NoPlan("no stand-off:\n  the floor"), "   7  NoPlan: no stand-off: the floor"),
        (Contact("left", "move", "it touches"), "   7  Contact: left: move: it touches"),
        (DegenerateCaptures("too few"), "   7  DegenerateCaptures: too few"),
    ],
)
def test_a_refused_or_failed_seed_is_a_row_with_its_reason(
    error: DualcalError, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> Run:
        raise error

    monkeypatch.setattr(accuracy, "run", fail)
    assert row(attempt(Path("cell.yaml"), 7, [])) == expected


def test_a_wrong_call_is_no_seeds_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> Run:
        raise UsageError("no")

    monkeypatch.setattr(accuracy, "run", fail)
    with pytest.raises(UsageError):
        attempt(Path("cell.yaml"), 7, [])


def test_seeds_without_a_result_are_counted_and_the_figures_are_of_the_others() -> None:
    alone = summary([RUN])
    assert alone.endswith("; without a result 0 of 1 seeds")
    with_another = summary([RUN, Ended(2, "NoPlan: no")])
    assert with_another == alone.replace("0 of 1", "1 of 2")
    assert summary([Ended(2, "NoPlan: no")]) == "without a result 1 of 1 seeds"


@pytest.mark.slow
def test_a_run_that_nothing_verifies_has_no_result() -> None:
    ended = attempt(PAPER.with_name("tiny.yaml"), 1, ["procedure.verification.constraints=0"])
    assert row(ended).startswith("   1  DegenerateCaptures: no verification captures")
