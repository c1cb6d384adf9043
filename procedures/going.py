"""Going from where the arms stand to where they shall be."""

from __future__ import annotations

from typing import Any

from procedures.planning.model import Posture
from procedures.planning.ways import Leg, WayFinder
from procedures.steps import Procedure, move, read, work

Way = tuple[Leg, ...] | None


def here() -> Procedure[Posture]:
    """Where the arms were sent last in this run, or stand."""
    readings = yield from read()
    return Posture(
        readings.active.commanded or readings.active.state.positions,
        readings.passive.commanded or readings.passive.state.positions,
    )


def go(ways: WayFinder, goal: Posture) -> Procedure[bool]:
    """Move both arms to a posture; says whether there was a clear way."""
    start = yield from here()
    asked = {"from": start.to_record(), "to": goal.to_record()}
    way = yield from work("way", asked, lambda: ways.find(start, goal), _way_to_record, ways.from_record)
    for leg in way or ():
        yield from move(leg.arm, *leg.waypoints)
    return way is not None


def _way_to_record(way: Way) -> Any:
    return None if way is None else [leg.to_record() for leg in way]
