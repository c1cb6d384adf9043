"""What no capture can show: what is listed is what the estimator's own Jacobian does not see, and all of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dualcal_hal.transforms import Array
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined import (
    CaptureArrays,
    Inexact,
    Knowns,
    Refined,
    joint_zeros,
    link_parameters,
    refined,
    target_mount,
)
from procedures.estimation.refined.hidden import hidden
from procedures.estimation.refined.inexact import by_inexact
from procedures.estimation.refined.model import Model
from tools.benchmarks.refined import NOISES, Cell, reference

NOISE = NOISES[0]
POINT = np.array([[0.5, 0.2, 0.4]])
FREE_MOUNT = target_mount(np.inf, np.inf)
OF_BASES = {f"{what} 1 of the {arm} arm" for what in ("zero of joint", "d of row") for arm in ("active", "passive")}
ACTIVE_ROW, PASSIVE_ROW = (
    {f"{what} 6 of the {arm} arm" for what in ("zero of joint", "d of row", "a of row", "alpha of row")}
    for arm in ("active", "passive")
)


def parameters(cell: Cell) -> list[Inexact]:
    """All 48 of both arms."""
    arms = {"active": cell.knowns.active, "passive": cell.knowns.passive}
    return [
        *(joint_zeros(name, [1.0] * arm.joints) for name, arm in arms.items()),
        *(link_parameters(name, arm, 1.0, 1.0) for name, arm in arms.items()),
    ]


def alone(one: Inexact, name: str) -> Inexact:
    """A single number of several."""
    which = np.array(one.names) == name

    def shifted(knowns: Knowns, by: Array) -> Knowns:
        return one.shifted(knowns, np.where(which, by[0], 0.0))

    at = int(np.flatnonzero(which)[0])
    return Inexact(name, (name,), (one.units[at],), np.array([np.inf]), one.scale[at : at + 1], shifted)


def anywhere(cell: Cell) -> Cell:
    """Captures at random joint angles, all corners in front of the camera."""
    rng, data = np.random.default_rng(0), cell.data
    near = np.repeat(np.arange(len(data)), 4)
    moved = CaptureArrays(
        active=data.active[near] + rng.normal(0, 0.3, (len(near), 6)),
        passive=data.passive[near] + rng.normal(0, 0.3, (len(near), 6)),
        arrivals=np.arange(len(near)),
        pixels=data.pixels[near],
    )
    pixels = replace(cell, data=moved).seen()
    inside = np.isfinite(pixels).all(axis=(1, 2)) & (np.abs(pixels).max(axis=(1, 2), initial=0.0) < 5000)
    return replace(cell, data=replace(moved, pixels=pixels).only(inside))


def taken_up(cell: Cell, others: list[Inexact]) -> set[str]:
    """The parameters of the arms whose column of the Jacobian is one of motions of T_P_A, of T_H_E and of the others'
    numbers.
    """
    model = Model(cell.data, cell.knowns, NOISE)
    state = model.state(cell.T_P_A, cell.T_H_E)
    towards_cell = model.linearised(state).towards_cell[model.arrival]
    taking = np.concatenate(
        [model.jacobian(state) @ towards_cell, by_inexact(cell.data, cell.knowns, NOISE, others, state)], axis=-1
    )
    axes, _ = np.linalg.qr(taking.reshape(-1, taking.shape[-1]))
    every = parameters(cell)
    columns = by_inexact(cell.data, cell.knowns, NOISE, every, state).reshape(len(axes), -1)
    left = columns - axes @ (axes.T @ columns)
    share = np.linalg.norm(left, axis=0) / np.linalg.norm(columns, axis=0)
    assert not np.any((share > 1e-6) & (share < 0.05))  # nothing is hardly seen: the question has an answer
    names = [name for one in every for name in one.names]
    assert len(names) == 48
    return {names[i] for i in np.flatnonzero(share <= 1e-6)}


def listed(result: Refined) -> set[str]:
    """What is told, but the scale, which is no parameter of one arm."""
    told = [one.what.removeprefix("the ").rsplit(", against")[0] for one in hidden(result, POINT)]
    assert told[-1] == "common scale of both arms"
    return set(told[:-1])


def estimated(*inexact: Inexact) -> Refined:
    cell = reference()
    return refined(cell.noisy(np.random.default_rng(0), NOISE), cell.knowns, NOISE, inexact=inexact)


@pytest.fixture(scope="module")
def result() -> Refined:
    return estimated()


def test_what_is_listed_is_what_the_transforms_take_up(result: Refined) -> None:
    assert taken_up(anywhere(reference()), []) == OF_BASES | ACTIVE_ROW
    assert listed(result) == OF_BASES | ACTIVE_ROW


def test_a_mount_that_is_free_takes_up_the_last_row_of_the_passive_arm_too() -> None:
    assert taken_up(anywhere(reference()), [FREE_MOUNT]) == OF_BASES | ACTIVE_ROW | PASSIVE_ROW
    assert listed(estimated(FREE_MOUNT)) == OF_BASES | ACTIVE_ROW | PASSIVE_ROW


def test_of_a_hayati_row_it_is_the_parameters_that_this_has(result: Refined) -> None:
    cell = reference()
    rows = cell.knowns.active.rows
    tilted = replace(cell.knowns.active, rows=(*rows[:5], replace(rows[5], d=0.0, beta=0.02)))
    other = replace(cell, knowns=replace(cell.knowns, active=tilted))
    of_row = ACTIVE_ROW - {"d of row 6 of the active arm"} | {"beta of row 6 of the active arm"}
    assert taken_up(anywhere(other), []) == OF_BASES | of_row
    assert listed(replace(result, knowns=other.knowns)) == OF_BASES | of_row


@pytest.mark.parametrize("name", ["zero of joint 6", "d of row 6", "a of row 6", "alpha of row 6"])
def test_the_effect_of_the_last_row_is_how_far_the_camera_is_told_from_where_it_is(result: Refined, name: str) -> None:
    """Captures of an arm that has the error, estimated as if it had none."""
    cell, name = reference(), f"{name} of the active arm"
    one = next(one for one in parameters(cell) if name in one.names)
    by = 1e-3 if name.startswith(("d", "a of")) else np.radians(0.1)
    true = replace(cell, knowns=alone(one, name).shifted(cell.knowns, np.array([by])))
    found = refined(replace(true.data, pixels=true.seen()), cell.knowns, NOISE)
    assert found.cost < 1e-6
    told = next(entry for entry in hidden(found, POINT) if name in entry.what)
    assert told.error == pytest.approx(np.linalg.norm(found.T_H_E[:3, 3] - cell.T_H_E[:3, 3]), rel=0.01)
    assert told.by == ("1 mm" if by == 1e-3 else "0.1 deg")


@pytest.mark.parametrize("name", sorted(OF_BASES | ACTIVE_ROW))
def test_none_of_it_can_be_free(name: str) -> None:
    one = next(one for one in parameters(reference()) if name in one.names)
    with pytest.raises(Degenerate, match=f"cannot be free: {name}"):
        estimated(alone(one, name))
