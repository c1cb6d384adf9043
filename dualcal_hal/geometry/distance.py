"""Distances between segments."""

from __future__ import annotations

import numpy as np

from dualcal_hal.transforms import Array

_TINY = 1e-12


def segment_distance(first: Array, second: Array) -> Array:
    """Distance (...) between segments (..., 2, 3), broadcast."""
    return length(segment_gap(first, second))


def segment_gap(first: Array, second: Array) -> Array:
    """Vector (..., 3) from the first segment's point to the second's where they (..., 2, 3) are closest, broadcast
    (C. Ericson, Real-Time Collision Detection, 5.1.9)."""
    d1 = first[..., 1, :] - first[..., 0, :]
    d2 = second[..., 1, :] - second[..., 0, :]
    r = first[..., 0, :] - second[..., 0, :]
    a, e = dot(d1, d1), dot(d2, d2)
    b, c, f = dot(d1, d2), dot(d1, r), dot(d2, r)
    determinant = a * e - b * b
    skew = determinant > _TINY * np.maximum(a * e, _TINY)
    s = np.where(skew, (b * f - c * e) / np.maximum(determinant, 1e-30), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.where(e > _TINY, (b * s + f) / np.maximum(e, 1e-30), 0.0)
    t = np.clip(t, 0.0, 1.0)
    s = np.where(a > _TINY, np.clip((b * t - c) / np.maximum(a, 1e-30), 0.0, 1.0), 0.0)
    return np.asarray(t[..., None] * d2 - s[..., None] * d1 - r)


def dot(u: Array, v: Array) -> Array:
    """Scalar products (...) of (..., 3), broadcast."""
    return np.asarray(np.einsum("...i,...i->...", u, v))


def length(v: Array) -> Array:
    """Lengths (...) of (..., 3)."""
    return np.asarray(np.sqrt(dot(v, v)))


def unit(v: Array) -> Array:
    """(..., 3) at length 1; zero where the length is (nearly) zero, for which there is no direction."""
    size = length(v)[..., None]
    return np.asarray(np.where(size > 1e-9, v / np.maximum(size, 1e-9), 0.0))
