"""How near the bodies are to each other, and which of them are in contact."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from backends.simulator.bullet.bodies import BulletBodies, Part
from backends.simulator.bullet.client import pybullet
from dualcal_hal.geometry import ArmBody
from dualcal_hal.transforms import Array

BETWEEN, WITHIN = 10.0, 0.2
"""Metres up to which distances between the arms, and of an arm to itself and its surroundings, are measured."""


_ROUNDING = 1e-3  # m


@dataclass(frozen=True)
class Near:
    """Two parts and the distance between them in m; below zero they are in contact."""

    distance: float
    first: str
    second: str


class Nearness:
    """Measures no more often than the speed of the parts demands."""

    def __init__(self, bodies: BulletBodies) -> None:
        self._bodies = bodies
        arms = bodies.shapes
        self._own = {name: _own_pairs(body, bodies.links[name]) for name, body in arms.items()}
        self._reach = {name: _reach(body) for name, body in arms.items()}
        # How far parts must go at least before any can touch, between the arms and within each.
        self._room_between = 0.0
        self._room_within = dict.fromkeys(arms, 0.0)
        self._measured_within = dict.fromkeys(arms, WITHIN)

    def contact(self, turned: Mapping[str, Array]) -> Near | None:
        """The parts that touch, if any do, after each arm's joints have turned by so much (n,) in rad."""
        ways = {arm: float(angles @ self._reach[arm]) for arm, angles in turned.items()}
        self._room_between -= sum(ways.values())
        found = []
        if self._room_between <= 0:
            found.append(self.between_arms())
        for arm, way in ways.items():
            self._room_within[arm] -= way
            if self._room_within[arm] <= 0:
                found.append(self._within_arm(arm))
        return min((near for near in found if near.distance < 0), key=lambda near: near.distance, default=None)

    def between_arms(self) -> Near:
        """The least distance between the arms, camera and target included."""
        first, second = (self._bodies.arms[arm] for arm in sorted(self._bodies.arms))
        near = self._least(self._points(first, second, BETWEEN), BETWEEN)
        self._room_between = near.distance
        return near

    def _within_arm(self, arm: str) -> Near:
        """The least distance of an arm to itself and to what stands about it."""
        body, own = self._bodies.arms[arm], self._own[arm]
        # It is no farther than it was and has come since; looking no farther spares most of a mesh's triangles.
        gone = self._measured_within[arm] - self._room_within[arm]
        within = min(self._measured_within[arm] + gone + _ROUNDING, WITHIN)
        points = [point for point in self._points(body, body, within) if (point[3], point[4]) in own]
        for other, links in self._bodies.standing[arm]:
            points += [point for point in self._points(body, other, within) if point[3] in links]
        near = self._least(points, within)
        self._room_within[arm] = self._measured_within[arm] = near.distance
        return near

    def _points(self, first: int, second: int, within: float) -> list[Any]:
        return list(pybullet.getClosestPoints(first, second, within, physicsClientId=self._bodies.client))

    def _least(self, points: Iterable[Any], within: float) -> Near:
        nearest = min(points, key=lambda point: (point[8], point[3], point[4]), default=None)
        if nearest is None:
            return Near(within, "", "")
        _, first, second, first_link, second_link = nearest[:5]
        names = self._bodies.names
        return Near(nearest[8], names[first, first_link], names[second, second_link])


def _reach(body: ArmBody) -> Array:
    """(n,) m: no part of the arm is farther from each joint's axis."""
    lengths = np.array([np.hypot(row.a, row.d) for row in body.chain.rows])
    tool = np.linalg.norm(body.tool.ends, axis=-1).max() + body.capsules.radius.max()
    return np.asarray(np.cumsum(lengths[::-1])[::-1] + tool)


def _own_pairs(body: ArmBody, links: list[int]) -> frozenset[Part]:
    """Pairs of an arm's links, as PyBullet numbers them, that can meet and do not touch by their make."""
    pairs = {(links[i], links[j]) for i, j in body.pairs.tolist()}
    return frozenset(pairs | {(j, i) for i, j in pairs})
