"""Observers can neither slow nor fail a run."""

from __future__ import annotations

import threading

import pytest

from procedures.observers import Observers


def test_events_reach_every_observer_in_order_before_the_end():
    first, second = [], []
    with Observers(first.append, second.append) as observers:
        for number in range(50):
            observers.tell(number)
    assert first == second == list(range(50))


def test_a_failing_observer_is_taken_off_and_the_others_go_on(caplog):
    seen = []

    def broken(event):
        raise RuntimeError("no screen")

    with Observers(broken, seen.append) as observers:
        observers.tell("one")
        observers.tell("two")
    assert seen == ["one", "two"]
    assert sum("failed" in record.message for record in caplog.records) == 1


@pytest.mark.timeout(20)
def test_an_observer_that_hangs_does_not_keep_a_run_from_ending(monkeypatch):
    monkeypatch.setattr("procedures.observers.PATIENCE", 0.05)
    release = threading.Event()
    with Observers(lambda event: release.wait(15)) as observers:
        observers.tell("stuck")
    assert not release.is_set()
    release.set()


@pytest.mark.timeout(20)
def test_a_slow_observer_never_blocks_the_teller():
    release = threading.Event()
    with Observers(lambda event: release.wait(10)) as observers:
        for number in range(5000):
            observers.tell(number)
        dropped = observers.dropped
        release.set()
    assert dropped > 0
