"""What every backend promises."""

from __future__ import annotations

import dataclasses
import inspect
import math
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualcal_hal.errors import (
    CommandRefused,
    DeviceTimeout,
    DualcalError,
    MotionStopped,
    NotOpen,
    UnknownDevice,
)
from dualcal_hal.robot import Mode, MotionState, RobotState
from tests.contract.rigs import FACTORY_RIGS, RIGS, Rig, factory, factory_cell, recorded, replayed
from tools.cli.emulator import emulator

IN_EVERY_RUN = ("controller, rep", "controller, can")
FACTORIES = [name if name in IN_EVERY_RUN else pytest.param(name, marks=pytest.mark.slow) for name in FACTORY_RIGS]


@pytest.fixture(scope="module")
def emulators(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Mapping[str, Any]]]:
    """Where the emulator of a rig serves it; each is started once."""
    with ExitStack() as running:

        @cache
        def start(rig: str) -> Mapping[str, Any]:
            path = tmp_path_factory.mktemp("emulated") / "cell.yaml"
            path.write_text(factory_cell(rig).text)
            return running.enter_context(emulator(path))

        yield start


@pytest.fixture(params=[*RIGS, "replay", *FACTORIES])
def closed_rig(
    request: pytest.FixtureRequest, tmp_path: Path, emulators: Callable[[str], Mapping[str, Any]]
) -> Iterator[Rig]:
    if request.param == "replay":
        record(request, tmp_path)
        rig = replayed(tmp_path)
    elif request.param in FACTORY_RIGS:
        rig = factory(request.param, emulators(request.param))
    else:
        rig = RIGS[request.param]()
    yield rig
    rig.backend.close()
    rig.broken.close()


@pytest.fixture
def rig(closed_rig: Rig) -> Rig:
    closed_rig.backend.open(closed_rig.timeout)
    return closed_rig


def record(request: pytest.FixtureRequest, session: Path) -> None:
    """Run the clause itself on the simulator, and record that."""
    rig, recording = recorded(session)
    with recording:
        names = inspect.signature(request.function).parameters
        given = {**request.node.callspec.params, "closed_rig": rig, "rig": rig}
        if "rig" in names:
            rig.backend.open(rig.timeout)
        try:
            request.function(**{name: given[name] for name in names})
        finally:
            rig.backend.close()
            rig.broken.close()


def use_of_every_device(rig: Rig) -> list[Callable[[], object]]:
    robot, camera = rig.robot, rig.camera
    return [
        lambda: robot.read(rig.timeout),
        lambda: robot.start(rig.path(0.1)),
        lambda: robot.stop("test"),
        lambda: robot.subscribe(lambda state: None),
        lambda: robot.enable(rig.timeout),
        lambda: robot.disable(rig.timeout),
        lambda: robot.reset_fault(rig.timeout),
        lambda: camera.grab(0.0, rig.timeout),
    ]


def call_in_thread(function: Callable[[], object]) -> object:
    results: list[object] = []
    thread = threading.Thread(target=lambda: results.append(function()))
    thread.start()
    thread.join()
    return results[0]


# Opening and closing


def test_opening_an_open_backend_is_an_error_and_leaves_it_open(rig: Rig) -> None:
    with pytest.raises(DualcalError):
        rig.backend.open(rig.timeout)
    rig.robot.read(rig.timeout)


def test_a_backend_may_be_closed_twice_and_without_having_been_open(closed_rig: Rig) -> None:
    closed_rig.backend.close()
    closed_rig.backend.open(closed_rig.timeout)
    closed_rig.backend.close()
    closed_rig.backend.close()


def test_a_backend_whose_opening_failed_is_not_open_and_may_be_closed(closed_rig: Rig) -> None:
    with pytest.raises(DualcalError):
        closed_rig.broken.open(closed_rig.timeout)
    with pytest.raises(NotOpen):
        closed_rig.broken.robot(closed_rig.robot_name).read(closed_rig.timeout)
    closed_rig.broken.close()


def test_a_closed_backend_opens_again(rig: Rig) -> None:
    rig.backend.close()
    rig.backend.open(rig.timeout)
    assert rig.robot.read(rig.timeout).mode is Mode.READY


@pytest.mark.parametrize("opened_before", [False, True])
def test_no_device_can_be_used_while_its_backend_is_not_open(closed_rig: Rig, opened_before: bool) -> None:
    if opened_before:
        closed_rig.backend.open(closed_rig.timeout)
        closed_rig.backend.close()
    for use in use_of_every_device(closed_rig):
        with pytest.raises(NotOpen):
            use()


def test_unknown_devices_are_refused_by_name(closed_rig: Rig) -> None:
    with pytest.raises(UnknownDevice, match="third"):
        closed_rig.backend.robot("third")
    with pytest.raises(UnknownDevice, match="third"):
        closed_rig.backend.camera("third")


def test_closing_ends_a_motion_as_stopped(rig: Rig) -> None:
    motion = rig.robot.start(rig.path(0.5))
    rig.backend.close()
    assert motion.state is MotionState.STOPPED
    with pytest.raises(MotionStopped):
        motion.wait(rig.timeout)


def test_no_thread_is_left_behind(closed_rig: Rig) -> None:
    before = set(threading.enumerate())
    closed_rig.backend.open(closed_rig.timeout)
    closed_rig.robot.subscribe(lambda state: None)
    closed_rig.robot.start(closed_rig.path(0.1)).wait(closed_rig.timeout)
    closed_rig.camera.grab(0.0, closed_rig.timeout)
    closed_rig.backend.close()
    assert set(threading.enumerate()) == before


# Motion


def test_a_motion_settles_at_its_last_waypoint(rig: Rig) -> None:
    motion = rig.robot.start(rig.path(0.1, -0.1, 0.05))
    assert motion.state is MotionState.RUNNING
    final = motion.wait(rig.timeout)
    assert motion.state is MotionState.SETTLED
    np.testing.assert_allclose(final.positions, rig.target(0.05), atol=rig.repeatability)
    np.testing.assert_array_equal(final.velocities, 0.0)


def test_the_same_target_is_the_same_pose(rig: Rig) -> None:
    readings = []
    for offset in (0.1, -0.1, 0.1):
        rig.robot.start(rig.path(offset)).wait(rig.timeout)
        readings.append(rig.robot.read(rig.timeout).positions)
    np.testing.assert_allclose(readings[0], readings[2], atol=rig.repeatability)


def test_a_path_to_where_the_arm_stands_settles(rig: Rig) -> None:
    rig.robot.start(rig.path(0.1)).wait(rig.timeout)
    rig.robot.start(rig.path(0.1)).wait(rig.timeout)


def test_waiting_too_short_for_a_motion_is_a_timeout_and_the_motion_goes_on(rig: Rig) -> None:
    motion = rig.robot.start(rig.path(0.5))
    with pytest.raises(DeviceTimeout):
        motion.wait(0.01)
    motion.wait(rig.timeout)


def test_a_moving_arm_refuses_another_path(rig: Rig) -> None:
    motion = rig.robot.start(rig.path(0.5))
    with pytest.raises(CommandRefused):
        rig.robot.start(rig.path(0.1))
    motion.wait(rig.timeout)


def test_paths_that_cannot_be_followed_are_refused_and_the_arm_stays(rig: Rig) -> None:
    good = rig.path(0.1)
    n = rig.robot.joints
    outside = tuple(rig.config.upper + 0.01)
    bad = [
        {"waypoints": ()},
        {"waypoints": ((0.0,) * (n + 1),)},
        {"waypoints": (good.waypoints[0], outside)},
        {"waypoints": ((math.nan, *good.waypoints[0][1:]),)},
        {"waypoints": ((math.inf, *good.waypoints[0][1:]),)},
        {"speed": good.speed[1:]},
        {"speed": (0.0,) * n},
        {"acceleration": (math.nan,) * n},
        {"acceleration": (-1.0,) * n},
    ]
    before = rig.robot.read(rig.timeout)
    for change in bad:
        with pytest.raises(CommandRefused):
            rig.robot.start(dataclasses.replace(good, **change))
    after = rig.robot.read(rig.timeout)
    np.testing.assert_allclose(after.positions, before.positions, atol=rig.repeatability)
    assert not any(after.velocities)


def test_a_disabled_arm_refuses_to_move_until_it_is_enabled(rig: Rig) -> None:
    if not rig.switches:
        for switch in (rig.robot.disable, rig.robot.enable, rig.robot.reset_fault):
            with pytest.raises(CommandRefused, match="at the pendant"):
                switch(rig.timeout)
        return
    rig.robot.disable(rig.timeout)
    assert rig.robot.read(rig.timeout).mode is not Mode.READY
    with pytest.raises(CommandRefused):
        rig.robot.start(rig.path(0.1))
    rig.robot.reset_fault(rig.timeout)
    rig.robot.enable(rig.timeout)
    rig.robot.start(rig.path(0.1)).wait(rig.timeout)


# Stopping


def test_a_stopped_motion_is_no_success(rig: Rig) -> None:
    motion = rig.robot.start(rig.path(0.5))
    assert rig.robot.stop("test").confirmed
    assert motion.state is MotionState.STOPPED
    with pytest.raises(MotionStopped, match="test"):
        motion.wait(rig.timeout)
    assert not any(rig.robot.read(rig.timeout).velocities)


def test_an_arm_is_stopped_from_another_thread(rig: Rig) -> None:
    motion = rig.robot.start(rig.path(0.5))
    result = call_in_thread(lambda: rig.robot.stop("from another thread"))
    assert result.confirmed  # type: ignore[attr-defined]
    with pytest.raises(MotionStopped, match="another thread"):
        motion.wait(rig.timeout)


def test_stopping_again_and_stopping_a_standing_arm_are_confirmed(rig: Rig) -> None:
    assert rig.robot.stop("standing").confirmed
    rig.robot.start(rig.path(0.5))
    assert rig.robot.stop("once").confirmed
    assert rig.robot.stop("twice").confirmed


def test_a_stopped_arm_moves_again(rig: Rig) -> None:
    rig.robot.start(rig.path(0.5))
    rig.robot.stop("test")
    rig.robot.start(rig.path(0.0)).wait(rig.timeout)


def test_listeners_hear_of_the_end_of_a_motion_once(rig: Rig) -> None:
    ends: list[str] = []
    motion = rig.robot.start(rig.path(0.1))
    motion.on_end(lambda: ends.append("before"))
    motion.wait(rig.timeout)
    motion.on_end(lambda: ends.append("after"))
    assert ends == ["before", "after"]


# States


def test_states_are_of_the_clock_and_their_sequence_grows(rig: Rig) -> None:
    before = rig.backend.clock.now()
    states = [rig.robot.read(rig.timeout)]
    states.append(rig.robot.start(rig.path(0.1)).wait(rig.timeout))
    states.append(rig.robot.read(rig.timeout))
    assert before <= states[0].time <= states[1].time <= states[2].time <= rig.backend.clock.now()
    assert states[0].sequence < states[1].sequence < states[2].sequence
    assert all(len(state.positions) == len(state.velocities) == rig.robot.joints for state in states)


def test_a_subscriber_gets_growing_states_until_it_unsubscribes(rig: Rig) -> None:
    states: list[RobotState] = []
    unsubscribe = rig.robot.subscribe(states.append)
    rig.robot.start(rig.path(0.3)).wait(rig.timeout)
    unsubscribe()
    unsubscribe()
    ended = rig.backend.clock.now()
    assert len(states) > 3
    assert all(a.sequence < b.sequence and a.time <= b.time for a, b in pairwise(states))
    assert any(any(state.velocities) for state in states)
    rig.robot.start(rig.path(0.0)).wait(rig.timeout)
    assert max(state.time for state in states) <= ended  # one that was on its way then may have come


# Frames


def test_a_frame_is_exposed_no_earlier_than_asked_and_its_sequence_grows(rig: Rig) -> None:
    clock = rig.backend.clock
    frames = []
    for wait in (0.0, 0.2, 0.0):
        not_before = clock.now() + wait
        frames.append(rig.camera.grab(not_before, rig.timeout))
        assert not_before <= frames[-1].time <= clock.now()
    assert frames[0].sequence < frames[1].sequence < frames[2].sequence


def test_a_frame_is_grey_whole_and_read_only(rig: Rig) -> None:
    image = rig.camera.grab(0.0, rig.timeout).image
    width, height = rig.backend.cell.cell.camera.intrinsics.size
    assert image.shape == (height, width)
    assert image.dtype == np.uint8
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0] = 0


def test_a_frame_that_cannot_come_in_time_is_a_timeout(rig: Rig) -> None:
    with pytest.raises(DeviceTimeout):
        rig.camera.grab(rig.backend.clock.now() + 1.0, 0.1)


@pytest.mark.parametrize("not_before", [math.nan, math.inf])
def test_a_time_that_is_none_is_refused(rig: Rig, not_before: float) -> None:
    with pytest.raises(CommandRefused):
        rig.camera.grab(not_before, rig.timeout)
