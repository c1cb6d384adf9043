"""What a plan says: constraints, each with the active arm's pose and the passive arm's positions along the axis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import Use
from dualcal_hal.transforms import Array, vector_from_rotation

PLAN_FORMAT = "dualcal.plan/1"


@dataclass(frozen=True)
class PlannedPosition:
    """A position of the feature point on one axis.

    distance: m from the camera along the axis; tilt: rad between the plate's normal and the axis;
    clearance: m, least of all distances in this posture.
    """

    passive: Joints
    distance: float
    tilt: float
    clearance: float

    def to_record(self) -> dict[str, Any]:
        return {
            "passive_joints_rad": list(self.passive),
            "distance_m": self.distance,
            "tilt_rad": self.tilt,
            "clearance_m": self.clearance,
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        passive = tuple(record["passive_joints_rad"])
        return cls(passive, record["distance_m"], record["tilt_rad"], record["clearance_m"])


@dataclass(frozen=True)
class PlannedConstraint:
    """One pose of the active arm, and positions to align with its optical axis, the farthest first."""

    name: str
    use: Use
    active: Joints
    positions: tuple[PlannedPosition, ...]

    def to_record(self) -> dict[str, Any]:
        return {
            "constraint": self.name,
            "use": self.use,
            "active_joints_rad": list(self.active),
            "positions": [position.to_record() for position in self.positions],
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        positions = tuple(PlannedPosition.from_record(position) for position in record["positions"])
        return cls(record["constraint"], record["use"], tuple(record["active_joints_rad"]), positions)


@dataclass(frozen=True)
class Plan:
    """Constraints in the order they are visited; ``refused`` counts candidates per condition that failed.

    ``planned_from`` says which transforms it was planned with; a provisional plan is for showing, not for moving.
    """

    constraints: tuple[PlannedConstraint, ...]
    refused: dict[str, int]
    provisional: bool
    planned_from: str

    def of(self, use: Use) -> tuple[PlannedConstraint, ...]:
        """The constraints of one use."""
        return tuple(constraint for constraint in self.constraints if constraint.use == use)

    def replaced(self, dropped: Sequence[PlannedConstraint], by: Plan) -> Plan:
        """This plan with constraints that will not be visited dropped, and those of another plan in their place."""
        names = {constraint.name for constraint in dropped}
        kept = tuple(constraint for constraint in self.constraints if constraint.name not in names)
        refused = {what: self.refused.get(what, 0) + by.refused.get(what, 0) for what in {**self.refused, **by.refused}}
        return Plan((*kept, *by.constraints), refused, self.provisional, self.planned_from)

    def to_record(self) -> dict[str, Any]:
        """The content of ``plan.json``, from which :meth:`from_record` makes the same plan to the last bit."""
        return {
            "format": PLAN_FORMAT,
            "provisional": self.provisional,
            "planned_from": self.planned_from,
            "constraints": [constraint.to_record() for constraint in self.constraints],
            "refused_candidates": self.refused,
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        constraints = tuple(PlannedConstraint.from_record(constraint) for constraint in record["constraints"])
        return cls(constraints, record["refused_candidates"], record["provisional"], record["planned_from"])


def turned_about_two_axes(R: Array) -> float:
    """How far flange orientations (k, 3, 3) are turned about a second axis, in rad.

    The largest angle, over pairs of relative rotations, that is left of one perpendicular to the other's axis: zero
    if all relative rotations share one axis, when the rotation step is singular.
    """
    first, second = np.triu_indices(len(R), 1)
    vectors = vector_from_rotation(np.swapaxes(R[first], 1, 2) @ R[second])
    angles = np.linalg.norm(vectors, axis=1)
    if not np.any(angles > 0):
        return 0.0
    axes = vectors / np.maximum(angles, 1e-12)[:, None]
    sideways = np.linalg.norm(np.cross(axes[:, None], vectors[None]), axis=2)
    return float(np.max(np.minimum(sideways, angles[:, None])))
