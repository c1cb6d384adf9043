"""First step of the paper: the rotation between the bases and the optical axis in the flange (section 5.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, rotation_from_vector, skew
from procedures.estimation.degenerate import Degenerate

CONVERGED = 1e-10

# The alternation converges linearly, the slower the weaker the set. Measured: 13 iterations for the reference,
# some 400 at a conditioning of 0.1, 7,000 and more for a fan at 0.02. Where it has not ended by then, Gauss-Newton
# steps on the same least-squares problem finish it (measured: at most 10 more, for a fan 15).
MOST_ALTERNATIONS = 100
MOST_JOINT_STEPS = 50


@dataclass(frozen=True)
class Iteration:
    """One turn of steps 2 to 5, or one joint step.

    rotation_update: ||R(t+1) - R(t)|| (Frobenius); axis_update: ||z(t+1) - z(t)||; rotation_error (3,): the
    paper's w accumulated since the nominal, sin(theta) v of ``R_A_P_nominal^T R_A_P``; optical_axis (3,): z_H_E.
    """

    rotation_update: float
    axis_update: float
    rotation_error: Array
    optical_axis: Array


@dataclass(frozen=True)
class RotationStep:
    """R_P_A (3, 3), z_H_E (3,), and how they were reached.

    singular_values (5,): of eq. 3 linearised jointly in the rotation (3) and the optical axis (2), per constraint
    (the Jacobian is divided by sqrt(n)); uncertainty: sigma of the weakest of the five directions (rad), from
    what the fit leaves.
    """

    R_P_A: Array
    z_H_E: Array
    iterations: tuple[Iteration, ...]
    singular_values: Array
    uncertainty: float


def estimate_rotation(directions: Array, R_A_H: Array, R_P_A: Array, z_H_E: Array) -> RotationStep:
    """Least squares of eq. 1 by the paper's alternation between optical axis and rotation (eqs. 24 to 33).

    directions: measured optical axes mu_k in P (n, 3), unit; R_A_H (n, 3, 3); R_P_A (3, 3) and z_H_E (3,)
    are the nominal values. Differs from the print where the print is wrong: eq. 25 adds the mean, eq. 29
    is ``-[mu x]``. It ends when an update of the rotation is below 1e-10; raises Degenerate if none is.
    """
    nominal = R_A_P = R_P_A.T
    pseudo_inverse = np.asarray(np.linalg.pinv(-skew(directions).reshape(-1, 3)), dtype=float)
    history: list[Iteration] = []
    for t in range(MOST_ALTERNATIONS + MOST_JOINT_STEPS):
        if t < MOST_ALTERNATIONS:
            updated, z = _alternate(directions, R_A_H, R_A_P, z_H_E, pseudo_inverse)
        else:
            updated, z = _step_jointly(directions, R_A_H, R_A_P, z_H_E)
        turned = nominal.T @ updated
        history.append(
            Iteration(
                rotation_update=float(np.linalg.norm(updated - R_A_P)),
                axis_update=float(np.linalg.norm(z - z_H_E)),
                rotation_error=_vee(turned - turned.T) / 2,
                optical_axis=z,
            )
        )
        R_A_P, z_H_E = updated, z
        if history[-1].rotation_update < CONVERGED:
            return _report(directions, R_A_H, R_A_P, z_H_E, tuple(history))
    raise Degenerate(
        f"the rotation does not converge: it still changes by {history[-1].rotation_update:.1e}"
        f" after {len(history)} iterations"
    )


def _alternate(
    directions: Array, R_A_H: Array, R_A_P: Array, z_H_E: Array, pseudo_inverse: Array
) -> tuple[Array, Array]:
    dz = np.einsum("kji,kj->ki", R_A_H, directions @ R_A_P.T) - z_H_E  # eq. 24
    z = z_H_E + dz.mean(axis=0)  # eq. 25
    z /= np.linalg.norm(z)
    residual = (R_A_H @ z) @ R_A_P - directions  # eq. 27
    return R_A_P @ _rotation_from_sine(pseudo_inverse @ residual.ravel()), z  # eqs. 31 to 33


def _step_jointly(directions: Array, R_A_H: Array, R_A_P: Array, z_H_E: Array) -> tuple[Array, Array]:
    axes = R_A_H @ z_H_E
    tangent = _tangent(z_H_E)
    step = np.linalg.lstsq(_joint_jacobian(R_A_H, z_H_E), (directions @ R_A_P.T - axes).ravel())[0]
    z = z_H_E + tangent @ step[3:]
    return rotation_from_vector(step[:3]) @ R_A_P, z / np.linalg.norm(z)


def _joint_jacobian(R_A_H: Array, z_H_E: Array) -> Array:
    """Of the axes ``R_A_H z`` in A against ``R_A_P mu``: (3n, 5) for a turn of R_A_P from the left, then for z."""
    return np.concatenate([skew(R_A_H @ z_H_E), R_A_H @ _tangent(z_H_E)], axis=2).reshape(-1, 5)


def _tangent(z: Array) -> Array:
    return np.asarray(np.linalg.svd(z[None])[2][1:].T)


def _report(
    directions: Array, R_A_H: Array, R_A_P: Array, z_H_E: Array, iterations: tuple[Iteration, ...]
) -> RotationStep:
    n = len(directions)
    singular_values = np.linalg.svd(_joint_jacobian(R_A_H, z_H_E) / np.sqrt(n), compute_uv=False)
    # A direction has two components, so 2n - 5 are left over.
    sigma = np.linalg.norm(directions @ R_A_P.T - R_A_H @ z_H_E) / np.sqrt(2 * n - 5)
    with np.errstate(divide="ignore"):
        uncertainty = float(sigma / (np.sqrt(n) * singular_values[-1]))
    return RotationStep(R_A_P.T, z_H_E, iterations, np.asarray(singular_values), uncertainty)


def _rotation_from_sine(w: Array) -> Array:
    """The rotation by arcsin|w| about w (eq. 32). A bad start asks for |w| > 1: then a quarter turn."""
    sine = float(np.linalg.norm(w))
    if sine == 0.0:
        return np.eye(3)
    return rotation_from_vector(np.arcsin(min(sine, 1.0)) * w / sine)


def _vee(S: Array) -> Array:
    return np.array([S[2, 1], S[0, 2], S[1, 0]])
