"""How far the feature point is from the optical axis that the transforms predict (section 5.3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array

Verdict = Literal["ok", "coarse", "fail", "unverified"]


def mismatch(T_P_A: ArrayLike, T_H_E: ArrayLike, T_A_H: ArrayLike, p_P_T: ArrayLike) -> Array:
    """Distance of the feature point from the optical axis, per capture (k,), in m (eqs. 37 to 42).

    T_P_A, T_H_E (4, 4); T_A_H (k, 4, 4); p_P_T: feature point in P (k, 3), m. With the nominal transforms this
    is the paper's e_b, with the estimated ones e_a.
    """
    T_P_E = np.asarray(T_P_A, dtype=float) @ np.asarray(T_A_H, dtype=float) @ np.asarray(T_H_E, dtype=float)
    from_camera = np.asarray(p_P_T, dtype=float) - T_P_E[:, :3, 3]
    return np.asarray(np.linalg.norm(np.cross(from_camera, T_P_E[:, :3, 2]), axis=1))


@dataclass(frozen=True)
class Statistics:
    """Of the mismatch, in m; ``values`` in the order of the captures."""

    mean: float
    rms: float
    p95: float
    max: float
    values: tuple[float, ...]


def statistics(values: ArrayLike) -> Statistics:
    """Statistics of (k,) values, k >= 1; p95 interpolates linearly between the order statistics."""
    v = np.asarray(values, dtype=float)
    return Statistics(
        mean=float(v.mean()),
        rms=float(np.sqrt(np.mean(v**2))),
        p95=float(np.percentile(v, 95)),
        max=float(v.max()),
        values=tuple(v.tolist()),
    )


def judge(after: Statistics | None, limit: float) -> tuple[Verdict, str]:
    """The verdict on the mean mismatch against ``limit`` in m, with its reason; None: nothing to verify with."""
    if after is None:
        return "unverified", "no verification captures: the mismatch on other constraints is not known"
    found = f"mean mismatch {1e3 * after.mean:.3f} mm on {len(after.values)} verification captures"
    if after.mean <= limit:
        return "ok", f"{found}, within the limit of {1e3 * limit:g} mm"
    return "fail", f"{found}, above the limit of {1e3 * limit:g} mm"
