"""What is proven of an exposure's beginning is never later than it began, whatever frames do on their way."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import accumulate

from hypothesis import given
from hypothesis import strategies as st

from backends.cameras.freshness import LARGEST_DRIFT, FramesInFlight, LargestLatency, SenderClock
from backends.cameras.whose_clock import ClockId, own_clock

steps = st.floats(0.001, 0.1)


@given(
    most=st.integers(1, 6),
    frames=st.lists(st.tuples(steps, steps, st.booleans()), min_size=1, max_size=40),
)
def test_with_few_frames_in_flight_none_began_before_what_is_proven(
    most: int, frames: list[tuple[float, float, bool]]
) -> None:
    flight = FramesInFlight(most)
    free = [0.0] * most  # when each place among those in flight is free again
    began = arrived = 0.0
    for rest, transfer, lost in frames:
        began = max(began + rest, min(free))
        arrived = max(arrived, began + transfer)
        free[free.index(min(free))] = arrived
        if not lost:
            assert flight.arrived(arrived) <= began


def test_with_one_frame_in_flight_it_began_after_the_one_before_had_arrived() -> None:
    flight = FramesInFlight(1)
    assert [flight.arrived(when) for when in (1.0, 2.0, 3.0)] == [-math.inf, 1.0, 2.0]


def test_nothing_is_proven_of_the_first_frames() -> None:
    flight = FramesInFlight(3)
    assert [flight.arrived(when) for when in (1.0, 2.0, 3.0, 4.0)] == [-math.inf, -math.inf, -math.inf, 1.0]


def test_a_largest_latency_is_taken_from_the_arrival() -> None:
    assert LargestLatency(0.5).arrived(2.0) == 1.5


@given(
    offset=st.floats(-1e6, 1e6),
    drift=st.floats(-LARGEST_DRIFT / 2, LARGEST_DRIFT / 2),
    frames=st.lists(st.tuples(steps, steps, st.booleans(), steps), min_size=1, max_size=30),
)
def test_by_marks_nothing_began_before_what_is_proven(
    offset: float, drift: float, frames: list[tuple[float, float, bool, float]]
) -> None:
    def senders(when: float) -> float:
        return offset + when * (1 + drift)

    clock = SenderClock()
    moments = list(accumulate(step for step, *_ in frames))
    for began, (_, transfer, marked, way) in zip(moments, frames, strict=True):
        if marked:  # sent before the frame was exposed, and heard some time after
            clock.heard(began - way, senders(began - way / 3))
        arrived = began + transfer
        earliest = clock.arrived(senders(began), arrived)
        assert earliest <= began + 1e-6  # what offsets of 1e6 leave of a double's digits
        assert earliest <= arrived
        low, high = clock.behind
        assert low - 0.1 <= high  # but for the drift over these few seconds


def test_before_a_mark_was_heard_nothing_is_proven() -> None:
    clock = SenderClock()
    assert clock.arrived(5.0, 7.0) == -math.inf
    clock.heard(10.0, 6.0)
    assert clock.arrived(6.0, 11.0) == 10.0
    assert clock.arrived(7.0, 12.0) == 11.0 - LARGEST_DRIFT


def test_only_clocks_of_one_boot_of_one_machine_are_comparable() -> None:
    own = own_clock()
    assert own.is_comparable_with(replace(own))
    assert not own.is_comparable_with(replace(own, boot="another"))
    assert not own.is_comparable_with(replace(own, host="another"))
    unknown = ClockId("somewhere", "")
    assert not unknown.is_comparable_with(unknown)
