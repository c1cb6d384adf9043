"""One arm's drives on its bus: found, set up, led in a cycle, and after a loss found anew."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from backends.controller.can.axis import Axis
from backends.controller.can.configuration import DriveRecord, configure, is_there, leave, supervise, switch_off
from backends.controller.can.cycle import Cycle
from backends.controller.can.drive import Goal, is_reached
from backends.controller.can.findings import bus_finding, cycle_findings, drive_findings, eds_findings
from backends.controller.can.motion import CourseLead, SetPointLead
from backends.controller.can.notices import Notices
from backends.controller.can.objects import (
    EMERGENCY,
    HEARTBEAT,
    INT32,
    NMT,
    RPDO1,
    SDO_ANSWER,
    SYNC,
    TPDO1,
    Control,
    NmtCommand,
    Operation,
    Scale,
    State,
    pack_command,
    pack_nmt,
)
from backends.controller.can.profile import follow_waypoints
from backends.controller.can.sdo import SdoNode
from backends.controller.can.statistics import CycleReport
from backends.controller.can.transport import BusAddress, Transport
from backends.controller.course import Course
from backends.controller.link import ArmLink, ArmReport, Transfer
from backends.controller.options import CanLink
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost, NotOpen
from dualcal_hal.findings import Finding

_BACK_OFF = (0.25, 5.0)  # s; first and longest wait before the bus is tried anew
_TRY = 10.0  # s for finding and setting up again
_STOP_TOLD = 0.15  # s for the cycle to take a stop, before the drives are told otherwise
_NEAR = 0.0175  # rad within which a course must begin at the drives' positions and targets: 1 deg
_ARRIVAL = 0.002  # rad within which a drive that says so has arrived
_AT_REST, _SHUT_DOWN = 1.0, 1.0  # s for drives to come to rest, and to switch off, when the link is closed
_HIGHEST_NODE = 127
_OPERATIONS = {"cyclic": Operation.CYCLIC_POSITION, "profile": Operation.PROFILE_POSITION}


class CanArmLink(ArmLink):
    """An arm whose joints are CiA 402 drives on one bus.

    A stop in cyclic mode brakes along the course, in profile mode by the halt bit; both leave the drives enabled. Only
    where the cycle does not come to tell them is it a quick stop, after which the operator enables them anew. Closing
    switches the drives off, and a drive that was lost has all of its arm switched off before it is set up again.
    """

    def __init__(self, arm: str, options: CanLink, clock: Clock) -> None:
        drives = options.arms[arm].drives
        super().__init__(arm, len(drives))
        self._clock = clock
        self._drives = drives
        self._operation = _OPERATIONS[options.mode]
        self._period = options.sync_period_ms / 1000
        address = BusAddress(options.interface, options.arms[arm].channel, options.bitrate)
        self._address = address
        self._transport = Transport(arm, address, clock, self._dispatch, self._bus_lost)
        nodes = [drive.node for drive in drives]
        self._master = next(node for node in range(_HIGHEST_NODE, 0, -1) if node not in nodes)
        self._sdo = {
            drive.node: SdoNode(arm, joint, drive.node, self._transport.send)
            for joint, drive in enumerate(drives, start=1)
        }
        self._axes: list[Axis] = []
        self._by_node: dict[int, Axis] = {}
        self._records: list[DriveRecord] = []
        self._cycle: Cycle | None = None
        self._notices = Notices(arm)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._waypoints: threading.Thread | None = None
        self._commanding = threading.Lock()
        self._lock = threading.Lock()
        self._report: ArmReport | None = None
        self._reported: list[threading.Event] = []
        self._sequence = 0
        self._loss: DeviceError | None = None

    # Open and close.

    def open(self, deadline: float) -> None:
        if self._thread is not None:
            raise NotOpen(self.arm, "open", "it is open already")
        self._closing.clear()
        self._report = self._loss = None
        begin = self._clock.now()
        cycle = self._connect(deadline)
        self._notices.start()
        self._thread = threading.Thread(target=self._live, args=(cycle,), name=f"{self.arm} CAN cycle", daemon=True)
        self._thread.start()
        try:
            self.report_after(begin, deadline)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        thread, self._thread = self._thread, None
        if thread is None:
            return
        if (cycle := self._cycle) is not None:
            self._switch_off(cycle)
        self._closing.set()
        if (cycle := self._cycle) is not None:  # another one where it has just been connected anew
            cycle.end()
        thread.join()
        if (waypoints := self._waypoints) is not None:
            waypoints.join()
        self._notices.end()
        self._wake()

    def _switch_off(self, cycle: Cycle) -> None:
        """No drive is left enabled without one that leads it, and none misses this program's heartbeat."""
        cycle.stop("the link is closed", _STOP_TOLD)
        # Where one drive is silent the others have their brake all the same.
        cycle.wait_for(lambda: not cycle.is_moving or cycle.is_silent, self._clock.now() + _AT_REST)
        cycle.want(Goal.OFF)
        cycle.wait_for(
            lambda: all(is_off(axis.state) for axis in self._axes if axis.name not in cycle.silent),
            self._clock.now() + _SHUT_DOWN,
        )
        for sdo in self._sdo.values():
            try:
                leave(sdo)
            except DeviceError:
                return  # a drive that does not answer stops by itself; the others need not be waited for

    def _connect(self, deadline: float) -> Cycle:
        """Open the bus and set all drives up; leaves it closed if it raises."""
        self._transport.open(deadline)
        try:
            self._find(deadline)
            self._axes = [
                Axis(joint, drive.node, Scale(drive.counts_per_rad, drive.offset_rad, drive.sign))
                for joint, drive in enumerate(self._drives, start=1)
            ]
            self._records = []
            for axis in self._axes:
                self._check(deadline)
                record = configure(self._sdo[axis.node], axis.node, self._operation, self._period)
                axis.last_error = record.last_error
                self._records.append(record)
            for axis in self._axes:
                supervise(self._sdo[axis.node], self._master)
            self._by_node = {axis.node: axis for axis in self._axes}
            self._tell_nodes(NmtCommand.START)
        except BaseException:
            self._transport.close()
            raise
        cycle = Cycle(
            self.arm,
            self._axes,
            self._transport.send_all,
            self._operation,
            self._period,
            self._master,
            self._clock,
            self._notices,
            self._take_report,
        )
        self._cycle = cycle
        return cycle

    def _find(self, deadline: float) -> None:
        """Have all nodes in pre-operational, where they are set up; all that are missing are named at once."""
        self._by_node = {}
        nodes = list(self._sdo.values())
        with ThreadPoolExecutor(len(nodes)) as pool:
            # A drive that a program left enabled would take the loss of its PDOs for a fault.
            list(pool.map(switch_off, nodes))
            self._check(deadline)
            self._tell_nodes(NmtCommand.PRE_OPERATIONAL)
            there = list(pool.map(is_there, nodes))
        missing = [sdo.name for sdo, answers in zip(nodes, there, strict=True) if not answers]
        if missing:
            everyone = not any(there)
            advice = "bit rate, termination and power of the bus" if everyone else "their power, cables and node ids"
            who = "no drive answers: " + ", ".join(missing) if everyone else f"no answer of {', '.join(missing)}"
            raise DeviceTimeout(self.arm, "find the drives", who, f"check {advice}")

    def _check(self, deadline: float) -> None:
        if self._closing.is_set():
            raise NotOpen(self.arm, "set up the drives", "it is closed meanwhile")
        if self._clock.now() > deadline:
            raise DeviceTimeout(self.arm, "set up the drives", "not done in time", "allow more time, or see the bus")

    def _tell_nodes(self, command: NmtCommand) -> None:
        self._transport.send_all([(NMT, pack_nmt(command, node)) for node in self._sdo])

    def _live(self, cycle: Cycle) -> None:
        """Run the cycle; after a loss connect anew, until the link is closed."""
        while True:
            loss = cycle.run() if not self._closing.is_set() else None
            if loss is not None:
                self._lost(loss)
            self._let_go(cycle.is_moving)
            if loss is None or (again := self._reconnect()) is None:
                return
            cycle = again

    def _lost(self, loss: DeviceError) -> None:
        with self._lock:
            self._loss = loss
        self._cycle = None
        self._wake()
        self._notices.failure(loss)

    def _let_go(self, moving: bool) -> None:
        """Leave no drive enabled that can still be told so, and the bus closed."""
        word = Control.QUICK_STOP if moving else Control.SHUTDOWN
        shutdown = [
            (RPDO1 + axis.node, pack_command(word, self._operation, axis.position))
            for axis in self._axes
            if axis.state in (State.OPERATION_ENABLED, State.QUICK_STOP)
        ]
        try:
            self._transport.send_all([*shutdown, (SYNC, b"")])
            if not moving:
                self._tell_nodes(NmtCommand.PRE_OPERATIONAL)
        except DeviceError:
            pass  # the bus is gone; drives that miss the heartbeat stop by themselves
        self._transport.close()
        self._cycle = None

    def _reconnect(self) -> Cycle | None:
        wait, longest = _BACK_OFF
        while not self._clock.wait(self._closing, self._clock.now() + wait):
            try:
                cycle = self._connect(self._clock.now() + _TRY)
            except DeviceError as error:
                wait = min(2 * wait, longest)
                with self._lock:
                    self._loss = error if isinstance(error, LinkLost) else self._loss
                continue
            with self._lock:
                self._loss = None
            return cycle
        return None

    # What arrives, on the bus's reader.

    def _dispatch(self, identifier: int, data: bytes, arrival: float) -> None:
        node = identifier & 0x7F
        kind = identifier - node
        if kind == SDO_ANSWER:
            if (sdo := self._sdo.get(node)) is not None:
                sdo.answered(data)
        elif (axis := self._by_node.get(node)) is None:
            return
        elif kind == TPDO1:
            axis.take_feedback(data, arrival)
        elif kind == HEARTBEAT:
            axis.take_heartbeat(data)
        elif kind == EMERGENCY:
            axis.take_emergency(data)

    def _bus_lost(self, error: DeviceError) -> None:
        if (cycle := self._cycle) is not None:
            cycle.lose(error)

    # What is told.

    def report_after(self, time: float, deadline: float) -> ArmReport:
        while True:
            event = threading.Event()
            with self._lock:
                if self._report is not None and self._report.time > time:
                    return self._report
                if self._loss is not None:
                    raise self._lost_link("read")
                if self._thread is None:
                    raise NotOpen(self.arm, "read", "it is not open")
                self._reported.append(event)
            if not self._clock.wait(event, deadline):
                with self._lock:
                    self._reported = [one for one in self._reported if one is not event]
                raise DeviceTimeout(self.arm, "read", self._why_no_report(), "check the drives and the bus")

    def _why_no_report(self) -> str:
        silent = [axis.name for axis in self._axes if axis.feedback is None]
        return f"no position of {', '.join(silent)}" if silent else "the drives have not all answered in time"

    def _lost_link(self, attempted: str) -> LinkLost:
        return LinkLost(self.arm, attempted, f"the link is lost ({self._loss})", "it is tried anew until it is closed")

    def _take_report(self, report: ArmReport) -> None:
        with self._lock:
            self._sequence += 1
            report = replace(report, sequence=self._sequence)
            self._report = report
        self._wake()
        self._notices.report(report)

    def _wake(self) -> None:
        with self._lock:
            waiting, self._reported = self._reported, []
        for event in waiting:
            event.set()

    def subscribe(self, function: Callable[[ArmReport], None]) -> Callable[[], None]:
        return self._notices.subscribe(function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        return self._notices.on_failure(function)

    # What is asked.

    def _running(self, attempted: str) -> Cycle:
        if self._thread is None:
            raise NotOpen(self.arm, attempted, "it is not open")
        if (cycle := self._cycle) is None:
            raise self._lost_link(attempted)
        return cycle

    def send(self, course: Course) -> Transfer:
        with self._commanding:
            cycle = self._running("move")
            self._check_course(course, cycle)
            transfer = Transfer()
            if self._operation is Operation.CYCLIC_POSITION:
                cycle.lead(CourseLead(course, np.array(cycle.held), self._period), transfer)
            else:
                self._send_waypoints(course, cycle, transfer)
            return transfer

    def _send_waypoints(self, course: Course, cycle: Cycle, transfer: Transfer) -> None:
        if (before := self._waypoints) is not None:
            before.join()  # a request of its own that still waits for an answer must not set speeds after ours
        arrival = max(2, round(_ARRIVAL * min(axis.scale.counts_per_rad for axis in self._axes)))
        lead = SetPointLead(cycle.halted, arrival)
        cycle.lead(lead, transfer)
        start = [axis.scale.to_angle(axis.position) for axis in self._axes]

        def follow() -> None:
            try:
                follow_waypoints(self.arm, course, start, lead, self._axes, self._sdo, self._clock)
            except DeviceError as error:
                if not lead.is_over:
                    cycle.give_up(error)

        self._waypoints = threading.Thread(target=follow, name=f"{self.arm} CAN waypoints", daemon=True)
        self._waypoints.start()

    def _check_course(self, course: Course, cycle: Cycle) -> None:
        why = self._why_not_ready(cycle) or self._why_not_taken(course, cycle)
        if why:
            raise CommandRefused(self.arm, "move", why, "see to it, then plan the motion anew")

    def _why_not_ready(self, cycle: Cycle) -> str:
        off = [f"{axis.name} is {axis.condition}" for axis in self._axes if axis.state is not State.OPERATION_ENABLED]
        if off:
            return ", ".join(off)
        if self._report is None or self._report.faults:
            return "; ".join(self._report.faults) if self._report is not None else "no position is known"
        other = [axis.name for axis in self._axes if axis.feedback and axis.feedback.operation != self._operation]
        if other:
            return f"{', '.join(other)}: not in mode {self._operation:d}, as 6061 says"
        age = self._clock.now() - self._report.time
        if age > max(3 * self._period, 0.1):
            silent = ", ".join(cycle.silent) or "all of them together"
            return f"the drives' positions are {age:.2f} s old; none came of {silent}"
        return "a motion is under way" if cycle.is_led else ""

    def _why_not_taken(self, course: Course, cycle: Cycle) -> str:
        for axis, begin, held, record, waypoints in zip(
            self._axes, course.start, cycle.held, self._records, zip(*course.waypoints, strict=True), strict=True
        ):
            stands = axis.scale.to_angle(axis.position)
            led = held if self._operation is Operation.CYCLIC_POSITION else stands
            if max(abs(begin - stands), abs(begin - led)) > _NEAR:
                where = f"stands at {stands:.4f} rad, is held at {led:.4f}"
                return f"{axis.name} {where}, and the course begins at {begin:.4f}"
            lower, upper = record.limits or (INT32.start, INT32.stop - 1)
            for angle in waypoints:
                if not lower <= axis.scale.to_counts(angle) <= upper:
                    return (
                        f"{axis.name}: {angle:.4f} rad is outside of the drive's own range, {lower} to {upper} counts"
                    )
        return ""

    def stop(self, reason: str) -> None:
        cycle = self._running("stop")
        if not cycle.stop(reason, _STOP_TOLD):
            cycle.quick_stop(reason)

    def enable(self, timeout: float) -> None:
        with self._commanding:
            cycle = self._running("enable")
            if faults := cycle.faults:
                why, advice = "; ".join(faults), f"dualcal reset CELL --arm {self.arm} first"
                raise CommandRefused(self.arm, "enable", f"in fault: {why}", advice)
            cycle.forget_emergencies()
            cycle.want(Goal.ON)
            axes = self._axes
            cycle.wait_for(
                lambda: (
                    all(a.state is State.OPERATION_ENABLED and self._is_in_mode(a) for a in axes)
                    or any(axis.goal is not Goal.ON for axis in axes)
                ),
                self._clock.now() + timeout,
            )
            if (why := self._why_not_ready_after(axes)) or cycle.failure is not None:
                cycle.want(Goal.OFF)
                raise cycle.failure or DeviceTimeout(
                    self.arm, "enable", why, "check power, emergency stop and safe torque off"
                )
            cycle.enabled()

    def _is_in_mode(self, axis: Axis) -> bool:
        return axis.feedback is not None and axis.feedback.operation == self._operation

    def _why_not_ready_after(self, axes: Sequence[Axis]) -> str:
        return ", ".join(
            f"{axis.name} is {axis.condition}, mode {axis.feedback.operation if axis.feedback else 'unknown'}"
            for axis in axes
            if axis.state is not State.OPERATION_ENABLED or not self._is_in_mode(axis)
        )

    def disable(self, timeout: float) -> None:
        with self._commanding:
            cycle = self._running("disable")
            deadline = self._clock.now() + timeout
            self.stop("the drives are switched off")
            cycle.wait_for(lambda: not cycle.is_moving, deadline)
            cycle.want(Goal.OFF)
            axes = self._axes
            if not cycle.wait_for(lambda: all(is_off(axis.state) for axis in axes), deadline):
                left = ", ".join(f"{axis.name} is {axis.state}" for axis in axes if not is_off(axis.state))
                raise DeviceTimeout(self.arm, "disable", left, "switch the power off")

    def reset_fault(self, timeout: float) -> None:
        with self._commanding:
            cycle = self._running("reset")
            axes = self._axes
            self.stop("a fault is reset")
            cycle.want(Goal.RESET)
            reached = cycle.wait_for(
                lambda: all(is_reached(axis.state, Goal.RESET) for axis in axes), self._clock.now() + timeout
            )
            cycle.want(Goal.OFF)
            if not reached:
                left = ", ".join(
                    f"{axis.name} is {axis.state}{f' ({axis.emergency})' if axis.emergency else ''}"
                    for axis in axes
                    if not is_reached(axis.state, Goal.RESET)
                )
                raise DeviceTimeout(self.arm, "reset", left, "its cause may last; see to the drive")
            for axis in axes:
                axis.last_error = ""
            cycle.forget_emergencies()

    # What an operator is told.

    def cycle_report(self) -> CycleReport:
        """How well the cycle has kept its time since it was last connected. NotOpen, LinkLost."""
        return self._running("measure").statistics.report()

    def findings(self) -> list[Finding]:
        cycle, records = self._cycle, self._records
        if self._thread is None:
            raise NotOpen(self.arm, "check", "it is not open")
        if cycle is None:
            return [bus_finding(self._address, self._transport.statistics, self._loss)]
        found = [bus_finding(self._address, self._transport.statistics, None)]
        for axis, record, drive in zip(self._axes, records, self._drives, strict=True):
            found += drive_findings(axis, record)
            if drive.eds is not None:
                found += eds_findings(axis, record, str(drive.eds))
        return found + cycle_findings(cycle.statistics.report(), self._period, cycle.prompt)


def is_off(state: State) -> bool:
    """Whether a drive in ``state`` carries no torque, or none that this program could take away."""
    return state not in (State.OPERATION_ENABLED, State.QUICK_STOP, State.SWITCHED_ON, State.READY)
