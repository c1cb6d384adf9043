"""Captures fitted from an estimate on, with knowns that may be others than those it was made with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Noise
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.fit import Fit, minimise
from procedures.estimation.refined.inexact import Inexact, Known, fit_inexact
from procedures.estimation.refined.model import Model


@dataclass(frozen=True)
class Again:
    """known: what was left to the captures, with sigmas, 0 where it is as the estimate's ``prior`` has it."""

    model: Model
    fit: Fit
    known: tuple[Known, ...] = ()

    @property
    def cost(self) -> float:
        """Least squares in units of sigma, those of what is known beforehand among them."""
        return self.fit.at.cost + sum((one.value / one.prior) ** 2 for one in self.known)


def fit_again(
    result: Refined, captures: CaptureArrays, inexact: Sequence[Inexact] | None = None, noise: Noise | None = None
) -> Again:
    """To captures with their corners in order; inexact, noise: by default the estimate's. Raises Degenerate and
    LinAlgError for captures that do not determine all of it.
    """
    inexact = result.inexact if inexact is None else inexact
    noise = noise or result.noise
    model = Model(captures, result.prior if inexact else result.knowns, noise)
    start = model.state(result.T_P_A, result.T_H_E)
    if inexact:
        found = fit_inexact(captures, result.prior, noise, start, inexact, True)
        again = Again(found.model, found.fit, found.known)
    else:
        again = Again(model, minimise(model, start))
    if not np.isfinite(again.fit.at.cost):
        raise Degenerate("a board should be behind the camera")
    return again
