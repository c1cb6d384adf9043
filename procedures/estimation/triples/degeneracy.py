"""Triples that do not determine X, Y and Z, and why."""

from __future__ import annotations

import numpy as np

from dualcal_hal.transforms import Array, rotation_angle
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.triples.noise import TripleNoise

FEWEST_TRIPLES = 4
"""Three have as many equations as unknowns: several solutions fit them, and nothing is left to tell these apart."""

ONE_AXIS = 0.005
"""rad, rms: turned about one axis, if there is one that wanders less; as for the method of the paper."""

# That axis wanders by some 1.4 sigma of noise alone.
_WANDER_SIGMAS = 3.0

# Two triples are the same if no flange is farther from where it was than noise may take it.
_SAME_ANGLE = 0.005  # rad
_SAME_PLACE = 0.005  # m
_SAME_SIGMAS = 5.0

UNCERTAIN = (0.05, 0.05)
"""m and rad: sigma of a translation and of a rotation above which nothing is determined but by noise."""

WEAK = (0.005, np.deg2rad(1.0))
"""m and rad: sigma above which a warning is given."""

DEGENERATE = 1e-5
"""Smallest over largest singular value of the whitened problem, its columns scaled to length 1."""

_POSES = {"A": "flange 1 (A)", "B": "the target as the camera sees it (B)", "C": "flange 2 (C)"}


def refuse_degenerate(A: Array, B: Array, C: Array, noise: TripleNoise) -> None:
    """Degenerate for triples (n, 4, 4) that are too few, too alike or turned about one axis.

    If all A turn about one axis, X may turn about it and Y with it; likewise C with Y and Z, and B with X and Z.
    """
    distinct = _count_distinct(A, C, noise)
    if distinct < FEWEST_TRIPLES:
        repeated = f", {distinct} of them different" if distinct < len(A) else ""
        raise Degenerate(f"{len(A)} triples{repeated}, at least {FEWEST_TRIPLES} are needed")
    for name, poses in (("A", A), ("B", B), ("C", C)):
        # A direction that all rotations take to the same place keeps its length under their mean.
        lengths = np.linalg.svd(poses[:, :3, :3].mean(axis=0), compute_uv=False)
        wander = np.sqrt(2 * np.maximum(0.0, 1 - lengths))
        needed = max(ONE_AXIS, _WANDER_SIGMAS * noise.rotation_sigma(name))
        if wander[0] < needed:
            how = "has the same orientation in all triples" if wander[-1] < needed else "is turned about one axis only"
            raise Degenerate(
                f"{_POSES[name]} {how} (that axis wanders by {1e3 * wander[0]:.2g} mrad, {1e3 * needed:.2g} are needed)"
            )


def conditioning(normal: Array) -> float:
    """Smallest over largest singular value of the whitened Jacobian, its columns scaled to length 1."""
    scale = np.sqrt(np.diag(normal))
    if np.any(scale == 0):
        return 0.0
    values = np.linalg.eigvalsh(normal / np.outer(scale, scale))
    return float(np.sqrt(max(values[0], 0.0) / values[-1]))


def refuse_singular(conditioning: float) -> None:
    """Degenerate where even exact triples say nothing."""
    if not conditioning >= DEGENERATE:
        raise Degenerate(
            "the triples leave a direction open: other X, Y and Z fit as well"
            f" (conditioning {conditioning:.1e}, at least {DEGENERATE:g} is needed);"
            " turn both flanges about two axes, not in step with each other"
        )


def refuse_uncertain(covariance: Array) -> None:
    """Degenerate where a sigma of covariance (18, 18) is as large as what noise alone brings about."""
    worst = weakest(covariance, UNCERTAIN)
    if worst is not None:
        raise Degenerate(f"{worst}: the triples do not determine it; turn both flanges by more, about two axes each")


def weakest(covariance: Array, limits: tuple[float, float]) -> str | None:
    """In words, which of X, Y, Z is uncertain by more than ``limits`` (m, rad) and farthest beyond; None: none is."""
    worst, words = 1.0, None
    for i, name in enumerate("XYZ"):
        for j, (limit, what, factor, unit) in enumerate(
            zip(limits, ("position", "rotation"), (1e3, np.rad2deg(1.0)), ("mm", "deg"), strict=True)
        ):
            at = slice(6 * i + 3 * j, 6 * i + 3 * j + 3)
            sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[at, at])[-1]))
            if sigma / limit > worst:
                worst = sigma / limit
                words = f"the {what} of {name} is uncertain by {factor * sigma:.2g} {unit} (limit {factor * limit:.2g})"
    return words


def _count_distinct(A: Array, C: Array, noise: TripleNoise) -> int:
    """How many triples there are with poses of their own, counted up to :data:`FEWEST_TRIPLES`."""
    new = np.ones(len(A), dtype=bool)
    count = 0
    while count < FEWEST_TRIPLES and new.any():
        first = int(np.argmax(new))
        count += 1
        apart = np.zeros(len(A), dtype=bool)
        for name, poses in (("A", A), ("C", C)):
            angle = _SAME_ANGLE + _SAME_SIGMAS * noise.rotation_sigma(name)
            place = _SAME_PLACE + _SAME_SIGMAS * noise.translation_sigma(name)
            apart |= rotation_angle(poses[:, :3, :3], poses[first, :3, :3]) > angle
            apart |= np.linalg.norm(poses[:, :3, 3] - poses[first, :3, 3], axis=1) > place
        new &= apart
    return count
