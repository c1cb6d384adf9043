"""What an arm is closest to, by name: for messages, not for planning."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from dualcal_hal.geometry import ArmBody, Capsules, CellGeometry, Fixture, Placement
from dualcal_hal.transforms import Array

_NOTHING = Capsules(np.zeros(0, dtype=np.int64), np.zeros((0, 2, 3)), np.zeros(0))


def closest_own(body: ArmBody, q: Array) -> str:
    """What the arm at joint angles (n,) is closest to of itself, the floor and the fixtures of its base."""
    return _own(body)[int(np.argmin(body.own_clearances_at(body.segments(q[None]))[:, 0]))]


def closer_than(margin: float, body: ArmBody, q: Array) -> Counter[str]:
    """In how many of the postures (k, n) the arm is closer than ``margin`` (m) to which of these."""
    close = body.own_clearances_at(body.segments(q)) < margin
    return Counter(dict(zip(_own(body), np.sum(close, axis=1).tolist(), strict=True)))


def closest_of_passive(geometry: CellGeometry, placement: Placement, q_a: Array, q_p: Array, arm: str) -> str:
    """What the active arm is closest to of the passive one, called ``arm``, and the fixtures of its base.

    Joint angles (n,); whatever the bases' error.
    """
    active = _alone(geometry.active)
    return min(
        _pieces(geometry.passive, arm, "target"),
        key=lambda named: float(CellGeometry(active, named[1]).between(q_a, q_p, placement)[0]),
    )[0]


def closest_of_active(geometry: CellGeometry, placement: Placement, q_a: Array, q_p: Array, arm: str) -> str:
    """The same of the active arm, for the passive one."""
    passive = _alone(geometry.passive)
    return min(
        _pieces(geometry.active, arm, "camera"),
        key=lambda named: float(CellGeometry(named[1], passive).between(q_a, q_p, placement)[0]),
    )[0]


def _pieces(body: ArmBody, arm: str, tool: str) -> Iterator[tuple[str, ArmBody]]:
    """Each part of an arm, then the whole with each fixture: that is the closest only where no part is."""
    capsules = body.capsules
    for i, frame in enumerate(capsules.frame):
        part = Capsules(capsules.frame[i : i + 1], capsules.ends[i : i + 1], capsules.radius[i : i + 1])
        name = f"link {frame} of '{arm}'" if i < len(body.links) else f"the {tool} of '{arm}'"
        yield name, ArmBody(body.chain, part, _NOTHING, None)
    for fixture in body.fixtures:
        yield f"'{fixture.name}'", _alone(body, fixtures=[fixture])


def _own(body: ArmBody) -> list[str]:
    """What an arm's own clearances are of, in their order."""
    return ["itself", "the floor", *(f"'{fixture.name}'" for fixture in body.fixtures)]


def _alone(body: ArmBody, fixtures: Sequence[Fixture] = ()) -> ArmBody:
    """The arm without anything about it but what is given."""
    return ArmBody(body.chain, body.links, body.tool, None, fixtures)
