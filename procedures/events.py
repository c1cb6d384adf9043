"""What a run tells those who watch it. ``str()`` of an event is a line for a person."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from procedures.planning.model import Posture
from procedures.planning.plan import Plan
from procedures.planning.ways import Leg


def counted(count: int, thing: str) -> str:
    """``1 picture``, ``2 pictures``."""
    return f"{count} {thing}" + ("" if count == 1 else "s")


@dataclass(frozen=True)
class LooksProposed:
    """Where the first looks are to be taken from.

    way: the moves that lead there, None if none was found; count: how many looks there will be, by moves of the wrists.
    """

    stand_off: Posture
    way: tuple[Leg, ...] | None
    count: int


@dataclass(frozen=True)
class LookTaken:
    """One of the first looks; ``reason`` says why it found nothing."""

    number: int
    count: int
    found: bool
    reason: str

    def __str__(self) -> str:
        return f"look {self.number + 1}/{self.count}: {'target found' if self.found else self.reason}"


@dataclass(frozen=True, eq=False)
class PlanReady:
    """Poses were selected."""

    plan: Plan

    def __str__(self) -> str:
        uses = {constraint.use: len(self.plan.of(constraint.use)) for constraint in self.plan.constraints}
        spread = self.plan.axis_spread
        return (
            "plan: "
            + ", ".join(f"{count} {use} constraints" for use, count in uses.items())
            + ("" if spread is None else f", axes spread {spread:.3f}")
        )


@dataclass(frozen=True)
class PointDone:
    """A point was aligned and captured, or given up; ``offset_px`` in u and v, None if the target was not seen."""

    use: str
    constraint: str
    position: int
    positions: int
    outcome: str
    captured: bool
    frames: int
    offset_px: tuple[float, float] | None
    reason: str

    def __str__(self) -> str:
        offset = f", offset {np.max(np.abs(self.offset_px)):.3f} px" if self.offset_px is not None else ""
        reason = f" ({self.reason})" if self.reason else ""
        where = f"{self.constraint} position {self.position + 1}/{self.positions}"
        return f"{where}: {self.outcome} after {counted(self.frames, 'picture')}{offset}{reason}"


@dataclass(frozen=True)
class ConstraintDone:
    """All positions of a constraint are captured; ``finished`` of ``count`` of its use are."""

    use: str
    constraint: str
    finished: int
    count: int

    def __str__(self) -> str:
        return f"{self.constraint}: done, {self.finished}/{self.count} {self.use} constraints"


@dataclass(frozen=True)
class ConstraintGivenUp:
    """A constraint is replaced by another."""

    constraint: str
    reason: str

    def __str__(self) -> str:
        return f"{self.constraint}: given up ({self.reason}); another is taken in its place"


@dataclass(frozen=True)
class BeliefRefined:
    """The transforms used for planning were fitted anew to all that was seen."""

    views: int
    rms_px: float

    def __str__(self) -> str:
        return f"transforms for planning from {counted(self.views, 'view')}, {self.rms_px:.3f} px rms"


@dataclass(frozen=True)
class NominalContradicted:
    """The looks found the bases farther from their nominal place than ``nominal.uncertainty`` allows; m and rad."""

    translation: float
    rotation: float

    def __str__(self) -> str:
        off = f"{self.translation * 1e3:.0f} mm and {np.rad2deg(self.rotation):.1f} deg"
        return (
            f"warning: the looks found the bases {off} from where the cell file has them, farther than "
            "nominal.uncertainty allows: the way so far was not sure to be clear. The run goes on by what was found; "
            "correct the nominal transforms or raise the uncertainty"
        )


@dataclass(frozen=True)
class NotHome:
    """All is captured, but no clear way home was found."""

    reason: str

    def __str__(self) -> str:
        return f"no clear way home ({self.reason}): the arms stay where they are; jog them apart, then home"
