"""The simulated arm as a device."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from backends.simulator.world import World
from dualcal_hal.errors import CommandRefused, DeviceError
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Mode, Motion, Robot, RobotState, StopResult

if TYPE_CHECKING:
    from dualcal_hal.config import RobotConfig

STATE_PERIOD = 0.05  # s of simulated time between subscribed states: what a viewer needs, at half the cost of 50 Hz


class SimulatedRobot(Robot):
    """``opened(device, attempted)`` gives the world, or raises NotOpen.

    Calls answer at once, so their timeouts never end them; only :meth:`stop` waits, for the braking.
    """

    def __init__(self, name: str, config: RobotConfig, opened: Callable[[str, str], World]) -> None:
        self.name = name
        self._limits = JointLimits.of(config)
        self._opened = opened

    @property
    def joints(self) -> int:
        return len(self._limits.lower)

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
        if (why := self._limits.objection(path)) is not None:
            raise CommandRefused(self.name, "move", why, "check the path")
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
