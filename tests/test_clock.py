"""Virtual time is made by waiting, in one defined order; real time passes by itself."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualcal_hal.clock import Clock, RealClock, VirtualClock, utc_now

NEVER = threading.Event()


def test_virtual_time_passes_only_by_waiting() -> None:
    clock = VirtualClock()
    assert clock.now() == 0.0
    assert not clock.wait(NEVER, 2.5)
    assert clock.now() == 2.5


def test_virtual_time_never_goes_back() -> None:
    clock = VirtualClock()
    clock.wait(NEVER, 2.0)
    clock.wait(NEVER, 1.0)
    assert clock.now() == 2.0


@given(st.lists(st.floats(0.0, 10.0), max_size=20), st.floats(0.0, 10.0))
def test_calls_that_are_due_run_in_the_order_of_their_times_and_of_their_asking(
    times: list[float], deadline: float
) -> None:
    clock = VirtualClock()
    ran: list[tuple[float, int]] = []
    for number, when in enumerate(times):
        clock.call_at(when, lambda when=when, number=number: ran.append((when, number)))
    clock.wait(NEVER, deadline)
    assert ran == sorted((when, number) for number, when in enumerate(times) if when <= deadline)
    assert clock.now() == deadline


def test_a_call_sees_its_own_time_and_may_ask_for_more_calls() -> None:
    clock = VirtualClock()
    seen: list[float] = []

    def tick() -> None:
        seen.append(clock.now())
        clock.call_at(clock.now() + 1.0, tick)

    clock.call_at(1.0, tick)
    clock.wait(NEVER, 3.5)
    assert seen == [1.0, 2.0, 3.0]


def test_an_event_ends_the_wait_at_the_time_it_is_set() -> None:
    clock = VirtualClock()
    event = threading.Event()
    clock.call_at(1.0, event.set)
    clock.call_at(2.0, lambda: pytest.fail("after the event"))
    assert clock.wait(event, 3.0)
    assert clock.now() == 1.0


def test_a_wait_inside_a_call_makes_time_go_on() -> None:
    clock = VirtualClock()
    ran: list[str] = []
    clock.call_at(1.0, lambda: clock.wait(NEVER, 2.0) or ran.append("outer"))
    clock.call_at(1.5, lambda: ran.append("inner"))
    clock.wait(NEVER, 1.2)
    assert ran == ["inner", "outer"]
    assert clock.now() == 2.0


def test_a_call_for_a_time_that_has_passed_runs_at_the_next_wait() -> None:
    clock = VirtualClock()
    clock.wait(NEVER, 2.0)
    seen: list[float] = []
    clock.call_at(1.0, lambda: seen.append(clock.now()))
    clock.wait(NEVER, 2.0)
    assert seen == [2.0]


def test_an_error_in_a_call_reaches_who_waits_and_the_clock_goes_on() -> None:
    clock = VirtualClock()

    def fail() -> None:
        raise ZeroDivisionError

    ran: list[float] = []
    clock.call_at(1.0, fail)
    clock.call_at(2.0, lambda: ran.append(clock.now()))
    with pytest.raises(ZeroDivisionError):
        clock.wait(NEVER, 3.0)
    assert clock.now() == 1.0
    clock.wait(NEVER, 3.0)
    assert ran == [2.0]


def test_without_a_deadline_another_thread_may_end_the_wait() -> None:
    clock, event = VirtualClock(), threading.Event()
    setter = threading.Timer(0.05, event.set)
    setter.start()
    assert clock.wait(event, None)
    setter.join()


@pytest.mark.parametrize("make", [VirtualClock, RealClock])
def test_a_call_that_was_taken_back_does_not_run(make: type[Clock]) -> None:
    clock = make()
    when = clock.now() + 0.5
    clock.call_at(when, lambda: pytest.fail("was taken back")).cancel()
    clock.wait(NEVER, when + 0.1)


def test_real_time_passes_and_calls_come_no_earlier_than_asked() -> None:
    clock, called = RealClock(), threading.Event()
    when = clock.now() + 0.02
    times: list[float] = []
    clock.call_at(when, lambda: (times.append(clock.now()), called.set()))
    assert clock.wait(called, when + 5.0)
    assert times[0] >= when
    before = clock.now()
    assert not clock.wait(NEVER, before + 0.01)
    assert clock.now() >= before + 0.01


def test_dates_are_in_universal_time() -> None:
    assert utc_now().utcoffset().total_seconds() == 0  # type: ignore[union-attr]
