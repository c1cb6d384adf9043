"""The guard: nothing unsafe is sent, and no configuration takes it away."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from dualcal_hal.cell import Cell
from dualcal_hal.clock import VirtualClock
from dualcal_hal.errors import CommandRefused
from dualcal_hal.geometry import BETWEEN_SAMPLES, LARGEST_MOTION, CellGeometry, Placement
from dualcal_hal.guard import PLANNERS_SHARE, CellGuard, GuardedRobot
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Mode, Motion, Robot, RobotState, StopResult
from tests.cells import paper_cell


class Recording(Robot):
    """A robot that reports what it is told to report and remembers what was sent."""

    def __init__(self, clock: VirtualClock, positions=(0.0, 0.0)):
        self.name, self.clock, self.positions = "arm", clock, positions
        self.mode, self.faults, self.age, self.sent = Mode.READY, (), 0.0, []

    @property
    def joints(self):
        return len(self.positions)

    def read(self, timeout):
        rest = (0.0,) * self.joints
        return RobotState(self.positions, rest, self.mode, self.faults, self.clock.now() - self.age, 1)

    def start(self, path):
        self.sent.append(path)
        return Motion(self.name, self.clock)

    def stop(self, reason):
        return StopResult(True, reason)

    def subscribe(self, function):
        return lambda: None

    def enable(self, timeout):
        self.mode = Mode.READY

    def disable(self, timeout):
        self.mode = Mode.DISABLED

    def reset_fault(self, timeout):
        self.faults = ()


LIMITS = JointLimits(np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.array([1.0, 1.0]), np.array([5.0, 5.0]))


@pytest.fixture
def device():
    return Recording(VirtualClock())


@pytest.fixture
def guarded(device):
    robot = GuardedRobot(device, LIMITS, device.clock)
    robot.admit(lambda start, path: None, threading.Lock())
    return robot


def path(*waypoints, speed=(1.0, 1.0), acceleration=(5.0, 5.0)):
    return JointPath(waypoints, speed, acceleration)


def test_a_path_within_everything_is_sent_as_it_is(device, guarded):
    wanted = path((0.5, -1.5), (1.0, 2.0))
    guarded.start(wanted)
    assert device.sent == [wanted]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (path((1.1, 0.0)), r"joint 1 would be 5\.730 deg beyond its limit"),
        (path((0.0, 0.0), (0.0, -2.5)), "joint 2 would be .* beyond"),
        (path((float("nan"), 0.0)), "finite"),
        (path((float("inf"), 0.0)), "finite"),
        (path((0.0,)), "2 finite numbers"),
        (path((0.0, 0.0, 0.0)), "2 finite numbers"),
        (path(), "empty"),
        (path((0.1, 0.1), speed=(1.2, 1.0)), "speed"),
        (path((0.1, 0.1), speed=(0.0, 1.0)), "speed"),
        (path((0.1, 0.1), speed=(float("nan"), 1.0)), "speed"),
        (path((0.1, 0.1), acceleration=(9.0, 5.0)), "acceleration"),
        (path((0.1, 0.1), acceleration=(float("nan"), 5.0)), "acceleration"),
        (path((0.1, 0.1), acceleration=(5.0,)), "acceleration"),
    ],
)
def test_values_that_must_not_be_sent_are_refused_and_nothing_is_sent(device, guarded, wrong, words):
    with pytest.raises(CommandRefused, match=words):
        guarded.start(wrong)
    assert device.sent == []


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode is not Mode.READY])
def test_an_arm_in_any_mode_but_ready_is_not_moved(device, guarded, mode):
    device.mode = mode
    with pytest.raises(CommandRefused, match=f"not ready.*{mode}"):
        guarded.start(path((0.1, 0.1)))
    assert device.sent == []


def test_an_arm_with_a_fault_is_not_moved(device, guarded):
    device.faults = ("overcurrent in joint 2",)
    with pytest.raises(CommandRefused, match="overcurrent in joint 2"):
        guarded.start(path((0.1, 0.1)))


def test_an_arm_whose_state_is_old_is_not_moved(device, guarded):
    device.age = 0.2
    with pytest.raises(CommandRefused, match=r"state is 0\.20 s old"):
        guarded.start(path((0.1, 0.1)))
    assert device.sent == []


def test_an_arm_whose_state_is_from_the_future_or_of_no_time_is_not_moved(device, guarded):
    for age in (-1.0, float("nan")):
        device.age = age
        with pytest.raises(CommandRefused, match="s old"):
            guarded.start(path((0.1, 0.1)))
    assert device.sent == []


@pytest.mark.parametrize("positions", [(float("nan"), 0.0), (0.0, float("inf"))])
def test_an_arm_that_reports_no_numbers_is_not_moved(device, guarded, positions):
    device.positions = positions
    with pytest.raises(CommandRefused, match="positions are not 2 finite numbers"):
        guarded.start(path((0.1, 0.1)))
    assert device.sent == []


def test_before_the_cell_is_put_together_nothing_moves(device):
    with pytest.raises(CommandRefused, match="not open"):
        GuardedRobot(device, LIMITS, device.clock).start(path((0.1, 0.1)))


def test_the_whole_path_is_judged_from_where_the_arm_stands(device):
    judged = []
    robot = GuardedRobot(device, LIMITS, device.clock)
    robot.admit(lambda start, way: judged.append([start.positions, *way.waypoints]), threading.Lock())
    device.positions = (0.4, 0.4)
    robot.start(path((0.8, -0.4), (0.0, 0.0)))
    np.testing.assert_array_equal(judged, [[(0.4, 0.4), (0.8, -0.4), (0.0, 0.0)]])


CONFIG = paper_cell().cell
GEOMETRY = CellGeometry.of(CONFIG)
NOMINAL = CONFIG.nominal.T_P_A


@pytest.fixture
def open_cell():
    """The cell as it is opened: the bases may be 120 mm and 12 degrees off."""
    with Cell(paper_cell()) as opened:
        yield opened


@pytest.fixture
def cell(open_cell):
    """The cell with its bases known to stand as in the cell file."""
    open_cell.guard.place(Placement(NOMINAL), GEOMETRY)
    return open_cell


REACHING = (0.0, -1.2, 0.8, 0.0, 0.0, 0.0)


def full_speed(arm, *waypoints):
    return JointPath(waypoints, tuple(arm.limits.speed), tuple(arm.limits.acceleration))


def go(arm, *waypoints):
    arm.robot.start(full_speed(arm, *waypoints)).wait(20)


def placed_arms(q_a, q_p, placement):
    """A guard's two arms standing at joint angles, their devices to look at, the bases believed to stand as told."""
    clock = VirtualClock()
    devices, robots = [], []
    for config, q in ((CONFIG.active, q_a), (CONFIG.passive, q_p)):
        limits = JointLimits.of(config)
        devices.append(Recording(clock, tuple(map(float, q))))
        robots.append(GuardedRobot(devices[-1], limits, clock))
    guard = CellGuard(*robots, GEOMETRY, placement, CONFIG.procedure.clearance)
    return robots, devices, guard


def move(robot, config, *waypoints):
    robot.start(JointPath(tuple(tuple(map(float, q)) for q in waypoints), tuple(config.speed), tuple(config.speed)))


def test_an_arm_is_not_sent_into_the_other(cell):
    go(cell.active, REACHING)
    with pytest.raises(CommandRefused, match="mm of the other arm"):
        cell.passive.robot.start(full_speed(cell.passive, REACHING))


def test_where_the_other_arm_stands_follows_from_the_transforms_believed_now(cell):
    go(cell.active, REACHING)
    far = NOMINAL.copy()
    far[0, 3] += 1.0
    cell.guard.place(Placement(far), GEOMETRY)
    go(cell.passive, REACHING)


def test_as_long_as_the_bases_are_uncertain_the_arms_keep_clear_for_every_error(open_cell):
    go(open_cell.active, REACHING)
    halfway = (0.0, -0.5, 0.8, 0.0, 0.0, 0.0)
    assert GEOMETRY.between([REACHING], [halfway], Placement(NOMINAL))[0] > 0.1
    with pytest.raises(CommandRefused, match=r"may come within .* mm of the other arm"):
        open_cell.passive.robot.start(full_speed(open_cell.passive, halfway))
    open_cell.guard.place(Placement(NOMINAL, 0.015, np.deg2rad(0.6)), GEOMETRY)
    go(open_cell.passive, halfway)


def test_one_arm_moves_at_a_time(cell):
    motion = cell.active.robot.start(full_speed(cell.active, REACHING))
    home = tuple(cell.passive.home)
    with pytest.raises(CommandRefused, match="this one is moving"):
        cell.passive.robot.start(full_speed(cell.passive, (home[0] + 0.1, *home[1:])))
    motion.wait(20)
    go(cell.passive, (home[0] + 0.1, *home[1:]))


def test_an_arm_near_its_own_limit_of_clearance_gets_no_nearer_to_the_other(cell, monkeypatch):
    geometry = cell.guard._geometry
    monkeypatch.setattr(geometry.active, "own_clearance", lambda q: np.full(len(q), 0.002))
    closing_in = lambda self, q_a, q_p, T: np.linspace(0.3, 0.005, len(np.atleast_2d(q_a)))  # noqa: E731
    monkeypatch.setattr(type(geometry), "between", closing_in)
    with pytest.raises(CommandRefused, match="of the other arm"):
        cell.active.robot.start(full_speed(cell.active, REACHING))


def test_clearance_that_is_no_number_is_refused(cell, monkeypatch):
    monkeypatch.setattr(type(cell.guard._geometry), "between", lambda self, q_a, q_p, T: np.array([np.nan]))
    with pytest.raises(CommandRefused, match="nan mm"):
        cell.active.robot.start(full_speed(cell.active, REACHING))


def test_an_arm_is_not_sent_into_the_floor(cell):
    with pytest.raises(CommandRefused, match="floor"):
        cell.active.robot.start(full_speed(cell.active, (0.0, -1.9, 0.0, 0.0, 0.5, 0.0)))


def test_an_arm_is_not_sent_into_a_fixture():
    post = "fixtures={post: {in: active_base, cylinder_mm: {radius: 50, length: 1500}, at: AT}}".replace(
        "AT", "{translation_mm: [200, 200, 750], rotation_vector_deg: [0, 0, 0]}"
    )
    with Cell(paper_cell(post)) as cell:
        home = np.array(cell.active.home)
        aside = (np.deg2rad(90), *home[1:])
        with pytest.raises(CommandRefused, match="a fixture"):
            cell.active.robot.start(full_speed(cell.active, aside))
    with Cell(paper_cell()) as cell:
        go(cell.active, aside)


def test_the_guard_insists_on_a_part_of_the_planners_clearance():
    assert 0 < PLANNERS_SHARE < 1
    q_a = (0.0, -0.75, 0.2, 0.0, 0.6, 0.0)
    allowed, refused = [], []
    for bend in np.linspace(0.0, -1.2, 120):
        goal = (0.0, float(bend), 0.2, 0.0, 0.6, 0.0)
        (_, passive), _, _ = placed_arms(q_a, (0.0, 0.0, 0.2, 0.0, 0.6, 0.0), Placement(NOMINAL))
        clearance = float(GEOMETRY.between([q_a], [goal], Placement(NOMINAL))[0])
        try:
            move(passive, CONFIG.passive, goal)
            allowed.append(clearance)
        except CommandRefused:
            refused.append(clearance)
    least = CONFIG.procedure.clearance * PLANNERS_SHARE + BETWEEN_SAMPLES
    assert max(refused) < least <= min(allowed)
    assert min(allowed) < least + 5e-3


def test_what_keeps_the_planners_clearance_is_never_refused():
    rng = np.random.default_rng(2)
    judged = 0
    for _ in range(150):
        q_a, q_p, goal = rng.uniform(-1.2, 1.2, (3, 6))
        placement = Placement(NOMINAL, rng.uniform(0, 0.12), rng.uniform(0, 0.2))
        path = GEOMETRY.active.sampled([q_a, goal], LARGEST_MOTION / 2)
        if GEOMETRY.clearance(path, [q_p], placement).min() < CONFIG.procedure.clearance + BETWEEN_SAMPLES / 2:
            continue
        (active, _), (device, _), _ = placed_arms(q_a, q_p, placement)
        move(active, CONFIG.active, goal)
        assert len(device.sent) == 1
        judged += 1
    assert judged > 10


def standing_close(least, most):
    """A bend of the passive arm, opposite the reaching active one, at which the exact distance is in this range (m)."""
    for bend in np.linspace(-0.3, -1.2, 900):
        close = (0.0, float(bend), 0.8, 0.0, 0.0, 0.0)
        if least < GEOMETRY.between([REACHING], [close], Placement(NOMINAL))[0] < most:
            return float(bend)
    raise AssertionError("no such posture")


def bent(bend):
    return (0.0, bend, 0.8, 0.0, 0.0, 0.0)


def test_an_arm_that_stands_too_close_may_move_away_but_no_closer():
    bend = standing_close(0.007, 0.010)
    (_, passive), (_, device), _ = placed_arms(REACHING, bent(bend), Placement(NOMINAL))
    with pytest.raises(CommandRefused, match="leads closer"):
        move(passive, CONFIG.passive, bent(bend - 0.05))
    move(passive, CONFIG.passive, bent(bend + 0.2))
    assert len(device.sent) == 1


def test_an_arm_that_stands_too_close_may_not_come_back_on_its_way():
    bend = standing_close(0.007, 0.010)
    (_, passive), (_, device), _ = placed_arms(REACHING, bent(bend), Placement(NOMINAL))
    with pytest.raises(CommandRefused, match="leads closer"):
        move(passive, CONFIG.passive, bent(bend + 0.2), bent(bend + 0.001))
    assert device.sent == []


def test_an_arm_that_may_be_touching_the_other_for_an_error_of_the_bases_is_jogged_by_hand():
    bend = -0.5
    placement = Placement(NOMINAL, 0.12, np.deg2rad(12))
    assert GEOMETRY.between([REACHING], [bent(bend)], Placement(NOMINAL))[0] > 0.05
    assert GEOMETRY.between([REACHING], [bent(bend)], placement)[0] < 0
    (_, passive), (_, device), _ = placed_arms(REACHING, bent(bend), placement)
    with pytest.raises(CommandRefused, match="jog"):
        move(passive, CONFIG.passive, bent(-0.3))
    assert device.sent == []


def test_an_arm_that_somebody_moved_since_its_last_motion_is_not_moved_from_there(guarded, device):
    guarded.start(path((0.2, 0.0))).settle(device.read(1.0))
    device.positions = (device.positions[0] + 0.1, device.positions[1])
    with pytest.raises(CommandRefused, match=r"stands 5\.73 deg from where its last motion has ended"):
        guarded.start(path((0.3, 0.0)))


def test_a_turn_that_no_arm_needs_is_refused(device):
    wide = JointLimits(np.full(2, -20.0), np.full(2, 20.0), LIMITS.speed, LIMITS.acceleration)
    robot = GuardedRobot(device, wide, device.clock)
    robot.admit(lambda start, path: None, threading.Lock())
    with pytest.raises(CommandRefused, match="joint 2 would turn by 745 deg in one step"):
        robot.start(path((0.0, 13.0)))
