"""A simulated arm: its motion, its errors and what its encoders read."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from backends.simulator.left import ArmLeft
from backends.simulator.mechanics import Approach
from dualcal_hal.errors import CommandRefused, Contact, NotOpen
from dualcal_hal.robot import JointPath, Joints, Mode, Motion, RobotState, StopResult
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.simulator.world import World

LONGEST_SETTLING = 3.0
"""Seconds after the end of its set points within which an arm must have settled."""


class SimulatedArm:
    """``target``: where it was sent last, in rad; after a stop, where that brought it to rest."""

    def __init__(self, name: str, world: World) -> None:
        self._name = name
        self._world = world
        self._stepper = world.stepper
        self._motion: Motion | None = None
        self._stop_reason: str | None = None
        self._sequence = 0
        self._mode = Mode.READY
        self.target: Joints = self._stepper.destination(name)
        self._approach = Approach.at_rest(len(self.target))
        self._begin = self._end = world.clock.now()
        self._settled: float | None = self._end
        self._error_before = self._error_after = world.joint_error(name, self.target)

    def left(self) -> ArmLeft:
        """How it came to its rest (call under the lock)."""
        approach = self._approach
        return ArmLeft(
            target_rad=self.target,
            joints_rad=tuple(self._stepper.sample(self._name, self._world.clock.now())[0].tolist()),
            slack_rad=tuple(approach.slack.tolist()),
            way=tuple(approach.way.tolist()),
            rested_s=approach.end,
            sequence=self._sequence,
        )

    def go_on_from(self, left: ArmLeft) -> None:
        """Be at rest as the arm that gave ``left``; the stepper has it there already (call under the lock)."""
        self._sequence = left.sequence
        self.target = left.target_rad
        self._approach = Approach(np.array(left.slack_rad), np.array(left.way), left.rested_s)
        self._begin = self._end = self._settled = self._world.clock.now()
        self._error_before = self._error_after = self._world.joint_error(self._name, self.target)

    def true_positions(self, when: float) -> Array:
        """(n,) rad at time ``when``, the error that the encoders do not see included."""
        with self._world.lock:
            read = self._stepper.sample(self._name, when)[0]
            return self._world.truth.link_angles(self._name, read, self._approach, when) + self._joint_error(when)

    def state(self, stream: str) -> RobotState:
        """What its encoders read now; each ``stream`` of states has noise of its own."""
        with self._world.lock:
            now = self._world.clock.now()
            positions, velocities = self._stepper.sample(self._name, now - self._world.time_skew)
            noise = self._world.sample_noise(self._name, stream).standard_normal(len(positions))
            positions = positions + self._world.noise.encoder * noise
            self._sequence += 1
            fault = self._stepper.fault
            mode, faults = (self._mode, ()) if fault is None else (Mode.FAULT, (fault,))
            return RobotState(tuple(positions.tolist()), tuple(velocities.tolist()), mode, faults, now, self._sequence)

    def follow(self, path: JointPath) -> Motion:
        """Begin to follow a path that the arm can follow; CommandRefused if it is moving, off or at fault.

        NotOpen if its world has been closed: another thread may do so at any time before this one has the lock.
        """
        self._finish(self._motion)
        with self._world.lock:
            if self._world.closed.is_set():
                raise NotOpen(self._name, "move", "it was closed meanwhile", "open its backend again")
            self._refuse_if_moving("move")
            self._refuse_if_faulty("move")
            if self._mode is not Mode.READY:
                raise CommandRefused(self._name, "move", "its drives are off", "enable it")
            motion = self._motion = Motion(self._name, self._world.clock)
            self._stop_reason = None
            now = self._world.clock.now()
            stretches = np.diff([self.target, *path.waypoints], axis=0)
            self._rest_anew(now, self._stepper.follow(self._name, path, now), stretches)
        self._look_again(motion)
        return motion

    def stop(self, reason: str) -> StopResult:
        """Brake along the path. The caller itself makes the time that takes, if the clock is virtual."""
        motion = self._motion
        self._finish(motion)
        with self._world.lock:
            if motion is None or self._motion is not motion:
                return StopResult(confirmed=True, detail="it stood still")
            if self._stop_reason is None:
                self._stop_reason = reason
                now = self._world.clock.now()
                here = self._stepper.sample(self._name, now)[0]
                end = self._stepper.brake(self._name, now)
                self._rest_anew(now, end, self._stepper.destination(self._name) - here[None])
        self._look_again(motion)
        while self._motion is motion and not self._world.closed.is_set():
            self._world.clock.wait(self._world.closed, self._next_look())
            self._finish(motion)
        with self._world.lock:
            return StopResult(confirmed=self._motion is not motion)

    def switch(self, mode: Mode) -> None:
        """Switch the drives on (READY) or off (DISABLED)."""
        self._finish(self._motion)
        with self._world.lock:
            self._refuse_if_moving("switch the drives")
            self._refuse_if_faulty("switch the drives")
            self._mode = mode

    def halt(self, reason: str) -> None:
        """End a motion where it is, without braking: its world ends."""
        with self._world.lock:
            motion, self._motion = self._motion, None
        if motion is not None:
            motion.stop(reason)

    def _look_again(self, motion: Motion) -> None:
        """Have the clock look whether ``motion`` is over, again and again until it is."""

        def look() -> None:
            self._finish(motion)
            if self._motion is motion:
                self._look_again(motion)

        self._world.clock.call_at(self._next_look(), look)

    def _next_look(self) -> float:
        with self._world.lock:
            now = self._world.clock.now()
            later = self._over_not_before(now)
            return now if later is None else later

    def _over_not_before(self, now: float) -> float | None:
        """When to look again whether the motion is over; None once it is.

        An arm at rest has to be so by its encoders too, which may report it late.
        """
        later = self._stepper.next_look(self._name, now)
        if later is not None or self._stepper.fault is not None:
            return later
        self._settled = now if self._settled is None else self._settled
        reported = self._settled + self._world.time_skew
        return reported if now < reported else None

    def _finish(self, motion: Motion | None) -> None:
        """End ``motion`` if it is the present one and is over; its listeners run without the lock."""
        with self._world.lock:
            now = self._world.clock.now()
            if motion is None or motion is not self._motion:
                return
            over = self._over_not_before(now) is None
            if not over and now <= self._end + LONGEST_SETTLING + self._world.time_skew:
                return
            self._motion = None
            fault, stop_reason = self._stepper.fault, self._stop_reason
            final = self.state("arrival")
        if fault is not None:
            motion.fail(fault, "check what the cell file says of bases, shapes and fixtures; then run anew", Contact)
        elif not over:
            motion.fail(f"not settled {LONGEST_SETTLING:g} s after its set points came to rest")
        elif stop_reason is None:
            motion.settle(final)
        else:
            motion.stop(stop_reason)

    def _rest_anew(self, begin: float, end: float, stretches: Array) -> None:
        """The stepper has another destination, by straight ``stretches`` (k, n) in rad; the joints' error drifts to
        the one that belongs there."""
        self._error_before = self._joint_error(begin)
        self._approach = self._world.truth.approach(self._approach, stretches, end)
        self._begin, self._end, self._settled = begin, end, None
        destination = self._stepper.destination(self._name)
        if destination != self.target:
            self.target = destination
            self._world.target_changed()
        self._error_after = self._world.joint_error(self._name, destination)

    def _joint_error(self, when: float) -> Array:
        if when >= self._end:
            return self._error_after
        share = (when - self._begin) / (self._end - self._begin)
        return self._error_before + share * (self._error_after - self._error_before)

    def _refuse_if_moving(self, attempted: str) -> None:
        if self._motion is not None:
            raise CommandRefused(self._name, attempted, "it is moving", "wait for its motion or stop it")

    def _refuse_if_faulty(self, attempted: str) -> None:
        if self._stepper.fault is not None:
            raise CommandRefused(self._name, attempted, self._stepper.fault, "begin a new run")
