"""What a plan says: constraints, each with the active arm's pose and the passive arm's positions along the axis."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self, cast, get_args

from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import Use
from dualcal_hal.session.plain import Fields

PLAN_FORMAT = "dualcal.plan/2"

_NAME = re.compile(r"[a-z]+/[0-9]{2,6}")


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
        fields = Fields(record, "the position")
        passive = fields.joints("passive_joints_rad")
        return cls(passive, fields.finite("distance_m"), fields.finite("tilt_rad"), fields.finite("clearance_m"))


@dataclass(frozen=True)
class PlannedConstraint:
    """One pose of the active arm, and positions to align with its optical axis, the farthest first.

    manipulability: T. Yoshikawa's sqrt(det J J^T), m^3 for six joints; joint_margin: rad to the nearest limit that a
    procedure keeps; both are the least of either arm at any position. seconds: the way from the constraint before,
    the moves between the positions, and the pictures, as expected.
    """

    name: str
    use: Use
    active: Joints
    positions: tuple[PlannedPosition, ...]
    manipulability: float
    joint_margin: float
    seconds: float

    @property
    def clearance(self) -> float:
        """The least of all its positions, m."""
        return min(position.clearance for position in self.positions)

    def to_record(self) -> dict[str, Any]:
        return {
            "constraint": self.name,
            "use": self.use,
            "active_joints_rad": list(self.active),
            "positions": [position.to_record() for position in self.positions],
            "manipulability": self.manipulability,
            "joint_margin_rad": self.joint_margin,
            "expected_s": self.seconds,
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        fields = Fields(record, "the constraint")
        name, use = fields.text("constraint"), fields.choice("use", get_args(Use))
        if _NAME.fullmatch(name) is None:
            raise ValueError(f"constraint is no name of one: {name[:60]!r}")
        positions = tuple(PlannedPosition.from_record(position) for position in fields.items("positions"))
        if not positions:
            raise ValueError("positions is empty")
        return cls(
            name,
            cast(Use, use),
            fields.joints("active_joints_rad"),
            positions,
            fields.finite("manipulability"),
            fields.finite("joint_margin_rad"),
            fields.finite("expected_s"),
        )


@dataclass(frozen=True)
class Plan:
    """Constraints in the order they are visited; ``refused`` counts candidates per condition that failed.

    ``axis_spread`` is the smallest eigenvalue of the mean of z z^T over the calibration's optical axes z, with those
    captured already; None in a plan for verification alone. ``planned_from`` says which transforms it was planned
    with; a provisional plan is for showing, not for moving.
    """

    constraints: tuple[PlannedConstraint, ...]
    axis_spread: float | None
    refused: dict[str, int]
    provisional: bool
    planned_from: str

    @property
    def seconds(self) -> float:
        """What all constraints are expected to take."""
        return sum(constraint.seconds for constraint in self.constraints)

    def of(self, use: Use) -> tuple[PlannedConstraint, ...]:
        """The constraints of one use."""
        return tuple(constraint for constraint in self.constraints if constraint.use == use)

    def replaced(self, dropped: Sequence[PlannedConstraint], by: Plan) -> Plan:
        """This plan with those of another in place of constraints that were given up or will not be visited.

        What is kept of the same use has been visited by then, so the new ones are the last of it. The plan is then
        planned from what the other one was, the transforms that are believed now.
        """
        names, uses = {constraint.name for constraint in dropped}, {constraint.use for constraint in by.constraints}
        end = 1 + max((i for i, constraint in enumerate(self.constraints) if constraint.use in uses), default=-1)
        before, after = (
            [constraint for constraint in part if constraint.name not in names]
            for part in (self.constraints[:end], self.constraints[end:])
        )
        refused = {what: self.refused.get(what, 0) + by.refused.get(what, 0) for what in {**self.refused, **by.refused}}
        spread = self.axis_spread if by.axis_spread is None else by.axis_spread
        return Plan((*before, *by.constraints, *after), spread, refused, self.provisional, by.planned_from)

    def to_record(self) -> dict[str, Any]:
        """The content of ``plan.json``, from which :meth:`from_record` makes the same plan to the last bit."""
        return {
            "format": PLAN_FORMAT,
            "provisional": self.provisional,
            "planned_from": self.planned_from,
            "constraints": [constraint.to_record() for constraint in self.constraints],
            "axis_spread": self.axis_spread,
            "refused_candidates": self.refused,
        }

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        fields = Fields(record, "the plan")
        refused = fields.part("refused_candidates")
        return cls(
            tuple(PlannedConstraint.from_record(constraint) for constraint in fields.items("constraints")),
            None if fields.is_null("axis_spread") else fields.finite("axis_spread"),
            {what: refused.whole(what) for what in refused.content},
            fields.flag("provisional"),
            fields.text("planned_from"),
        )

    def require_joints(self, active: int, passive: int) -> None:
        """ValueError where its postures, which come from somewhere else, are not of arms with so many joints."""
        for constraint in self.constraints:
            if len(constraint.active) != active:
                raise ValueError(f"{constraint.name}: the active arm has {active} joints, not {len(constraint.active)}")
            for position in constraint.positions:
                if len(position.passive) != passive:
                    what = f"the passive arm has {passive} joints, not {len(position.passive)}"
                    raise ValueError(f"{constraint.name}: {what}")
