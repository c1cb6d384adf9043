"""The views of one arm fitted once more from a result: fewer of them, or with other sigmas."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.transforms import Array, Mask, inverse
from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.fit import minimise
from procedures.estimation.refined.inexact import Inexact, Known, fit_inexact
from procedures.estimation.refined.model import Model, State
from procedures.estimation.refined.one_arm import OneArm, Views, as_captures


@dataclass(frozen=True)
class Refit:
    """captures: fitted, with their corners in order; state and knowns: where they fit best; known: inexact ones."""

    captures: CaptureArrays
    state: State
    knowns: Knowns
    known: tuple[Known, ...]


def refit(views: Views, result: OneArm, used: Mask, noise: Noise, inexact: Sequence[Inexact]) -> Refit:
    """The views where ``used`` (k,) is True; inexact: estimated anew."""
    data, knowns = as_captures(views, result.placement)
    kept = data.turned(result.flipped).only(used)
    there = replace(knowns, matrix=result.matrix, distortion=result.distortion)
    state = Model(kept, there, noise).state(inverse(result.target), result.camera)
    if not inexact:
        return Refit(kept, minimise(Model(kept, there, noise), state).state, there, ())
    found = fit_inexact(kept, knowns, noise, state, inexact, True)
    return Refit(kept, found.fit.state, found.knowns, found.known)


def corners_alone(result: OneArm) -> Noise:
    """The arm exactly where it was read."""
    return Noise(result.pixel_sigma, 0.0, 0.0)


def both(result: OneArm) -> Noise:
    """What the result was reckoned with."""
    return Noise(result.pixel_sigma, result.arm_sigma, result.arm_sigma)


def residuals_as_read(views: Views, result: OneArm, refitted: Refit) -> Array:
    """(k, n, 2) px of all views, found minus seen, NaN for corners not seen."""
    data, _ = as_captures(views, result.placement)
    model = Model(data.turned(result.flipped), refitted.knowns, both(result))
    state = model.state(refitted.state.T_P_A, refitted.state.T_H_E)
    return np.where(model.seen[..., None], model.residuals(state) * result.pixel_sigma, np.nan)
