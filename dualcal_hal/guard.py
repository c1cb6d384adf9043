"""The last look before anything is sent to an arm. No configuration takes it away."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError
from dualcal_hal.geometry import BETWEEN_SAMPLES, CellGeometry, Placement
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Mode, Motion, MotionState, Robot, RobotState, StopResult
from dualcal_hal.transforms import Array

READ_TIMEOUT = 0.5
"""Seconds within which an arm must answer with its state."""

OLDEST_FEEDBACK = 0.1
"""Seconds after which a state no longer says where an arm is."""

CLOCK_SLACK = 0.005
"""Seconds that a state may seem to be ahead where times were taken from one clock to another."""

STANDSTILL = 0.01
"""rad/s below which a joint counts as standing; readings of a resting arm scatter."""

PLANNERS_SHARE = 0.5
"""Part of the clearance that the guard insists on; the rest is what plans and the reading of joints may differ by.

So a plan that kept the whole of it, for the same placement, is not refused.
"""

READING_SLACK = 0.001
"""m by which clearance may seem to fall because joints are read, not known."""

_ENCODERS = "check the link and the encoders"


class CellGuard:
    """Holds both arms; every motion of either passes here.

    Refused with CommandRefused before the first byte: values that are not finite or too many or few, positions
    beyond limits, speeds beyond the arm's, an arm that is not ready or whose state is not fresh, the second of two
    arms at a time, and paths that come closer than half the clearance to the other arm, the floor, a fixture or the arm
    itself, whatever the error of the bases that the placement allows for.
    """

    def __init__(
        self,
        active: GuardedRobot,
        passive: GuardedRobot,
        geometry: CellGeometry,
        placement: Placement,
        clearance: float,
    ) -> None:
        self._active, self._passive = active, passive
        self._geometry = geometry
        self._placement = placement
        self._clearance = clearance * PLANNERS_SHARE
        one_at_a_time = threading.Lock()
        active.admit(self._check_active, one_at_a_time)
        passive.admit(self._check_passive, one_at_a_time)

    def place(self, placement: Placement, geometry: CellGeometry) -> None:
        """Judge clearance with the bases there and these shapes from here on; before, they are the nominal ones."""
        self._placement, self._geometry = placement, geometry

    def _check_active(self, waypoints: Array) -> None:
        other = self._standing(self._passive)
        path = self._geometry.active.sampled(waypoints)
        self._require(
            self._active.name,
            self._geometry.between(path, [other.positions], self._placement),
            self._geometry.active.own_clearance(path),
        )

    def _check_passive(self, waypoints: Array) -> None:
        other = self._standing(self._active)
        path = self._geometry.passive.sampled(waypoints)
        self._require(
            self._passive.name,
            self._geometry.between([other.positions], path, self._placement),
            self._geometry.passive.own_clearance(path),
        )

    def _standing(self, other: GuardedRobot) -> RobotState:
        """Where the other arm stands; one that moves is nowhere for long enough to keep clear of."""
        state = other.fresh_state("move the other arm")
        if other.moving or max(map(abs, state.velocities)) > STANDSTILL:
            raise CommandRefused(other.name, "move the other arm", "this one is moving", "wait until it has settled")
        return state

    def _require(self, arm: str, between: Array, own: Array) -> None:
        if between[0] < BETWEEN_SAMPLES - READING_SLACK:
            # Every way could lead deeper into what the arm may be touching.
            why = "the bases may stand so that it touches the other arm, or what stands about that, where it is"
            raise CommandRefused(arm, "move", why, "nothing was sent; jog the arms apart by hand")
        for at_samples, what in (
            (between, "the other arm or what stands about it"),
            (own, "the floor, a fixture or itself"),
        ):
            clearance = at_samples - BETWEEN_SAMPLES
            # An arm that already stands too close to something may move away from that, never closer again.
            reached = np.maximum.accumulate(clearance)
            allowed = np.minimum(self._clearance, reached - READING_SLACK)
            if np.all(clearance >= allowed):
                continue
            least = float(np.min(clearance))
            if clearance[0] < self._clearance:
                why = f"it may stand within {clearance[0] * 1e3:.1f} mm of {what}, and the path leads closer"
                advice = "nothing was sent; jog it away by hand"
            else:
                needed = f"{self._clearance * 1e3:.1f} mm are needed"
                why = f"the path may come within {least * 1e3:.1f} mm of {what}; {needed}"
                advice = "nothing was sent; plan anew or check the nominal transforms in the cell file"
            raise CommandRefused(arm, "move", why, advice)


class GuardedRobot(Robot):
    """A robot that starts no motion which its limits, its state or the cell forbid."""

    def __init__(self, robot: Robot, limits: JointLimits, clock: Clock) -> None:
        self.name = robot.name
        self._robot = robot
        self._limits = limits
        self._clock = clock
        self._check_cell: Callable[[Array], None] | None = None
        self._starting = threading.Lock()
        self._motion: Motion | None = None

    @property
    def moving(self) -> bool:
        """Whether the motion that was started last has not ended."""
        return self._motion is not None and self._motion.state is MotionState.RUNNING

    def admit(self, check: Callable[[Array], None], lock: threading.Lock) -> None:
        """Let ``check`` judge the waypoints (w, n) of each path, the first where the arm stands (called by CellGuard).

        Without it nothing moves. ``lock`` is held from the judging until the motion has begun, so that no other
        begins meanwhile.
        """
        self._check_cell, self._starting = check, lock

    @property
    def joints(self) -> int:
        return self._robot.joints

    def read(self, timeout: float) -> RobotState:
        """The arm's state; DeviceError if it is none of an arm with these joints."""
        state = self._robot.read(timeout)
        if (why := self._unusable(state)) is not None:
            raise DeviceError(self.name, "read", why, _ENCODERS)
        return state

    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        return self._robot.subscribe(function)

    def start(self, path: JointPath) -> Motion:
        """Begin to follow ``path`` (rad, rad/s, rad/s^2) if nothing speaks against it, else CommandRefused."""
        if self._check_cell is None:
            raise CommandRefused(self.name, "move", "the cell is not open", "open it first")
        if (why := self._limits.objection(path)) is not None:
            raise CommandRefused(self.name, "move", why, "nothing was sent; this is an error in the plan")
        with self._starting:
            return self._start(path, self._check_cell)

    def _start(self, path: JointPath, check_cell: Callable[[Array], None]) -> Motion:
        state = self.fresh_state("move")
        if state.mode is not Mode.READY or state.faults:
            what = ", ".join([f"mode '{state.mode}'", *state.faults])
            raise CommandRefused(self.name, "move", f"the arm is not ready: {what}", "clear it at the controller")
        check_cell(np.array([state.positions, *path.waypoints]))
        self._motion = self._robot.start(path)
        return self._motion

    def stop(self, reason: str) -> StopResult:
        return self._robot.stop(reason)

    def enable(self, timeout: float) -> None:
        self._robot.enable(timeout)

    def disable(self, timeout: float) -> None:
        self._robot.disable(timeout)

    def reset_fault(self, timeout: float) -> None:
        self._robot.reset_fault(timeout)

    def fresh_state(self, attempted: str) -> RobotState:
        """The arm's state, read now; CommandRefused if it is not fresh or no joint angles."""
        state = self._robot.read(READ_TIMEOUT)
        age = self._clock.now() - state.time
        if not -CLOCK_SLACK <= age <= OLDEST_FEEDBACK:
            raise CommandRefused(self.name, attempted, f"its state is {age:.2f} s old", "check the link to the arm")
        if (why := self._unusable(state)) is not None:
            raise CommandRefused(self.name, attempted, why, _ENCODERS)
        return state

    def _unusable(self, state: RobotState) -> str | None:
        for what, values in (("positions", state.positions), ("velocities", state.velocities)):
            if len(values) != len(self._limits.lower) or not np.all(np.isfinite(values)):
                return f"its {what} are not {len(self._limits.lower)} finite numbers: {values}"
        return None
