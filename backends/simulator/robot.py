"""The simulated arm as a device."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from backends.simulator.world import World
from dualcal_hal.errors import CommandRefused, DeviceError
from dualcal_hal.robot import JointPath, Mode, Motion, Robot, RobotState, StopResult

if TYPE_CHECKING:
    from dualcal_hal.config import RobotConfig

STATE_PERIOD = 0.05  # s of simulated time between subscribed states: what a viewer needs, at half the cost of 50 Hz
_ROUNDING = 1e-6  # rad by which a waypoint may exceed a limit


class SimulatedRobot(Robot):
    """``opened(device, attempted)`` gives the world, or raises NotOpen.

    Calls answer at once, so their timeouts never end them; only :meth:`stop` waits, for the braking.
    """

    def __init__(self, name: str, config: RobotConfig, opened: Callable[[str, str], World]) -> None:
        self.name = name
        self._lower, self._upper = config.lower, config.upper
        self._largest = {"speed": config.speed, "acceleration": config.acceleration}
        self._opened = opened

    @property
    def joints(self) -> int:
        return len(self._lower)

    def read(self, timeout: float) -> RobotState:
        return self._world("read").arms[self.name].state("read")

    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """States every 0.05 s of simulated time, in the thread that makes the time; nothing is queued.

        If ``function`` raises, its subscription ends and whoever made the time, by waiting on the clock,
        gets a DeviceError.
        """
        subscription = _Subscription(self.name, self._world("subscribe"), function)
        subscription.schedule()
        return subscription.end

    def start(self, path: JointPath) -> Motion:
        arm = self._world("move").arms[self.name]
        self._check(path)
        return arm.follow(path)

    def stop(self, reason: str) -> StopResult:
        return self._world("stop").arms[self.name].stop(reason)

    def enable(self, timeout: float) -> None:
        self._world("enable").arms[self.name].switch(Mode.READY)

    def disable(self, timeout: float) -> None:
        self._world("disable").arms[self.name].switch(Mode.DISABLED)

    def reset_fault(self, timeout: float) -> None:
        """Nothing to acknowledge: the simulated arm has no faults of its own."""
        self._world("reset a fault")

    def _world(self, attempted: str) -> World:
        return self._opened(self.name, attempted)

    def _check(self, path: JointPath) -> None:
        bounds = {"speed": path.speed, "acceleration": path.acceleration}
        waypoints = {f"waypoint {number}": q for number, q in enumerate(path.waypoints, start=1)}
        if not waypoints:
            self._refuse("the path has no waypoint")
        for what, values in {**bounds, **waypoints}.items():
            if len(values) != self.joints:
                self._refuse(f"{what} has {len(values)} values for {self.joints} joints")
            if not np.all(np.isfinite(values)):
                self._refuse(f"{what} is not finite")
        for what, values in bounds.items():
            if min(values) <= 0:
                self._refuse(f"{what} must be above 0 for every joint")
            if np.any(np.asarray(values) > self._largest[what] * (1 + 1e-9)):
                self._refuse(f"{what} is beyond the arm's own")
        for what, values in waypoints.items():
            outside = np.maximum(self._lower - values, np.asarray(values) - self._upper)
            joint = int(np.argmax(outside))
            if outside[joint] > _ROUNDING:
                self._refuse(
                    f"{what}: joint {joint + 1} at {np.degrees(values[joint]):.3f} deg is outside its limits "
                    f"{np.degrees(self._lower[joint]):g} to {np.degrees(self._upper[joint]):g} deg"
                )

    def _refuse(self, why: str) -> None:
        raise CommandRefused(self.name, "move", why, "check the path")


class _Subscription:
    def __init__(self, device: str, world: World, function: Callable[[RobotState], None]) -> None:
        self._device = device
        self._world = world
        self._function = function
        self._ended = False

    def end(self) -> None:
        self._ended = True

    def schedule(self) -> None:
        self._world.clock.call_at(self._world.clock.now() + STATE_PERIOD, self._deliver)

    def _deliver(self) -> None:
        if self._ended or self._world.closed.is_set():
            return
        self.schedule()
        try:
            self._function(self._world.arms[self._device].state("subscribed"))
        except Exception as error:
            self.end()
            raise DeviceError(
                self._device, "hand over a state", f"the subscriber failed: {error!r}", "it gets no more states"
            ) from error
