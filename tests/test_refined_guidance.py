"""What captures would help with what is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.transforms import Array
from procedures.estimation.refined import Limits, refined
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.guidance import would_help
from tests.test_refined_start import FAN, turned_to
from tools.benchmarks.refined import NOISES, Cell, reference

NOISE = NOISES[0]


def named(cell: Cell, limits: Limits) -> tuple[str, ...]:
    data = cell.noisy(np.random.default_rng(0), NOISE)
    return would_help(refined(data, cell.knowns, NOISE, observable=limits), data)


def test_nothing_is_said_where_all_is_seen() -> None:
    assert named(reference(), Limits()) == ()


@pytest.mark.parametrize(
    ("turns", "words"),
    [
        (FAN * [0, 1, 0] + np.radians(np.tile([2.5, -2.5], 6))[:, None] * [1, 0, 0], "turned about its x-axis"),
        (FAN * [1, 0, 0] + np.radians(np.tile([2.5, -2.5], 6))[:, None] * [0, 1, 0], "turned about its y-axis"),
    ],
    ids=["y", "x"],
)
def test_a_fan_wants_another_axis(turns: Array, words: str) -> None:
    """Rolling the camera turns it about another axis too."""
    lines = named(turned_to(turns), Limits(translation=4e-4, rotation=4e-4))
    assert any(words in line for line in lines)
    kinds = [line.split(", for")[0] for line in lines]
    assert all(words in kind or "rolled about its optical axis" in kind for kind in kinds)


def test_the_kind_that_is_named_is_the_one_that_helps_when_it_is_taken() -> None:
    """A fan about y, and the same number of captures again: as they were, or turned about another axis."""
    sides = np.radians(np.tile([2.5, -2.5], 6))[:, None] * [1, 0, 0]
    fan, other = turned_to(FAN * [0, 1, 0] + sides), turned_to(FAN * [1, 0, 0] + FAN[::-1] * [0, 0, 1], seed=1)
    worst = np.argmax(np.sqrt(np.diag(fan.bound(NOISE))[:3]))
    again, turned = (
        _both(fan, each).bound(NOISE)[worst, worst] for each in (turned_to(FAN * [0, 1, 0] + sides, seed=2), other)
    )
    assert turned < 0.5 * again


def _both(first: Cell, second: Cell) -> Cell:
    one, two = first.data, second.data
    return replace(
        first,
        data=CaptureArrays(
            active=np.concatenate([one.active, two.active]),
            passive=np.concatenate([one.passive, two.passive]),
            arrivals=np.concatenate([one.arrivals, two.arrivals + 1 + one.arrivals.max()]),
            pixels=np.concatenate([one.pixels, two.pixels]),
        ),
    )


def test_where_all_is_well_spread_more_of_the_same_is_wanted() -> None:
    (line,) = named(reference(), Limits(translation=9e-5, rotation=8e-5))
    assert line.startswith("as many captures again")
    assert "rotation about z of camera" in line


def test_one_noisy_position_a_constraint_wants_more_distances_for_the_camera() -> None:
    cell = reference()
    first = np.isin(np.arange(28), np.unique(cell.data.arrivals, return_index=True)[1])
    noise = replace(NOISE, pixel=2.0, active=1e-6, passive=1e-6)
    data = cell.noisy(np.random.default_rng(0), noise).only(first)
    lines = would_help(refined(data, cell.knowns, noise, observable=Limits(2e-3, 5e-3)), data)
    (line,) = lines
    assert line.startswith("positions at more distances")
    assert "rotation about x of camera" in line
    assert "active_base" not in line
