"""The last look before anything is sent to an arm. No configuration takes it away."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence

import numpy as np

from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError
from dualcal_hal.findings import Finding
from dualcal_hal.geometry import BETWEEN_SAMPLES, ArmBody, CellGeometry, Placement
from dualcal_hal.limits import JointLimits
from dualcal_hal.pace import FULL_PACE, Pace, fastest_part, part_speed
from dualcal_hal.robot import JointPath, Joints, Mode, Motion, MotionState, Robot, RobotState, StopResult
from dualcal_hal.transforms import Array
from dualcal_hal.watch import Bounds, Watch

_Admission = Callable[[RobotState, JointPath], Bounds | None]
"""Judges a path from where the arm stands; what it has to keep on the way, None where it is not watched."""

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

LARGEST_STEP = 4 * np.pi
"""rad that no joint turns by from one waypoint to the next: more is a mistake, of units or of where the arm stands."""

LEFT_WITHIN = 0.02
"""rad that an arm may stand from where its last motion has settled: farther off somebody has moved it."""

WATCH_SLACK = 0.010
"""m by which clearance may be less than anywhere on the path while the arm moves: readings are late and scatter."""

_LEVER = 0.2  # m; a corner that is cut by so much more turns a joint by less
_ROUNDING = 1e-6
_ENCODERS = "check the link and the encoders"


class CellGuard:
    """Holds both arms; every motion of either passes here, at the ``pace`` that the cell allows.

    Refused with CommandRefused before the first byte: values that are not finite or too many or few, positions
    beyond limits, speeds beyond the arm's, an arm that is not ready or whose state is not fresh, the second of two
    arms at a time, and paths that come closer than half the clearance to the other arm, the floor, a fixture or the arm
    itself, whatever the error of the bases that the placement allows for; a speed beyond the pace, and an arm that
    moves at a speed of its own which nobody has confirmed to be within it.

    Where time is real both arms are watched while one moves: what goes wrong with one stops both, and ends the motion
    by its error.
    """

    def __init__(
        self,
        active: GuardedRobot,
        passive: GuardedRobot,
        geometry: CellGeometry,
        placement: Placement,
        clearance: float,
        pace: Pace = FULL_PACE,
        corridor: float = 0.0,
        watched: bool = False,
    ) -> None:
        """``corridor``: m by which arms may cut corners of their paths; ``watched``: whether motions are."""
        self._active, self._passive = active, passive
        self._geometry = geometry
        self._pace, self._corridor, self._watched = pace, corridor, watched
        self._placement = placement
        self._clearance = clearance * PLANNERS_SHARE + corridor
        one_at_a_time = threading.Lock()
        active.admit(self._admit_active, one_at_a_time)
        passive.admit(self._admit_passive, one_at_a_time)

    def place(self, placement: Placement, geometry: CellGeometry) -> None:
        """Judge clearance with the bases there and these shapes from here on; before, they are the nominal ones."""
        self._placement, self._geometry = placement, geometry

    def path(self, arm: str, start: Joints, waypoints: tuple[Joints, ...]) -> JointPath:
        """The fastest path of an arm from ``start`` through ``waypoints`` (rad) at the cell's pace."""
        robot, body = self._side(arm)
        return self._pace_of(robot).path(start, waypoints, robot.limits, body)

    def _side(self, arm: str) -> tuple[GuardedRobot, ArmBody]:
        if arm == self._active.name:
            return self._active, self._geometry.active
        return self._passive, self._geometry.passive

    def _pace_of(self, robot: GuardedRobot) -> Pace:
        return self._pace if robot.keeps_speed else self._pace.at_most(robot.confirmed_speed)

    def _admit_active(self, start: RobotState, path: JointPath) -> Bounds | None:
        geometry, placement = self._geometry, self._placement
        other = self._standing(self._passive).positions
        samples = geometry.active.sampled([start.positions, *path.waypoints])
        least = self._require(
            self._active.name,
            geometry.between(samples, [other], placement),
            geometry.active.own_clearance(samples),
        )

        def clearance(q: Array, q_other: Array) -> float:
            own = geometry.active.own_clearance(q)
            return float(np.minimum(own, geometry.between(q, q_other, placement))[0])

        return self._bounds(self._active, other, geometry.active, start, path, clearance, least)

    def _admit_passive(self, start: RobotState, path: JointPath) -> Bounds | None:
        geometry, placement = self._geometry, self._placement
        other = self._standing(self._active).positions
        samples = geometry.passive.sampled([start.positions, *path.waypoints])
        least = self._require(
            self._passive.name,
            geometry.between([other], samples, placement),
            geometry.passive.own_clearance(samples),
        )

        def clearance(q: Array, q_other: Array) -> float:
            own = geometry.passive.own_clearance(q)
            return float(np.minimum(own, geometry.between(q_other, q, placement))[0])

        return self._bounds(self._passive, other, geometry.passive, start, path, clearance, least)

    def _bounds(
        self,
        robot: GuardedRobot,
        standing: Joints,
        body: ArmBody,
        start: RobotState,
        path: JointPath,
        clearance: Callable[[Array, Array], float],
        least: float,
    ) -> Bounds | None:
        """What the motion has to keep while it is watched; CommandRefused if it would be too fast."""
        self._require_pace(robot, body, start, path)
        if not self._watched:
            return None
        return Bounds(
            other=self._passive if robot is self._active else self._active,
            standing=standing,
            waypoints=np.array([start.positions, *path.waypoints]),
            corner=self._corridor / _LEVER,
            clearance=clearance,
            least=least - WATCH_SLACK - self._corridor,
            speed=lambda before, after, seconds: part_speed(body, before, after, seconds),
            fastest=self._pace.bound if robot.keeps_speed else self._pace.to_be_confirmed,
        )

    def _require_pace(self, robot: GuardedRobot, body: ArmBody, start: RobotState, path: JointPath) -> None:
        pace, needed = self._pace_of(robot), self._pace.to_be_confirmed
        if not robot.keeps_speed and needed is not None:
            confirmed = robot.confirmed_speed
            if confirmed is None or confirmed > needed * (1 + 1e-9):
                said = "nobody has confirmed it" if confirmed is None else f"{confirmed * 1e3:.0f} mm/s are confirmed"
                why = f"its controller moves at a speed of its own, {needed * 1e3:.0f} mm/s are allowed, and {said}"
                advice = "set it there, and say so in the cell file: controller_speed_confirmed: {mm_s: ...}"
                raise CommandRefused(robot.name, "move", why, advice)
        if pace.bound is None:
            return
        fastest = fastest_part(body, start.positions, path)
        if fastest > pace.bound * (1 + _ROUNDING):
            why = f"a part would move at {fastest * 1e3:.0f} mm/s, and {pace.bound * 1e3:.0f} mm/s are allowed"
            raise CommandRefused(robot.name, "move", why, "nothing was sent; this is an error in the plan")

    def _standing(self, other: GuardedRobot) -> RobotState:
        """Where the other arm stands; one that moves is nowhere for long enough to keep clear of."""
        state = other.fresh_state("move the other arm")
        if self._watched:
            # The watch would stop the motion at once: better not to begin it.
            other.require_ready(state, "move the other arm")
        if other.moving or max(map(abs, state.velocities), default=0.0) > STANDSTILL:
            raise CommandRefused(other.name, "move the other arm", "this one is moving", "wait until it has settled")
        return state

    def _require(self, arm: str, between: Array, own: Array) -> float:
        """The least clearance (m) on the way; CommandRefused if that is too little."""
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
        return float(min(np.min(between), np.min(own)) - BETWEEN_SAMPLES)


class GuardedRobot(Robot):
    """A robot that starts no motion which its limits, its state or the cell forbid."""

    def __init__(self, robot: Robot, limits: JointLimits, clock: Clock) -> None:
        self.name = robot.name
        self._robot = robot
        self.limits = limits
        self._clock = clock
        self._admit: _Admission | None = None
        self._starting = threading.Lock()
        self._motion: Motion | None = None

    @property
    def moving(self) -> bool:
        """Whether the motion that was started last has not ended."""
        return self._motion is not None and self._motion.state is MotionState.RUNNING

    def admit(self, admission: _Admission, lock: threading.Lock) -> None:
        """Let ``admission`` judge each path, from where the arm stands (called by CellGuard).

        Without it nothing moves. ``lock`` is held from the judging until the motion has begun, so that no other
        begins meanwhile.
        """
        self._admit, self._starting = admission, lock

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

    def observe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        return self._robot.observe(function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        return self._robot.on_failure(function)

    @property
    def keeps_speed(self) -> bool:
        return self._robot.keeps_speed

    @property
    def confirmed_speed(self) -> float | None:
        return self._robot.confirmed_speed

    def findings(self) -> list[Finding]:
        return self._robot.findings()

    def start(self, path: JointPath) -> Motion:
        """Begin to follow ``path`` (rad, rad/s, rad/s^2) if nothing speaks against it, else CommandRefused."""
        admit = self._admit
        if admit is None:
            raise CommandRefused(self.name, "move", "the cell is not open", "open it first")
        if (why := self.limits.objection(path)) is not None:
            raise CommandRefused(self.name, "move", why, "nothing was sent; this is an error in the plan")
        with self._starting:
            self._motion = self._start(path, admit)
            return self._motion

    def _start(self, path: JointPath, admit: _Admission) -> Motion:
        state = self.fresh_state("move")
        self.require_ready(state, "move")
        left_at = None if self._motion is None else self._motion.final
        away = 0.0 if left_at is None else float(np.max(np.abs(np.subtract(state.positions, left_at.positions))))
        if away > LEFT_WITHIN:
            why = f"it stands {np.rad2deg(away):.2f} deg from where its last motion has ended"
            raise CommandRefused(self.name, "move", why, "nothing was sent; find out what moved it, and run anew")
        steps = np.abs(np.diff([state.positions, *path.waypoints], axis=0))
        if np.max(steps) > LARGEST_STEP:
            joint = int(np.unravel_index(np.argmax(steps), steps.shape)[1])
            why = f"joint {joint + 1} would turn by {np.rad2deg(np.max(steps)):.0f} deg in one step"
            raise CommandRefused(self.name, "move", why, "nothing was sent; check the units and where the arm stands")
        bounds = admit(state, path)
        if bounds is None:
            return self._robot.start(path)
        return self._watched(path, bounds)

    def _watched(self, path: JointPath, bounds: Bounds) -> Motion:
        """A motion that ends as the device's does, or by what the watch finds: then both arms are stopped first."""
        motion = Motion(self.name, self._clock)
        found: list[DeviceError] = []

        def alarm(error: DeviceError, told: Sequence[DeviceError]) -> None:
            found.append(error)
            # Both at once: the stop of one whose link is lost is not confirmed for a while.
            other = threading.Thread(target=_stopped, args=(bounds.other, error), name=f"stop {bounds.other.name}")
            other.start()
            _stopped(self, error)
            other.join()
            for more in told:
                if more is not error:  # such as the drive that did not answer, where the arm was late
                    error.add_note(str(more))
            motion.end(MotionState.FAILED, None, error)

        watch = Watch(self._robot, bounds, self._clock, alarm)
        try:
            sent = self._robot.start(path)
        except BaseException as error:
            watch.end()
            if found:  # what is raised is only that it was stopped
                raise found[0] from error
            raise

        def ended() -> None:
            watch.end()
            if not found:
                motion.end(sent.state, sent.final, sent.error)

        sent.on_end(ended)
        return motion

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

    def require_ready(self, state: RobotState, attempted: str) -> None:
        """CommandRefused if the arm would not move, or has a fault, by its ``state``."""
        if state.mode is not Mode.READY or state.faults:
            what = ", ".join([f"mode '{state.mode}'", *state.faults])
            raise CommandRefused(self.name, attempted, f"the arm is not ready: {what}", "clear it at the controller")

    def _unusable(self, state: RobotState) -> str | None:
        for what, values in (("positions", state.positions), ("velocities", state.velocities)):
            if len(values) != len(self.limits.lower) or not np.all(np.isfinite(values)):
                return f"its {what} are not {len(self.limits.lower)} finite numbers: {values}"
        return None


def _stopped(robot: Robot, error: DeviceError) -> None:
    """Stop an arm because of an error, which gets a note where it may not stand."""
    try:
        result = robot.stop(error.why)
    except Exception as second:  # noqa: BLE001 - the other arm has to be stopped, too; told by the note
        error.add_note(f"{robot.name}: could not be stopped ({second}): use the emergency stop")
        return
    if not result.confirmed:
        error.add_note(f"{robot.name}: its stop is not confirmed ({result.detail}): use the emergency stop")
