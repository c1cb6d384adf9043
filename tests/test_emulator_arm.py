"""An emulated arm: it goes where it is told, as drives do, and stands there as the simulated cell has it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event

import numpy as np
import pytest

from backends.controller.emulator.arm import ENCODER_STEP, Braking, EmulatedArm, Ramp
from backends.controller.emulator.servo import RESERVE, TICK, Servo, Still
from backends.controller.emulator.world import EmulatedWorld
from dualcal_hal.cellfile import CellFile
from dualcal_hal.clock import RealClock
from dualcal_hal.robot import JointPath
from dualcal_hal.trajectory import Trajectory
from dualcal_hal.transforms import Array
from tests.simple_message_client import ARMS, PATIENCE, tcp_cell

CLOCK, NEVER = RealClock(), Event()
AWAY = np.array([0.2, -0.1, 0.1, 0.2, 0.1, -0.3])


@contextmanager
def world(*overrides: str) -> Iterator[tuple[EmulatedWorld, CellFile]]:
    file = tcp_cell("dialect: rep", ARMS, *overrides)
    assert file.simulation is not None
    emulated = EmulatedWorld(file.cell, file.simulation)
    try:
        yield emulated, file
    finally:
        emulated.close()


def wait(condition: Callable[[], object]) -> None:
    end = CLOCK.now() + PATIENCE
    while not condition():
        assert CLOCK.now() < end
        CLOCK.wait(NEVER, CLOCK.now() + 0.005)


def go(arm: EmulatedArm, goal: Array, duration: float = 0.4) -> None:
    arm.follow(Ramp(arm.commanded(), goal, duration))
    wait(lambda: not arm.in_motion)


def unseen(arm: EmulatedArm) -> Array:
    motors, links = arm.angles(CLOCK.now())
    return links - motors


def servo(file: CellFile) -> Servo:
    robot = file.cell.active
    return Servo(robot.home, robot.speed, robot.acceleration)


def planned(file: CellFile) -> Trajectory:
    """The fastest motion that the cell file allows."""
    robot = file.cell.active
    trajectory = Trajectory(robot.home, robot.acceleration)
    goal = tuple((robot.home + 3 * AWAY).tolist())
    trajectory.follow(JointPath((goal,), tuple(robot.speed), tuple(robot.acceleration)), 0.0)
    return trajectory


# The drives, in a time of the test's own


def test_a_motion_within_the_limits_is_followed_a_little_later() -> None:
    file = tcp_cell()
    drives, trajectory = servo(file), planned(file)
    drives.tell(trajectory, 0.0)
    off = []
    for t in np.arange(0.0, trajectory.end, TICK):
        sought = trajectory.sample(max(0.0, t - 0.01))[0]
        off.append(np.max(np.abs(drives.sample(t)[0] - sought)))
    assert max(off) < 3e-3
    drives.sample(trajectory.end + 0.5)
    assert drives.end < trajectory.end + 0.3
    assert drives.sample(trajectory.end + 0.5)[0] == pytest.approx(np.array(trajectory.destination), abs=1e-12)


def test_drives_are_no_faster_than_they_can_be_and_do_not_overshoot() -> None:
    file = tcp_cell()
    robot, drives = file.cell.active, servo(file)
    goal = robot.home + 3 * AWAY
    drives.tell(Still(goal), 0.0)  # a set point far away at once
    samples = [drives.sample(t) for t in np.arange(0.0, 3.0, TICK)]
    q, v = (np.array(of) for of in zip(*samples, strict=True))
    assert np.all(np.abs(v) <= robot.speed * (1 + 1e-9))
    assert np.all(np.abs(np.diff(v, axis=0)) <= TICK * RESERVE * robot.acceleration * (1 + 1e-9))
    assert np.all(np.abs(q - robot.home) <= np.abs(goal - robot.home) + 1e-3)
    assert q[-1] == pytest.approx(goal, abs=1e-9)


def test_set_points_that_come_late_and_all_at_once_do_not_lead_off_a_straight_way() -> None:
    file = tcp_cell()
    drives, trajectory = servo(file), planned(file)
    home, way = file.cell.active.home, np.array(trajectory.destination) - file.cell.active.home
    cycles = np.arange(0.0, trajectory.end + 0.02, 0.01)
    for due in cycles:
        came = due if not 0.2 < due < 0.3 else 0.3 + (due - 0.2) * 1e-3  # nothing came for 0.1 s
        drives.tell(Ramp(drives.commanded(came), trajectory.sample(due)[0], 0.01), came)
    off = []
    for t in np.arange(0.0, trajectory.end + 0.5, TICK):
        gone = drives.sample(t)[0] - home
        off.append(np.max(np.abs(gone - (gone @ way) / (way @ way) * way)))
    assert max(off) < 2e-3
    assert drives.sample(9.0)[0] == pytest.approx(home + way, abs=1e-6)


def test_braking_stays_on_the_way_and_begins_at_once() -> None:
    file = tcp_cell()
    robot, drives, trajectory = file.cell.active, servo(file), planned(file)
    drives.tell(trajectory, 0.0)
    q, v = drives.sample(0.3)
    drives.brake(0.3)
    rest = np.array(drives.destination)
    longest = float(np.max(np.abs(v) / robot.acceleration))
    drives.sample(0.3 + longest + 0.3)
    assert drives.end < 0.3 + longest + 0.3
    way, full = rest - robot.home, np.array(trajectory.destination) - robot.home
    assert np.linalg.norm(np.cross(way[:3], full[:3])) / np.linalg.norm(way) < 1e-2
    assert np.all(np.abs(rest - q) <= longest * np.abs(v) + 1e-3)


def test_braking_is_even_in_all_joints() -> None:
    braking = Braking(np.zeros(2), np.array([1.0, -0.5]), np.array([2.0, 4.0]))
    assert braking.end == 0.5
    q, v = braking.sample(0.25)
    assert v == pytest.approx([0.5, -0.25])
    assert braking.sample(9.0)[0] == pytest.approx([0.25, -0.125])
    assert q[1] == pytest.approx(-0.5 * q[0])


# In the world, in real time


def test_it_comes_to_rest_where_it_is_told_and_reads_in_steps_of_its_encoders() -> None:
    with world() as (emulated, file):
        arm = emulated.arms["left"]
        assert not arm.in_motion
        goal = file.cell.active.home + AWAY
        arm.follow(Ramp(arm.commanded(), goal, 1.0))
        assert arm.in_motion
        wait(lambda: not arm.in_motion)
        read = arm.read()
        assert read.positions == pytest.approx(goal, abs=5 * file.cell.active.encoder_sigma + ENCODER_STEP)
        assert read.positions / ENCODER_STEP == pytest.approx(np.round(read.positions / ENCODER_STEP), abs=1e-6)
        assert read.velocities == pytest.approx(np.zeros(6))
        assert abs(read.time - CLOCK.now()) < PATIENCE


def test_what_encoders_do_not_see_belongs_to_the_target() -> None:
    with world() as (emulated, file):
        arm, home = emulated.arms["left"], file.cell.active.home
        at_home = unseen(arm)
        assert np.all(at_home != 0.0)
        go(arm, home + AWAY)
        away = unseen(arm)
        assert np.max(np.abs(away - at_home)) > 1e-6
        go(arm, home, 0.3)
        assert unseen(arm) == pytest.approx(at_home, abs=1e-12)
        go(arm, home + AWAY + 1e-8, 0.6)  # the same target, by numbers that were rounded elsewhere
        assert unseen(arm) == pytest.approx(away, abs=1e-12)


def test_once_it_says_that_it_rests_nothing_moves_any_more() -> None:
    with world("simulation.errors.settle_time.amplitude_mrad=0") as (emulated, file):
        arm = emulated.arms["left"]
        before = unseen(arm)
        go(arm, file.cell.active.home + AWAY, 0.2)
        at_once = unseen(arm)
        assert np.max(np.abs(at_once - before)) > 1e-6
        CLOCK.wait(NEVER, CLOCK.now() + 0.1)
        assert unseen(arm) == pytest.approx(at_once, abs=1e-12)


def test_set_points_that_stream_are_followed() -> None:
    with world() as (emulated, file):
        arm, trajectory = emulated.arms["left"], planned(file)
        begin, cycle = CLOCK.now(), 0
        while cycle * 0.01 < trajectory.end + 0.05:
            arm.command(trajectory.sample(cycle * 0.01)[0], 0.01)
            cycle += 1
            CLOCK.wait(NEVER, begin + cycle * 0.01)
        wait(lambda: not arm.in_motion)
        assert arm.read().positions == pytest.approx(np.array(trajectory.destination), abs=1e-4)
        assert arm.motions == 1
        arm.command(np.array(trajectory.destination), 0.01)
        assert not arm.in_motion  # nothing new


def test_being_told_to_stand_where_an_encoder_shows_it_to_is_no_motion() -> None:
    with world() as (emulated, file):
        arm, home = emulated.arms["left"], file.cell.active.home
        for flicker in (2e-5, -2e-5, 1e-5):
            arm.command(home + flicker, 0.01)
        assert arm.motions == 0
        for way in (5e-5, 2e-4, 5e-4):
            arm.command(home + way, 0.01)
        assert arm.motions == 1


def test_a_hold_brings_it_to_rest_on_its_way() -> None:
    with world() as (emulated, file):
        arm, home = emulated.arms["left"], file.cell.active.home
        arm.follow(Ramp(home, home + 3 * AWAY, 4.0))
        wait(lambda: np.max(np.abs(arm.read().positions - home)) > 0.1)
        arm.hold()
        wait(lambda: not arm.in_motion)
        share = (arm.read().positions - home) / (3 * AWAY)
        assert 0.1 < share[0] < 0.99
        assert share == pytest.approx(np.full(6, share[0]), abs=0.02)
        assert arm.commanded() == pytest.approx(arm.read().positions, abs=1e-4)


def test_arms_that_touch_are_halted_for_good_and_it_is_said_which() -> None:
    with world("simulation.stepper=bullet") as (emulated, file):
        told: list[str] = []
        emulated.on_contact(told.append)
        arm = emulated.arms["left"]
        arm.follow(Ramp(arm.commanded(), file.cell.active.home + np.array([0, -1.9, 0, 0, 0, 0]), 2.0))
        wait(lambda: told)
        assert "left" in told[0]
        wait(lambda: not arm.in_motion)
        stands = arm.read().positions
        arm.follow(Ramp(arm.commanded(), file.cell.active.home, 0.2))
        assert not arm.in_motion
        assert arm.read().positions == pytest.approx(stands, abs=1e-4)
        assert len(told) == 1
        assert emulated.distances().times
