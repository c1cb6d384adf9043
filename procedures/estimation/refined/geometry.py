"""Whether the active flange was turned enough for the captures to say anything."""

from __future__ import annotations

import numpy as np

from dualcal_hal.transforms import Array
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import Words

# How far, rms, that axis wanders between the arrivals about which the flanges turn most nearly. Flanges turned about
# one axis or not at all come to 6e-4 with 0.3 mrad of noise; with 5 degrees about a second axis to 0.039 at least.
ONE_AXIS = 0.005  # rad
NOISE = 6  # times the sigma of a joint, where that is more

PARALLEL = 0.02  # rad between optical axes, as seen by each arrival alone

WEAK = 0.08  # rad; below it the second axis has less than some 10 degrees


def refuse_few(arrivals: int) -> None:
    """Raises Degenerate for fewer than three."""
    if arrivals < 3:
        count = f"{arrivals} arrival{'s' if arrivals != 1 else ''}"
        raise Degenerate(f"{count} of the active arm with captures that can be used, at least 3 are needed")


def refuse_one_axis(T_A_H: Array, optical_axes: Array, joint: float, words: Words) -> tuple[str, ...]:
    """Raises Degenerate unless the flanges of the arrivals (a, 4, 4) turn about two axes; warnings if they hardly do.

    optical_axes (b, 3): directions in P, as far as known; joint: sigma of the active arm's, rad.
    """
    flange = words.flange
    refuse_few(len(T_A_H))
    limit = max(ONE_AXIS, NOISE * joint)
    off = T_A_H[:, :3, :3] - T_A_H[:, :3, :3].mean(axis=0)
    values = np.linalg.eigvalsh(np.einsum("kia,kib->ab", off, off) / len(off))
    wander = np.sqrt(np.maximum(values, 0.0))
    if ONE_AXIS < wander[2] < limit:
        raise Degenerate(
            f"a joint noise of {1e3 * joint:.4g} mrad (1 sigma) hides how the {flange} turns: see that the joint sigma"
            f" is right, or turn the {flange} further"
        )
    if wander[2] < limit:
        raise Degenerate(f"the {flange} always has the same orientation: it was only shifted")
    if ONE_AXIS < wander[0] < limit:
        raise Degenerate(
            f"the {flange} is off by {1e3 * joint:.3g} mrad, hardly less than it turns about a second axis"
        )
    if wander[0] < limit:
        if _orientations(T_A_H[:, :3, :3], limit) < 3:
            raise Degenerate(f"the {flange} has only two orientations, at least 3 are needed")
        apart = optical_axes - np.median(optical_axes, axis=0)
        if len(apart) > 1 and np.median(np.linalg.norm(apart, axis=1)) < PARALLEL:
            raise Degenerate("the optical axes of all arrivals are parallel")
        raise Degenerate(f"the {flange} was turned about one axis only")
    if wander[0] < WEAK:
        degrees = np.degrees(2 * wander[0])
        return (
            f"weak: the {flange} turns by about {degrees:.0f} deg about a second axis; "
            f"{words.captures} with at least 30 deg about two axes would help",
        )
    return ()


def _orientations(R: Array, limit: float) -> int:
    """How many there are that differ by more than the limit."""
    found: list[Array] = []
    for rotation in R:
        if all(np.linalg.norm(rotation - other) > 2 * limit for other in found):
            found.append(rotation)
    return len(found)
