"""An emulated arm: what its motors and encoders are to the controller that has it."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from backends.controller.emulator.servo import Braking, Ramp, Servo, SetPoints, Still
from backends.simulator.mechanics import Approach, unseen_error
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.controller.emulator.world import EmulatedWorld
    from dualcal_hal.clock import Clock
    from dualcal_hal.config import RobotConfig

__all__ = ["Braking", "EmulatedArm", "Ramp", "Reading", "SetPoints", "Still"]

ENCODER_STEP = 2 * np.pi / 2**20
"""Radians from one reading of an encoder to the next."""

SETTLING = 0.05
"""Seconds after its joints came to rest in which the error comes in that its encoders do not see."""

_AWAY = 1e-4  # rad by which set points differ that are more than where a controller reads that it stands
_SLOW = 1e-3  # rad/s below which a stretch of a motion has ended
_SAME_TARGET = 1e-6  # rad: what belongs to a target does not depend on how its numbers were rounded on the wire


@dataclass(frozen=True, eq=False)
class Reading:
    """What the encoders show: positions (n,) rad in steps of the encoder, velocities (n,) rad/s, time in s of the
    clock."""

    positions: Array
    velocities: Array
    time: float


class EmulatedArm:
    """The arm's motors and encoders, in the joints of its kinematics; times are the clock's, in s.

    Of power, modes and faults it knows nothing: they are the controller's. Any thread may call; nothing here waits.
    motions: how often it began to move.
    """

    def __init__(self, name: str, config: RobotConfig, world: EmulatedWorld) -> None:
        self.name = name
        self.joints = config.chain.joints
        self.speed, self.acceleration = config.speed, config.acceleration
        self.lower, self.upper = config.lower, config.upper
        self.clock: Clock = world.clock
        self.motions = 0
        self._world = world
        self._servo = Servo(config.home, config.speed, config.acceleration)
        self._encoder_noise = np.random.default_rng([world.seed, *name.encode()])
        self._listeners: list[Callable[[EmulatedArm], None]] = []
        self._approach = Approach.at_rest(self.joints)
        self._before = self._stretch_start = config.home
        self._rested: float | None = -math.inf
        self._error_before = self._error_after = self._error_of(self._servo.destination)
        self._stood_at = config.home
        self._moving = self._counted = False
        world.stepper.track(name, self._servo, 0.0)

    # What a controller asks

    def read(self) -> Reading:
        """What its encoders show now."""
        with self._world.lock:
            now = self._world.now()
            q, v = self._world.stepper.sample(self.name, max(0.0, now - self._world.time_skew))
            q = q + self._world.noise.encoder * self._encoder_noise.standard_normal(self.joints)
            return Reading(np.round(q / ENCODER_STEP) * ENCODER_STEP, v, self._world.begin + now)

    @property
    def in_motion(self) -> bool:
        """Whether it has not come to rest, or has just done so."""
        return self._moving

    @property
    def rests_since(self) -> float | None:
        """When it came to rest, None while it has not; -inf if it has never moved."""
        rested = self._rested
        return None if rested is None else self._world.begin + rested

    def commanded(self) -> Array:
        """(n,) rad: where it was told to be by now; where it is to rest, once it has been told no more."""
        with self._world.lock:
            return self._servo.commanded(self._world.now())

    def following_error(self) -> Array:
        """(n,) rad by which it lags behind what it was told."""
        with self._world.lock:
            now = self._world.now()
            return self._servo.commanded(now) - self._world.stepper.sample(self.name, now)[0]

    # What a controller tells

    def follow(self, set_points: SetPoints) -> float:
        """Follow set points whose time begins now; they replace what it was told before. Returns when that is.

        They may become longer while it follows them, if they are changed under :attr:`lock`.
        """
        with self._world.lock:
            now = self._world.now()
            self._tell(set_points, now)
            self._count()
            return self._world.begin + now

    def command(self, q: Array, period: float) -> None:
        """The next set point (n,) in rad of a drive that gets one every ``period`` s, and goes evenly from one to the
        next; without a next one it rests there."""
        with self._world.lock:
            now = self._world.now()
            if np.array_equal(q, self._servo.destination):
                return
            self._tell(Ramp(self._servo.commanded(now), q, period), now)
            if np.max(np.abs(q - self._stood_at)) > _AWAY:
                self._count()

    def hold(self) -> None:
        """Brake to rest as fast as it can, and stay there."""
        with self._world.lock:
            if self._moving and self._world.stepper.fault is None:
                now = self._world.now()
                self._servo.brake(now)
                self._world.stepper.track(self.name, self._servo, now)
                self._world.wake()

    @property
    def lock(self) -> AbstractContextManager[bool]:
        """What set points that change while they are followed are changed under."""
        return self._world.lock

    def on_motion(self, listener: Callable[[EmulatedArm], None]) -> None:
        """Call ``listener``, which must not wait, each time that it begins to move."""
        self._listeners.append(listener)

    # What the world asks

    @property
    def target(self) -> Joints:
        """Where it was sent last, rad."""
        return self._servo.destination

    def angles(self, when: float) -> tuple[Array, Array]:
        """Where its motors (n,) and its links (n,) truly stand at a ``when`` of up to a second ago, rad."""
        with self._world.lock:
            t = when - self._world.begin
            q = self._world.stepper.sample(self.name, t)[0]
            return q, self._world.truth.link_angles(self.name, q, self._approach, t) + self._error(t)

    def advance(self, now: float) -> bool:
        """Go on to ``now`` of the world's time; whether more is to come (called by the world, under its lock)."""
        if not self._moving:
            return False
        q, v = self._world.stepper.sample(self.name, now)
        self._go_on_with_approach(q, v)
        if self._world.stepper.next_look(self.name, now) is not None:
            return True
        if self._rested is None:
            self._rested = now
            self._error_after = self._error_of(self._servo.destination)
            farthest = float(np.max(np.abs(self._approach.way)))
            self._approach = Approach(self._approach.slack, self._approach.way / (farthest or 1.0), self._servo.end)
        self._moving = now < self._rested + SETTLING + self._world.time_skew
        return self._moving

    def _tell(self, set_points: SetPoints, now: float) -> None:
        if self._world.stepper.fault is not None:
            return  # parts touch: nothing moves any more
        if not self._moving:
            self._stood_at, self._counted = self._servo.commanded(now), False
        self._servo.tell(set_points, now)
        self._world.stepper.track(self.name, self._servo, now)
        self._error_before, self._rested = self._error(now), None
        self._approach = Approach(self._approach.slack, self._approach.way, math.inf)
        self._moving = True
        self._world.wake()

    def _count(self) -> None:
        """It has begun to move, unless it is doing so already, or parts touch."""
        if self._moving and not self._counted:
            self._counted = True
            self.motions += 1
            for listener in self._listeners:
                listener(self)

    def _go_on_with_approach(self, q: Array, v: Array) -> None:
        slack = self._approach.then(q - self._before, self._world.backlash, math.inf).slack
        self._before = q
        stretch = q - self._stretch_start
        if float(np.max(np.abs(v))) > _SLOW:
            self._approach = Approach(slack, stretch, math.inf)
        else:
            self._approach, self._stretch_start = Approach(slack, self._approach.way, math.inf), q

    def _error(self, when: float) -> Array:
        """(n,) rad that the encoders do not see."""
        if self._rested is None:
            return self._error_before
        share = min(1.0, max(0.0, (when - self._rested) / SETTLING))
        smooth = share * share * (3.0 - 2.0 * share)
        return self._error_before + smooth * (self._error_after - self._error_before)

    def _error_of(self, target: Joints) -> Array:
        known_by = tuple(round(angle / _SAME_TARGET) * _SAME_TARGET for angle in target)
        return unseen_error(self._world.seed, self.name, known_by, self._world.noise.joint)
