"""Camera and target where they fit the corners best with the arm exactly where it was read.

A fit that may move the poses of the arm takes for theirs what is off in the lens or on the board, and then believes the
poses little where the corners show them well. Least squares over the corners alone does not.

How far it is off follows from the noise that its residuals show. What no pose of a view explains is noise of the
corners; what remains is taken for the arm's, as much of it as makes the residuals as large as they are. The likelihood
would weigh residuals by how well a view shows them, and so find in a bent lens an arm that is off by centimetres.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.transforms import Array, inverse
from procedures.estimation.refined.data import Noise
from procedures.estimation.refined.inexact import Inexact
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.one_arm import OneArm, Views, camera_and_target
from procedures.estimation.refined.refit import Refit, corners_alone, refit, residuals_as_read
from procedures.estimation.refined.uncertainty import Limits, condition, directions

_STEP = 1e-5  # of the differences, in units of what counts as a small change
_UNIT = Noise(1.0, 1.0, 1.0)
_LEAST = 1e-4  # px: no corner is told better
_FEWEST = 3.0  # degrees of freedom that are reckoned with


@dataclass(frozen=True)
class _Spread:
    """pixel, px, and arm, rad: sigmas; information (12 + m, 12 + m) on camera, target and inexact knowns if only
    corners were noisy; parts: by what noise their estimate is off, (12 + m, 12 + m) each.
    """

    pixel: float
    arm: float
    information: Array
    parts: dict[str, Array]


def fit_as_read(
    views: Views, result: OneArm, inexact: Sequence[Inexact] = (), observable: Limits | None = None
) -> OneArm:
    """From the result of ``one_arm``, of the views that it used; ``inexact`` and both sigmas are estimated anew."""
    fitted = refit(views, result, result.used, corners_alone(result), inexact)
    spread = _spread(fitted, inexact)
    total = sum(spread.parts.values(), np.zeros_like(spread.information))
    M = camera_and_target(fitted.state.T_P_A)
    contributions = {what: M @ part[:CELL, :CELL] @ M.T for what, part in spread.parts.items()}
    covariance = sum(contributions.values(), np.zeros((CELL, CELL)))
    return replace(
        result,
        camera=fitted.state.T_H_E,
        target=inverse(fitted.state.T_P_A),
        covariance=covariance,
        directions=directions(covariance, observable or Limits(), ("camera", "target")),
        condition=condition(spread.information[:CELL, :CELL]),
        residuals=residuals_as_read(views, result, fitted),
        pixel_sigma=spread.pixel,
        arm_sigma=spread.arm,
        matrix=fitted.knowns.matrix,
        distortion=fitted.knowns.distortion,
        known=tuple(
            replace(known, sigma=float(sigma))
            for known, sigma in zip(fitted.known, np.sqrt(np.diag(total))[CELL:], strict=True)
        ),
        contributions=contributions,
        as_read=True,
    )


def _spread(fitted: Refit, inexact: Sequence[Inexact]) -> _Spread:
    """With D the derivatives of the corners, P what a unit of the arm's errors does to them, N = D^T D, H = D N^-1 D^T:
    of white noise p and the arm's s the estimate is off by N^-1 D^T (p^2 + s^2 P P^T) D N^-1, and the squares of the
    residuals come to p^2 (count - unknowns) + s^2 trace(G), G = P^T (1 - H) P.

    What is found for s^2 scatters like a chi-square of trace(G)^2 / trace(G^2) degrees of freedom (Satterthwaite, "An
    approximate distribution of estimates of variance components", 1946); the covariance is widened for that, as
    Student's distribution is wider than the normal one.
    """
    model = Model(fitted.captures, fitted.knowns, _UNIT)
    at, J = model.linearised(fitted.state), model.jacobian(fitted.state)
    r = model.residuals(fitted.state).reshape(model.captures, -1)
    D = np.concatenate([J @ at.towards_cell[model.arrival], *_by_inexact(fitted, inexact)], axis=2)
    P = J @ at.towards_active[model.arrival]
    U, values, _ = np.linalg.svd(P, full_matrices=False)
    explained = np.where(values > 1e-9 * values[:, :1], np.einsum("kri,kr->ki", U, r), 0.0)
    alone = np.sum(r**2) - np.sum(explained**2)
    count = (
        model.measurements - np.minimum(model.freedom, np.count_nonzero(values > 1e-9 * values[:, :1], axis=1)).sum()
    )
    pixel = max(np.sqrt(max(alone, 0.0) / max(count, 1)), _LEAST)

    priors = np.concatenate([np.zeros(CELL), *(1 / (one.sigmas / pixel) ** 2 for one in inexact)])
    N = np.einsum("kri,krj->ij", D, D) + np.diag(priors)
    spread = np.linalg.inv(N)
    of_arm = np.einsum("kri,kra->kia", D, P)
    M = np.einsum("kia,kja->ij", of_arm, of_arm)
    excess = np.sum(r**2) - pixel**2 * (model.measurements - len(N))
    S, trace = np.swapaxes(P, 1, 2) @ P, np.sum(P**2) - np.trace(spread @ M)
    across = np.einsum("kia,ij,kjb->kab", of_arm, spread, of_arm)
    trace_of_square = np.sum(S**2) - 2 * np.sum(S * across) + np.sum((spread @ M) * (spread @ M).T)
    arm = float(np.sqrt(max(excess, 0.0) / max(trace, 1e-300)))
    freedom = max(trace**2 / max(trace_of_square, 1e-300), _FEWEST)
    widened = arm**2 * freedom / (freedom - 2)
    parts = {"pixels": pixel**2 * spread, "arm": widened * spread @ M @ spread}
    return _Spread(float(pixel), arm, N / pixel**2, parts)


def _by_inexact(fitted: Refit, inexact: Sequence[Inexact]) -> Iterator[Array]:
    """(k, 2n, .): of the corners in px, by each of the inexact knowns."""
    for one in inexact:
        columns = []
        for step in np.diag(_STEP * one.scale):
            ends = (
                Model(fitted.captures, one.shifted(fitted.knowns, by), _UNIT).residuals(fitted.state)
                for by in (step, -step)
            )
            columns.append(np.subtract(*ends).reshape(len(fitted.captures), -1) / (2 * step.sum()))
        yield np.stack(columns, axis=-1)
