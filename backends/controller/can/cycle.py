"""The cycle of one arm's bus: targets, SYNC, and what the drives answered to the last one.

One thread for each arm, which also sends this program's heartbeat: so if it hangs, the drives stop by themselves. What
the drives say is judged here, as each cycle begins.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Sequence

from backends.controller.can.axis import Axis
from backends.controller.can.configuration import HEARTBEAT
from backends.controller.can.drive import Goal, next_controlword
from backends.controller.can.motion import STOP_AT, Lead
from backends.controller.can.notices import Notices
from backends.controller.can.objects import (
    FOLLOWING_ERROR,
    HALT,
    IN_FAULT,
    RPDO1,
    SYNC,
    Control,
    NmtState,
    Operation,
    State,
    pack_command,
)
from backends.controller.can.objects import HEARTBEAT as HEARTBEAT_FRAME
from backends.controller.can.statistics import CycleStatistics
from backends.controller.link import ArmReport, Transfer
from backends.controller.promptness import prompt_interpreter, prompt_thread
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, LinkLost, MotionStopped
from dualcal_hal.robot import Mode

LOST = 1.0
"""s without an answer, or a heartbeat, after which a drive counts as lost."""
_LATE_FEEDBACK = 0.1  # s, or three periods if that is longer
_LATE_HEARTBEAT = 3.5 * HEARTBEAT
_VELOCITY_OVER = 5  # periods
_STANDING = 2, 5e-5  # counts and rad within which a joint stands: what an encoder shows of itself

Send = Callable[[Sequence[tuple[int, bytes]]], None]


class Cycle:
    """Leads the axes of one arm while it runs; everything asked of it is done as its next cycle begins."""

    def __init__(
        self,
        device: str,
        axes: Sequence[Axis],
        send: Send,
        operation: Operation,
        period: float,
        master: int,
        clock: Clock,
        notices: Notices,
        on_report: Callable[[ArmReport], None],
    ) -> None:
        self.axes = axes
        self.statistics = CycleStatistics()
        self.failure: DeviceError | None = None
        """The last one, until the drives are enabled anew."""
        self._device = device
        self._send = send
        self._operation = operation
        self._period = period
        self._clock = clock
        self._notices = notices
        self._on_report = on_report
        self._lock = threading.RLock()
        self._ending = threading.Event()
        self._loss: DeviceError | None = None
        self._lead: Lead | None = None
        self._transfer: Transfer | None = None
        self._halted = False
        self._enabled = False
        self._stops: list[threading.Event] = []
        self._waiting: list[tuple[Callable[[], bool], threading.Event]] = []
        self._standing = True
        self._history: deque[tuple[float, list[int]]] = deque(maxlen=_VELOCITY_OVER + 1)
        self._beat = (HEARTBEAT_FRAME + master, bytes((NmtState.OPERATIONAL,)))
        self._watch = [_Watch(axis) for axis in axes]
        self._late_feedback = math.ceil(max(3 * period, _LATE_FEEDBACK) / period)
        self._late_heartbeat = math.ceil(_LATE_HEARTBEAT / period)
        self._lost = math.ceil(LOST / period)
        self._delay = 0.0
        self.prompt = False
        """Whether its thread has real-time priority."""

    # What is asked of it, from any thread.

    @property
    def is_moving(self) -> bool:
        """Whether something leads the drives, or they have not come to rest."""
        return self._lead is not None or not self._standing

    @property
    def is_led(self) -> bool:
        """Whether something leads the drives at the moment."""
        return self._lead is not None

    @property
    def halted(self) -> bool:
        """Whether the drives are held by the halt bit."""
        return self._halted

    @property
    def held(self) -> list[float]:
        """The targets that the drives have, rad."""
        return [axis.scale.to_angle(axis.target) for axis in self.axes]

    def lead(self, lead: Lead, transfer: Transfer) -> None:
        """Follow ``lead`` from the next cycle on; ``transfer`` is told when all of it was told."""
        with self._lock:
            self._lead, self._transfer = lead, transfer

    def stop(self, reason: str, timeout: float) -> bool:
        """Come to rest; whether the drives were told within ``timeout`` s, also that they shall go on to stand."""
        told = threading.Event()
        with self._lock:
            self._stop_leading(MotionStopped(self._device, "move", f"stopped: {reason}"))
            self._stops.append(told)
        return self._clock.wait(told, self._clock.now() + timeout)

    def quick_stop(self, reason: str) -> None:
        """Tell the drives so from the calling thread, where the cycle does not come to it. LinkLost."""
        with self._lock:
            self._stop_leading(MotionStopped(self._device, "move", f"stopped: {reason}"))
            self._want(Goal.QUICK_STOP)
        frames = [
            (RPDO1 + axis.node, pack_command(Control.QUICK_STOP, self._operation, axis.target)) for axis in self.axes
        ]
        self._send([*frames, (SYNC, b"")])

    def give_up(self, error: DeviceError) -> None:
        """What leads the drives cannot go on."""
        with self._lock:
            self._fail(error)

    @property
    def is_silent(self) -> bool:
        """Whether no drive has answered for so many cycles that no motion goes on: one may be late for all."""
        return all(watch.silent >= STOP_AT for watch in self._watch)

    @property
    def silent(self) -> list[str]:
        """Drives that did not answer in the last cycle."""
        return [watch.axis.name for watch in self._watch if watch.silent]

    @property
    def faults(self) -> tuple[str, ...]:
        """What is wrong with the drives, in words."""
        return tuple(text for watch in self._watch if (text := watch.fault))

    def want(self, goal: Goal) -> None:
        """Have each drive led towards ``goal``, a step in each cycle."""
        with self._lock:
            self._want(goal)

    def enabled(self) -> None:
        """All drives have come to be enabled: from here on none may leave it unasked."""
        with self._lock:
            self._enabled, self.failure = True, None

    def forget_emergencies(self) -> None:
        """The operator has acknowledged them."""
        with self._lock:
            for axis in self.axes:
                axis.emergency = None
            for watch in self._watch:
                watch.fault_told = False
            self.failure = None

    def wait_for(self, condition: Callable[[], bool], deadline: float) -> bool:
        """Wait until ``condition`` holds in a cycle; asked on its thread. Whether it did; nobody waits after a loss."""
        event = threading.Event()
        with self._lock:
            if self._ending.is_set():
                return condition()
            self._waiting.append((condition, event))
        self._clock.wait(event, deadline)
        with self._lock:
            self._waiting = [one for one in self._waiting if one[1] is not event]
        return condition()

    def lose(self, error: DeviceError) -> None:
        """The bus is gone (called by its reader)."""
        self._loss = self._loss or error
        self._ending.set()

    def end(self) -> None:
        """Have :meth:`run` return."""
        self._ending.set()

    # Its thread.

    def run(self) -> DeviceError | None:
        """Cycle after cycle until it is ended, then None, or the link is lost, then why."""
        with prompt_interpreter(), prompt_thread() as self.prompt:
            try:
                self._run()
            except DeviceError as error:
                self.lose(error)
            except Exception as error:  # noqa: BLE001 - a thread that died silently would leave its arm unwatched
                failed = LinkLost(self._device, "run the cycle", f"this program failed: {error!r}", "report it")
                failed.__cause__ = error
                self.lose(failed)
        with self._lock:
            if self._loss is not None:
                self._stop_leading(self._loss)
            else:
                self._stop_leading(MotionStopped(self._device, "move", "stopped: the link was closed"))
            for _, event in self._waiting:
                event.set()
            for told in self._stops:
                told.set()
        return self._loss

    def _run(self) -> None:
        due = begin = self._clock.now()
        next_beat = due
        sync = None
        while not self._ending.is_set():
            overslept = int((begin - due) / self._period)
            self._collect(sync, due, overslept)
            with self._lock:
                frames = self._frames()
                stops, self._stops = self._stops, []
            if begin >= next_beat:
                frames.append(self._beat)
                next_beat = begin + HEARTBEAT
            self._delay, sync = begin - due, self._clock.now()
            self._send(frames)
            for told in stops:
                told.set()
            due += self._period * (1 + overslept)
            self._clock.wait(self._ending, due)
            begin = self._clock.now()

    def _collect(self, sync: float | None, due: float, overslept: int) -> None:
        """Judge what has come since the last SYNC, sent at ``sync``, and was to come until ``due``."""
        arrived = 0.0
        complete = True
        for watch in self._watch:
            complete = watch.look() and complete
            arrived = max(arrived, watch.axis.arrival)
        if sync is None:
            return
        late = overslept + (0 if complete and arrived <= due else 1)
        duration = arrived - sync if complete else None
        self.statistics.ended(duration, self._delay, late, self._lead is not None)
        with self._lock:
            self._judge()
            if complete:
                self._report(sync)
            for condition, event in self._waiting:
                if condition():
                    event.set()

    def _frames(self) -> list[tuple[int, bytes]]:
        """What the drives are told in this cycle, and SYNC."""
        frames = []
        # Before a drive has said where it stands, there is no target that would not move it.
        if all(axis.feedback is not None for axis in self.axes):
            self._command(self.statistics.late_run)
            for axis in self.axes:
                axis.controlword = next_controlword(axis.state, axis.goal, axis.controlword)
                word = axis.controlword | (axis.bits if axis.controlword == Control.ENABLE_OPERATION else 0)
                frames.append((RPDO1 + axis.node, pack_command(word, self._operation, axis.target)))
        frames.append((SYNC, b""))
        return frames

    def _command(self, late: int) -> None:
        lead = self._lead
        if lead is None:
            for axis in self.axes:
                axis.bits = HALT if self._halted else 0
        else:
            if late >= STOP_AT and not lead.is_braking:
                self._fail(self._why_late(late))
            try:
                lead.command(self.axes, late)
            except ValueError as error:
                self._fail(DeviceError(self._device, "move", str(error), "this is an error of the program"))
                lead.brake()
            self.statistics.largest_step = max(self.statistics.largest_step, lead.largest_step)
            self._halted = lead.halted
            if lead.is_told:
                self._end_transfer(None)
            if lead.is_over:
                self._lead = None
        for axis in self.axes:
            if axis.state is not State.OPERATION_ENABLED:
                # So nothing jumps when it comes to be enabled.
                axis.target = axis.position

    # What the drives said. All with the lock held.

    def _judge(self) -> None:
        left = [watch.axis for watch in self._watch if self._judge_drive(watch)]
        if left:
            self._fail_left(left)
        self._judge_silence([w for w in self._watch if w.silent == self._late_feedback], "has not answered")
        heartless = [w for w in self._watch if w.heartless == self._late_heartbeat and w.silent < self._late_feedback]
        self._judge_silence(heartless, "has sent no heartbeat")
        for watch in self._watch:
            if (what := watch.missing_for(self._lost)) is not None:
                self.lose(LinkLost(self._device, "receive", what, "check its power and the bus"))

    def _judge_drive(self, watch: _Watch) -> bool:
        """Whether it has left operation enabled, other than by a fault, which is told here."""
        axis = watch.axis
        while axis.emergencies:
            emergency = axis.emergencies.popleft()
            axis.emergency = None if emergency.is_over else emergency
            watch.fault_told = not emergency.is_over
            if not emergency.is_over:
                self._fail_drive(axis, f"emergency, {emergency}, error register 0x{emergency.register:02X}")
        if axis.booted:
            axis.booted = False
            watch.rebooted = True
            axis.goal = Goal.OFF
            self._fail_drive(axis, "has rebooted and lost what it was set up to")
        led = axis.goal is Goal.ON
        if axis.state in IN_FAULT:
            axis.goal = Goal.OFF if led else axis.goal
            if not watch.fault_told:
                watch.fault_told = True
                hint = ", following error" if axis.statusword & FOLLOWING_ERROR else ""
                self._fail_drive(axis, f"is in {axis.state}{hint}; it told no code")
        elif self._enabled and led and axis.state is not State.OPERATION_ENABLED:
            axis.goal = Goal.OFF  # it is enabled again by the operator alone
            return True
        return False

    def _fail_left(self, axes: list[Axis]) -> None:
        names = ", ".join(f"{axis.name} is {axis.state}" for axis in axes)
        power = "; there is no voltage for the motors: emergency stop?" if not any(a.has_voltage for a in axes) else ""
        advice = f"see why, then enable arm {self._device}"
        why = f"operation enabled was left, unasked: {names}{power}"
        self._fail(DeviceError(self._device, "watch the drives", why, advice))

    def _judge_silence(self, watches: list[_Watch], what: str) -> None:
        if watches:
            names = ", ".join(watch.axis.name + watch.hint for watch in watches)
            self._fail(DeviceTimeout(self._device, "receive", f"{names} {what} in time", "check its power and the bus"))

    def _fail_drive(self, axis: Axis, what: str) -> None:
        advice = f"see to the drive, then reset and enable arm {self._device}"
        self._fail(DeviceError(self._device, "watch the drives", f"{axis.name} {what}", advice))

    def _fail(self, error: DeviceError) -> None:
        self.failure = error
        self._stop_leading(error)
        self._notices.failure(error)

    def _why_late(self, late: int) -> DeviceError:
        silent = ", ".join(watch.axis.name + watch.hint for watch in self._watch if watch.silent)
        why = f"{silent} did not answer" if silent else "this program, or the bus, was late"
        return DeviceTimeout(
            self._device, "move", f"stopped after {late} late cycles in a row: {why}", "see what loads machine and bus"
        )

    def _stop_leading(self, error: DeviceError) -> None:
        if self._lead is not None:
            self._lead.brake()
        self._end_transfer(error)

    def _end_transfer(self, error: DeviceError | None) -> None:
        transfer, self._transfer = self._transfer, None
        if transfer is not None:
            self._notices.call(transfer.completed if error is None else lambda: transfer.failed(error))

    def _want(self, goal: Goal) -> None:
        self._enabled = False
        for axis in self.axes:
            axis.goal = goal

    def _report(self, sync: float) -> None:
        """What the drives sampled at ``sync``, as a report."""
        axes = self.axes
        counts = [axis.position for axis in axes]
        history = self._history
        history.append((sync, counts))
        if len(history) < 3:
            return  # a velocity needs a past
        (begin, first), span = history[0], sync - history[0][0]
        velocities = []
        steps, angle = _STANDING
        for number, axis in enumerate(axes):
            past = [entry[number] for _, entry in history]
            stands = span <= 0.0 or max(past) - min(past) <= max(steps, angle * axis.scale.counts_per_rad)
            rate = 0.0 if stands else (counts[number] - first[number]) / (sync - begin)
            velocities.append(axis.scale.sign * rate / axis.scale.counts_per_rad)
        self._standing = not any(velocities)
        faults = self.faults
        self._on_report(
            ArmReport(
                positions=tuple(axis.scale.to_angle(count) for axis, count in zip(axes, counts, strict=True)),
                velocities=tuple(velocities),
                mode=self._mode(faults),
                faults=faults,
                in_motion=self.is_moving,
                time=sync,
                sequence=0,
            )
        )

    def _mode(self, faults: tuple[str, ...]) -> Mode:
        if faults:
            return Mode.FAULT
        if not any(axis.has_voltage for axis in self.axes):
            return Mode.EMERGENCY_STOP
        ready = all(
            axis.goal is Goal.ON
            and axis.state is State.OPERATION_ENABLED
            and axis.feedback is not None
            and axis.feedback.operation == self._operation
            for axis in self.axes
        )
        return Mode.READY if ready else Mode.DISABLED


class _Watch:
    """How long a drive has been silent, in cycles, so that a program that is late itself blames no drive."""

    def __init__(self, axis: Axis) -> None:
        self.axis = axis
        self.silent = 0
        self.heartless = 0
        self.rebooted = False
        self._away = 0
        self.fault_told = axis.state in IN_FAULT
        self._answers = axis.answers
        self._heartbeats = axis.heartbeats

    def look(self) -> bool:
        """Count a cycle; whether the drive has answered in it."""
        axis = self.axis
        answers, heartbeats = axis.answers, axis.heartbeats
        self.silent = self.silent + 1 if answers == self._answers else 0
        self.heartless = self.heartless + 1 if heartbeats == self._heartbeats else 0
        self._answers, self._heartbeats = answers, heartbeats
        self._away += self.rebooted
        return self.silent == 0

    def missing_for(self, cycles: int) -> str | None:
        """What so many cycles have been without, in words; None if nothing is missing.

        A drive that starts itself after a reboot answers and sends heartbeats, but is not what it was set up to: it
        has to be found anew.
        """
        if max(self.silent, self.heartless) >= cycles:
            what = "answer" if self.silent >= cycles else "heartbeat"
            return f"no {what} of {self.axis.name} for {LOST:g} s{self.hint}"
        return f"{self.axis.name} has rebooted and is to be set up anew" if self._away >= cycles else None

    @property
    def hint(self) -> str:
        """Why a drive may be silent."""
        if self.rebooted:
            return " (it has rebooted)"
        if self.axis.malformed:
            return f" ({self.axis.malformed})"
        if self.axis.nmt_state != NmtState.OPERATIONAL:
            return f" (its heartbeat says NMT state 0x{self.axis.nmt_state:02X}, not operational)"
        return ""

    @property
    def fault(self) -> str:
        """What is wrong with the drive, in words; empty if nothing is."""
        axis = self.axis
        if axis.emergency is not None:
            return f"{axis.name}: {axis.emergency}"
        if axis.state in IN_FAULT:
            return f"{axis.name}: {axis.last_error or axis.state}"
        return f"{axis.name}: has rebooted" if self.rebooted else ""
