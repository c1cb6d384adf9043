"""Motors, gravity and contact: the arms' joints as PyBullet moves them."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np

from backends.simulator.bullet.bodies import STEP, BulletBodies
from backends.simulator.bullet.nearness import Near, Nearness
from backends.simulator.stepper import SetPoints, Stepper
from dualcal_hal.robot import JointPath
from dualcal_hal.robot import Joints as Target
from dualcal_hal.session.distances import DISTANCES, Distances
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.simulator.truth import Truth
    from dualcal_hal.config import CellConfig

SETTLED = 1e-5
"""rad that a settled joint may stand from its set point; under gravity up to 2e-6 stay."""

STILL = 1e-4
"""rad/s below which a joint can have settled."""

STEPS_A_RECORD = 8
"""Steps from one recorded distance between the arms to the next: 30 a second."""

_KEPT = 240  # steps that the past is remembered for: one second

Joints = Mapping[str, tuple[Array, Array]]


class BulletStepper(Stepper):
    """Set points go to the motors in every step; an arm has settled when its simulated joints have.

    Steps are made only while an arm has not settled; over the rest time jumps. Contact halts both arms for good.
    """

    def __init__(self, cell: CellConfig, truth: Truth) -> None:
        super().__init__(cell, truth)
        self._time = self._begun = 0.0
        self._moving: list[str] = []
        self._past: deque[tuple[float, Joints]] = deque(maxlen=_KEPT)
        self._steps = itertools.count()
        self._distances: list[tuple[float, Near]] = []
        self.scene: BulletBodies = BulletBodies(cell, truth)
        with ExitStack() as if_it_fails:
            if_it_fails.callback(self.close)
            self._nearness = Nearness(self.scene)
            self._past.append((0.0, {arm: self.scene.joints(arm) for arm in self.scene.arms}))
            self._halt_on_contact(self._past[0][1])
            if_it_fails.pop_all()

    def stand(self, joints: Mapping[str, tuple[Target, Array]], now: float) -> None:
        super().stand(joints, now)
        for arm, (target, q) in joints.items():
            self.scene.put(arm, q)
            self.scene.drive(arm, np.array(target), np.zeros_like(q))
        self._time = self._begun = now
        self._past.clear()
        self._past.append((now, {arm: self.scene.joints(arm) for arm in self.scene.arms}))
        self._nearness = Nearness(self.scene)
        self._halt_on_contact(self._past[0][1])

    def follow(self, arm: str, path: JointPath, now: float) -> float:
        self._set_moving(arm, now)
        return super().follow(arm, path, now)

    def track(self, arm: str, set_points: SetPoints, now: float) -> None:
        self._set_moving(arm, now)
        super().track(arm, set_points, now)

    def brake(self, arm: str, now: float) -> float:
        self._advance(now)
        return super().brake(arm, now)

    def sample(self, arm: str, when: float) -> tuple[Array, Array]:
        """Between two steps joints go on at their velocity; earlier than a second ago nothing is known."""
        self._advance(when)
        time, joints = next((entry for entry in reversed(self._past) if entry[0] <= when), self._past[0])
        q, velocity = joints[arm]
        return q + np.clip(when - time, 0.0, STEP) * velocity, velocity.copy()

    def next_look(self, arm: str, now: float) -> float | None:
        self._advance(now)
        return self._time + STEP if arm in self._moving else None

    def documents(self, now: float) -> Mapping[str, dict[str, Any]]:
        times, nears = [time for time, _ in self._distances], [near for _, near in self._distances]
        between = [(near.first, near.second) for near in nears]
        distances = Distances(times, [near.distance for near in nears], between, [(self._begun, now)])
        return {DISTANCES: distances.to_document()}

    def close(self) -> None:
        self._moving = []
        self.scene.close()

    def _set_moving(self, arm: str, now: float) -> None:
        self._advance(now)
        if not self._moving:
            self._time = now
        if arm not in self._moving:
            self._moving.append(arm)

    def _advance(self, until: float) -> None:
        # Times are sums of steps: one that is due must not be missed by a rounding.
        while self._moving and self._time + STEP <= until + 1e-9:
            self._time += STEP
            self._step()

    def _step(self) -> None:
        for arm in self._moving:
            self.scene.drive(arm, *self._set_points[arm].sample(self._time))
        self.scene.step()
        joints = {arm: self.scene.joints(arm) for arm in self.scene.arms}
        if next(self._steps) % STEPS_A_RECORD == 0:
            self._distances.append((self._time, self._nearness.between_arms()))
        self._halt_on_contact(joints)
        self._moving = [arm for arm in self._moving if not self._has_settled(arm, *joints[arm])]
        still = {arm: (q, np.zeros_like(q)) for arm, (q, _) in joints.items() if arm not in self._moving}
        self._past.append((self._time, {**joints, **still}))

    def _has_settled(self, arm: str, q: Array, velocity: Array) -> bool:
        set_points = self._set_points[arm]
        off = np.max(np.abs(q - set_points.destination), initial=0.0)
        return bool(set_points.end <= self._time and off <= SETTLED and np.max(np.abs(velocity), initial=0.0) <= STILL)

    def _halt_on_contact(self, joints: Joints) -> None:
        contact = self._nearness.contact({arm: STEP * np.abs(velocity) for arm, (_, velocity) in joints.items()})
        if contact is not None:
            self.fault = f"{contact.first} touches {contact.second}"
            self._moving = []
