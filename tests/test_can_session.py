"""An arm on CAN, against small drives on a virtual bus: set up, moved, stopped, and what it tells when drives fail."""

from __future__ import annotations

import itertools
import threading
import time

import numpy as np
import pytest

from backends.controller.can import links
from backends.controller.can.cycle import Cycle
from backends.controller.course import Course
from backends.controller.joint_map import JointMap
from backends.controller.options import CanLink
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost, MotionStopped, NotOpen
from dualcal_hal.robot import JointPath, Mode
from tests.small_drive import COUNTS, ENABLED, FAULT, PERIOD, QUICK_STOP, SWITCH_ON_DISABLED, SmallBus

NODES = (1, 2, 5)
CLOCK = RealClock()
_channels = itertools.count()
PATIENCE = 10.0  # s; for what comes within a tenth of one where the machine is not busy


class Arm:
    """A link and the drives at its other end."""

    def __init__(self, bus, channel, mode="cyclic", **drive):
        self.bus = bus
        drives = tuple({"node": node, "counts_per_rad": COUNTS, **drive} for node in NODES)
        arms = {"left": {"channel": channel, "drives": drives}}
        link = {"interface": "virtual", "mode": mode, "sync_period_ms": 1000 * PERIOD, "arms": arms}
        options = CanLink.model_validate(link)
        self.link = links(options, {"left": 3}, CLOCK)["left"]
        self.failures = []
        self.failed = threading.Event()
        self.link.on_failure(self._fail)

    def _fail(self, error):
        self.failures.append(error)
        self.failed.set()

    def open(self):
        self.link.open(CLOCK.now() + PATIENCE)

    def report(self):
        return self.link.report_after(CLOCK.now(), CLOCK.now() + PATIENCE)

    def report_that(self, condition):
        deadline = CLOCK.now() + PATIENCE
        while True:
            try:
                report = self.link.report_after(CLOCK.now(), deadline)
            except LinkLost:
                CLOCK.wait(threading.Event(), CLOCK.now() + 0.02)
                if CLOCK.now() > deadline:
                    raise
                continue
            if condition(report):
                return report
            assert CLOCK.now() < deadline, report

    def course(self, *waypoints, speed=0.5):
        start = np.array(self.report().positions)
        path = JointPath(waypoints, (speed,) * 3, (4.0,) * 3)
        return Course(start, path, JointMap(None, 3))

    def move(self, *waypoints, speed=0.5):
        """Begin to move, and wait until the drives do."""
        transfer = self.link.send(self.course(*waypoints, speed=speed))
        self.report_that(lambda report: report.in_motion and any(report.velocities))
        return transfer

    def ended(self, transfer):
        event = threading.Event()
        transfer.on_end(event.set)
        assert event.wait(PATIENCE)
        return transfer

    def failure(self, kind, *words):
        """The first failure of that kind with these words."""
        deadline = CLOCK.now() + PATIENCE
        while CLOCK.now() < deadline:
            for error in tuple(self.failures):
                if isinstance(error, kind) and all(word in str(error) for word in words):
                    return error
            CLOCK.wait(threading.Event(), CLOCK.now() + 0.01)
        raise AssertionError(self.failures)

    def until(self, condition):
        deadline = CLOCK.now() + PATIENCE
        while not condition():
            assert CLOCK.now() < deadline
            CLOCK.wait(threading.Event(), CLOCK.now() + 0.005)


@pytest.fixture
def channel():
    return f"test {next(_channels)}"


@pytest.fixture
def bus(channel):
    with SmallBus(channel, NODES) as bus:
        yield bus


@pytest.fixture
def arm(bus, channel):
    arm = Arm(bus, channel)
    yield arm
    arm.link.close()


@pytest.fixture
def enabled(arm):
    arm.open()
    arm.link.enable(PATIENCE)
    return arm


@pytest.fixture
def profile(bus, channel):
    arm = Arm(bus, channel, mode="profile")
    try:
        arm.open()
        arm.link.enable(PATIENCE)
        yield arm
    finally:
        arm.link.close()


def states(bus):
    return [drive.state for drive in bus.drives.values()]


# Opening


def test_opening_sets_drives_up_and_enables_nothing(arm, bus):
    bus.drives[2].position = 1234
    arm.open()
    report = arm.report()
    assert report.mode is Mode.DISABLED
    assert report.positions == (0.0, 1234 / COUNTS, 0.0)
    assert report.velocities == (0.0, 0.0, 0.0)
    assert states(bus) == [SWITCH_ON_DISABLED] * 3
    drive = bus.drives[5]
    assert drive.nmt == 0x05
    written = {(index, subindex): value for index, subindex, value in drive.sdo_writes}
    assert written[0x1600, 1] == 0x60400010
    assert [written[0x1A00, n] for n in (1, 2, 3)] == [0x60410010, 0x60610008, 0x60640020]
    assert written[0x1400, 2] == written[0x1800, 2] == 1
    assert written[0x1017, 0] == 100
    assert written[0x605B, 0] == 1  # one that would coast when it is switched off is told to slow down
    assert written[0x6007, 0] == 3  # a drive that would do nothing when this program dies is told to stop
    master, time_ms = written[0x1016, 1] >> 16, written[0x1016, 1] & 0xFFFF
    assert (master, time_ms) == (127, 500)
    arm.until(lambda: bus.master_beats > 3)


def test_mapping_is_written_while_the_pdo_is_off(arm, bus):
    arm.open()
    writes = [(index, value) for index, subindex, value in bus.drives[1].sdo_writes if index in (0x1400, 0x1600)]
    assert writes[0] == (0x1400, 0x80000201)
    assert writes[-1] == (0x1400, 0x201)


def test_a_pdo_that_is_not_sent_on_request_stays_so(arm, bus, monkeypatch):
    not_on_request, request = 1 << 30, bus._request
    for drive in bus.drives.values():
        drive.objects[0x1800, 1] = (not_on_request | 0x180 + drive.node).to_bytes(4, "little")

    def strict(drive, data):
        written = int.from_bytes(data[4:], "little")
        if data[0] & 0xE0 == 0x20 and data[1:4] == b"\x00\x18\x01" and not written & not_on_request:
            bus.send(0x580 + drive.node, b"\x80" + data[1:4] + (0x06090030).to_bytes(4, "little"))
        else:
            request(drive, data)

    monkeypatch.setattr(bus, "_request", strict)
    arm.open()
    assert bus.drives[2].number(0x1800, 1) == not_on_request | 0x182


def test_drives_that_do_not_answer_are_all_named(arm, bus):
    bus.drives[1].dead = bus.drives[5].dead = True
    with pytest.raises(DeviceTimeout, match=r"joint 1 \(node 1\), joint 3 \(node 5\)"):
        arm.open()


def test_a_bus_without_drives_is_told_as_such(arm, bus):
    for drive in bus.drives.values():
        drive.dead = True
    with pytest.raises(DeviceTimeout, match=r"no drive answers.*bit rate"):
        arm.open()


def test_an_object_that_is_aborted_is_named_with_its_node_and_code(arm, bus):
    bus.drives[2].aborts.add(0x1600)
    with pytest.raises(CommandRefused, match=r"object 1600:00: joint 2 \(node 2\).*0x06020000"):
        arm.open()


def test_what_is_no_drive_is_refused(arm, bus):
    bus.drives[2].objects[0x1000, 0] = bytes.fromhex("91 01 0f 00")
    with pytest.raises(DeviceError, match=r"joint 2 \(node 2\).*no drive by CiA 402"):
        arm.open()


def test_a_drive_without_the_mode_is_refused(arm, bus):
    bus.drives[2].objects[0x6502, 0] = bytes.fromhex("01 00 00 00")
    with pytest.raises(DeviceError, match="no cyclic mode"):
        arm.open()


def test_a_drive_that_sends_no_position_is_named(arm, bus, monkeypatch):
    monkeypatch.setattr("backends.controller.can.cycle.LOST", PATIENCE)
    bus.drives[2].silent = True
    with pytest.raises(DeviceTimeout, match=r"no position of joint 2 \(node 2\)"):
        arm.link.open(CLOCK.now() + 2.0)


def test_a_drive_left_enabled_is_switched_off_before_it_is_set_up(arm, bus):
    bus.drives[2].state = ENABLED
    arm.open()
    assert arm.report_that(lambda report: bus.drives[2].state == SWITCH_ON_DISABLED).mode is Mode.DISABLED
    words = [index for index, _, _ in bus.drives[2].sdo_writes]
    assert words[0] == 0x6040


def test_a_fault_that_stands_is_reported_with_its_code(arm, bus):
    bus.drives[2].state = FAULT
    bus.drives[2].objects[0x603F, 0] = bytes.fromhex("05 73")
    arm.open()
    report = arm.report()
    assert report.mode is Mode.FAULT
    assert report.faults == ("joint 2 (node 2): code 0x7305 encoder fault",)


def test_a_link_is_used_only_while_it_is_open(arm):
    for use in (arm.report, lambda: arm.link.enable(1.0), lambda: arm.link.stop("test"), arm.link.findings):
        with pytest.raises(NotOpen):
            use()
    arm.open()
    with pytest.raises(NotOpen, match="open already"):
        arm.open()
    arm.link.close()
    arm.link.close()
    with pytest.raises(NotOpen):
        arm.report()


def test_closing_leaves_no_drive_enabled_and_none_that_misses_a_heartbeat(enabled, bus):
    transfer = enabled.move((0.5, 0.0, 0.0))
    enabled.link.close()
    assert isinstance(enabled.ended(transfer).error, MotionStopped)
    assert states(bus) == [SWITCH_ON_DISABLED] * 3
    for drive in bus.drives.values():
        assert drive.number(0x1016, 1) == 0
    # It is told so last, and nothing answers that.
    enabled.until(lambda: all(drive.nmt == 0x7F for drive in bus.drives.values()))


def test_closing_within_a_move_lets_drives_come_to_rest_also_where_one_is_silent(enabled, bus):
    enabled.move((1.5, 0.0, 0.0), speed=0.8)
    led = bus.drives[1].targets
    enabled.until(lambda: led[-1] - led[-2] == pytest.approx(0.8 * PERIOD * COUNTS, abs=1))
    bus.drives[2].silent = True
    enabled.until(lambda: enabled.link._cycle.silent)
    enabled.link.close()
    assert led[-1] - led[-2] < 0.2 * PERIOD * COUNTS
    assert states(bus)[0] == SWITCH_ON_DISABLED


def test_closing_within_a_move_lets_drives_come_to_rest_also_where_a_cycle_goes_unanswered(enabled, bus, monkeypatch):
    enabled.move((1.5, 0.0, 0.0), speed=0.8)
    led = bus.drives[1].targets
    enabled.until(lambda: led[-1] - led[-2] == pytest.approx(0.8 * PERIOD * COUNTS, abs=1))
    stop, sync, told, unanswered = enabled.link._cycle.stop, bus._sync, threading.Event(), set()

    def stop_then_no_answer(reason, timeout):
        done = stop(reason, timeout)
        told.set()
        return done

    def once_without_answer(drive):
        drive.silent = told.is_set() and drive.node not in unanswered
        sync(drive)
        if drive.silent:
            unanswered.add(drive.node)

    monkeypatch.setattr(enabled.link._cycle, "stop", stop_then_no_answer)
    monkeypatch.setattr(bus, "_sync", once_without_answer)
    enabled.link.close()
    assert unanswered == set(NODES)
    assert led[-1] - led[-2] < 0.2 * PERIOD * COUNTS
    assert states(bus) == [SWITCH_ON_DISABLED] * 3


def test_it_opens_again_after_it_was_closed(arm):
    arm.open()
    arm.link.close()
    arm.open()
    assert arm.report().mode is Mode.DISABLED


# Enabling


def test_enabling_moves_nothing(arm, bus):
    bus.drives[1].position = 4321
    arm.open()
    arm.link.enable(PATIENCE)
    assert arm.report().mode is Mode.READY
    assert set(bus.drives[1].targets) == {4321}
    words = [word for word, _ in itertools.groupby(bus.drives[1].controlwords)]
    assert words[-3:] == [0x06, 0x07, 0x0F]


def test_disabling_switches_all_off(enabled, bus):
    enabled.link.disable(PATIENCE)
    assert states(bus) == [SWITCH_ON_DISABLED] * 3
    assert enabled.report().mode is Mode.DISABLED


def test_a_drive_that_does_not_come_to_be_enabled_is_named_and_the_others_are_switched_off(arm, bus, monkeypatch):
    arm.open()
    monkeypatch.setattr(bus.drives[5], "control", lambda word: None)
    with pytest.raises(DeviceTimeout, match=r"joint 3 \(node 5\) is switch-on disabled"):
        arm.link.enable(0.3)
    arm.until(lambda: states(bus) == [SWITCH_ON_DISABLED] * 3)


def test_a_fault_is_not_enabled_but_reset_first_and_stays_off_then(enabled, bus):
    bus.fail(2, 0x8611)
    enabled.failure(DeviceError, "0x8611")
    with pytest.raises(CommandRefused, match=r"in fault: joint 2 \(node 2\)"):
        enabled.link.enable(PATIENCE)
    assert bus.drives[2].state == FAULT
    enabled.link.reset_fault(PATIENCE)
    report = enabled.report()
    assert report.mode is Mode.DISABLED
    assert report.faults == ()
    assert states(bus) == [SWITCH_ON_DISABLED] * 3
    enabled.link.enable(PATIENCE)
    assert enabled.report().mode is Mode.READY


def test_a_fault_that_lasts_is_told_so(enabled, bus, monkeypatch):
    bus.fail(2, 0x7305)
    enabled.failure(DeviceError, "0x7305")
    monkeypatch.setattr(bus.drives[2], "control", lambda word: None)
    with pytest.raises(DeviceTimeout, match=r"joint 2 \(node 2\) is fault \(code 0x7305 encoder fault\)"):
        enabled.link.reset_fault(0.3)


# Moving


def test_a_course_is_followed_to_its_end(enabled, bus):
    transfer = enabled.move((0.2, -0.1, 0.0), (0.2, 0.1, 0.3), speed=1.0)
    assert enabled.ended(transfer).complete
    report = enabled.report_that(lambda report: report.in_motion is False)
    assert report.positions == pytest.approx((0.2, 0.1, 0.3), abs=1 / COUNTS)
    assert report.velocities == (0.0, 0.0, 0.0)
    for drive in bus.drives.values():
        assert np.abs(np.diff(drive.targets)).max() <= 1.0 * PERIOD * COUNTS + 1


def test_reports_tell_velocities_while_it_moves(enabled):
    transfer = enabled.move((0.3, -0.3, 0.0))
    enabled.report_that(
        lambda report: report.velocities == pytest.approx((0.5, -0.5, 0.0), abs=0.05) and report.in_motion
    )
    enabled.ended(transfer)


def test_counts_are_taken_by_sign_and_offset(bus, channel):
    arm = Arm(bus, channel, sign=-1, offset_rad=0.5)
    try:
        arm.open()
        assert arm.report().positions == (0.5, 0.5, 0.5)
        arm.link.enable(PATIENCE)
        arm.ended(arm.move((0.4, 0.5, 0.5)))
        arm.until(lambda: bus.drives[1].position == 1000)
    finally:
        arm.link.close()


def test_a_course_is_refused_unless_the_drives_are_enabled(arm):
    arm.open()
    with pytest.raises(CommandRefused, match="switch-on disabled"):
        arm.link.send(arm.course((0.1, 0.0, 0.0)))


def test_a_drive_that_comes_not_to_its_mode_is_named_and_not_left_enabled(arm, bus):
    arm.open()
    bus.drives[2].shows_operation = 0
    with pytest.raises(DeviceTimeout, match=r"joint 2 \(node 2\) is operation enabled, mode 0"):
        arm.link.enable(0.5)
    arm.until(lambda: states(bus) == [SWITCH_ON_DISABLED] * 3)


def test_an_arm_with_a_drive_in_another_mode_is_not_ready(enabled, bus):
    bus.drives[2].shows_operation = 6
    enabled.report_that(lambda report: report.mode is Mode.DISABLED)
    with pytest.raises(CommandRefused, match=r"joint 2 \(node 2\): not in mode 8"):
        enabled.link.send(enabled.course((0.1, 0.0, 0.0)))


def test_a_course_that_begins_elsewhere_is_refused(enabled):
    path = JointPath(((0.2, 0.1, 0.0),), (0.5,) * 3, (4.0,) * 3)
    with pytest.raises(CommandRefused, match=r"joint 2 \(node 2\) stands at 0.0000 rad.*begins at 0.1"):
        enabled.link.send(Course(np.array((0.0, 0.1, 0.0)), path, JointMap(None, 3)))


def test_a_course_outside_of_a_drives_own_limits_is_refused(enabled):
    with pytest.raises(CommandRefused, match=r"joint 1 \(node 1\).*-100000 to 100000 counts"):
        enabled.link.send(enabled.course((10.5, 0.0, 0.0)))


def test_a_second_course_is_refused_while_one_is_followed(enabled):
    transfer = enabled.move((0.5, 0.0, 0.0))
    with pytest.raises(CommandRefused, match="under way"):
        enabled.link.send(enabled.course((0.0, 0.0, 0.0)))
    enabled.link.stop("test")
    enabled.ended(transfer)


def test_a_stop_brakes_along_the_course_and_leaves_the_arm_able_to_move(enabled, bus):
    transfer = enabled.move((1.0, 0.5, 0.0))
    enabled.link.stop("enough")
    error = enabled.ended(transfer).error
    assert isinstance(error, MotionStopped)
    assert "enough" in str(error)
    report = enabled.report_that(lambda report: report.in_motion is False)
    assert 0.0 < report.positions[0] < 1.0
    assert report.positions[1] == pytest.approx(report.positions[0] / 2, abs=2 / COUNTS)
    assert report.mode is Mode.READY
    assert enabled.ended(enabled.move((0.0, 0.0, 0.0))).complete
    assert enabled.failures == []


def test_a_stop_goes_out_where_nothing_moves(enabled, bus):
    syncs = bus.syncs
    enabled.link.stop("test")
    enabled.until(lambda: bus.syncs > syncs)
    assert enabled.report().mode is Mode.READY


def test_a_stop_that_the_cycle_does_not_take_is_a_quick_stop(enabled, bus, monkeypatch):
    enabled.move((1.0, 0.0, 0.0))
    monkeypatch.setattr(enabled.link._cycle, "stop", lambda reason, timeout: False)
    enabled.link.stop("test")
    enabled.until(lambda: states(bus) == [QUICK_STOP] * 3)
    monkeypatch.undo()
    assert enabled.report().mode is Mode.DISABLED
    enabled.link.enable(PATIENCE)
    assert enabled.report().mode is Mode.READY


# Profile position


def test_drives_make_their_own_way_from_set_point_to_set_point(profile, bus):
    transfer = profile.link.send(profile.course((0.1, -0.05, 0.0), (0.1, 0.05, 0.1)))
    assert profile.ended(transfer).complete
    report = profile.report_that(lambda report: report.in_motion is False)
    assert report.positions == pytest.approx((0.1, 0.05, 0.1), abs=2 / COUNTS)
    assert bus.drives[2].set_points == [-500, 500]
    velocities = [value for index, _, value in bus.drives[1].sdo_writes if index == 0x6081]
    assert velocities[0] == 5000
    assert next(value for index, _, value in bus.drives[2].sdo_writes if index == 0x6081) == 2500


def test_a_stop_halts_them_and_they_do_not_go_on_before_they_are_sent_elsewhere(profile, bus):
    transfer = profile.move((0.5, 0.0, 0.0), speed=0.2)
    profile.link.stop("enough")
    assert isinstance(profile.ended(transfer).error, MotionStopped)
    report = profile.report_that(lambda report: report.in_motion is False)
    assert report.mode is Mode.READY
    assert 0.0 < report.positions[0] < 0.5
    again = profile.link.send(profile.course((0.0, 0.0, 0.0)))
    assert profile.ended(again).complete
    report = profile.report_that(lambda report: report.in_motion is False)
    assert report.positions[0] == pytest.approx(0.0, abs=2 / COUNTS)
    assert max(bus.drives[1].set_points) == 5000
    assert bus.drives[1].set_points[-1] == 0


def test_what_a_stopped_course_still_asks_of_a_drive_is_nothing_to_the_next_one(profile, bus, monkeypatch):
    request, unanswered = bus._request, threading.Event()

    def swallow(drive, data):
        if data[1:3] == b"\x81\x60" and not unanswered.is_set():
            unanswered.set()
        else:
            request(drive, data)

    monkeypatch.setattr(bus, "_request", swallow)
    first = profile.link.send(profile.course((1.0, 0.0, 0.0)))
    assert unanswered.wait(PATIENCE)
    profile.link.stop("enough")
    assert isinstance(profile.ended(first).error, MotionStopped)
    assert profile.ended(profile.link.send(profile.course((0.2, 0.0, 0.0)))).complete
    assert not profile.failures


def test_drives_that_do_not_take_their_speeds_do_not_move(profile, bus):
    bus.drives[2].aborts.add(0x6083)
    transfer = profile.link.send(profile.course((0.1, 0.1, 0.0)))
    assert "6083" in str(profile.ended(transfer).error)
    profile.failure(CommandRefused, "joint 2 (node 2)", "6083")
    assert bus.drives[1].set_points == []


# What goes wrong


def test_an_emergency_is_told_with_joint_node_and_code_and_the_arm_stops(enabled, bus):
    transfer = enabled.move((1.0, 0.5, 0.3))
    bus.fail(2, 0x3220)
    error = enabled.failure(DeviceError, "joint 2 (node 2)", "0x3220", "under voltage")
    assert enabled.ended(transfer).error is error
    report = enabled.report_that(lambda report: report.in_motion is False)
    assert report.mode is Mode.FAULT
    assert report.faults == ("joint 2 (node 2): code 0x3220 under voltage of the DC link",)
    assert report.positions[0] < 1.0
    assert bus.drives[1].state == ENABLED, "the others hold what they carry"


def test_a_warning_is_a_fault_until_the_drive_takes_it_back(enabled, bus):
    bus.emergency(1, 0x4210)
    enabled.failure(DeviceError, "0x4210")
    assert enabled.report_that(lambda report: report.faults).mode is Mode.FAULT
    bus.emergency(1, 0x0000)
    assert enabled.report_that(lambda report: not report.faults).mode is Mode.READY


def test_a_following_error_of_a_blocked_joint_stops_the_arm(enabled, bus):
    bus.drives[1].stiff = True
    bus.drives[1].window = 300
    transfer = enabled.link.send(enabled.course((1.0, 0.5, 0.0)))
    enabled.failure(DeviceError, "joint 1 (node 1)", "0x8611 following error")
    assert enabled.ended(transfer).error is not None
    report = enabled.report_that(lambda report: report.in_motion is False)
    assert report.positions[1] < 0.5


def test_a_fault_without_an_emergency_is_told_all_the_same(enabled, bus):
    bus.drives[5].state = FAULT
    enabled.failure(DeviceError, "joint 3 (node 5)", "is in fault")


def test_a_drive_that_leaves_operation_enabled_is_not_enabled_again_by_itself(enabled, bus):
    transfer = enabled.move((1.0, 0.0, 0.0))
    with bus.lock:
        bus.drives[5].state = SWITCH_ON_DISABLED
    enabled.failure(DeviceError, "operation enabled was left", "joint 3 (node 5) is switch-on disabled")
    assert enabled.ended(transfer).error is not None
    report = enabled.report_that(lambda report: report.in_motion is False)
    assert report.mode is Mode.DISABLED
    assert bus.drives[5].state == SWITCH_ON_DISABLED
    enabled.link.enable(PATIENCE)
    assert enabled.report().mode is Mode.READY


def test_an_emergency_stop_is_told_once_and_by_its_name(enabled, bus):
    transfer = enabled.move((1.0, 0.0, 0.0))
    with bus.lock:
        for drive in bus.drives.values():
            drive.voltage, drive.state = False, SWITCH_ON_DISABLED
    error = enabled.failure(DeviceError, "emergency stop?", "joint 1 (node 1)", "joint 3 (node 5)")
    assert enabled.ended(transfer).error is error
    assert enabled.report_that(lambda report: report.mode is not Mode.READY).mode is Mode.EMERGENCY_STOP
    assert enabled.failures == [error]


def test_a_missing_pdo_halts_drives_that_make_their_own_way(profile, bus):
    profile.move((0.9, 0.0, 0.0))
    bus.drives[2].silent = True
    profile.failure(DeviceTimeout, "late cycles", "joint 2 (node 2)")
    profile.until(lambda: bus.drives[1].controlwords[-1] == 0x10F)


def test_a_missing_pdo_stops_the_motion_within_three_cycles(enabled, bus):
    transfer = enabled.move((1.0, 0.0, 0.0))
    bus.drives[2].silent = True
    error = enabled.ended(transfer).error
    assert isinstance(error, DeviceTimeout)
    assert "joint 2 (node 2)" in str(error)
    enabled.failure(DeviceTimeout, "late cycles", "joint 2 (node 2)")
    bus.drives[2].silent = False
    assert enabled.report_that(lambda report: report.in_motion is False).positions[0] < 1.0


def test_feedback_that_is_late_at_rest_is_told_and_then_the_link_is_lost(enabled, bus):
    bus.drives[2].silent = True
    enabled.failure(DeviceTimeout, "joint 2 (node 2) has not answered")
    with pytest.raises(CommandRefused, match=r"joint 2 \(node 2\)"):
        enabled.link.send(Course(np.zeros(3), JointPath(((0.1, 0, 0),), (0.5,) * 3, (4.0,) * 3), JointMap(None, 3)))
    enabled.failure(LinkLost, "joint 2 (node 2)")
    with pytest.raises(LinkLost):
        enabled.report()
    with pytest.raises(LinkLost):
        enabled.link.stop("test")


@pytest.mark.slow
def test_a_lost_heartbeat_is_told(enabled, bus):
    bus.drives[5].heartless = True
    enabled.failure(DeviceTimeout, "joint 3 (node 5)", "heartbeat")
    enabled.failure(LinkLost, "no heartbeat of joint 3 (node 5)")


def test_a_reboot_is_told_and_the_arm_set_up_anew_but_not_enabled(enabled, bus):
    transfer = enabled.move((1.0, 0.0, 0.0))
    bus.reboot(5)
    enabled.failure(DeviceError, "joint 3 (node 5)", "rebooted")
    assert enabled.ended(transfer).error is not None
    enabled.failure(LinkLost)
    enabled.report_that(lambda report: report.mode is Mode.DISABLED)
    assert states(bus) == [SWITCH_ON_DISABLED] * 3
    assert bus.drives[5].nmt == 0x05
    enabled.link.enable(PATIENCE)
    assert enabled.ended(enabled.move((0.0, 0.0, 0.0))).complete


def test_a_drive_that_starts_itself_after_a_reboot_is_not_enabled_before_it_was_set_up_anew(enabled, bus):
    enabled.report_that(lambda report: report.mode is Mode.READY)
    with bus.lock:
        bus.reboot(5)
        bus.drives[5].nmt = 0x05
        bus.drives[5].objects[0x1017, 0] = (100).to_bytes(2, "little")
    enabled.failure(DeviceError, "joint 3 (node 5)", "rebooted")
    with pytest.raises(CommandRefused, match=r"joint 3 \(node 5\): has rebooted"):
        enabled.link.enable(PATIENCE)
    enabled.failure(LinkLost, "joint 3 (node 5)", "set up anew")
    enabled.report_that(lambda report: report.mode is Mode.DISABLED)
    assert bus.drives[5].number(0x1016, 1) & 0xFFFF == 500
    enabled.link.enable(PATIENCE)


def test_drives_stop_when_this_program_sends_no_more_heartbeats(enabled, bus):
    cycle = enabled.link._cycle
    cycle._send = lambda frames: None  # as if its process were gone
    enabled.until(lambda: states(bus) == [QUICK_STOP] * 3)


@pytest.mark.slow
def test_a_failure_of_this_program_itself_is_a_lost_link_and_no_silence(enabled, monkeypatch):
    transfer = enabled.move((1.0, 0.5, 0.3))

    def failing(cycle):
        raise RuntimeError("oh")

    monkeypatch.setattr(Cycle, "_frames", failing)
    error = enabled.failure(LinkLost, "this program failed", "oh")
    monkeypatch.undo()
    assert enabled.ended(transfer).error is error


def test_a_link_that_is_lost_can_be_closed(enabled, bus):
    for drive in bus.drives.values():
        drive.dead = True
    enabled.failure(LinkLost)
    begin = time.monotonic()
    enabled.link.close()
    assert time.monotonic() - begin < 5.0


def test_a_slow_listener_holds_no_cycle_up(enabled, bus):
    release = threading.Event()
    enabled.link.subscribe(lambda report: release.wait(PATIENCE))
    cycles = bus.syncs
    enabled.until(lambda: bus.syncs > cycles + 20)
    assert enabled.report().mode is Mode.READY
    release.set()


def test_a_listener_that_raises_is_heard_of_and_takes_nothing_from_the_others(enabled, bus, monkeypatch):
    seen, reports = [], []
    monkeypatch.setattr(threading, "excepthook", seen.append)
    end_bad = enabled.link.subscribe(lambda report: 1 / 0)
    end_good = enabled.link.subscribe(reports.append)
    enabled.until(lambda: len(reports) > 3)
    assert seen[0].exc_type is ZeroDivisionError
    end_bad()
    end_good()
    sequences = [report.sequence for report in reports]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))


def test_findings_tell_bus_drives_and_cycle(enabled, bus):
    enabled.until(lambda: bus.syncs > 20)
    said = {finding.subject: finding for finding in enabled.link.findings()}
    assert "virtual" in said["CAN bus"].said
    assert "a small drive" in said["joint 2 (node 2)"].said
    assert "vendor 0x1234" in said["joint 2 (node 2)"].said
    assert said["joint 2 (node 2) state"].said == "operation enabled"
    assert "-573.0 to 573.0 deg" in said["joint 2 (node 2) position"].said
    assert f"{1 / PERIOD:.0f} Hz" in said["cycle"].said
    bus.fail(2, 0x7305)
    enabled.failure(DeviceError, "0x7305")
    said = {finding.subject: finding for finding in enabled.link.findings()}
    assert said["joint 2 (node 2) state"].verdict == "problem"
    assert "0x7305 encoder fault" in said["joint 2 (node 2) state"].said


EDS = """
[DeviceInfo]
VendorName=Some Maker
VendorNumber=0x1234
ProductName=Servo 7
ProductNumber=0x{product:X}
[MandatoryObjects]
SupportedObjects=0
[OptionalObjects]
SupportedObjects=0
[ManufacturerObjects]
SupportedObjects=0
"""


@pytest.mark.parametrize(
    ("sheet", "verdict", "words"),
    [
        (EDS.format(product=0x42), "good", "Some Maker, Servo 7"),
        (EDS.format(product=0x43), "problem", "product 0x42, not 0x43"),
        ("[DeviceInfo", "problem", "cannot be read"),
        (None, "problem", "no such file"),
    ],
)
def test_a_drive_is_held_against_its_data_sheet(bus, channel, tmp_path, sheet, verdict, words):
    path = tmp_path / "drive.eds"
    if sheet is not None:
        path.write_text(sheet)
    arm = Arm(bus, channel, eds=str(path))
    try:
        arm.open()
        said = {finding.subject: finding for finding in arm.link.findings()}
        assert said["joint 2 (node 2) data sheet"].verdict == verdict
        assert words in said["joint 2 (node 2) data sheet"].said
    finally:
        arm.link.close()


def test_a_closed_link_that_was_lost_is_left_alone(arm, bus, monkeypatch):
    """Closed while it is connecting anew, at whatever moment, it ends."""
    arm.open()
    again = threading.Event()
    connect = arm.link._connect

    def slowly(deadline):
        again.set()
        return connect(deadline)

    monkeypatch.setattr(arm.link, "_connect", slowly)
    arm.link._cycle.lose(LinkLost("left", "receive", "test"))
    assert again.wait(PATIENCE)
    arm.link.close()
    assert states(bus) == [SWITCH_ON_DISABLED] * 3


def test_an_arm_has_one_drive_for_each_joint(channel):
    drives = tuple({"node": node, "counts_per_rad": COUNTS} for node in NODES)
    options = CanLink.model_validate({"interface": "virtual", "arms": {"left": {"channel": channel, "drives": drives}}})
    with pytest.raises(CommandRefused, match="6 joints, but 3 drives"):
        links(options, {"left": 6}, CLOCK)
