"""Knowns that are not exact: estimated with a prior, freed, or only reckoned with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, apply, inverse, transform
from procedures.estimation import Degenerate
from procedures.estimation.refined import (
    Inexact,
    Knowns,
    Refined,
    free_intrinsics,
    intrinsics,
    joint_zeros,
    link_parameters,
    refined,
    square_size,
    target_mount,
)
from procedures.estimation.refined.hidden import hidden
from procedures.estimation.refined.inexact import common_scale
from procedures.estimation.refined.uncertainty import Limits
from tools.benchmarks.refined import NOISES, Cell, reference

NOISE = NOISES[0]
MOUNT = target_mount(5e-4, float(np.radians(0.1)))
ZEROS = [joint_zeros("active", [1e-3] * 6), joint_zeros("passive", [1e-3] * 6)]
ZEROS_SEEN = [joint_zeros("active", [0.0, 3e-4, 3e-4, 3e-4, 3e-4, 0.0]), joint_zeros("passive", [0.0, *[3e-4] * 5])]
ACTIVE, PASSIVE = (
    chain for chain in (reference().knowns.active, reference().knowns.passive) if isinstance(chain, Chain)
)
LINKS = [link_parameters("active", ACTIVE, 2e-4, 3e-4), link_parameters("passive", PASSIVE, 2e-4, 3e-4)]
LENS = intrinsics(1.0, 2.0, [0.01, 0.01, 1e-3, 1e-3, 0])


def off(inexact: Sequence[Inexact], rng: np.random.Generator) -> Cell:
    """The reference cell where the knowns are in truth off by a draw of their sigmas, 3 mm and 3 mrad of what is free;
    the estimate knows those of the reference.
    """
    cell = reference()
    true = cell.knowns
    for one in inexact:
        sigmas = np.where(np.isfinite(one.sigmas), one.sigmas, 3e-3)
        true = one.shifted(true, rng.normal(0, sigmas))
    cell = replace(cell, knowns=true)
    return replace(cell, data=replace(cell.data, pixels=cell.seen()))


def estimates(inexact: Sequence[Inexact], runs: int, estimated: bool) -> list[tuple[Array, Refined]]:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(runs):
        cell = off(inexact, rng)
        data = cell.noisy(rng, NOISE)
        result = refined(data, reference().knowns, NOISE, inexact=inexact, estimate_inexact=estimated)
        found.append((cell.error(result.T_P_A, result.T_H_E), result))
    return found


def normalised(found: Sequence[tuple[Array, Refined]]) -> float:
    return float(np.mean([error @ np.linalg.solve(result.covariance, error) for error, result in found]))


@pytest.mark.parametrize(
    "inexact", [[MOUNT], [target_mount(np.inf, np.inf)], [square_size(1e-3), LENS]], ids=["mount", "free mount", "lens"]
)
def test_what_is_estimated_with_its_prior_leaves_errors_that_the_covariance_explains(inexact: list[Inexact]) -> None:
    """The mean of 3 chi-squares of 12 has a sigma of 2.8."""
    found = estimates(inexact, 3, estimated=True)
    assert normalised(found) == pytest.approx(12, abs=8)
    assert all(result.used.all() for _, result in found)


def test_joint_zeros_are_estimated_but_those_that_cannot_be_seen_are_named() -> None:
    found = estimates(ZEROS, 1, estimated=True)
    assert normalised(found) < 40
    hidden = {known.name for known in found[0][1].known if not known.seen}
    assert hidden == {
        "zero of joint 1 of the active arm",
        "zero of joint 6 of the active arm",
        "zero of joint 1 of the passive arm",
    }
    assert any("cannot be seen" in words for words in found[0][1].warnings)


@pytest.mark.slow
def test_of_the_links_the_first_d_and_the_active_arms_last_row_cannot_be_seen() -> None:
    ((error, result),) = estimates(LINKS, 1, estimated=True)
    assert error @ np.linalg.solve(result.covariance, error) < 40
    assert {known.name for known in result.known if not known.seen} == {
        "d of row 1 of the active arm",
        "d of row 1 of the passive arm",
        *(f"{what} of row 6 of the active arm" for what in ("d", "a", "alpha")),
    }


def test_what_is_only_reckoned_with_widens_the_covariance_as_its_errors_do() -> None:
    """And no more than that: a mount off by more than the noise shows in the residuals, but no capture is to blame."""
    found = estimates([MOUNT], 3, estimated=False)
    plain = reference().bound(NOISE)
    assert all(result.covariance[0, 0] > 20 * plain[0, 0] for _, result in found)
    assert normalised(found) == pytest.approx(12, abs=8)
    assert all(result.used.all() and result.scale == 1 for _, result in found)
    assert all(np.array_equal(result.knowns.T_F_T, reference().knowns.T_F_T) for _, result in found)


def test_outliers_are_dropped_where_knowns_are_only_reckoned_with() -> None:
    cell = off([MOUNT], np.random.default_rng(0))
    data = cell.noisy(np.random.default_rng(0), NOISE)
    data.pixels[5] += 6
    found = refined(data, reference().knowns, NOISE, inexact=[MOUNT], estimate_inexact=False)
    assert np.flatnonzero(~found.used).tolist() == [5]


@pytest.mark.parametrize(
    ("one", "name"),
    [
        (joint_zeros("passive", [np.inf, 0, 0, 0, 0, 0]), "zero of joint 1 of the passive arm"),
        (joint_zeros("active", [0, 0, 0, 0, 0, np.inf]), "zero of joint 6 of the active arm"),
    ],
)
def test_what_cannot_be_seen_is_refused_for_freeing(one: Inexact, name: str) -> None:
    cell = reference()
    with pytest.raises(Degenerate, match=name):
        refined(cell.noisy(np.random.default_rng(0), NOISE), cell.knowns, NOISE, inexact=[one])


def test_what_is_free_is_estimated_while_the_others_are_only_reckoned_with() -> None:
    """The mean of 3 chi-squares of 12 has a sigma of 2.8."""
    free = target_mount(np.inf, np.inf)
    found = estimates([free, *ZEROS_SEEN], 3, estimated=False)
    assert normalised(found) == pytest.approx(12, abs=8)
    for _, result in found:
        assert [known.value for known in result.known[6:]] == [0.0] * len(result.known[6:])
        assert [known.sigma for known in result.known[6:]] == [known.prior for known in result.known[6:]]
        assert all(known.value != 0 for known in result.known[:6])


def test_the_mount_that_is_found_is_as_uncertain_as_what_is_only_reckoned_with_makes_it() -> None:
    free, draws = target_mount(np.inf, np.inf), np.random.default_rng(0)
    squares = []
    for _ in range(3):
        cell = off([free, *ZEROS_SEEN], draws)
        data = cell.noisy(draws, NOISE)
        found = refined(data, reference().knowns, NOISE, inexact=[free, *ZEROS_SEEN], estimate_inexact=False)
        error = cell.mount_error(found.knowns.T_F_T)
        squares.append(error @ np.linalg.solve(found.joint_covariance[12:18, 12:18], error))
    assert np.mean(squares) == pytest.approx(6, abs=6)


def test_warnings_are_of_the_covariance_with_the_inexact_knowns_in_it() -> None:
    cell, coarse = reference(), target_mount(0.05, 0.05)
    data = cell.noisy(np.random.default_rng(0), NOISE)
    assert refined(data, cell.knowns, NOISE).warnings == ()
    found = refined(data, cell.knowns, NOISE, inexact=[coarse], estimate_inexact=False)
    assert any(d.sigma > 5e-3 for d in found.directions if d.name.startswith("translation"))
    assert any(words.startswith("uncertain (1 sigma): translation") for words in found.warnings)
    tight = refined(data, cell.knowns, NOISE, inexact=[MOUNT], estimate_inexact=False, observable=Limits(rotation=1e-4))
    assert any(words.startswith("not observable: ") for words in tight.warnings)


def test_contributions_add_up_to_the_covariance() -> None:
    cell = reference()
    data = cell.noisy(np.random.default_rng(0), NOISE)
    plain = refined(data, cell.knowns, NOISE)
    assert set(plain.contributions) == {"pixels", "active joints", "passive joints"}
    np.testing.assert_allclose(sum(plain.contributions.values()), plain.covariance, rtol=1e-6, atol=1e-14)
    reckoned = refined(data, cell.knowns, NOISE, inexact=[MOUNT], estimate_inexact=False)
    np.testing.assert_allclose(sum(reckoned.contributions.values()), reckoned.covariance, rtol=1e-6, atol=1e-14)
    assert np.trace(reckoned.contributions["target mount"]) > 10 * np.trace(plain.covariance)


def test_a_scale_common_to_both_arms_cannot_be_free() -> None:
    with pytest.raises(Degenerate, match="common scale of both arms"):
        common_scale(np.inf)


def test_a_hayati_row_has_a_beta_and_no_d_of_its_own() -> None:
    """The captures show a beta that is off, given the rest."""
    one = link_parameters("passive", PASSIVE, 2e-4, 1e-3)
    assert "beta of row 2 of the passive arm" in one.names
    assert "d of row 2 of the passive arm" not in one.names
    off_by = np.where(np.array(one.names) == "beta of row 2 of the passive arm", 2e-3, 0.0)
    true = one.shifted(reference().knowns, off_by)
    cell = replace(reference(), knowns=true)
    cell = replace(cell, data=replace(cell.data, pixels=cell.seen()))
    alone = replace(one, **_only(one, int(np.argmax(off_by))))
    found = refined(cell.noisy(np.random.default_rng(0), NOISE), reference().knowns, NOISE, inexact=[alone])
    (known,) = found.known
    assert known.seen
    assert known.value == pytest.approx(2e-3, abs=4 * known.sigma)
    assert known.sigma < 3e-4


def _only(one: Inexact, index: int) -> dict[str, Any]:
    def shifted(knowns: Knowns, by: Array) -> Knowns:
        every = np.zeros(len(one.names))
        every[index] = by[0]
        return one.shifted(knowns, every)

    at = slice(index, index + 1)
    return {
        "names": one.names[at],
        "units": one.units[at],
        "sigmas": one.sigmas[at],
        "scale": one.scale[at],
        "shifted": shifted,
    }


class TestFreeLens:
    """Small boards in the middle of the image, which hardly show it."""

    @pytest.mark.parametrize("seed", [1, 5])
    def test_it_is_found_as_exactly_as_is_said_also_with_the_mount(self, seed: int) -> None:
        cell = reference()
        small = replace(cell, knowns=replace(cell.knowns, corners=0.48 * cell.knowns.corners))
        data = replace(cell.data, pixels=small.seen())
        taken = replace(small, data=data).noisy(np.random.default_rng(seed), NOISE)
        found = refined(taken, small.knowns, NOISE, inexact=[free_intrinsics(), target_mount(np.inf, np.inf)])
        error = cell.error(found.T_P_A, found.T_H_E)
        assert error @ np.linalg.solve(found.covariance, error) < 33  # 0.1 % of chi-squares of 12
        assert not any("converged" in words for words in found.warnings)

    def test_what_moves_no_corner_is_said(self) -> None:
        cell = reference()
        small = replace(cell, knowns=replace(cell.knowns, corners=0.48 * cell.knowns.corners))
        taken = replace(small, data=replace(cell.data, pixels=small.seen())).noisy(np.random.default_rng(1), NOISE)
        found = refined(taken, small.knowns, NOISE, inexact=[free_intrinsics()])
        assert "cannot be seen in the captures: k3" in found.warnings


def test_knowns_that_are_not_found_in_time_are_warned_of(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("procedures.estimation.refined.inexact._MOST_STEPS", 1)
    cell = off([LENS], np.random.default_rng(0))
    found = refined(cell.noisy(np.random.default_rng(0), NOISE), reference().knowns, NOISE, inexact=[LENS])
    assert "the estimate has not converged" in found.warnings


HIDDEN = {
    "the zero of joint 1 of the passive arm, against its base": joint_zeros("passive", [1.0] + [0.0] * 5),
    "the zero of joint 1 of the active arm, against its base": joint_zeros("active", [1.0] + [0.0] * 5),
    "the common scale of both arms": common_scale(1.0),
}


@pytest.mark.parametrize("what", HIDDEN)
def test_the_effect_of_what_cannot_be_seen_is_the_error_it_makes(what: str) -> None:
    """Where squares are no better known than the arms, a common scale is as little seen as the others."""
    cell, point = reference(), np.array([[0.5, 0.2, 0.4]])
    by = 1e-3 if "scale" in what else np.radians(0.1)
    true = HIDDEN[what].shifted(cell.knowns, np.array([by]))
    turned = replace(cell, knowns=true)
    if "scale" in what:
        stretched = [transform(T[:3, :3], (1 + by) * T[:3, 3]) for T in (cell.T_P_A, cell.T_H_E, true.T_F_T)]
        larger = replace(true, corners=true.corners * (1 + by), T_F_T=stretched[2])
        turned = replace(turned, knowns=larger, T_P_A=stretched[0], T_H_E=stretched[1])
    taken = replace(turned.data, pixels=turned.seen())
    found = refined(taken, cell.knowns, NOISE)
    assert found.cost < 1e-6
    told = next(one for one in hidden(found, point) if one.what == what)
    held = point * (1 + by) if "scale" in what else point  # an arm that is larger is farther than it reads
    there = apply(inverse(turned.T_P_A), held) - apply(inverse(found.T_P_A), point)
    assert told.error == pytest.approx(np.linalg.norm(there), rel=0.01)


def test_what_cannot_be_seen_is_told_with_its_stated_sigma() -> None:
    cell = reference()
    found = refined(cell.noisy(np.random.default_rng(0), NOISE), cell.knowns, NOISE, inexact=ZEROS)
    told = {one.what: one for one in hidden(found, np.array([[0.5, 0.0, 0.4]]))}
    passive = told["the zero of joint 1 of the passive arm, against its base"]
    assert passive.by == "0.057 deg"
    assert passive.error == pytest.approx(0.5e-3)
