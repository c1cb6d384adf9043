"""AXB = YCZ by maximum likelihood: X, Y, Z and what A and C truly were, B following from them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualcal_hal.transforms import Array, inverse, rotation_from_vector, skew
from procedures.estimation.refined.motion import adjoint, motion_between, moved
from procedures.estimation.triples.closed_form import Solution

UNKNOWNS = 18
"""Motions of X, then Y, then Z, [translation in m; rotation in rad] in the child frame of each."""

MOST_STEPS = 60
_MOST_DAMPING = 1e10
_LEAST_DAMPING = 1e-9

# In units of sigma squared; the next step would gain the square of it.
_SMALLEST_GAIN = 1e-6

_LEAST_CERTAIN = 4  # of the eigenvectors


@dataclass(frozen=True)
class Measured:
    """A, B, C (n, 4, 4) as measured, and what their errors are made of: roots (n or 1, 6, 6) with root root^T the
    covariance of A's and C's, covariance_B (n or 1, 6, 6), all of motions in the child frames.
    """

    A: Array
    B: Array
    C: Array
    root_A: Array
    root_C: Array
    covariance_B: Array
    precision_B: Array

    def some(self, indices: NDArray[np.intp]) -> Measured:
        """Those triples alone."""
        of_each = (self.root_A, self.root_C, self.covariance_B, self.precision_B)
        return Measured(
            self.A[indices],
            self.B[indices],
            self.C[indices],
            *(each[indices] if len(each) == len(self.A) else each for each in of_each),
        )


@dataclass(frozen=True)
class State:
    """errors (n, 12) of A, then C, in units of their roots."""

    solution: Solution
    errors: Array


@dataclass(frozen=True)
class Linearised:
    """normal (18, 18) with the errors marginalised; squares (n,): the cost of each triple, about chi-square of 6."""

    cost: float
    normal: Array
    gradient: Array
    squares: Array
    towards_unknowns: Array
    towards_errors: Array
    offset: Array
    solved: Array


def minimise(measured: Measured, start: Solution, most_steps: int = MOST_STEPS) -> tuple[State, Linearised, bool]:
    """Levenberg-Marquardt; the last tells whether it converged.

    A step is damped in X, Y, Z alone: the errors of A and C are their best for it, to first order.
    """
    state = State(start, np.zeros((len(measured.A), 12)))
    at = linearised(measured, state)
    cost, damping = _cost(measured, state), 1e-4
    for _ in range(most_steps):
        scale = np.diag(at.normal) + 1e-12 * np.trace(at.normal)
        change = np.asarray(np.linalg.solve(at.normal + damping * np.diag(scale), -at.gradient), dtype=float)
        tried = _stepped(state, at, change)
        tried_cost = _cost(measured, tried)
        gain = cost - tried_cost
        if gain >= -1e-9 * cost:
            state, cost, damping = tried, tried_cost, max(damping / 10, _LEAST_DAMPING)
            at = linearised(measured, state)
            if gain < _SMALLEST_GAIN * max(1.0, 1e-3 * cost) and damping < 1e-2:
                return state, at, True
        else:
            damping *= 10
            if not damping < _MOST_DAMPING:
                break
    return state, at, False


def linearised(measured: Measured, state: State) -> Linearised:
    X, Y, Z = state.solution.X, state.solution.Y, state.solution.Z
    A, C = _true_flanges(measured, state)
    CZ = C @ Z
    YCZ = Y @ CZ
    B = inverse(A @ X) @ YCZ
    r = motion_between(measured.B, B)
    # How B moves in its own frame when X, Y, Z and A, C move in theirs.
    of_X, of_Y, of_Z = -adjoint(inverse(B)), adjoint(inverse(CZ)), np.broadcast_to(np.eye(6), (len(B), 6, 6))
    of_A, of_C = -adjoint(inverse(X @ B)), adjoint(inverse(Z))
    of_B = _of_motion(r, inverted=True)
    a, c = _errors(measured, state)
    J = of_B @ np.concatenate([of_X, of_Y, of_Z], axis=2)
    J_errors = of_B @ np.concatenate(
        [of_A @ _of_motion(a) @ measured.root_A, of_C @ _of_motion(c) @ measured.root_C], axis=2
    )
    offset = r - (J_errors @ state.errors[:, :, None])[:, :, 0]
    S = measured.covariance_B + J_errors @ np.swapaxes(J_errors, 1, 2)
    solved = np.linalg.solve(S, np.concatenate([J, offset[:, :, None]], axis=2))
    both = np.concatenate([J, offset[:, :, None]], axis=2).reshape(-1, UNKNOWNS + 1).T @ solved.reshape(
        -1, UNKNOWNS + 1
    )
    squares = np.einsum("ni,ni->n", offset, solved[:, :, -1])
    normal = (both[:-1, :-1] + both[:-1, :-1].T) / 2
    return Linearised(float(squares.sum()), normal, both[:-1, -1], squares, J, J_errors, offset, solved)


def rise_by_one_sigma(measured: Measured, state: State, at: Linearised) -> float:
    """The most that one sigma along the least certain directions raises the cost: 1 if the model is linear so far."""
    scale = np.sqrt(np.diag(at.normal))
    values, vectors = np.linalg.eigh(at.normal / np.outer(scale, scale))
    sigmas = (vectors[:, :_LEAST_CERTAIN] / np.sqrt(values[:_LEAST_CERTAIN]) / scale[:, None]).T
    return max(_cost(measured, _stepped(state, at, step)) for step in (*sigmas, *-sigmas)) - at.cost


def _cost(measured: Measured, state: State) -> float:
    A, C = _true_flanges(measured, state)
    solution = state.solution
    r = motion_between(measured.B, inverse(A @ solution.X) @ solution.Y @ C @ solution.Z)
    return float(np.sum(state.errors**2) + np.sum(r[:, :, None] * (measured.precision_B @ r[:, :, None])))


def _stepped(state: State, at: Linearised, change: Array) -> State:
    x, y, z = change.reshape(3, 6)
    solution = state.solution
    e = at.solved[:, :, -1] + at.solved[:, :, :-1] @ change
    errors = -(np.swapaxes(at.towards_errors, 1, 2) @ e[:, :, None])[:, :, 0]
    return State(Solution(moved(solution.X, x), moved(solution.Y, y), moved(solution.Z, z)), errors)


def _errors(measured: Measured, state: State) -> tuple[Array, Array]:
    a = measured.root_A @ state.errors[:, :6, None]
    c = measured.root_C @ state.errors[:, 6:, None]
    return a[:, :, 0], c[:, :, 0]


def _true_flanges(measured: Measured, state: State) -> tuple[Array, Array]:
    a, c = _errors(measured, state)
    return moved(measured.A, a), moved(measured.C, c)


def _of_motion(motion: Array, *, inverted: bool = False) -> Array:
    """(n, 6, 6): by what the frame moves, in itself, when the motion (n, 6) that brought it there changes; or the
    inverse of that. With the right Jacobian of SO(3) (Sola, Deray, Atchuthan, "A micro Lie theory for state
    estimation in robotics", eqs. 143 and 144).
    """
    w = motion[:, 3:]
    S = skew(w)
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    safe = np.maximum(angle, 1e-4)
    R = rotation_from_vector(w)
    J = np.zeros((len(motion), 6, 6))
    if inverted:
        square = np.where(angle > 1e-4, (1 - safe / 2 / np.tan(safe / 2)) / safe**2, 1 / 12)
        J[:, :3, :3], J[:, 3:, 3:] = R, np.eye(3) + S / 2 + square * (S @ S)
    else:
        first = np.where(angle > 1e-4, (1 - np.cos(safe)) / safe**2, 1 / 2)
        second = np.where(angle > 1e-4, (safe - np.sin(safe)) / safe**3, 1 / 6)
        J[:, :3, :3], J[:, 3:, 3:] = np.swapaxes(R, 1, 2), np.eye(3) - first * S + second * (S @ S)
    return J
