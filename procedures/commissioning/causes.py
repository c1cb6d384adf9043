"""What may be wrong between a controller and us: a cause, and how well it explains what the controller shows."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array

POSITION_SIGMA, ROTATION_SIGMA = 1e-3, np.deg2rad(0.15)
"""m and rad by which a controller's own model of an arm differs from a calibrated one where nothing is wrong."""


class Kind(StrEnum):
    """What is wrong."""

    SIGN = "sign"
    ZERO = "zero"
    COUPLING = "coupling"
    ORDER = "order"
    TOOL = "active tool"
    FRAME = "work object"
    SCALE = "scale"
    CONVENTION = "rotation form"
    KINEMATICS = "kinematics"


@dataclass(frozen=True, eq=False)
class Poses:
    """joints: (k, n) rad as we read them; flange: (k, 4, 4) in the base, m, as the controller shows it."""

    chain: Chain
    joints: Array
    flange: Array

    def deviation(self, joints: Array) -> Deviation:
        """How far the flange would be from where it is shown if these (..., k, n) were the joint angles in rad."""
        return Deviation.between(self.chain.forward(joints), self.flange)


@dataclass(frozen=True, eq=False)
class Deviation:
    """Of each pose: translation (..., k) in m, rotation (..., k) in rad."""

    translation: Array
    rotation: Array

    @classmethod
    def between(cls, flange: Array, other: Array) -> Deviation:
        """Of poses (..., k, 4, 4)."""
        distance = np.linalg.norm(flange[..., :3, 3] - other[..., :3, 3], axis=-1)
        # By the chord of the turn, since this is asked many thousand times: |R - I| = 2 sqrt(2) sin(angle / 2).
        chord = np.linalg.norm(flange[..., :3, :3] - other[..., :3, :3], axis=(-2, -1))
        return cls(distance, 2 * np.arcsin(np.minimum(chord / np.sqrt(8.0), 1.0)))

    def __getitem__(self, index: int) -> Deviation:
        return Deviation(self.translation[index], self.rotation[index])

    @property
    def chi2(self) -> Array:
        """(...): squares of both in their sigmas, summed over the poses."""
        parts = (self.translation / POSITION_SIGMA) ** 2 + (self.rotation / ROTATION_SIGMA) ** 2
        return np.asarray(np.sum(parts, axis=-1))

    def within(self, translation: float, rotation: float) -> bool:
        """Whether no pose deviates by more (m, rad)."""
        return bool(np.max(self.translation) <= translation and np.max(self.rotation) <= rotation)

    def __str__(self) -> str:
        return f"{1e3 * np.max(self.translation):.1f} mm and {np.degrees(np.max(self.rotation)):.2f} deg"


@dataclass(frozen=True, eq=False)
class Cause:
    """One thing that may be wrong, at its best.

    what: in words; advice: what to change; joints: those concerned, counted from 1; parameters: how many numbers were
    fitted; rarity: how seldom it is met, on the scale of chi2; deviation: what it leaves unexplained.
    """

    kind: Kind
    what: str
    advice: str
    joints: tuple[int, ...]
    parameters: int
    rarity: float
    deviation: Deviation

    @property
    def score(self) -> float:
        """The less the likelier: Schwarz's criterion, with what is seldom met behind what is common."""
        numbers = 6 * len(self.deviation.translation)
        return float(self.deviation.chi2 + self.parameters * np.log(numbers) + self.rarity)


def fitted(flange: Callable[[Array], Array], shown: Array, grid: Array) -> tuple[float, Deviation]:
    """The number with which the poses ``flange(x)``, (m,) to (m, k, 4, 4), come nearest to those shown (k, 4, 4).

    Looked for on an even ``grid`` (m,), then about the best of it, ever finer.
    """
    step = grid[1] - grid[0]
    while True:
        deviation = Deviation.between(flange(grid), shown)
        best = int(np.argmin(deviation.chi2))
        if step < _FINEST:
            return float(grid[best]), deviation[best]
        grid, step = grid[best] + step * np.linspace(-1.0, 1.0, 21), step / 10


_FINEST = 1e-5  # rad, m or a factor: far below what a pendant shows


def joints_in_words(joints: Iterable[int]) -> str:
    """Of joints counted from 0."""
    names = [str(joint + 1) for joint in joints]
    if len(names) == 1:
        return f"joint {names[0]}"
    return f"joints {', '.join(names[:-1])} and {names[-1]}"


def from_1(joints: Iterable[int]) -> tuple[int, ...]:
    """Joints counted from 0, counted from 1."""
    return tuple(int(joint) + 1 for joint in joints)
