"""What a simulated cell needs to go on in another process from where it stood. Nothing of the truth is in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from dualcal_hal.errors import FormatError, Problem

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig

_Number = Annotated[float, Field(strict=True)]
_Count = Annotated[int, Field(strict=True, ge=0)]
_Joints = tuple[_Number, ...]


class _State(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ArmLeft(_State):
    """An arm at rest: where it was sent, where its motors have it, and how it came there.

    slack_rad, way, rested_s: as in ``mechanics.Approach``; sequence: of its last state.
    """

    target_rad: _Joints
    joints_rad: _Joints
    slack_rad: _Joints
    way: _Joints
    rested_s: _Number
    sequence: _Count


class CellLeft(_State):
    """A cell at rest: its time, its arms by name, how many samples of each device's streams there are at these
    targets, and how many frames in all.
    """

    clock_s: Annotated[float, Field(strict=True, ge=0)]
    arms: dict[str, ArmLeft]
    samples: dict[str, dict[str, _Count]]
    frames: _Count

    @staticmethod
    def read(state: Mapping[str, Any], backend: str, cell: CellConfig) -> CellLeft:
        """From plain JSON; FormatError if it is none of this cell's."""
        try:
            left = CellLeft.model_validate(state)
        except ValidationError as error:
            details = error.errors()
            raise FormatError([_problem(backend, each["loc"], each["msg"]) for each in details]) from error
        problems = []
        if set(left.arms) != set(cell.robots):
            problems.append(_problem(backend, ("arms",), f"must be {', '.join(sorted(cell.robots))}"))
        for name, arm in left.arms.items():
            joints = cell.robots[name].chain.joints if name in cell.robots else 0
            for key in ("target_rad", "joints_rad", "slack_rad", "way"):
                if joints and len(getattr(arm, key)) != joints:
                    problems.append(_problem(backend, ("arms", name, key), f"must be of {joints} joints"))
        if problems:
            raise FormatError(problems)
        return left


def _problem(backend: str, location: tuple[str | int, ...], what: str) -> Problem:
    where = ".".join(("backends", backend, *map(str, location)))
    return Problem(where, f"is no state that the simulator was left in: {what}")
