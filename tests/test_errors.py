"""What each error of a real cell does to the simulated one and to the mismatch, held against METHOD's figures.

Those are of an all-corner fit on poses of their own: what is compared is within a factor of two, as medians over a few
draws where the error is drawn.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import astuple
from functools import partial

import numpy as np
import pytest

from backends.simulator.mechanics import Approach, Weight
from backends.simulator.truth import Truth
from backends.simulator.world import World
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import load_cell
from dualcal_hal.clock import VirtualClock
from dualcal_hal.config.errors import ErrorsConfig
from dualcal_hal.config.simulation import NoiseConfig
from dualcal_hal.errors import CellFileError
from dualcal_hal.guard import STANDSTILL
from dualcal_hal.kinematics import Chain, Row, random_joints
from dualcal_hal.robot import JointPath, RobotState
from dualcal_hal.session.captures import Captures, read_captures
from dualcal_hal.transforms import Array, inverse, rotation_angle
from procedures.analysis import analyse
from tests.cells import PAPER
from tests.cells import paper_cell as paper_cell_file
from tests.seen_captures import seen
from tools.benchmarks.captures import simulated_captures
from tools.benchmarks.errors import POSES, Errors, Figures, figures, fit_to_all_corners, joint_zero, paper_cell

TINY = PAPER.with_name("tiny.yaml")
SEEDS = (1, 2, 3)
ACTIVE, PASSIVE = "left", "right"
Q_ACTIVE = np.array([0.3, 0.4, -0.5, 0.6, 0.7, -0.8])
Q_PASSIVE = np.array([-0.2, 0.5, -0.6, 0.4, -0.7, 0.9])
STILL = Approach.at_rest(6)
GONE_UP = Approach(np.zeros(6), np.array([1.0, 0.5, 0, 0, 0, -1.0]), 10.0)


def drawn(errors: Errors) -> Figures:
    """The medians over several draws."""
    return Figures(*np.median([astuple(figures(errors, seed)) for seed in SEEDS], axis=0))


def captured(errors: Errors) -> Captures:
    return simulated_captures(*paper_cell(errors), read_captures(POSES))


def truth(errors: Errors, seed: int = 1) -> Truth:
    return Truth(*paper_cell(errors, seed))


def links(truth: Truth, arm: str, read: Array, approach: Approach = STILL, when: float = 0.0) -> Array:
    return truth.link_angles(arm, read, approach, when)


def within_a_factor_of_two(found: float, expected: float) -> bool:
    return expected / 2 <= found <= expected * 2


# None


def test_without_errors_nothing_is_wrong() -> None:
    assert ErrorsConfig() == paper_cell({})[1].errors
    assert figures({}).corners < 1e-4
    T_E_T = truth({}).T_E_T(Q_ACTIVE, Q_PASSIVE, 3600.0)
    np.testing.assert_array_equal(T_E_T, truth({}).T_E_T(Q_ACTIVE, Q_PASSIVE, 0.0))
    np.testing.assert_array_equal(links(truth({}), ACTIVE, Q_ACTIVE, GONE_UP, 10.01), Q_ACTIVE)


def test_what_is_drawn_belongs_to_the_seed() -> None:
    errors = {"kinematics": {"angle_deg": 0.02, "length_mm": 0.1}}
    assert truth(errors).chains == truth(errors).chains
    other = truth(errors, seed=2)
    assert truth(errors).chains[ACTIVE] != other.chains[ACTIVE]
    assert truth(errors).chains[ACTIVE] != truth({}).chains[ACTIVE]


# Arms


def test_each_denavit_hartenberg_parameter_is_wrong_by_a_normal_error_of_its_own() -> None:
    known, found = truth({}).chains, []
    for seed in range(1, 61):
        wrong = truth({"kinematics": {"angle_deg": 0.1, "length_mm": 0.5}}, seed).chains
        found.append([np.subtract(parameters(wrong[arm]), parameters(known[arm])) for arm in (ACTIVE, PASSIVE)])
    errors = np.array(found)  # (60, 2, 6, 5)
    sigmas = np.tile([np.radians(0.1), 0.5e-3, 0.5e-3, np.radians(0.1), np.radians(0.1)], (2, 6, 1))
    has_beta = np.array([[row.beta is not None for row in known[arm].rows] for arm in (ACTIVE, PASSIVE)])
    sigmas[has_beta, 1] = 0.0  # such a row has no d
    sigmas[~has_beta, 4] = 0.0
    np.testing.assert_allclose(errors.std(axis=0), sigmas, rtol=0.35)


def parameters(chain: Chain) -> Array:
    """(n, 5): theta, d, a, alpha, beta; 0 for a beta that there is not."""
    return np.array([(row.theta, row.d, row.a, row.alpha, row.beta or 0.0) for row in chain.rows])


@pytest.mark.parametrize(("angle", "length", "expected"), [(0.02, 0.1, 0.8), (0.1, 0.5, 3.5)])
def test_wrong_kinematics_leave_the_mismatch_of_the_method(angle: float, length: float, expected: float) -> None:
    found = drawn({"kinematics": {"angle_deg": angle, "length_mm": length}})
    assert within_a_factor_of_two(found.corners, expected)


def test_one_joint_zero_leaves_the_mismatch_of_the_method_over_the_joints_that_can_be_seen() -> None:
    seen = [(ACTIVE, 2), (ACTIVE, 3), (ACTIVE, 4), (ACTIVE, 5), *((PASSIVE, joint) for joint in range(2, 7))]
    found = [figures(joint_zero(*joint, 0.1)).corners for joint in seen]
    assert within_a_factor_of_two(float(np.median(found)), 0.36)
    assert min(found) > 0.05


@pytest.mark.parametrize("joint", [(ACTIVE, 1), (ACTIVE, 6), (PASSIVE, 1)])
def test_the_zero_of_both_first_joints_and_of_the_active_arms_last_cannot_be_seen(joint: tuple[str, int]) -> None:
    found = figures(joint_zero(*joint, 0.1))
    assert found.corners < 1e-3
    assert found.residual < 1e-3
    # A first joint's goes to T_P_A, the last one's to T_H_E.
    assert found.rotation == pytest.approx(0.0 if joint[1] == 6 else 0.1, abs=1e-3)


def test_a_joint_zero_is_refused_for_an_arm_or_a_joint_that_there_is_not() -> None:
    setting = "simulation.errors.joint_zero.offset_deg"
    with pytest.raises(CellFileError, match="no arm of that name"):
        paper_cell_file(f"{setting}={{middle: [0, 0, 0, 0, 0, 0]}}")
    with pytest.raises(CellFileError, match="must have 6 entries"):
        paper_cell_file(f"{setting}={{{ACTIVE}: [0.1]}}")


def test_eccentric_encoders_err_by_a_sine_of_one_period_a_turn() -> None:
    eccentric = truth({"encoder_eccentricity": {"amplitude_mrad": 0.5}})
    turn = np.linspace(0, 2 * np.pi, 64, endpoint=False)[:, None] + Q_ACTIVE
    errors = np.array([links(eccentric, ACTIVE, q) - q for q in turn])
    spectrum = np.abs(np.fft.rfft(errors, axis=0)) / 32
    np.testing.assert_allclose(spectrum[1], 0.5e-3, rtol=1e-6)
    assert np.delete(spectrum, 1, axis=0).max() < 1e-9
    small, large = (figures({"encoder_eccentricity": {"amplitude_mrad": mrad}}).corners for mrad in (0.25, 0.5))
    assert large > 0.2
    assert large == pytest.approx(2 * small, rel=0.05)


def test_backlash_leaves_the_mismatch_of_the_method() -> None:
    """METHOD's 0.15 mrad: a link that far to either side of its motor."""
    assert within_a_factor_of_two(figures({"backlash": {"gap_mrad": 0.3}}).corners, 0.25)


def test_with_backlash_a_link_lags_by_half_the_gap_and_waits_until_the_gap_is_crossed() -> None:
    slack = truth({"backlash": {"gap_mrad": 0.2}})

    def lag(*ways: float) -> float:
        approach = slack.approach(STILL, [np.full(6, way) for way in ways], 0.0)
        return float((Q_ACTIVE - links(slack, ACTIVE, Q_ACTIVE, approach))[0])

    assert lag(0.5) == pytest.approx(1e-4)
    assert lag(-0.5) == pytest.approx(-1e-4)
    assert lag(0.5, -0.05e-3) == pytest.approx(0.5e-4)
    assert lag(0.5, -0.3e-3) == pytest.approx(-1e-4)


def test_with_backlash_a_path_is_followed_through_all_its_waypoints() -> None:
    """Half of the gap's way is left after the last one: only the first shows on which side the gears lay before."""
    cell, simulation = paper_cell({"backlash": {"gap_mrad": 0.2}})
    quiet = {"stepper": "kinematic", "noise": NoiseConfig(joint_mrad=0, encoder_mrad=0)}
    clock = VirtualClock()
    arm = World(cell, simulation.model_copy(update=quiet), clock).arms[ACTIVE]
    home = np.array(arm.target)
    waypoints = tuple(tuple((home + offset).tolist()) for offset in (0.5, 0.5 - 0.05e-3))
    read = arm.follow(JointPath(waypoints, (1.0,) * 6, (2.0,) * 6)).wait(30.0).positions
    np.testing.assert_allclose(read - arm.true_positions(clock.now()), 0.5e-4, rtol=0, atol=1e-9)


def test_sagging_joints_leave_the_mismatch_of_the_method() -> None:
    assert within_a_factor_of_two(figures({"compliance": {"sag_mrad": 1}}).corners, 0.27)


def test_joints_give_way_downwards_and_the_shoulder_most_with_the_arm_stretched_out_level() -> None:
    sagging = truth({"compliance": {"sag_mrad": 1}})
    robot = paper_cell({})[0].active
    for q in random_joints(np.random.default_rng(1), 100, robot.lower, robot.upper):
        sag = links(sagging, ACTIVE, q) - q
        assert np.abs(sag).max() < 1e-3
        assert abs(sag[0]) < 1e-5  # about the vertical there is no weight
        lower = sagging.chains[ACTIVE].frames(q)[:, 2, 3] - sagging.chains[ACTIVE].frames(q + sag)[:, 2, 3]
        assert lower.sum() > 0
    level = np.radians([0, 85, 60, 0, 120, 0])
    assert abs((links(sagging, ACTIVE, level) - level)[1]) > 0.85e-3


@pytest.mark.parametrize("radii", [(0.05, 0.05), (0.08, 0.04), (0.04, 0.08)])
def test_links_weigh_by_their_volume(radii: tuple[float, float]) -> None:
    """A level arm of an upper arm and a forearm of one length: the shoulder carries both, the elbow one."""
    length = 0.4
    rows = [Row(theta=0, d=0, a=0, alpha=np.pi / 2)] + [Row(theta=0, d=0, a=length, alpha=0)] * 2
    upper_arm, forearm = (np.pi * r**2 * (length + 4 / 3 * r) for r in radii)
    _, shoulder, elbow = Weight(Chain(tuple(rows)), np.array([0.05, *radii])).torque(np.zeros(3))
    expected = forearm / 2 / (upper_arm / 2 + forearm * 3 / 2)
    assert elbow / shoulder == pytest.approx(expected)


def test_a_common_scale_of_both_arms_cannot_be_seen_though_the_bases_are_off_by_it() -> None:
    found = figures({"arm_scale": {"ppm": 1000}})
    assert found.corners < 0.01
    assert found.paper < 0.01
    assert found.translation == pytest.approx(1.2, rel=0.1)


def test_growth_while_they_warm_up_can_be_seen_and_ends_as_a_scale() -> None:
    warming = {"thermal": {"growth_ppm": 1000, "time_constant_min": 10}}
    assert figures(warming).corners > 10 * figures({"arm_scale": {"ppm": 1000}}).corners
    growing, grown = truth(warming), truth({"arm_scale": {"ppm": 1000}})
    for when, share in ((0.0, 0.0), (600.0, 1 - np.exp(-1)), (36000.0, 1.0)):
        T_P_E, cold, warm = (t.T_P_E(Q_ACTIVE, at) for t, at in ((growing, when), (truth({}), 0.0), (grown, 0.0)))
        np.testing.assert_allclose(T_P_E[:3, 3], cold[:3, 3] + share * (warm - cold)[:3, 3], atol=1e-9)


def test_both_arms_warm_up() -> None:
    grown = truth({"arm_scale": {"ppm": 1000}})
    warm = truth({"thermal": {"growth_ppm": 1000, "time_constant_min": 10}})
    np.testing.assert_allclose(
        warm.T_E_T(Q_ACTIVE, Q_PASSIVE, 36000.0), grown.T_E_T(Q_ACTIVE, Q_PASSIVE, 0.0), rtol=0, atol=1e-9
    )


# Mounts


def test_a_camera_mount_that_bends_leaves_the_mismatch_of_the_method() -> None:
    assert within_a_factor_of_two(figures({"mount_flex": {"mrad_per_g": 0.5}}).corners, 0.11)


def test_a_bent_mount_leans_the_optical_axis_towards_the_ground() -> None:
    to_base = inverse(truth({}).T_P_A)
    stiff, bent = (to_base @ t.T_P_E(Q_ACTIVE, 0.0) for t in (truth({}), truth({"mount_flex": {"mrad_per_g": 0.5}})))
    lean = np.arccos(np.clip(stiff[:3, 2] @ bent[:3, 2], -1, 1))
    assert lean == pytest.approx(0.5e-3 * np.linalg.norm(stiff[:2, 2]), rel=1e-3)
    assert bent[2, 2] < stiff[2, 2]


def test_a_base_that_drifts_is_off_by_its_speed_times_the_time() -> None:
    drifting = truth({"base_drift": {"translation_mm_per_hour": 5, "rotation_deg_per_hour": 0.2}})
    T_A_E = inverse(truth({}).T_P_A) @ truth({}).T_P_E(Q_ACTIVE, 0.0)
    for hours in (0.5, 2.0):
        T_P_A = drifting.T_P_E(Q_ACTIVE, hours * 3600) @ inverse(T_A_E)
        off = inverse(drifting.T_P_A) @ T_P_A
        assert np.linalg.norm(off[:3, 3]) == pytest.approx(hours * 5e-3)
        assert rotation_angle(off[:3, :3], np.eye(3)) == pytest.approx(np.radians(hours * 0.2))


def test_the_mismatch_grows_with_the_speed_of_the_drift() -> None:
    slow, fast = (figures({"base_drift": {"translation_mm_per_hour": speed}}).corners for speed in (5, 20))
    assert slow > 0.02
    assert fast == pytest.approx(4 * slow, rel=0.2)


@pytest.mark.parametrize(("offset", "expected"), [(0.5, 0.66), (5.0, 7.4)])
def test_a_target_mounted_elsewhere_leaves_the_mismatch_of_the_method(offset: float, expected: float) -> None:
    found = drawn({"target_mount": {"translation_mm": offset}})
    assert within_a_factor_of_two(found.corners, expected)


def test_a_target_mount_is_off_by_the_stated_length_and_angle() -> None:
    mounted = truth({"target_mount": {"translation_mm": 2, "rotation_deg": 0.3}})
    off = inverse(truth({}).T_F_T) @ mounted.T_F_T
    assert np.linalg.norm(off[:3, 3]) == pytest.approx(2e-3)
    assert rotation_angle(off[:3, :3], np.eye(3)) == pytest.approx(np.radians(0.3))


def test_a_target_that_slips_changes_the_captures_from_then_on() -> None:
    whole = read_captures(POSES).captures
    # Captures come every 10 s, so the slip is between the 14th and the 15th.
    slip = {"target_slip": {"translation_mm": 0.5, "at_s": 145}}
    slipped = captured(slip).captures
    differ = [
        np.abs(np.subtract(a.passive_joints, b.passive_joints)).max() > 1e-5
        for a, b in zip(whole, slipped, strict=True)
    ]
    assert differ == [False] * 14 + [True] * (len(whole) - 14)
    assert figures(slip).corners > 0.1


def test_a_target_that_slips_is_shifted_and_turned_by_the_stated_length_and_angle() -> None:
    slipping = truth({"target_slip": {"translation_mm": 2, "rotation_deg": 0.3, "at_s": 100}})
    before, after = (slipping.T_E_T(Q_ACTIVE, Q_PASSIVE, when) for when in (99.9, 100.0))
    np.testing.assert_array_equal(before, truth({}).T_E_T(Q_ACTIVE, Q_PASSIVE, 0.0))
    off = inverse(before) @ after
    assert np.linalg.norm(off[:3, 3]) == pytest.approx(2e-3)
    assert rotation_angle(off[:3, :3], np.eye(3)) == pytest.approx(np.radians(0.3))


# Time

SWING: Errors = {"settle_time": {"amplitude_mrad": 1, "frequency_hz": 10, "decay_s": 0.1}}


def test_links_swing_along_their_last_move_until_it_has_faded() -> None:
    swinging = truth(SWING)

    def off(when: float) -> Array:
        return np.asarray(links(swinging, ACTIVE, Q_ACTIVE, GONE_UP, when) - Q_ACTIVE)

    np.testing.assert_array_equal(off(GONE_UP.end), 0.0)
    quarter = 0.025  # s, of a period
    np.testing.assert_allclose(off(GONE_UP.end + quarter), 1e-3 * np.exp(-0.25) * GONE_UP.way, atol=1e-12)
    assert np.abs(off(GONE_UP.end + 1.025)).max() < 1e-7


def moving(errors: Errors, look: Callable[[World, float], None]) -> Iterator[float]:
    """Times, every 10 ms of a move of the active arm and the second after it, with ``look`` called at each."""
    cell, simulation = paper_cell(errors)
    clock = VirtualClock()
    quiet = {"stepper": "kinematic", "noise": NoiseConfig(joint_mrad=0, encoder_mrad=0)}
    world = World(cell, simulation.model_copy(update=quiet), clock)
    home = np.array(world.arms[ACTIVE].target)
    world.arms[ACTIVE].follow(JointPath((tuple(home + 0.2),), (1.0,) * 6, (2.0,) * 6))
    for when in np.arange(0.0, 2.0, 0.01).tolist():
        clock.call_at(when, partial(look, world, when))
        yield when
    clock.wait(threading.Event(), 2.0)


def test_the_target_trembles_in_the_camera_after_a_move_and_encoders_do_not_show_it() -> None:
    places: list[Array] = []
    states: list[RobotState] = []

    def look(world: World, when: float) -> None:
        places.append(world.T_E_T(when)[:3, 3])
        states.append(world.arms[ACTIVE].state("read"))

    times = np.array(list(moving(SWING, look)))
    off = np.linalg.norm(np.array(places) - places[-1], axis=1)
    rested = np.array([not np.any(state.velocities) for state in states]) & (times > 0)
    assert 0.0 < times[rested].min() < 1.0
    assert off[rested][:10].max() > 1e-4
    assert off[times > 1.9].max() < 1e-6
    assert len({state.positions for state, still in zip(states, rested, strict=True) if still}) == 1


def test_the_mismatch_grows_with_the_swing_at_the_shutters_opening_and_is_gone_when_it_has_faded() -> None:
    def mismatch(amplitude_mrad: float, since_rest: float) -> float:
        swing: Errors = {"settle_time": {"amplitude_mrad": amplitude_mrad, "frequency_hz": 5, "decay_s": 0.1}}
        return seen(swing, since_rest).mismatch

    small, large = mismatch(0.5, 0.05), mismatch(1.0, 0.05)
    assert small > 0.05
    assert large == pytest.approx(2 * small, rel=0.05)
    assert mismatch(1.0, 1.05) < 0.005


@pytest.mark.parametrize("delay", [0.02, 0.05])
def test_with_skew_the_place_that_the_joints_tell_is_off_by_the_way_of_the_time_and_not_at_rest(delay: float) -> None:
    """The mismatch of a capture taken on the way; the arms' standing is waited for, so captures of a run have none."""
    off, rests = [], []

    def look(world: World, when: float) -> None:
        state = world.arms[ACTIVE].state("read")
        told, true = (
            world.truth.T_P_E(q, when)[:3, 3]
            for q in (np.array(state.positions), world.arms[ACTIVE].true_positions(when))
        )
        off.append(float(np.linalg.norm(told - true)))
        rests.append(not np.any(state.velocities))

    times = np.array(list(moving({"time_skew": {"delay_s": delay}}, look)))
    speed = np.linalg.norm(np.diff(path_of_the_camera(times), axis=0), axis=1) / 0.01
    assert max(off) == pytest.approx(delay * speed.max(), rel=0.1)
    assert max(np.array(off)[np.array(rests) & (times > delay)]) < 1e-9


def path_of_the_camera(times: Array) -> Array:
    """(k, 3) m, of the move that :func:`moving` makes."""
    places: list[Array] = []

    def look(world: World, when: float) -> None:
        places.append(world.truth.T_P_E(world.arms[ACTIVE].true_positions(when), when)[:3, 3])

    assert len(list(moving({}, look))) == len(times)
    return np.array(places)


@pytest.mark.parametrize("stepper", ["kinematic", "bullet"])
def test_with_skew_an_arm_has_settled_once_its_encoders_say_so_and_the_other_may_move(stepper: str) -> None:
    file = load_cell(TINY, [f"simulation.stepper={stepper}", "simulation.errors.time_skew.delay_s=0.05"])
    with Cell(file) as cell:
        for offset in (0.1, -0.1, 0.05):
            for arm in (cell.active, cell.passive):
                target = tuple((np.array(arm.home) + [offset, 0, 0, 0, offset, 0]).tolist())
                path = JointPath((target,), tuple(arm.limits.speed), tuple(arm.limits.acceleration))
                state = arm.robot.start(path).wait(30.0)
                assert np.abs(state.velocities).max() < STANDSTILL
                np.testing.assert_allclose(state.positions, target, atol=1e-4)


def test_a_state_with_skew_says_where_the_joints_were_earlier() -> None:
    def positions(delay: float) -> Array:
        read: list[tuple[float, ...]] = []

        def look(world: World, when: float) -> None:
            read.append(world.arms[ACTIVE].state("read").positions)

        assert len(list(moving({"time_skew": {"delay_s": delay}}, look))) == len(read)
        return np.array(read)

    prompt, late = positions(0.0), positions(0.1)
    assert np.abs(prompt - late).max() > 0.01
    np.testing.assert_allclose(late[10:], prompt[:-10], atol=1e-12)


# Target and lens: the feature point is aligned where the axis is, so the paper's method sees little of them.


def test_a_bowed_plate_leaves_the_mismatch_of_the_method_to_a_fit_of_all_corners_only() -> None:
    """METHOD's bow of 0.2 mm: of the corners that are seen, half as far out as the pattern's outer ones."""
    found = figures({"flatness": {"bow_mm": 0.8}})
    assert within_a_factor_of_two(found.corners, 0.11)
    assert found.paper < 1e-3


def test_squares_of_a_wrong_size_show_in_the_residuals_and_not_in_the_mismatch() -> None:
    found = figures({"square_scale": {"x_ppm": 1000}})
    assert found.residual > 0.01
    assert found.corners < 5e-3
    assert found.paper < 1e-3


@pytest.mark.parametrize(
    ("errors", "turn"),
    [({"principal_point": {"right_px": 2}}, 2 / 812), ({"corner_bias": {"down_px": 0.5}}, 0.5 / 812)],
)
def test_a_wrong_place_in_the_image_only_redefines_the_optical_axis(errors: Errors, turn: float) -> None:
    cell, simulation = paper_cell(errors)
    found = analyse(captured(errors), cell, "paper")
    assert found.mismatch_after is not None
    assert found.mismatch_after.mean < 1e-6
    np.testing.assert_allclose(found.T_P_A, simulation.truth.T_P_A, atol=1e-6)
    assert np.linalg.norm(np.cross(found.optical_axis, simulation.truth.T_H_E[:3, 2])) == pytest.approx(turn, rel=0.01)


def test_a_wrong_focal_length_moves_the_camera_along_its_axis_and_is_not_in_the_mismatch() -> None:
    errors = {"focal": {"x_ppm": 1000, "y_ppm": 1000}}
    cell, simulation = paper_cell(errors)
    fit = fit_to_all_corners(cell, captured(errors))
    back = (inverse(simulation.truth.T_H_E) @ fit.T_H_E)[2, 3]
    assert abs(back) == pytest.approx(0.4e-3, rel=0.25)  # 1000 ppm of 0.3 to 0.5 m
    assert figures(errors).corners < 0.01


def test_a_distortion_left_out_spares_the_feature_point_on_the_axis() -> None:
    found = figures({"distortion_residual": {"corner_px": 5}})
    assert found.paper < 1e-3
    assert found.residual > 1e-3
