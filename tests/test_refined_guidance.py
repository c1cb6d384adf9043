"""What captures would help with what is not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.transforms import Array
from procedures.estimation.refined import Inexact, Limits, Refined, joint_zeros, link_parameters, refined, target_mount
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


class TestKnownsThatAreNotExact:
    """What a known brings in no captures take away; what leaves both to be found they do."""

    MOUNT = target_mount(1e-3, np.radians(0.2))
    ZEROS = joint_zeros("passive", np.radians([0.2] * 6).tolist())
    TIGHT = Limits(translation=4e-4, rotation=float(np.radians(0.05)))

    def found(self, cell: Cell, *inexact: Inexact, estimated: bool, limits: Limits = TIGHT) -> Refined:
        data = cell.noisy(np.random.default_rng(0), NOISE)
        return refined(data, cell.knowns, NOISE, inexact=inexact, estimate_inexact=estimated, observable=limits)

    def lines(self, found: Refined) -> tuple[str, ...]:
        return would_help(found, reference().noisy(np.random.default_rng(0), NOISE))

    def test_a_known_that_is_only_reckoned_with_is_to_be_measured_better(self) -> None:
        """But where captures from elsewhere would let less of it through."""
        found = self.found(reference(), self.MOUNT, estimated=False)
        first, *others = self.lines(found)
        assert first.startswith("measure the target mount better, for ")
        assert first.count(",") == 10
        assert all(line.startswith("positions at more distances") for line in others)
        assert sum(line.count(",") for line in others) == 2

    def test_and_measuring_it_is_what_helps_while_as_many_captures_again_do_not(self) -> None:
        cell = reference()
        now = self.found(cell, self.MOUNT, estimated=False)
        index = next(i for i, one in enumerate(now.directions) if not one.observable)
        again = self.found(_both(cell, cell), self.MOUNT, estimated=False)
        better = self.found(cell, target_mount(5e-4, np.radians(0.1)), estimated=False)
        assert again.directions[index].sigma > 0.95 * now.directions[index].sigma
        assert better.directions[index].sigma < 0.55 * now.directions[index].sigma

    def test_so_is_one_that_is_estimated_but_taken_up_by_the_bases(self) -> None:
        """The zero of the passive arm's first joint turns the whole cell."""
        (line,) = self.lines(self.found(reference(), self.ZEROS, estimated=True))
        assert line.startswith("measure the joint zeros of the passive arm better, for ")
        assert "rotation about z of active_base" in line

    def test_of_several_knowns_it_is_the_one_that_brings_most_in(self) -> None:
        links = link_parameters("passive", reference().knowns.passive, 1e-5, np.radians(0.001))
        for estimated in (False, True):
            found = self.found(reference(), links, self.ZEROS, estimated=estimated)
            assert all(line.startswith("measure the joint zeros of") for line in self.lines(found))

    def test_what_several_bring_in_alike_no_captures_are_asked_for(self) -> None:
        every = [
            target_mount(2e-4, np.radians(0.04)),
            joint_zeros("passive", np.radians([0.02] * 6).tolist()),
            link_parameters("passive", reference().knowns.passive, 1e-4, np.radians(0.02)),
            link_parameters("active", reference().knowns.active, 1e-4, np.radians(0.02)),
        ]
        limits = Limits(translation=1e-4, rotation=float(np.radians(0.01)))
        lines = self.lines(self.found(reference(), *every, estimated=False, limits=limits))
        assert lines
        assert all(line.startswith("measure the ") for line in lines)

    def test_one_that_the_captures_themselves_show_wants_more_of_them(self) -> None:
        """A mount of which nothing is known cannot be measured better than not at all."""
        found = self.found(reference(), target_mount(np.inf, np.inf), estimated=True, limits=Limits(2e-4, 2e-4))
        lines = self.lines(found)
        assert lines
        assert not any("measure" in line for line in lines)

    def test_captures_count_for_less_where_the_known_is_found_from_them_too(self) -> None:
        """Of a loose mount that is found as well half the uncertainty is left by four times as many captures."""
        cell, loose = reference(), target_mount(0.1, np.radians(20.0))
        now, again = (self.found(each, loose, estimated=True) for each in (cell, _both(cell, cell)))
        for before, after in zip(now.directions, again.directions, strict=True):
            assert after.sigma == pytest.approx(before.sigma / np.sqrt(2), rel=0.05)
        tight = replace(now, directions=tuple(replace(one, observable=False) for one in now.directions))
        assert not any("measure" in line for line in self.lines(tight))
