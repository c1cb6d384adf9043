"""What stands in the place of an arm: it has no joints, and no device behind it."""

from __future__ import annotations

from collections.abc import Callable

from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused
from dualcal_hal.robot import JointPath, Mode, Motion, Robot, RobotState, StopResult


class Stand(Robot):
    """Ready at any time, and never moved."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        self._sequence = 0

    @property
    def joints(self) -> int:
        return 0

    def read(self, timeout: float) -> RobotState:
        self._sequence += 1
        return RobotState((), (), Mode.READY, (), self._clock.now(), self._sequence)

    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        """There is nothing to be told of it."""
        return lambda: None

    def start(self, path: JointPath) -> Motion:
        raise CommandRefused(self.name, "move", "it has no joints", "nothing was sent; this is an error in the plan")

    def stop(self, reason: str) -> StopResult:
        return StopResult(confirmed=True, detail="it cannot move")

    def enable(self, timeout: float) -> None:
        """It has no drives."""

    def disable(self, timeout: float) -> None:
        """It has no drives."""

    def reset_fault(self, timeout: float) -> None:
        """It has no faults."""
