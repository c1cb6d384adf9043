"""Camera and target where they fit the corners best with the arm exactly where it was read.

A fit that may move the poses of the arm takes for theirs what is off in the lens or on the board, and then believes the
poses little where the corners show them well. Least squares over the corners alone does not. Its covariance is that of
this estimate under the noise of both, corners and poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from dualcal_hal.transforms import Array, inverse
from procedures.estimation.refined.inexact import Inexact
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.one_arm import OneArm, Views, camera_and_target
from procedures.estimation.refined.refit import Refit, both, corners_alone, refit, residuals_as_read
from procedures.estimation.refined.uncertainty import Limits, condition, directions

_STEP = 1e-5  # of the differences, in units of what counts as a small change


def fit_as_read(
    views: Views, result: OneArm, inexact: Sequence[Inexact] = (), observable: Limits | None = None
) -> OneArm:
    """From the result of ``one_arm``: of the views that it used, with its noise, and ``inexact`` estimated anew."""
    fitted = refit(views, result, result.used, corners_alone(result), inexact)
    information, parts = _covariances(fitted, result, inexact)
    total = sum(parts.values(), np.zeros_like(information))
    M = camera_and_target(fitted.state.T_P_A)
    contributions = {what: M @ part[:CELL, :CELL] @ M.T for what, part in parts.items()}
    covariance = sum(contributions.values(), np.zeros((CELL, CELL)))
    return replace(
        result,
        camera=fitted.state.T_H_E,
        target=inverse(fitted.state.T_P_A),
        covariance=covariance,
        directions=directions(covariance, observable or Limits(), ("camera", "target")),
        condition=condition(information[:CELL, :CELL]),
        residuals=residuals_as_read(views, result, fitted),
        matrix=fitted.knowns.matrix,
        distortion=fitted.knowns.distortion,
        known=tuple(
            replace(known, sigma=float(sigma))
            for known, sigma in zip(fitted.known, np.sqrt(np.diag(total))[CELL:], strict=True)
        ),
        contributions=contributions,
        as_read=True,
    )


def _covariances(fitted: Refit, result: OneArm, inexact: Sequence[Inexact]) -> tuple[Array, dict[str, Array]]:
    """Information on the cell and the inexact knowns (12 + m, 12 + m) if corners alone were noisy; and by what noise
    their estimate is off, (12 + m, 12 + m) each.

    With D the derivatives of the corners, white noise in them, P what a sigma of the arm does to them, and N = D^T D:
    N^-1 D^T (1 + P P^T) D N^-1.
    """
    model = Model(fitted.captures, fitted.knowns, both(result))
    at, J = model.linearised(fitted.state), model.jacobian(fitted.state)
    D = np.concatenate([J @ at.towards_cell[model.arrival], *_by_inexact(fitted, result, inexact)], axis=2)
    priors = np.concatenate([np.zeros(CELL), *(1 / one.sigmas**2 for one in inexact)])
    N = np.einsum("kri,krj->ij", D, D) + np.diag(priors)
    spread = np.linalg.inv(N)
    of_arm = np.swapaxes(D, 1, 2) @ (J @ at.towards_active[model.arrival])
    return N, {"pixels": spread, "arm": spread @ np.einsum("kia,kja->ij", of_arm, of_arm) @ spread}


def _by_inexact(fitted: Refit, result: OneArm, inexact: Sequence[Inexact]) -> Iterator[Array]:
    """(k, 2n, .): of the corners in units of sigma, by each of the inexact knowns."""
    for one in inexact:
        columns = []
        for step in np.diag(_STEP * one.scale):
            ends = (
                Model(fitted.captures, one.shifted(fitted.knowns, by), both(result)).residuals(fitted.state)
                for by in (step, -step)
            )
            columns.append(np.subtract(*ends).reshape(len(fitted.captures), -1) / (2 * step.sum()))
        yield np.stack(columns, axis=-1)
