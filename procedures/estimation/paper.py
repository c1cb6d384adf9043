"""The paper's two-step estimator: rotations by iteration, then translations by SVD (section 5)."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.transforms import Array, nearest_rotation, smallest_rotation, transform
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.line import fit_line
from procedures.estimation.rotation import Iteration, estimate_rotation
from procedures.estimation.translation import RANK, estimate_translation

FEWEST_CONSTRAINTS = 3

# How far, rms, that axis wanders between the constraints about which the flanges turn most nearly. Measured, 200 sets
# each of 3 to 7 constraints: flanges turned about one axis or not at all 4e-8 without noise, 2e-4 with 0.1 mrad, 6e-4
# with 0.3 mrad; fans with 5 deg about a second axis 0.039 at least; turns of 15 to 40 deg about random axes 0.043.
ONE_AXIS = 0.005  # rad

# Smallest over largest singular value of a step, below which even exact captures say nothing. For a given optical
# axis there are such sets besides those turned about one axis.
DEGENERATE = 0.001

# Sigma of the weakest direction of the rotation step. Measured with 0.1 mrad and 0.1 mm of noise: turns about random
# axes 0.021 at most, of 400 sets; most fans that tilt by 5 deg without roll are above, with errors of 2 to 14 deg.
UNCERTAIN = 0.05  # rad

# Warned of below WEAK: fans with 5 deg about a second axis have up to 0.031; 7 random orientations 0.065 in 19 of
# 20 sets, the reference captures 0.41.
WEAK = 0.04

_TOO_WEAK = "the active flange is turned too little about a second axis, or the nominal transforms are far off"


@dataclass(frozen=True)
class Unobservable:
    """What aligned points cannot show: a unit 6-vector [translation; rotation] in the child frame of ``of``."""

    what: str
    direction: tuple[float, ...]
    of: str


_UNOBSERVABLE = (
    Unobservable("shift along the optical axis", (0.0, 0.0, 1.0, 0.0, 0.0, 0.0), "camera_in_active_flange"),
    Unobservable("roll about the optical axis", (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "camera_in_active_flange"),
)


@dataclass(frozen=True)
class Estimate:
    """What the paper's method finds.

    T_P_A, T_H_E (4, 4); optical_axis: z_H_E (3,); unobservable: the directions of T_H_E that keep their nominal
    value; rotation_singular_values (5,) and translation_singular_values (6,): of the two linearised steps;
    conditioning: smallest over largest singular value, the lower of both steps; warnings in words.
    """

    T_P_A: Array
    T_H_E: Array
    optical_axis: Array
    iterations: tuple[Iteration, ...]
    unobservable: tuple[Unobservable, ...]
    rotation_singular_values: Array
    translation_singular_values: Array
    conditioning: float
    warnings: tuple[str, ...]


def estimate(
    T_A_H: ArrayLike,
    T_P_T: ArrayLike,
    constraints: Sequence[Hashable],
    nominal_T_P_A: ArrayLike,
    nominal_T_H_E: ArrayLike,
) -> Estimate:
    """Estimate T_P_A and T_H_E from captures with the feature point on the optical axis.

    T_A_H, T_P_T: active flange and target of each capture (k, 4, 4), m; constraints: the name of each capture's
    constraint (k); nominal transforms (4, 4). Raises Degenerate for fewer than three constraints, fewer than
    three separate positions in one, and active flanges not turned about two axes.
    """
    T_A_H, T_P_T = np.asarray(T_A_H, dtype=float), np.asarray(T_P_T, dtype=float)
    T_P_A, T_H_E = np.asarray(nominal_T_P_A, dtype=float), np.asarray(nominal_T_H_E, dtype=float)
    members = _members(constraints)
    flanges = np.stack([nearest_rotation(T_A_H[m, :3, :3].mean(axis=0)) for m in members.values()])
    directions = _directions(members, T_P_T[:, :3, 3], T_P_A[:3, :3] @ flanges @ T_H_E[:3, 2])
    _refuse_one_axis(flanges, directions)

    rotation = estimate_rotation(directions, flanges, T_P_A[:3, :3], T_H_E[:3, 2])
    conditioning = _conditioning(rotation.singular_values)
    _refuse_uncertain(rotation.uncertainty)

    of_capture = np.empty((len(T_A_H), 3))
    for m, direction in zip(members.values(), directions, strict=True):
        of_capture[m] = direction
    translation = estimate_translation(
        of_capture, T_A_H, T_P_T[:, :3, 3], rotation.R_P_A, rotation.z_H_E, T_P_A[:3, 3], T_H_E[:3, 3]
    )
    conditioning = min(conditioning, _conditioning(translation.singular_values[:RANK]))
    R_H_E = smallest_rotation(T_H_E[:3, 2], rotation.z_H_E) @ T_H_E[:3, :3]
    return Estimate(
        T_P_A=transform(rotation.R_P_A, translation.p_P_A),
        T_H_E=transform(R_H_E, translation.p_H_E),
        optical_axis=rotation.z_H_E,
        iterations=rotation.iterations,
        unobservable=_UNOBSERVABLE,
        rotation_singular_values=rotation.singular_values,
        translation_singular_values=translation.singular_values,
        conditioning=conditioning,
        warnings=_warnings(conditioning),
    )


def _members(constraints: Sequence[Hashable]) -> dict[Hashable, list[int]]:
    members: dict[Hashable, list[int]] = {}
    for index, name in enumerate(constraints):
        members.setdefault(name, []).append(index)
    if len(members) < FEWEST_CONSTRAINTS:
        raise Degenerate(f"{len(members)} constraints, at least {FEWEST_CONSTRAINTS} are needed")
    return members


def _directions(members: dict[Hashable, list[int]], points: Array, nominal: Array) -> Array:
    # The nominal axis tells the line's sign: it is wrong only from an error of 90 degrees on, whereas a wrong
    # nominal position may well lie beyond the nearest point.
    directions = np.empty((len(members), 3))
    for k, (name, m) in enumerate(members.items()):
        try:
            directions[k] = fit_line(points[m], nominal[k]).direction
        except Degenerate as error:
            raise Degenerate(f"constraint {name}: {error}") from error
    return directions


def _refuse_one_axis(flanges: Array, directions: Array) -> None:
    """Both steps are singular if a direction fixed in the flange is fixed in A as well, whatever the optical axis.

    A unit vector u that every rotation takes to the same place keeps its length under their mean; one that
    wanders by a small rms angle loses half that angle's square.
    """
    wander = np.sqrt(2 * np.maximum(0.0, 1 - np.linalg.svd(flanges.mean(axis=0), compute_uv=False)))
    if wander[0] >= ONE_AXIS:
        return
    if wander[-1] < ONE_AXIS:
        reason = "the active flange has the same orientation in all constraints"
    elif 1 - np.linalg.norm(directions.mean(axis=0)) < ONE_AXIS**2:
        reason = "the optical axes of all constraints are parallel"
    else:
        reason = "the active flange is turned about one axis only between the constraints"
    raise Degenerate(f"{reason} (that axis wanders by {1e3 * wander[0]:.2g} mrad, {1e3 * ONE_AXIS:g} are needed)")


def _conditioning(singular_values: Array) -> float:
    """Smallest over largest; Degenerate where even exact captures say nothing."""
    conditioning = float(singular_values[-1] / singular_values[0])
    if conditioning < DEGENERATE:
        raise Degenerate(f"{_TOO_WEAK} (conditioning {conditioning:.1e}, at least {DEGENERATE:g} is needed)")
    return conditioning


def _refuse_uncertain(sigma: float) -> None:
    if sigma > UNCERTAIN:
        found, most = np.degrees(sigma), np.degrees(UNCERTAIN)
        raise Degenerate(f"{_TOO_WEAK} (uncertain by {found:.1f} deg, at most {most:.1f} deg are accepted)")


def _warnings(conditioning: float) -> tuple[str, ...]:
    if conditioning >= WEAK:
        return ()
    return (
        f"weak conditioning {conditioning:.3f} (good sets have more than {WEAK:g}):"
        " turn the active flange by at least 30 deg about two axes",
    )
