"""The simulated cell: exact without noise, reproducible with it, and true to its truth."""

from __future__ import annotations

import dataclasses
import json
import math
import threading
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.simulator import SimulatorBackend
from backends.simulator.camera import LATENCY
from backends.simulator.noise import generator
from backends.simulator.world import World
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import VirtualClock
from dualcal_hal.errors import CellFileError, CommandRefused, DeviceError, MotionStopped, NotOpen, UsageError
from dualcal_hal.registry import backend_class
from dualcal_hal.robot import JointPath, Joints, Motion, MotionState, RobotState
from dualcal_hal.trajectory import Trajectory
from dualcal_hal.transforms import Array
from tests.reference_cell import DOCUMENT

PAPER_CELL = Path(__file__).parents[1] / "cells" / "paper.yaml"
NO_NOISE = tuple(f"simulation.noise.{what}=0" for what in ("joint_mrad", "encoder_mrad", "image_grey", "blur_px"))
ACTIVE, PASSIVE = "left", "right"
TIMEOUT = 30.0
NEVER = threading.Event()


@cache
def cell(*overrides: str) -> CellFile:
    return load_cell(PAPER_CELL, ("simulation.stepper=kinematic", *overrides))


@pytest.fixture
def noisy() -> Iterator[SimulatorBackend]:
    yield from opened(cell())


@pytest.fixture
def exact() -> Iterator[SimulatorBackend]:
    yield from opened(cell(*NO_NOISE))


def opened(file: CellFile) -> Iterator[SimulatorBackend]:
    backend = SimulatorBackend("sim", file)
    backend.open(TIMEOUT)
    yield backend
    backend.close()


def away(name: str, offset: float) -> Joints:
    return tuple((cell().cell.robots[name].home + offset).tolist())


def move(backend: SimulatorBackend, name: str, target: Joints) -> RobotState:
    return start(backend, name, target).wait(TIMEOUT)


def start(backend: SimulatorBackend, name: str, *waypoints: Joints) -> Motion:
    config = backend.cell.cell.robots[name]
    return backend.robot(name).start(JointPath(waypoints, tuple(config.speed), tuple(config.acceleration)))


def readings(backend: SimulatorBackend, count: int = 2) -> list[Joints]:
    return [backend.robot(name).read(TIMEOUT).positions for name in (ACTIVE, PASSIVE) for _ in range(count)]


# The cell file


def test_the_registry_knows_the_simulator() -> None:
    assert backend_class("simulator") is SimulatorBackend
    assert (SimulatorBackend.time, SimulatorBackend.simulated) == ("drives", True)


def test_a_cell_without_simulation_is_refused() -> None:
    with pytest.raises(CellFileError, match="simulation: missing key"):
        SimulatorBackend("sim", dataclasses.replace(cell(), simulation=None))


def test_devices_of_other_backends_are_refused_all_at_once() -> None:
    mixed = cell("backends.other={type: simulator}", "robots.right.backend=other", "camera.backend=other")
    with pytest.raises(CellFileError, match="whole cell") as caught:
        SimulatorBackend("sim", mixed)
    assert [problem.where for problem in caught.value.problems] == ["robots.right.backend", "camera.backend"]


# Truth


@pytest.mark.parametrize("capture", DOCUMENT["captures"][::9], ids=lambda capture: capture["id"])
def test_the_camera_sees_the_reference_captures(capture: dict[str, list[float]]) -> None:
    file = cell(*NO_NOISE)
    assert file.simulation is not None
    world = World(file.cell, file.simulation, VirtualClock())
    for name, key in ((ACTIVE, "active_joints_rad"), (PASSIVE, "passive_joints_rad")):
        q, fast = tuple(capture[key]), (1.0,) * 6
        world.arms[name].follow(JointPath((q,), fast, fast))
    T_E_T = world.T_E_T(60.0)
    camera, board = file.cell.camera.intrinsics, file.cell.target.board
    rotation, _ = cv2.Rodrigues(T_E_T[:3, :3])
    corners, _ = cv2.projectPoints(board.corners, rotation, T_E_T[:3, 3], camera.matrix, camera.distortion)
    np.testing.assert_allclose(corners.reshape(-1, 2), capture["corners_px"], rtol=0, atol=1e-6)


def test_without_noise_readings_are_the_commanded_angles_and_frames_repeat(exact: SimulatorBackend) -> None:
    target = away(PASSIVE, 0.123456789)
    assert move(exact, PASSIVE, target).positions == target
    assert exact.robot(PASSIVE).read(TIMEOUT).positions == target
    camera = exact.camera("camera")
    first, second = camera.grab(0.0, TIMEOUT), camera.grab(0.0, TIMEOUT)
    np.testing.assert_array_equal(first.image, second.image)


# Noise


def test_the_same_seed_is_the_same_run_bit_for_bit_and_another_seed_is_not() -> None:
    def run(*overrides: str) -> tuple[list[Joints], bytes]:
        backend = next(runs := opened(cell(*overrides)))
        move(backend, ACTIVE, away(ACTIVE, 0.2))
        result = readings(backend), backend.camera("camera").grab(0.0, TIMEOUT).image.tobytes()
        runs.close()
        backend.close()
        return result

    assert run() == run()
    assert run()[0] != run("simulation.seed=2")[0]
    assert run()[1] != run("simulation.seed=2")[1]


def test_a_resumed_run_reads_what_an_uninterrupted_one_reads() -> None:
    uninterrupted, resumed = SimulatorBackend("sim", cell()), SimulatorBackend("sim", cell())
    uninterrupted.open(TIMEOUT)
    for offset in (0.1, -0.2, 0.3):
        move(uninterrupted, ACTIVE, away(ACTIVE, offset))
        readings(uninterrupted)
        uninterrupted.camera("camera").grab(0.0, TIMEOUT)
    resumed.open(TIMEOUT)
    move(resumed, ACTIVE, away(ACTIVE, 0.3))
    move(uninterrupted, PASSIVE, away(PASSIVE, 0.1))
    move(resumed, PASSIVE, away(PASSIVE, 0.1))
    assert readings(resumed) == readings(uninterrupted)
    frames = [backend.camera("camera").grab(0.0, TIMEOUT).image for backend in (resumed, uninterrupted)]
    np.testing.assert_array_equal(*frames)
    uninterrupted.close()
    resumed.close()


def test_readings_at_one_target_differ_and_subscribed_states_do_not_shift_them(
    noisy: SimulatorBackend,
) -> None:
    move(noisy, ACTIVE, away(ACTIVE, 0.1))
    plain = readings(noisy)
    assert len(set(plain)) == len(plain)
    move(noisy, ACTIVE, away(ACTIVE, 0.0))
    unsubscribe = noisy.robot(ACTIVE).subscribe(lambda state: None)
    move(noisy, ACTIVE, away(ACTIVE, 0.1))
    noisy.clock.wait(NEVER, noisy.clock.now() + 1.0)
    unsubscribe()
    assert readings(noisy) == plain


def test_the_error_encoders_do_not_see_belongs_to_the_target() -> None:
    file = cell("simulation.noise.encoder_mrad=0")
    assert file.simulation is not None
    clock = VirtualClock()
    world = World(file.cell, file.simulation, clock)
    arm = world.arms[ACTIVE]

    def error_at(offset: float) -> Array:
        path = JointPath((away(ACTIVE, offset),), (1.0,) * 6, (1.0,) * 6)
        state = arm.follow(path).wait(TIMEOUT)
        return arm.true_positions(clock.now()) - state.positions

    errors = [error_at(0.01 * number) for number in range(200)]
    np.testing.assert_array_equal(error_at(0.05), errors[5])
    assert not np.any(errors[5] == errors[6])
    np.testing.assert_allclose(np.std(errors), 3e-5, rtol=0.1)
    np.testing.assert_allclose(np.mean(errors, axis=0), 0.0, atol=4 * 3e-5 / math.sqrt(200))


def test_that_error_changes_without_a_jump_along_a_motion_and_a_stop() -> None:
    file = cell("simulation.noise.joint_mrad=100")
    assert file.simulation is not None
    clock = VirtualClock()
    world = World(file.cell, file.simulation, clock)
    arm = world.arms[ACTIVE]
    arm.follow(JointPath((away(ACTIVE, 0.5),), (1.0,) * 6, (1.0,) * 6))
    true = []
    clock.call_at(0.5, lambda: arm.stop("test"))
    for step in range(200):
        clock.call_at(step * 0.005, lambda: true.append(arm.true_positions(clock.now())))
    clock.wait(NEVER, 1.0)
    assert len(true) == 200
    # At 1 rad/s and an error of 0.1 rad that comes within the braking time (0.07 s): below 5 rad/s.
    assert np.abs(np.diff(true, axis=0)).max() < 0.005 * 5


def test_noise_depends_on_every_part_of_its_key() -> None:
    keys = [
        (1, "a", 0.5),
        (2, "a", 0.5),
        (1, "b", 0.5),
        (1, "a", 0.25),
        (1, "a", 0.5, 0),
        (1, "a0", 5),
        (1.0, "a", 0.5),
    ]
    assert len({generator(*key).random() for key in keys}) == len(keys)
    assert generator(1, 0.0).random() == generator(1, -0.0).random()
    assert generator(2**80, "large seed").random() == generator(2**80, "large seed").random()


# Motion

ANGLE = st.floats(-2.0, 2.0)
BOUND = st.floats(0.1, 5.0)


@given(
    waypoints=st.lists(st.tuples(ANGLE, ANGLE, ANGLE), min_size=1, max_size=4),
    speed=st.tuples(BOUND, BOUND, BOUND),
    acceleration=st.tuples(BOUND, BOUND, BOUND),
)
def test_a_path_is_followed_straight_within_its_bounds_and_with_a_rest_at_each_waypoint(
    waypoints: list[Joints], speed: Joints, acceleration: Joints
) -> None:
    trajectory = Trajectory(np.zeros(3), np.array(acceleration))
    begin = 7.0
    trajectory.follow(JointPath(tuple(waypoints), speed, acceleration), begin)
    end = trajectory.end
    times = np.linspace(begin, end, 400)
    q, velocity = (np.array(values) for values in zip(*map(trajectory.sample, times), strict=True))
    step = (end - begin) / 399
    assert np.all(np.abs(velocity) <= np.array(speed) * (1 + 1e-9) + 1e-9)
    assert np.all(np.abs(np.diff(velocity, axis=0)) <= np.array(acceleration) * step * (1 + 1e-6) + 1e-9)
    assert np.all(np.abs(np.diff(q, axis=0)) <= np.array(speed) * step * (1 + 1e-6) + 1e-9)
    corners = np.array([(0.0, 0.0, 0.0), *waypoints])
    assert max(distance_to_polyline(point, corners) for point in q[::10]) < 1e-9
    assert tuple(trajectory.sample(end)[0]) == waypoints[-1] == trajectory.destination
    assert not trajectory.sample(end)[1].any()


def distance_to_polyline(point: Array, corners: Array) -> float:
    distances = []
    for a, b in pairwise(corners):
        length = (b - a) @ (b - a)
        share = np.clip((point - a) @ (b - a) / length, 0.0, 1.0) if length > 0 else 0.0
        distances.append(float(np.linalg.norm(point - a - share * (b - a))))
    return min(distances)


@pytest.mark.parametrize(
    ("way", "expected"),
    [(4.0, 2.0 / 1.0 + 4.0 / 2.0), (1.0, 2.0)],  # v / a + way / v; 2 sqrt(way / a)
)
def test_a_segment_takes_as_long_as_its_trapezoid_or_triangle(way: float, expected: float) -> None:
    trajectory = Trajectory(np.zeros(2), np.ones(2))
    trajectory.follow(JointPath(((way, -way / 3),), (2.0, 2.0), (1.0, 1.0)), 0.0)
    assert trajectory.end == pytest.approx(expected)


def test_a_path_faster_than_the_arm_is_refused_and_the_arms_own_speed_is_kept(exact: SimulatorBackend) -> None:
    config = exact.cell.cell.robots[ACTIVE]
    speed, acceleration = tuple(config.speed), tuple(config.acceleration)
    for hurried in ((tuple(2 * config.speed), acceleration), (speed, tuple(2 * config.acceleration))):
        with pytest.raises(CommandRefused, match="beyond the arm's own"):
            exact.robot(ACTIVE).start(JointPath((away(ACTIVE, 0.8),), *hurried))
    began = exact.clock.now()
    exact.robot(ACTIVE).start(JointPath((away(ACTIVE, 0.8),), speed, acceleration)).wait(TIMEOUT)
    slowest = 0.8 / config.speed.min() + config.speed.min() / config.acceleration.min()
    assert exact.clock.now() - began == pytest.approx(slowest)


@given(when=st.floats(0.0, 3.0))
def test_a_stop_brakes_along_the_path_as_fast_as_the_arm_can(when: float) -> None:
    arm_acceleration = np.array([4.0, 2.0])
    trajectory = Trajectory(np.zeros(2), arm_acceleration)
    way = np.array([1.0, -0.5])
    trajectory.follow(JointPath((tuple(way),), (1.0, 1.0), (1.0, 1.0)), 0.0)
    _, velocity = trajectory.sample(when)
    trajectory.brake(when)
    assert trajectory.end - when == pytest.approx(np.max(np.abs(velocity) / arm_acceleration))
    rest, still = trajectory.sample(trajectory.end)
    assert not still.any()
    assert abs(rest[0] * way[1] - rest[1] * way[0]) < 1e-12
    assert 0.0 <= rest[0] <= 1.0 + 1e-12


def test_a_stop_in_the_middle_of_a_motion_ends_it_where_it_came_to_rest(exact: SimulatorBackend) -> None:
    robot, clock = exact.robot(ACTIVE), exact.clock
    home, target = np.array(away(ACTIVE, 0.0)), np.array(away(ACTIVE, 0.8))
    motion = start(exact, ACTIVE, tuple(target))
    clock.call_at(clock.now() + 0.3, lambda: robot.stop("enough"))
    with pytest.raises(MotionStopped, match="enough"):
        motion.wait(TIMEOUT)
    share = (np.array(robot.read(TIMEOUT).positions) - home) / (target - home)
    np.testing.assert_allclose(share, share[0])
    assert 0.2 < share[0] < 0.9
    move(exact, ACTIVE, tuple(target))


def test_stops_from_many_threads_during_a_motion_all_find_the_arm_standing(exact: SimulatorBackend) -> None:
    robot = exact.robot(ACTIVE)
    for _ in range(20):
        motion = start(exact, ACTIVE, away(ACTIVE, 0.5))
        confirmed: list[bool] = []
        together = threading.Barrier(4)

        def stop(done: list[bool] = confirmed, together: threading.Barrier = together) -> None:
            together.wait(TIMEOUT)
            done.append(robot.stop("test").confirmed)

        threads = [threading.Thread(target=stop) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()  # whoever waits for the motion before that may well bring it to its end first
        with pytest.raises(MotionStopped):
            motion.wait(TIMEOUT)
        assert confirmed == [True] * 4
        assert motion.state is MotionState.STOPPED
        move(exact, ACTIVE, away(ACTIVE, 0.0))


def test_after_opening_again_the_arms_are_at_home_and_time_has_gone_on(exact: SimulatorBackend) -> None:
    move(exact, ACTIVE, away(ACTIVE, 0.3))
    before = exact.clock.now()
    exact.close()
    exact.open(TIMEOUT)
    assert exact.robot(ACTIVE).read(TIMEOUT).positions == away(ACTIVE, 0.0)
    assert exact.clock.now() == before > 0.0


@pytest.mark.parametrize("stepper", ["kinematic", "bullet"])
def test_in_a_world_that_another_thread_has_closed_no_motion_begins(stepper: str) -> None:
    file = cell(f"simulation.stepper={stepper}")
    assert file.simulation is not None
    world = World(file.cell, file.simulation, VirtualClock())
    arm = world.arms[ACTIVE]
    world.close()
    with pytest.raises(NotOpen, match="left: move: it was closed meanwhile"):
        arm.follow(JointPath((away(ACTIVE, 0.1),), (1.0,) * 6, (1.0,) * 6))
    assert arm.target == away(ACTIVE, 0.0)


# States and frames


def test_subscribed_states_come_at_20_hz_of_simulated_time(noisy: SimulatorBackend) -> None:
    states: list[RobotState] = []
    noisy.robot(ACTIVE).subscribe(states.append)
    noisy.clock.wait(NEVER, 1.001)
    np.testing.assert_allclose([state.time for state in states], 0.05 * np.arange(1, 21))


def test_a_failing_subscriber_is_told_to_who_makes_time_once_and_others_go_on(noisy: SimulatorBackend) -> None:
    heard: list[RobotState] = []
    noisy.robot(ACTIVE).subscribe(lambda state: heard[99])  # type: ignore[arg-type, return-value]
    noisy.robot(ACTIVE).subscribe(heard.append)
    motion = start(noisy, ACTIVE, away(ACTIVE, 0.3))
    with pytest.raises(DeviceError, match="subscriber failed") as caught:
        motion.wait(TIMEOUT)
    assert isinstance(caught.value.__cause__, IndexError)
    motion.wait(TIMEOUT)
    assert len(heard) > 5


def test_a_frame_shows_the_board_where_it_was_at_the_exposure(exact: SimulatorBackend) -> None:
    camera, clock = exact.camera("camera"), exact.clock
    standing = camera.grab(0.0, TIMEOUT)
    # The motion starts right after the exposure and before the frame is there.
    clock.call_at(clock.now() + LATENCY / 2, lambda: start(exact, PASSIVE, away(PASSIVE, 0.2)) and None)
    exposed_before = camera.grab(0.0, TIMEOUT)
    np.testing.assert_array_equal(exposed_before.image, standing.image)
    assert clock.now() - exposed_before.time == pytest.approx(LATENCY)


def test_image_noise_has_the_stated_sigma_and_is_new_in_each_frame() -> None:
    backend = next(runs := opened(cell("simulation.noise.image_grey=3")))
    camera = backend.camera("camera")
    first, second = (camera.grab(0.0, TIMEOUT).image.astype(float) for _ in range(2))
    runs.close()
    backend.close()
    assert (first - second).std() / math.sqrt(2) == pytest.approx(math.hypot(3.0, math.sqrt(1 / 12)), rel=0.01)


# Going on in another process


ERRORS = (
    "simulation.errors={kinematics: {angle_deg: 0.02}, backlash: {gap_mrad: 0.5}, compliance: {sag_mrad: 1}, "
    "base_drift: {translation_mm_per_hour: 100, rotation_deg_per_hour: 5}, "
    "thermal: {growth_ppm: 500, time_constant_min: 0.2}, mount_flex: {mrad_per_g: 0.5}, "
    "target_slip: {translation_mm: 1, at_s: 3}, settle_time: {amplitude_mrad: 1}, time_skew: {delay_s: 0.03}, "
    "motion_blur: {exposure_ms: 10}}"
)


def seen(backend: SimulatorBackend) -> list[Any]:
    """All that its devices tell, and where the target truly is in the camera, before, while and after an arm moves."""
    told: list[Any] = []
    for name, offset in ((PASSIVE, 0.05), (ACTIVE, -0.02), (PASSIVE, 0.04)):
        told += [backend.robot(arm).read(TIMEOUT) for arm in (ACTIVE, PASSIVE)]
        told += [backend.clock.now(), backend._opened_world("test", "look").T_E_T(backend.clock.now()).tolist()]
        frame = backend.camera("camera").grab(backend.clock.now(), TIMEOUT)
        told += [frame.time, frame.sequence, frame.image.tobytes()]
        told.append(move(backend, name, away(name, offset)))
    return told


def left_after_some_time(backend: SimulatorBackend) -> dict[str, Any]:
    """What it needs to go on, after it has been in a file."""
    for name, offset in ((ACTIVE, 0.1), (PASSIVE, 0.2), (PASSIVE, 0.1)):
        move(backend, name, away(name, offset))
        readings(backend)
        backend.camera("camera").grab(backend.clock.now(), TIMEOUT)
    state: dict[str, Any] = json.loads(json.dumps(backend.left()))
    return state


@pytest.mark.parametrize("overrides", [(), (ERRORS,)], ids=["noise", "errors"])
def test_another_simulator_goes_on_to_the_last_bit_from_where_one_was_left(overrides: tuple[str, ...]) -> None:
    first, second = (SimulatorBackend("sim", cell(*overrides)) for _ in range(2))
    first.open(TIMEOUT)
    state = left_after_some_time(first)
    second.go_on_from(state)
    second.open(TIMEOUT)
    assert second.left() == first.left()
    assert seen(second) == seen(first)
    for backend in (first, second):
        backend.close()


def test_what_is_left_holds_nothing_of_the_truth(noisy: SimulatorBackend) -> None:
    state = left_after_some_time(noisy)
    assert set(state) == {"clock_s", "arms", "samples", "frames"}
    told = {"target_rad", "joints_rad", "slack_rad", "way", "rested_s", "sequence"}
    assert all(set(arm) == told for arm in state["arms"].values())
    assert state["arms"][PASSIVE]["joints_rad"] == list(away(PASSIVE, 0.1))  # not where the links truly are


def test_its_time_goes_on_before_it_is_opened(noisy: SimulatorBackend) -> None:
    state = left_after_some_time(noisy)
    backend = SimulatorBackend("sim", cell())
    backend.go_on_from(state)
    assert backend.clock.now() == state["clock_s"] == noisy.clock.now()


def test_one_whose_time_is_later_already_does_not_go_back(noisy: SimulatorBackend) -> None:
    state = left_after_some_time(noisy)
    move(noisy, PASSIVE, away(PASSIVE, 0.0))
    with pytest.raises(UsageError, match="its time has begun already"):
        noisy.go_on_from(state)
