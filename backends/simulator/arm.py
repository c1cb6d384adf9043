"""A simulated arm: its motion, its errors and what its encoders read."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from backends.simulator.stepper import Stepper
from dualcal_hal.errors import CommandRefused
from dualcal_hal.robot import JointPath, Joints, Mode, Motion, RobotState, StopResult
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.simulator.world import World
    from dualcal_hal.config import RobotConfig


class SimulatedArm:
    """``target``: where it was sent last, in rad; after a stop, where that brought it to rest."""

    def __init__(self, name: str, config: RobotConfig, world: World) -> None:
        self._name = name
        self._world = world
        self._stepper: Stepper = world.stepper(config.home, config.acceleration)
        self._motion: Motion | None = None
        self._stop_reason: str | None = None
        self._sequence = 0
        self._mode = Mode.READY
        self.target: Joints = self._stepper.destination()
        self._begin = self._end = world.clock.now()
        self._error_before = self._error_after = world.joint_error(name, self.target)

    def true_positions(self, when: float) -> Array:
        """(n,) rad at time ``when``, the error that the encoders do not see included."""
        return self._stepper.sample(when)[0] + self._joint_error(when)

    def state(self, stream: str) -> RobotState:
        """What its encoders read now; each ``stream`` of states has noise of its own."""
        with self._world.lock:
            now = self._world.clock.now()
            positions, velocities = self._stepper.sample(now)
            noise = self._world.sample_noise(self._name, stream).standard_normal(len(positions))
            positions = positions + self._world.noise.encoder * noise
            self._sequence += 1
            return RobotState(
                tuple(positions.tolist()), tuple(velocities.tolist()), self._mode, (), now, self._sequence
            )

    def follow(self, path: JointPath) -> Motion:
        """Begin to follow a path that the arm can follow; CommandRefused if it moves or is switched off."""
        self._finish(self._motion)
        with self._world.lock:
            self._refuse_if_moving("move")
            if self._mode is not Mode.READY:
                raise CommandRefused(self._name, "move", "its drives are off", "enable it")
            motion = self._motion = Motion(self._name, self._world.clock)
            self._stop_reason = None
            now = self._world.clock.now()
            self._rest_anew(now, self._stepper.follow(path, now))
        self._world.clock.call_at(self._end, partial(self._finish, motion))
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
                self._rest_anew(now, self._stepper.brake(now))
            end = self._end
        self._world.clock.call_at(end, partial(self._finish, motion))
        self._world.clock.wait(self._world.closed, end)
        self._finish(motion)
        with self._world.lock:
            return StopResult(confirmed=self._motion is not motion)

    def switch(self, mode: Mode) -> None:
        """Switch the drives on (READY) or off (DISABLED)."""
        self._finish(self._motion)
        with self._world.lock:
            self._refuse_if_moving("switch the drives")
            self._mode = mode

    def halt(self, reason: str) -> None:
        """End a motion where it is, without braking: its world ends."""
        with self._world.lock:
            motion, self._motion = self._motion, None
        if motion is not None:
            motion.stop(reason)

    def _finish(self, motion: Motion | None) -> None:
        """End ``motion`` if it is the present one and its time has come; its listeners run without the lock."""
        with self._world.lock:
            if motion is None or motion is not self._motion or self._world.clock.now() < self._end:
                return
            self._motion = None
            stop_reason = self._stop_reason
            final = self.state("arrival")
        if stop_reason is None:
            motion.settle(final)
        else:
            motion.stop(stop_reason)

    def _rest_anew(self, begin: float, end: float) -> None:
        """The stepper has another destination; the joints' error drifts to the one that belongs there."""
        self._error_before = self._joint_error(begin)
        self._begin, self._end = begin, end
        destination = self._stepper.destination()
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
