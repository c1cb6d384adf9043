"""Each view predicted by an estimate that did not see it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, apply, inverse
from procedures.estimation.projection import project, undistort
from procedures.estimation.refined.data import CaptureArrays, Knowns
from procedures.estimation.refined.inexact import Inexact
from procedures.estimation.refined.one_arm import OneArm, Views, as_captures
from procedures.estimation.refined.refit import both, corners_alone, refit

MOST_FITS = 25


@dataclass(frozen=True)
class LeftOut:
    """pixels (k, n, 2): px, predicted minus seen; at_target (k, n), m: from a predicted corner straight to the line of
    sight of the one that was seen. NaN for corners not seen.
    """

    pixels: Array
    at_target: Array

    def rms(self) -> tuple[Array, Array]:
        """(k,) px per axis and (k,) m, of each view; NaN for a view without a corner."""
        count = np.isfinite(self.at_target).sum(axis=1)
        squares = np.nansum(self.pixels**2, axis=(1, 2)), np.nansum(self.at_target**2, axis=1)
        count = np.where(count > 0, count, np.nan)
        return np.sqrt(squares[0] / (2 * count)), np.sqrt(squares[1] / count)


def leave_one_out(views: Views, result: OneArm, inexact: Sequence[Inexact] = ()) -> LeftOut:
    """From the result of ``one_arm`` or ``fit_as_read``, with the same ``inexact`` if they were estimated.

    Views that share the arm's error are left out together, and of more than MOST_FITS several at a time, so that time
    stays linear in them. Views that were dropped are predicted too.
    """
    data = as_captures(views, result.placement)[0].turned(result.flipped)
    noise = corners_alone(result) if result.as_read else both(result)
    pixels, at_target = np.full(data.pixels.shape, np.nan), np.full(data.pixels.shape[:2], np.nan)
    number = np.arange(len(views))
    stop = np.unique(data.arrivals, return_inverse=True)[1]
    for fold in range(min(int(stop.max()) + 1, MOST_FITS)):
        left = stop % MOST_FITS == fold
        fitted = refit(views, result, result.used & ~left, noise, inexact)
        for view in np.flatnonzero(left & np.any(views.seen, axis=1)):
            one = predicted(data.only(number == view), fitted.knowns, fitted.state.T_P_A, fitted.state.T_H_E)
            pixels[view], at_target[view] = one.pixels[0], one.at_target[0]
    return LeftOut(pixels, at_target)


def predicted(views: CaptureArrays, knowns: Knowns, T_P_A: Array, T_H_E: Array) -> LeftOut:
    """Views with the arm where it was read, by transforms (4, 4) that come from elsewhere."""
    every = (_predicted(views.only(np.arange(len(views)) == k), knowns, T_P_A, T_H_E) for k in range(len(views)))
    pixels, at_target = zip(*every, strict=True)
    return LeftOut(np.stack(pixels), np.stack(at_target))


def _predicted(view: CaptureArrays, knowns: Knowns, T_P_A: Array, T_H_E: Array) -> tuple[Array, Array]:
    """Of one view (n, 2), px, and (n,), m."""
    T_E_T = inverse(T_P_A @ knowns.active.forward(view.active[0]) @ T_H_E)
    points, seen = apply(T_E_T, knowns.corners), view.pixels[0]
    off = project(points, knowns.matrix, knowns.distortion) - seen
    there = np.isfinite(seen).all(axis=1)
    sight = np.ones((len(points), 3))
    sight[:, :2] = undistort(np.where(there[:, None], seen, knowns.matrix[:2, 2]), knowns.matrix, knowns.distortion)
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    across = np.linalg.norm(np.cross(points, sight), axis=1)
    return off, np.where(there, across, np.nan)
