"""Emulated drives keep CiA 301 and CiA 402: states, PDOs, modes, ways to stop and to fail."""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import can
import canopen
import numpy as np
import pytest
from canopen.profiles.p402 import BaseNode402
from hypothesis import given
from hypothesis import strategies as st

from backends.controller.emulator.dictionary import entries, object_dictionary
from backends.controller.emulator.drives import FAULTS, DriveBuses
from backends.controller.emulator.generator import TrajectoryGenerator
from backends.controller.joint_map import JointMap, JointMapConfig
from backends.controller.options import CanLink
from dualcal_hal.clock import RealClock
from tests.drive_rig import Aborted, IdealMotors, Rig, i16, i32, u8, u16, u32

OPERATIONAL, STOPPED, PRE_OPERATIONAL, RESET = 1, 2, 128, 129
NEVER = threading.Event()


@pytest.fixture
def rig() -> Rig:
    """One drive, operational and switched off."""
    rig = Rig()
    rig.nmt(OPERATIONAL)
    return rig


# Nodes


def test_a_node_boots_into_pre_operational_with_a_boot_up_message() -> None:
    rig = Rig(joints=2)
    assert rig.boot_messages == [(0x701, b"\0"), (0x702, b"\0")]
    assert rig.sync() == {}  # no PDO before it is operational


def test_a_drive_says_what_it_is() -> None:
    rig = Rig(joints=2)
    assert rig.read(0x1008) == b"dualcal emulated drive"
    assert rig.read(0x1009) == b"1.0"
    assert rig.read(0x100A) == b"1.0"
    assert rig.number(0x1000) == 0x00020192
    assert [rig.number(0x1018, k, node=2) for k in range(5)] == [4, 0, 402, 0x10000, 2]


def test_what_is_not_there_or_must_not_be_written_is_aborted_with_the_standards_code(rig: Rig) -> None:
    for code, attempt in (
        (0x06020000, lambda: rig.read(0x5FFF)),
        (0x06090011, lambda: rig.read(0x607D, 3)),
        (0x06010002, lambda: rig.write(0x6041, 0, u16(1))),
        (0x06070010, lambda: rig.write(0x6040, 0, u8(6))),
        (0x06090030, lambda: rig.write(0x6060, 0, u8(3))),
        (0x06090030, lambda: rig.write(0x605A, 0, i16(9))),
        (0x06090030, lambda: rig.write(0x6085, 0, u32(0))),
    ):
        with pytest.raises(Aborted) as aborted:
            attempt()
        assert aborted.value.args == (code,), f"{aborted.value.args[0]:08X}"


def test_a_stopped_node_answers_no_request_and_an_operational_one_does(rig: Rig) -> None:
    rig.nmt(STOPPED)
    with pytest.raises(TimeoutError):
        rig.read(0x1000)
    rig.nmt(OPERATIONAL)
    assert rig.number(0x1000)


def test_commands_to_another_node_do_not_count() -> None:
    rig = Rig(joints=2)
    rig.nmt(OPERATIONAL, node=2)
    assert list(rig.sync()) == [2]


def test_heartbeats_are_sent_with_the_nodes_state_as_often_as_told(rig: Rig) -> None:
    rig.pass_time(1.0)
    assert rig.taken() == []
    rig.write(0x1017, 0, u16(100))
    rig.taken()
    rig.pass_time(1.0)
    beats = rig.taken()
    assert len(beats) in (10, 11)
    assert set(beats) == {(0x701, b"\x05")}
    rig.nmt(PRE_OPERATIONAL)
    rig.taken()
    rig.pass_time(0.1)
    assert rig.taken() == [(0x701, b"\x7f")]


@pytest.mark.parametrize("command", [RESET, 130])
def test_a_reset_boots_anew_with_all_objects_as_at_power_on(rig: Rig, command: int) -> None:
    rig.write(0x1017, 0, u16(100))
    rig.write(0x607D, 1, i32(-5))
    rig.nmt(command, node=1)
    rig.taken()
    with pytest.raises(TimeoutError):
        rig.read(0x1000)
    rig.pass_time(0.3)
    assert rig.taken() == [(0x701, b"\0")]  # and no heartbeat: it has forgotten that one was asked for
    assert struct.unpack("<i", rig.read(0x607D, 1)) == (-(1 << 31),)
    rig.nmt(OPERATIONAL)
    assert rig.sync()[1].state == "switch-on disabled"


@given(st.integers(0, 0x7FF), st.binary(max_size=8))
def test_no_frame_at_all_upsets_a_drive(can_id: int, data: bytes) -> None:
    rig = Rig()
    rig.send(can_id, data)
    rig.pass_time(0.12)
    rig.nmt(OPERATIONAL)
    assert rig.sync()[1].position == 0


# The state machine


def test_a_drive_is_enabled_step_by_step_and_switched_off_at_once(rig: Rig) -> None:
    states = [rig.cycle(word).state for word in (0x00, 0x07, 0x0F, 0x06, 0x0F, 0x07, 0x06, 0x07, 0x0F, 0x00)]
    assert states == [
        "switch-on disabled",
        "switch-on disabled",  # not before a shutdown
        "switch-on disabled",
        "ready",
        "enabled",
        "switched on",
        "ready",
        "switched on",
        "enabled",
        "switch-on disabled",
    ]


def test_what_was_sent_by_pdo_counts_from_the_next_sync_on(rig: Rig) -> None:
    rig.send(0x201, struct.pack("<Hbi", 0x06, 8, 0))
    assert rig.number(0x6041) & 0x6F != 0x21
    assert rig.sync()[1].state == "switch-on disabled"  # sampled with the SYNC
    assert rig.sync()[1].state == "ready"


def test_a_controlword_may_come_by_sdo(rig: Rig) -> None:
    rig.write(0x6040, 0, u16(0x06))
    assert rig.number(0x6041) & 0x6F == 0x21
    assert rig.number(0x6040) == 0x06


@given(st.lists(st.integers(0, 0xFFFF), max_size=40))
def test_whatever_controlwords_come_a_drive_moves_only_when_enabled_or_stopping(words: list[int]) -> None:
    rig = Rig()
    rig.nmt(OPERATIONAL)
    for k, word in enumerate(words):
        before = rig.sync()[1]
        commands = len(rig.motors.commands)
        after = rig.cycle(word, target=k, mode=8)
        moving = {"enabled", "quick stop", "fault reaction"}
        assert len(rig.motors.commands) == commands or {before.state, after.state} & moving
        assert after.state != "not ready"


# Modes


def test_cyclic_positions_are_followed_with_each_sync(rig: Rig) -> None:
    rig.enable()
    assert [rig.cycle(0x0F, target).position for target in (10, 20, 35)] == [10, 20, 35]
    assert rig.cycle(0x0F, 35).status & 0x1000  # follows
    assert rig.number(0x6061) == 8


def test_a_target_beyond_the_software_limits_is_held_back_and_the_statusword_says_so(rig: Rig) -> None:
    rig.write(0x607D, 1, i32(-50))
    rig.write(0x607D, 2, i32(100))
    rig.enable()
    assert rig.cycle(0x0F, 100).status & 0x0800 == 0
    beyond = rig.cycle(0x0F, 130)
    assert (beyond.position, beyond.status & 0x0800) == (100, 0x0800)
    assert rig.cycle(0x0F, -60).position == -50


def test_a_profile_goes_its_own_way_after_a_rising_edge_and_says_when_it_is_there(rig: Rig) -> None:
    rig.write(0x6081, 0, u32(500))
    rig.write(0x6083, 0, u32(2000))
    rig.write(0x6084, 0, u32(2000))
    rig.enable(mode=1)
    assert rig.cycle(0x0F, 400, mode=1).position == 0
    started = rig.cycle(0x1F, 400, mode=1)
    assert started.status & 0x1400 == 0x1000  # acknowledged, not reached
    assert rig.cycle(0x0F, 400, mode=1).status & 0x1000 == 0
    rig.pass_time(0.3)
    underway = rig.sync()[1]
    assert 50 < underway.position < 200
    rig.pass_time(1.0)  # 0.8 s of cruise and 0.25 s of ramps in all, with no SYNC at all
    arrived = rig.sync()[1]
    assert (arrived.position, arrived.status & 0x0400) == (400, 0x0400)
    # The same bit again without an edge is nothing new.
    assert rig.cycle(0x0F, 0, mode=1).position == 400


def test_a_second_set_point_waits_for_the_first_unless_it_is_to_replace_it(rig: Rig) -> None:
    rig.enable(mode=1)
    for word, target in ((0x1F, 300), (0x0F, 300), (0x1F, 100)):
        waiting = rig.cycle(word, target, mode=1)
    assert rig.cycle(0x0F, 100, mode=1).status & 0x1000  # still waiting: not ready for a third
    assert waiting.position < 300
    rig.pass_time(3.0)
    assert rig.sync()[1].position == 100
    rig.cycle(0x1F, 2000, mode=1)
    rig.cycle(0x0F, 2000, mode=1)
    rig.cycle(0x3F, 0, mode=1)
    rig.pass_time(3.0)
    assert rig.sync()[1].position == 0


def test_a_relative_set_point_is_added_to_the_last_one(rig: Rig) -> None:
    rig.enable(mode=1)
    for _ in range(2):
        rig.cycle(0x5F, 150, mode=1)
        rig.cycle(0x0F, 150, mode=1)
        rig.pass_time(2.0)
    assert rig.sync()[1].position == 300


def test_a_halted_profile_stands_and_goes_on(rig: Rig) -> None:
    rig.enable(mode=1)
    rig.cycle(0x1F, 1000, mode=1)
    rig.pass_time(0.1)
    rig.cycle(0x11F, 1000, mode=1)
    rig.pass_time(1.0)
    stands = rig.sync()[1]
    assert 0 < stands.position < 1000
    rig.cycle(0x1F, 1000, mode=1)
    rig.pass_time(2.0)
    assert rig.sync()[1].position == 1000


@given(st.integers(-500, 500), st.floats(50, 5000), st.floats(100, 1e5), st.floats(100, 1e5), st.floats(0.001, 0.01))
def test_a_profile_keeps_speed_and_accelerations_and_ends_exactly_at_its_target(
    target: int, speed: float, up: float, down: float, dt: float
) -> None:
    generator = TrajectoryGenerator()
    for _ in range(20_000):
        before = generator.velocity
        if generator.approach(target, speed, up, down, dt):
            break
        assert abs(generator.velocity) <= speed * (1 + 1e-9)
        assert abs(generator.velocity - before) <= max(up, down) * dt * (1 + 1e-9)
        assert (target - generator.position) * target >= -1e-6  # never beyond it
    assert (generator.position, generator.velocity) == (target, 0.0)


# Stops


@pytest.mark.parametrize(
    ("option", "ends"),
    [
        (0, "switch-on disabled"),
        (1, "switch-on disabled"),
        (2, "switch-on disabled"),
        (5, "quick stop"),
        (6, "quick stop"),
    ],
)
def test_a_quick_stop_brakes_and_ends_as_its_option_has_it(rig: Rig, option: int, ends: str) -> None:
    rig.write(0x605A, 0, i16(option))
    rig.enable()
    for target in (20, 40, 60):  # 2000 counts/s, 8000 counts/s^2
        rig.cycle(0x0F, target)
    first = rig.cycle(0x02, 80)
    rig.pass_time(0.5)
    last = rig.sync()[1]
    assert last.state == ends
    if option == 0:
        assert last.position == 60
    else:
        assert first.state == "quick stop"
        assert last.position == pytest.approx(60 + 2000**2 / 8000 / 2, abs=15)


def test_a_drive_that_stays_in_quick_stop_is_enabled_again_where_it_stands(rig: Rig) -> None:
    rig.write(0x605A, 0, i16(6))
    rig.enable(mode=1)
    rig.cycle(0x1F, 1000, mode=1)
    rig.cycle(0x02, 1000, mode=1)
    rig.pass_time(0.5)
    stands = rig.sync()[1]
    assert stands.status & 0x0400
    again = rig.cycle(0x0F, 1000, mode=1)
    rig.pass_time(0.5)
    assert (again.state, rig.sync()[1].position) == ("enabled", stands.position)


def test_enabling_moves_nothing_however_the_encoder_flickers(rig: Rig) -> None:
    rig.motors.noise = np.array([0.9e-3])
    rig.enable(mode=1)
    assert rig.motors.commands == []


def test_a_node_that_leaves_operational_while_it_moves_has_a_fault(rig: Rig) -> None:
    rig.enable()
    rig.taken()
    rig.nmt(PRE_OPERATIONAL)
    assert (0x81, struct.pack("<HB5x", 0x8100, 0x11)) in rig.taken()
    rig.pass_time(0.1)
    assert rig.number(0x6041) & 0x4F == 0x08


# Heartbeats of the master


def beat(rig: Rig, seconds: float) -> None:
    for _ in range(round(seconds / 0.05)):
        rig.send(0x77F, b"\x05")
        rig.pass_time(0.05)


def watching(rig: Rig, **more: int) -> None:
    rig.write(0x1016, 1, u32(0x7F << 16 | 200))
    rig.enable()


def test_a_drive_stops_and_has_a_fault_when_the_masters_heartbeat_is_lost(rig: Rig) -> None:
    watching(rig)
    beat(rig, 1.0)
    for target in (20, 40):
        rig.cycle(0x0F, target)
    rig.taken()
    rig.pass_time(0.1)
    assert rig.taken() == []
    rig.pass_time(0.1)
    assert rig.taken() == [(0x81, struct.pack("<HB5x", 0x8130, 0x11))]
    rig.pass_time(1.0)
    assert rig.number(0x6041) & 0x4F == 0x08
    assert rig.number(0x603F) == 0x8130
    assert rig.sync() == {}  # it has gone to pre-operational, as 1029 has it


def test_a_drive_whose_master_has_gone_goes_no_farther_than_its_last_target(rig: Rig) -> None:
    watching(rig)
    beat(rig, 0.1)
    for target in (20, 40, 60):
        rig.cycle(0x0F, target)
    rig.pass_time(1.0)
    assert (rig.shown().state, rig.shown().position) == ("fault", 60)


def test_it_is_watched_from_the_first_one_on(rig: Rig) -> None:
    watching(rig)
    rig.pass_time(1.0)
    assert rig.sync()[1].state == "enabled"


@pytest.mark.parametrize(("option", "state"), [(0, "enabled"), (2, "switch-on disabled"), (3, "switch-on disabled")])
def test_what_a_lost_heartbeat_does_is_the_masters_choice(rig: Rig, option: int, state: str) -> None:
    rig.write(0x6007, 0, i16(option))
    rig.write(0x1029, 1, u8(1))
    watching(rig)
    beat(rig, 0.1)
    rig.pass_time(0.5)
    assert rig.sync()[1].state == state


# Faults


def test_a_fault_is_told_stops_and_is_reset_by_a_rising_edge_only(rig: Rig) -> None:
    rig.enable()
    for target in (20, 40):
        rig.cycle(0x0F, target)
    rig.taken()
    rig.drives.drives[0].axis.fail(0x2310)
    assert rig.taken() == [(0x81, struct.pack("<HB5x", 0x2310, 0x03))]
    assert rig.cycle(0x0F, 60).state == "fault reaction"
    rig.pass_time(0.5)
    assert rig.cycle(0x8F, 60).state == "switch-on disabled"  # an edge, whatever else is asked for
    assert rig.number(0x603F) == rig.number(0x1001) == 0
    assert [rig.number(0x1003, k) for k in (0, 1)] == [1, 0x2310]
    rig.drives.drives[0].axis.fail(0x2310)
    assert rig.cycle(0x80).state == "fault"  # the bit was set before
    rig.cycle(0x00)
    rig.taken()
    assert rig.cycle(0x80).state == "switch-on disabled"


def test_a_motor_that_does_not_follow_is_a_following_error(rig: Rig) -> None:
    rig.write(0x6065, 0, u32(30))
    rig.write(0x6066, 0, u16(40))
    rig.enable()
    rig.cycle(0x0F, 20)
    rig.drives.drives[0].axis.block()
    assert rig.cycle(0x0F, 21).state == "enabled"
    assert rig.cycle(0x0F, 60).status & 0x2000
    heard = []
    for _ in range(6):
        rig.send(0x201, struct.pack("<Hbi", 0x0F, 8, 60))
        rig.send(0x80)
        rig.pass_time(0.01)
        heard += rig.taken()
    assert (0x81, struct.pack("<HB5x", 0x8611, 0x21)) in heard
    rig.pass_time(0.5)
    shown = rig.sync()[1]
    assert (shown.state, shown.position) == ("fault", 20)


def test_the_history_of_errors_keeps_the_newest_first_and_can_be_cleared(rig: Rig) -> None:
    for code in range(0x4201, 0x4207):
        rig.drives.drives[0].tell_emergency(code)
    assert [rig.number(0x1003, k) for k in range(5)] == [4, 0x4206, 0x4205, 0x4204, 0x4203]
    rig.write(0x1003, 0, u8(0))
    assert rig.number(0x1003, 1) == 0


# PDOs


def remap(rig: Rig, communication: int, mapped: list[int], transmission: int = 1) -> None:
    """As CiA 301 asks for it."""
    cob_id = rig.number(communication, 1) & 0x7FF
    rig.write(communication, 1, u32(cob_id | 1 << 31))
    rig.write(communication, 2, u8(transmission))
    rig.write(communication + 0x200, 0, u8(0))
    for k, entry in enumerate(mapped, 1):
        rig.write(communication + 0x200, k, u32(entry))
    rig.write(communication + 0x200, 0, u8(len(mapped)))
    rig.write(communication, 1, u32(cob_id))


def test_pdos_are_mapped_anew_by_sdo() -> None:
    rig = Rig()
    remap(rig, 0x1400, [0x607A0020, 0x60400010])
    remap(rig, 0x1800, [0x60640020, 0x603F0010, 0x10010008])
    remap(rig, 0x1801, [0x60410010], transmission=2)
    rig.nmt(OPERATIONAL)
    rig.send(0x201, struct.pack("<iH", 7, 0x06))
    heard = []
    for _ in range(4):
        rig.send(0x80)
        heard.append(rig.taken())
    assert [[can_id for can_id, _ in frames] for frames in heard] == [[0x181], [0x181, 0x281]] * 2
    assert struct.unpack("<iHB", heard[0][0][1]) == (0, 0, 0)
    assert struct.unpack("<H", heard[1][1][1])[0] & 0x6F == 0x21
    assert struct.unpack("<i", rig.read(0x607A)) == (7,)


def test_a_pdo_may_count_at_once() -> None:
    rig = Rig()
    remap(rig, 0x1400, [0x60400010], transmission=255)
    rig.nmt(OPERATIONAL)
    rig.send(0x201, u16(0x06))
    assert rig.number(0x6041) & 0x6F == 0x21


def test_a_pdo_that_is_on_or_filled_is_not_changed_and_nothing_that_does_not_fit_is_mapped() -> None:
    rig = Rig()
    for index, subindex, value in ((0x1600, 0, u8(0)), (0x1600, 1, u32(0x60400010))):
        with pytest.raises(Aborted) as aborted:
            rig.write(index, subindex, value)
        assert aborted.value.args == (0x08000022,)
    rig.write(0x1400, 1, u32(0x201 | 1 << 31))
    rig.write(0x1600, 0, u8(0))
    for value, code in ((0x60FF0020, 0x06020000), (0x60410010, 0x06040041), (0x60400020, 0x06040041)):
        with pytest.raises(Aborted) as aborted:
            rig.write(0x1600, 1, u32(value))
        assert aborted.value.args == (code,)
    for k in (1, 2, 3):
        rig.write(0x1600, k, u32(0x607A0020))
    with pytest.raises(Aborted) as aborted:
        rig.write(0x1600, 0, u8(3))
    assert aborted.value.args == (0x06040042,)


def test_a_pdo_that_is_too_short_is_not_taken(rig: Rig) -> None:
    rig.send(0x201, b"\x06\x00\x08")
    rig.send(0x80)
    assert rig.number(0x6041) & 0x6F != 0x21


# From counts to joints


def test_counts_sign_offset_order_and_coupling_lie_between_drives_and_joints() -> None:
    config = JointMapConfig.model_validate(
        {"order": [2, 1, 3], "coupling": [{"joint": 3, "from_joint": 2, "factor": 1.0}]}
    )
    drives = [
        {"node": 5, "counts_per_rad": 1000.0, "offset_rad": 0.5, "sign": -1},
        {"node": 6, "counts_per_rad": 2000.0},
        {"node": 7, "counts_per_rad": 4000.0, "offset_rad": -0.25},
    ]
    rig = Rig(3, home=0.2, drives=drives, joint_map=config)
    rig.motors.q = np.array([0.1, 0.2, 0.3])
    rig.nmt(OPERATIONAL)
    shown = rig.sync()
    c = JointMap(config, 3).to_controller(rig.motors.q)
    assert [shown[node].position for node in (5, 6, 7)] == [
        round(-1000 * (c[0] - 0.5)),
        round(2000 * c[1]),
        round(4000 * (c[2] + 0.25)),
    ]
    for node in (5, 6, 7):
        rig.enable(node=node, target=shown[node].position)
    rig.cycle(0x0F, shown[6].position + 200, node=6)
    # The controller's second joint is the first of the kinematics, and takes its third along.
    assert np.allclose(rig.motors.q, [0.2, 0.2, 0.2], atol=1e-3)


def test_all_drives_of_an_arm_are_commanded_together() -> None:
    rig = Rig(joints=3)
    rig.nmt(OPERATIONAL)
    for node in (1, 2, 3):
        rig.enable(node=node)
    rig.motors.commands.clear()
    for node in (1, 2, 3):
        rig.send(0x200 + node, struct.pack("<Hbi", 0x0F, 8, 10 * node))
    assert rig.motors.commands == []
    rig.sync()
    assert [q.tolist() for q in rig.motors.commands] == [[0.01, 0.02, 0.03]]


def test_it_is_told_that_an_arm_is_sent_elsewhere_and_only_then(rig: Rig) -> None:
    sent: list[float] = []
    rig.drives.on_target = lambda: sent.append(float(rig.motors.q[0]))
    rig.enable()
    for target in (10, 10, 20):
        rig.cycle(0x0F, target)
    assert sent == [0.01, 0.02]


# Over wires, with canopen's master


@pytest.fixture
def buses() -> Iterator[DriveBuses]:
    drives = [{"node": node, "counts_per_rad": 1000.0} for node in (1, 2)]
    arms = {name: {"channel": name, "drives": drives} for name in ("left", "right")}
    options = CanLink.model_validate({"interface": "socketcand", "arms": arms})
    buses = DriveBuses(options, {name: IdealMotors(2) for name in arms}, RealClock())
    yield buses
    buses.close()


@contextmanager
def on_bus(buses: DriveBuses, arm: str) -> Iterator[canopen.Network]:
    assert buses.endpoints["interface"] == "socketcand"
    address, name = buses.endpoints["arms"][arm]["channel"].split("/")
    host, port = address.split(":")
    network = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    network.connect(interface="socketcand", host=host, port=int(port), channel=name, tcp_tune=True, ignore_config=True)
    yield network
    network.disconnect()


@pytest.fixture
def master(buses: DriveBuses) -> Iterator[canopen.Network]:
    """On the left arm's bus."""
    with on_bus(buses, "left") as network:
        yield network


def wait_for(what: threading.Event) -> None:
    assert what.wait(10.0)


@contextmanager
def bare_bus(buses: DriveBuses, arm: str) -> Iterator[can.BusABC]:
    """Without canopen's master, whose reading thread may be the first to see that a connection is gone."""
    address, name = buses.endpoints["arms"][arm]["channel"].split("/")
    host, port = address.split(":")
    with can.Bus(interface="socketcand", host=host, port=int(port), channel=name, ignore_config=True) as bus:
        yield bus


def send_for_ever(bus: can.BusABC) -> None:
    while True:
        bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        NEVER.wait(0.01)


def add_node(network: canopen.Network, node: int = 1) -> BaseNode402:
    remote = BaseNode402(node, object_dictionary(node, entries(node)))
    network.add_node(remote)
    remote.sdo.RESPONSE_TIMEOUT = 5.0
    return remote


def test_canopens_master_maps_and_moves_a_drive(buses: DriveBuses, master: canopen.Network) -> None:
    node = add_node(master)
    assert node.sdo[0x1008].raw == "dualcal emulated drive"
    node.tpdo.read()
    node.rpdo.read()
    node.tpdo[1].clear()
    for index in (0x6041, 0x6064):
        node.tpdo[1].add_variable(index)
    node.tpdo[1].trans_type, node.tpdo[1].enabled = 1, True
    node.tpdo[1].save()
    node.nmt.state = "OPERATIONAL"
    node.sdo[0x6060].raw = 1
    for word in (0x06, 0x07, 0x0F):
        node.sdo[0x6040].raw = word
    node.sdo[0x607A].raw = 100
    node.sdo[0x6040].raw = 0x1F
    there = threading.Event()
    node.tpdo[1].add_callback(lambda pdo: there.set() if pdo[0x6064].raw == 100 and pdo[0x6041].raw & 0x400 else None)
    master.sync.start(0.01)
    wait_for(there)
    master.sync.stop()


def enabled(network: canopen.Network) -> BaseNode402:
    """The left arm's second drive, in profile position."""
    node = add_node(network, 2)
    node.nmt.state = "OPERATIONAL"
    node.sdo[0x6060].raw = 1
    for word in (0x06, 0x07, 0x0F):
        node.sdo[0x6040].raw = word
    return node


def told_emergency(node: BaseNode402) -> threading.Event:
    told = threading.Event()
    node.emcy.add_callback(lambda emergency: told.set())
    return told


@pytest.mark.parametrize(("fault", "error"), [("emergency", 0), ("drive-fault", 0x2310)])
def test_an_emergency_is_a_frame_and_a_fault_of_a_drive_is_more(
    buses: DriveBuses, master: canopen.Network, fault: str, error: int
) -> None:
    node = enabled(master)
    told = told_emergency(node)
    assert buses.strike(fault, "left") is None
    wait_for(told)
    assert node.sdo[0x603F].raw == error


def test_a_blocked_motor_is_found_by_its_following_error(buses: DriveBuses, master: canopen.Network) -> None:
    node = enabled(master)
    told = told_emergency(node)
    free = buses.strike("following-error", "left")
    node.sdo[0x607A].raw = 500
    node.sdo[0x6040].raw = 0x1F
    wait_for(told)
    assert node.sdo[0x603F].raw == 0x8611
    assert free is not None
    free()


def test_a_node_that_reboots_says_so_and_is_off(buses: DriveBuses, master: canopen.Network) -> None:
    node = enabled(master)
    booted = threading.Event()
    node.nmt.add_heartbeat_callback(lambda state: booted.set() if state == 0 else None)
    assert buses.strike("node-reboot", "left") is None
    wait_for(booted)
    assert node.sdo[0x6041].raw & 0x6F == 0x40


def test_aborted_transfers_are_aborted_until_that_ends(buses: DriveBuses, master: canopen.Network) -> None:
    node = enabled(master)
    end = buses.strike("sdo-abort", "left")
    with pytest.raises(canopen.SdoAbortedError):
        node.sdo[0x6040].raw = 0x02
    assert end is not None
    end()
    assert node.sdo[0x6040].raw == 0x0F


def test_an_emergency_stop_takes_the_voltage_of_all_drives_and_none_comes_back_by_itself(
    buses: DriveBuses, master: canopen.Network
) -> None:
    node, other = enabled(master), add_node(master, 1)
    end = buses.strike("estop", "left")
    assert node.sdo[0x6041].raw & 0x5F == 0x40
    node.sdo[0x6040].raw = 0x06
    assert node.sdo[0x6041].raw & 0x5F == 0x40
    assert other.sdo[0x6041].raw & 0x10 == 0
    assert end is not None
    end()
    assert node.sdo[0x6041].raw & 0x5F == 0x50
    node.sdo[0x6040].raw = 0x06
    assert node.sdo[0x6041].raw & 0x6F == 0x21


def test_a_missing_pdo_is_one_drives_alone(buses: DriveBuses, master: canopen.Network) -> None:
    heard: dict[int, threading.Event] = {node: threading.Event() for node in (1, 2)}
    for node, event in heard.items():
        add_node(master, node)
        master.subscribe(0x180 + node, lambda *_, event=event: event.set())
    master.nmt.state = "OPERATIONAL"
    end = buses.strike("missing-pdo", "left")
    master.send_message(0x80, b"")
    wait_for(heard[1])
    assert not heard[2].is_set()
    assert end is not None
    end()
    master.send_message(0x80, b"")
    wait_for(heard[2])


def test_a_lost_link_is_that_of_one_arm(buses: DriveBuses) -> None:
    with bare_bus(buses, "left") as bus:
        end = buses.strike("lost-link", "left")
        with pytest.raises((can.CanError, OSError)):
            send_for_ever(bus)
    assert end is not None
    end()
    with on_bus(buses, "left"), on_bus(buses, "right"):
        pass


def test_all_faults_of_drives_are_told_of_here() -> None:
    lasting = {"following-error", "heartbeat-loss", "sdo-abort", "missing-pdo", "estop", "lost-link"}
    assert set(FAULTS) == lasting | {"emergency", "drive-fault", "node-reboot"}
    assert {fault for fault, (_, end) in FAULTS.items() if end is not None} == lasting


def test_a_drive_without_heartbeat_is_otherwise_there(buses: DriveBuses, master: canopen.Network) -> None:
    beats = {node: threading.Event() for node in (1, 2)}
    for node, heard in beats.items():
        master.subscribe(0x700 + node, lambda *_, heard=heard: heard.set())
        add_node(master, node).sdo[0x1017].raw = 20
    for heard in beats.values():
        wait_for(heard)
    end = buses.strike("heartbeat-loss", "left", joint=2)
    assert end is not None
    assert master.nodes[2].sdo[0x1000].raw  # by now it has struck
    beats[2].clear()
    NEVER.wait(0.1)
    assert not beats[2].is_set()
    end()
    wait_for(beats[2])


def test_arms_have_buses_of_their_own(buses: DriveBuses, master: canopen.Network) -> None:
    add_node(master).nmt.state = "OPERATIONAL"
    assert master.nodes[1].sdo[0x6041].raw & 0x200
    assert not buses.arms["right"].drives[0].transmits
