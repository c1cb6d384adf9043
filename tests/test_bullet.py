"""PyBullet: arms with weight that arrive where they are sent, and contact that ends everything."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from backends.simulator import SimulatorBackend
from backends.simulator.bullet.bodies import STEP, BulletBodies
from backends.simulator.bullet.client import pybullet
from backends.simulator.bullet.nearness import Nearness
from backends.simulator.bullet.stepper import SETTLED, BulletStepper
from backends.simulator.truth import Truth
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import CellFileError, CommandRefused, Contact, MotionFailed
from dualcal_hal.geometry import CellGeometry, Placement, segment_distance
from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.robot import JointPath, Joints, Mode, Motion, RobotState
from dualcal_hal.session.distances import Distances
from dualcal_hal.trajectory import Trajectory
from dualcal_hal.transforms import Array, apply, inverse
from tests.cells import NOISELESS, PAPER, SMALL
from tools.cli.app import app

ACTIVE, PASSIVE = "left", "right"
BULLET = "simulation.stepper=bullet"
NO_NOISE = tuple(override for override in NOISELESS if override.startswith("simulation"))
TIMEOUT = 30.0
NEVER = threading.Event()


@cache
def cell(*overrides: str) -> CellFile:
    return load_cell(PAPER, (BULLET, *NO_NOISE, *overrides))


def opened(file: CellFile) -> Iterator[SimulatorBackend]:
    backend = SimulatorBackend("sim", file)
    backend.open(TIMEOUT)
    yield backend
    backend.close()


@pytest.fixture
def backend() -> Iterator[SimulatorBackend]:
    yield from opened(cell())


def degrees(*angles: float) -> Joints:
    return tuple(np.radians(angles).tolist())


def start(backend: SimulatorBackend, name: str, *waypoints: Joints) -> Motion:
    config = backend.cell.cell.robots[name]
    return backend.robot(name).start(JointPath(waypoints, tuple(config.speed), tuple(config.acceleration)))


def move(backend: SimulatorBackend, name: str, target: Joints) -> RobotState:
    return start(backend, name, target).wait(TIMEOUT)


def truth_of(file: CellFile) -> Truth:
    assert file.simulation is not None
    return Truth(file.cell, file.simulation)


@pytest.fixture
def bodies() -> Iterator[BulletBodies]:
    file = cell()
    bodies = BulletBodies(file.cell, truth_of(file))
    yield bodies
    bodies.close()


# Bodies


@pytest.mark.parametrize("arm", [ACTIVE, PASSIVE])
def test_what_the_arms_carry_stands_where_the_true_chain_has_it(bodies: BulletBodies, arm: str) -> None:
    truth, rng = truth_of(cell()), np.random.default_rng(1)
    T_P_base, T_flange_tool = (truth.T_P_A, truth.T_H_E) if arm == ACTIVE else (np.eye(4), truth.T_F_T)
    for q in rng.uniform(-3, 3, (50, 6)):
        bodies.put(arm, q)
        expected = T_P_base @ truth.chains[arm].forward(q) @ T_flange_tool
        np.testing.assert_allclose(bodies.link_pose(*bodies.tool(arm)), expected, rtol=0, atol=1e-6)


ANGLE, LENGTH = st.floats(-np.pi, np.pi), st.floats(-0.6, 0.6)
PLAIN = st.builds(Row, theta=ANGLE, d=LENGTH, a=LENGTH, alpha=ANGLE)
HAYATI = st.builds(Row, theta=ANGLE, d=st.just(0.0), a=LENGTH, alpha=ANGLE, beta=ANGLE)


@settings(max_examples=20, deadline=None)
@given(rows=st.lists(PLAIN | HAYATI, min_size=6, max_size=6), q=st.lists(ANGLE, min_size=6, max_size=6))
def test_that_holds_for_any_denavit_hartenberg_table(rows: list[Row], q: list[float]) -> None:
    file = cell()
    truth = truth_of(file)
    truth.chains[PASSIVE] = Chain(tuple(rows))
    bodies = BulletBodies(file.cell, truth)
    bodies.put(PASSIVE, np.array(q))
    expected = truth.chains[PASSIVE].forward(q) @ truth.T_F_T
    np.testing.assert_allclose(bodies.link_pose(*bodies.tool(PASSIVE)), expected, rtol=0, atol=1e-6)
    bodies.close()


def surface_of_tool(bodies: BulletBodies, arm: str) -> Array:
    """Points (k, 3) on the box that an arm carries in PyBullet, in the passive base."""
    ((_, _, shape, size, _, position, quaternion),) = pybullet.getCollisionShapeData(
        *bodies.tool(arm), physicsClientId=bodies.client
    )
    assert shape == pybullet.GEOM_BOX
    grid = np.array(list(itertools.product(np.linspace(-0.5, 0.5, 13), repeat=3)))
    surface = grid[np.abs(grid).max(axis=1) == 0.5] * size
    # PyBullet places a shape from the link's centre of mass.
    state = pybullet.getLinkState(*bodies.tool(arm), computeForwardKinematics=True, physicsClientId=bodies.client)
    pose = pybullet.multiplyTransforms(*state[:2], position, quaternion)
    R = np.reshape(pybullet.getMatrixFromQuaternion(pose[1]), (3, 3))
    return np.asarray(surface @ R.T + pose[0])


def sticks_out(points: Array, ends: Array, radii: Array) -> float:
    """How far (m) the farthest of points (k, 3) is from what capsules (c, 2, 3) fill."""
    outside = segment_distance(np.stack([points, points], axis=1)[:, None], ends[None]) - radii
    return float(outside.min(axis=1).max())


@pytest.mark.parametrize("arm", [ACTIVE, PASSIVE])
def test_the_planners_capsules_hold_the_boxes_that_stand_for_camera_and_target_here(arm: str) -> None:
    file = cell()
    truth, geometry = truth_of(file), CellGeometry.of(file.cell)
    truth.T_P_A, truth.T_H_E = np.eye(4), file.cell.nominal.T_H_E
    bodies = BulletBodies(file.cell, truth)
    body, q = (geometry.active if arm == ACTIVE else geometry.passive), file.cell.robots[arm].home
    tool = slice(len(body.links), None)
    points = surface_of_tool(bodies, arm)
    assert sticks_out(points, body.segments([q])[0, tool], body.capsules.radius[tool]) < 1e-6
    # The test can tell: a box a little larger would stick out.
    larger = points.mean(axis=0) + 1.02 * (points - points.mean(axis=0))
    assert sticks_out(larger, body.segments([q])[0, tool], body.capsules.radius[tool]) > 0
    bodies.close()


def test_the_true_camera_sticks_out_of_the_planners_capsule_by_less_than_the_clearance(bodies: BulletBodies) -> None:
    file = cell()
    truth, body = truth_of(file), CellGeometry.of(file.cell).active
    ends = apply(truth.T_P_A, body.segments([file.cell.active.home])[0, -1])
    out = sticks_out(surface_of_tool(bodies, ACTIVE), ends[None], body.capsules.radius[-1:])
    assert 0 < out < file.cell.procedure.clearance


def test_parts_are_as_far_apart_as_the_planners_shapes_are_or_farther(bodies: BulletBodies) -> None:
    file = cell()
    geometry, placement = CellGeometry.of(file.cell), Placement(truth_of(file).T_P_A, 0.012, 0.0)
    nearness, rng = Nearness(bodies), np.random.default_rng(2)
    for q_a, q_p in rng.uniform(-1.5, 1.5, (100, 2, 6)):
        bodies.put(ACTIVE, q_a)
        bodies.put(PASSIVE, q_p)
        assert nearness.between_arms().distance >= geometry.between(q_a, q_p, placement)[0]


@pytest.mark.parametrize("arm", [ACTIVE, PASSIVE])
def test_an_arm_that_meets_itself_in_the_planners_capsules_does_so_here(bodies: BulletBodies, arm: str) -> None:
    """All pairs of links that can be brought apart, also where others on the same links touch by their make."""
    geometry, rng = CellGeometry.of(cell().cell), np.random.default_rng(3)
    shape = geometry.active if arm == ACTIVE else geometry.passive
    first, second = shape.pairs[np.all(shape.pairs < len(shape.links), axis=1)].T
    radii = shape.capsules.radius[first] + shape.capsules.radius[second]
    nearness, met = Nearness(bodies), set()
    for q in rng.uniform(-np.pi, np.pi, (300, 6)):
        bodies.put(arm, q)
        segments = shape.segments([q])[0]
        least = float(np.min(segment_distance(segments[first], segments[second]) - radii))
        contact = nearness.contact({arm: np.full(6, np.inf)})
        if least < -1e-4:
            assert contact is not None
            assert contact.distance <= least + 1e-4
            met.add((contact.first, contact.second))
        elif contact is not None and least > 1e-4:
            assert {contact.first, contact.second} & {"camera of left", "target of right", "floor"}
    assert len(met) > 5


@pytest.mark.parametrize("arm", [ACTIVE, PASSIVE])
def test_an_arm_weighs_about_20_kg(bodies: BulletBodies, arm: str) -> None:
    masses = [pybullet.getDynamicsInfo(bodies.arms[arm], link, physicsClientId=bodies.client)[0] for link in range(7)]
    assert min(masses) > 0.05
    assert 15 < sum(masses) < 25


def test_an_arm_whose_motors_are_off_falls(bodies: BulletBodies) -> None:
    before = bodies.link_pose(*bodies.tool(ACTIVE))[:3, 3]
    for joint in range(6):
        pybullet.setJointMotorControl2(
            bodies.arms[ACTIVE], joint, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=bodies.client
        )
    for _ in range(24):
        bodies.step()
    after = bodies.link_pose(*bodies.tool(ACTIVE))[:3, 3]
    # Stretched out ahead, it turns about its shoulder: its end falls a little faster than a stone.
    assert before[2] - after[2] == pytest.approx(0.5 * 9.81 * 0.1**2, rel=0.5)


# Motion


def test_an_arm_arrives_where_it_was_sent_against_its_weight_and_stays(backend: SimulatorBackend) -> None:
    for target in (degrees(30, -20, 80, 40, 60, 100), degrees(30, -20, 80, 40, 60, 101)):
        arrived = np.array(move(backend, ACTIVE, target).positions)
        off = np.abs(arrived - target).max()
        assert 0 < off <= SETTLED
        # While the other arm moves time passes for this one too.
        move(backend, PASSIVE, (*target[:5], -target[5]))
        np.testing.assert_allclose(backend.robot(ACTIVE).read(TIMEOUT).positions, arrived, rtol=0, atol=2e-6)


@pytest.mark.parametrize("offset", [0.5, 0.002])
def test_a_motion_ends_when_the_joints_have_settled_not_when_their_set_points_rest(
    backend: SimulatorBackend, offset: float
) -> None:
    config = backend.cell.cell.active
    target = tuple((config.home + offset).tolist())
    trajectory = Trajectory(config.home, config.acceleration)
    trajectory.follow(JointPath((target,), tuple(config.speed), tuple(config.acceleration)), 0.0)
    move(backend, ACTIVE, target)
    assert 0.01 < backend.clock.now() - trajectory.end < 0.1


def test_a_path_back_to_where_it_began_is_followed_before_it_is_over(backend: SimulatorBackend) -> None:
    """It begins so gently that after the first step the joints are all but at rest where the path ends."""
    home = backend.cell.cell.active.home
    away = home + 0.002
    heard: list[RobotState] = []
    backend.robot(ACTIVE).subscribe(heard.append)
    there_and_back = JointPath((tuple(away.tolist()), tuple(home.tolist())), (1.0,) * 6, (0.01,) * 6)
    backend.robot(ACTIVE).start(there_and_back).wait(TIMEOUT)
    np.testing.assert_allclose(np.max([state.positions for state in heard], axis=0), away, rtol=0, atol=1e-4)


def test_between_two_steps_joints_go_on(backend: SimulatorBackend) -> None:
    robot, clock = backend.robot(ACTIVE), backend.clock
    motion = start(backend, ACTIVE, degrees(60, 0, 60, 0, 30, 0))
    times, turned = 0.4 + STEP * np.arange(0.0, 4.0, 0.125), []
    for when in times:
        clock.call_at(float(when), lambda: turned.append(robot.read(TIMEOUT).positions[0]))
    motion.wait(TIMEOUT)
    speed = np.diff(turned) / np.diff(times)
    np.testing.assert_allclose(speed, backend.cell.cell.active.speed[0], rtol=0.1)


def test_a_motion_that_does_not_settle_fails(backend: SimulatorBackend, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.simulator.bullet.stepper.SETTLED", 0.0)
    with pytest.raises(MotionFailed, match="not settled 3 s after"):
        move(backend, ACTIVE, degrees(0, 10, 60, 0, 30, 0))
    monkeypatch.undo()
    move(backend, ACTIVE, degrees(0, 0, 60, 0, 30, 0))


def test_on_the_way_joints_are_near_their_set_points(backend: SimulatorBackend) -> None:
    exact = next(runs := opened(cell("simulation.stepper=kinematic")))
    states: dict[str, list[RobotState]] = {}
    for name, one in (("bullet", backend), ("kinematic", exact)):
        heard = states.setdefault(name, [])
        one.robot(ACTIVE).subscribe(heard.append)
        move(one, ACTIVE, degrees(60, -30, 20, 10, 50, -60))
    for here, there in zip(states["bullet"], states["kinematic"], strict=False):
        assert here.time == there.time
        np.testing.assert_allclose(here.positions, there.positions, rtol=0, atol=0.02)
    assert max(max(state.velocities) for state in states["bullet"]) > 1.0
    runs.close()


def test_both_arms_may_move_at_once(backend: SimulatorBackend) -> None:
    motions = [start(backend, name, degrees(20, 0, 60, 0, 30, 0)) for name in (ACTIVE, PASSIVE)]
    for motion in motions:
        np.testing.assert_allclose(motion.wait(TIMEOUT).positions, degrees(20, 0, 60, 0, 30, 0), rtol=0, atol=SETTLED)


def test_the_same_motions_are_the_same_bit_for_bit() -> None:
    def run() -> list[Joints]:
        backend = next(runs := opened(cell()))
        readings = [move(backend, ACTIVE, degrees(20, 0, 60, 0, 30, 0)).positions]
        start(backend, PASSIVE, degrees(20, 0, 60, 0, 30, 0))
        backend.robot(PASSIVE).stop("test")
        readings += [backend.robot(name).read(TIMEOUT).positions for name in (ACTIVE, PASSIVE)]
        runs.close()
        return readings

    assert run() == run()


# Contact

HOME = degrees(0, 0, 60, 0, 30, 0)
LEANING = degrees(0, -45, 45, 0, 0, 0)


def test_arms_that_meet_halt_and_both_motions_fail_naming_the_parts(backend: SimulatorBackend) -> None:
    robots = [backend.robot(name) for name in (ACTIVE, PASSIVE)]
    motions = [start(backend, robot.name, LEANING) for robot in robots]
    for motion in motions:
        with pytest.raises(Contact, match=r"(camera|link 6) of left touches (target|link 6) of right"):
            motion.wait(TIMEOUT)
    for robot in robots:
        halted = robot.read(TIMEOUT)
        assert (halted.mode, halted.velocities) == (Mode.FAULT, (0.0,) * 6)
        assert "touches" in halted.faults[0]
        assert np.abs(np.subtract(halted.positions, LEANING)).max() > 0.1
        assert robot.stop("test").confirmed
        for command in (lambda one=robot: one.enable(TIMEOUT), lambda one=robot: start(backend, one.name, LEANING)):
            with pytest.raises(CommandRefused, match="touches"):
                command()
        backend.clock.wait(NEVER, backend.clock.now() + 1.0)
        assert robot.read(TIMEOUT).positions == halted.positions


def test_contact_is_found_before_parts_are_deep_in_each_other(backend: SimulatorBackend) -> None:
    move(backend, PASSIVE, degrees(0, -30, 30, 0, 0, 0))
    with pytest.raises(Contact):
        move(backend, ACTIVE, LEANING)
    distances = Distances.from_document(backend.documents()["distances.json"])
    assert distances.distances[-1] < 0.1
    assert min(distances.distances) > -0.02


@pytest.mark.parametrize(
    ("begin", "end", "other"),
    [
        (degrees(40, -45, 45, 0, 0, 0), degrees(-40, -45, 45, 0, 0, 0), LEANING),
        (HOME, degrees(0, -70, 30, 0, 30, 0), HOME),
        (HOME, degrees(0, 0, -80, 0, 0, 0), HOME),
    ],
    ids=["the other arm", "the floor", "itself"],
)
@pytest.mark.parametrize("angle", [0.01, 0.02, 0.03, 0.05])
def test_contact_is_found_in_the_step_in_which_measuring_all_finds_it(
    bodies: BulletBodies, begin: Joints, end: Joints, other: Joints, angle: float
) -> None:
    bodies.put(PASSIVE, np.array(other))
    nearness, way = Nearness(bodies), np.subtract(end, begin)
    turned = angle * np.abs(way) / np.abs(way).max()
    for share in np.arange(0.0, 1.0, angle / np.abs(way).max()):
        bodies.put(ACTIVE, begin + share * way)
        touching = Nearness(bodies).contact({ACTIVE: turned})
        assert nearness.contact({ACTIVE: turned}) == touching
        if touching is not None:
            return
    pytest.fail("nothing touched")


def test_a_fast_motion_halts_in_the_step_in_which_parts_touch() -> None:
    stepper = BulletStepper(cell().cell, truth_of(cell()))
    stepper.follow(ACTIVE, JointPath((degrees(0, -70, 30, 0, 30, 0),), (8.0,) * 6, (80.0,) * 6), 0.0)
    steps = itertools.count(1)
    while stepper.fault is None:
        stepper.sample(ACTIVE, next(steps) * STEP)
        touching = Nearness(stepper.scene).contact({ACTIVE: np.zeros(6)})
        assert (stepper.fault is None) == (touching is None)
    assert "touches floor" in stepper.fault
    stepper.close()


@pytest.mark.parametrize(
    ("target", "parts"),
    [
        (degrees(0, -70, 30, 0, 30, 0), "(link [56]|camera) of left touches floor"),
        (degrees(0, -110, 125, 0, 30, 0), "link [23] of left touches floor"),
        (degrees(0, 0, -80, 0, 0, 0), "link [12] of left touches link [56] of left"),
    ],
)
def test_an_arm_that_meets_the_floor_or_itself_halts(backend: SimulatorBackend, target: Joints, parts: str) -> None:
    with pytest.raises(Contact, match=parts):
        move(backend, ACTIVE, target)


POST = "at: {translation_mm: [450, 450, 450], rotation_vector_deg: [0, 0, 30]}"


@pytest.mark.parametrize("shape", ["box_mm: [200, 200, 900]", "cylinder_mm: {radius: 100, length: 900}", "mesh"])
def test_an_arm_that_meets_a_fixture_halts(shape: str, tmp_path: Path) -> None:
    if shape == "mesh":
        shape = f"mesh: {{file: {tmp_path / 'post.obj'}}}"
        corners = itertools.product((-100, 100), (-100, 100), (-450, 450))
        faces = ["1 2 4 3", "5 6 8 7", "1 2 6 5", "3 4 8 7", "1 3 7 5", "2 4 8 6"]
        lines = [f"v {x} {y} {z}" for x, y, z in corners] + [f"f {face}" for face in faces]
        (tmp_path / "post.obj").write_text("\n".join(lines) + "\n")
    backend = next(runs := opened(cell(f"fixtures={{post: {{in: passive_base, {POST}, {shape}}}}}")))
    move(backend, PASSIVE, LEANING)
    with pytest.raises(Contact, match="of right touches post"):
        move(backend, PASSIVE, (np.radians(90), *LEANING[1:]))
    runs.close()


KNOBS = {"link 1": [0, 65, 136], "link 2": [0, 106, 280], "link 3": [0, 95, 640]}
"""Where, in mm, the parts come by as the passive arm turns about its first axis."""


def knob(part: str, base: str = "passive_base") -> str:
    """A fixture of one of the bases in that part's way."""
    T_base_P = inverse(truth_of(cell()).T_P_A) if base == "active_base" else np.eye(4)
    (at,) = 1e3 * apply(T_base_P, 1e-3 * np.array([KNOBS[part]]))
    place = f"{{translation_mm: {at.tolist()}, rotation_vector_deg: [0, 0, 0]}}"
    return f"fixtures={{knob: {{in: {base}, at: {place}, cylinder_mm: {{radius: 5, length: 10}}}}}}"


@pytest.mark.parametrize(
    ("part", "base"),
    [
        ("link 1", "passive_base"),
        ("link 2", "passive_base"),
        ("link 3", "passive_base"),
        ("link 2", "active_base"),
        ("link 3", "active_base"),
    ],
)
def test_every_part_that_moves_is_held_against_the_fixtures(part: str, base: str) -> None:
    for backend in opened(cell(knob(part, base))):
        with pytest.raises(Contact, match=f"{part} of right touches knob"):
            move(backend, PASSIVE, degrees(80, 0, 60, 0, 30, 0))


def test_the_shoulder_is_held_against_the_fixtures_of_its_own_base_alone() -> None:
    turned = degrees(45, 0, 60, 0, 30, 0)
    for backend in opened(cell(knob("link 1", "active_base"))):
        move(backend, PASSIVE, turned)
    for backend in opened(cell(knob("link 1", "passive_base"))):
        with pytest.raises(Contact):
            move(backend, PASSIVE, turned)


def a_ball(path: Path, rings: int, radius: float) -> str:
    """A fixture beside the passive arm: a mesh of 4 rings (rings - 1) triangles, ``radius`` in mm."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)
    x, y, z = np.broadcast_arrays(np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar))
    vertices = [*np.stack([x, y, z], axis=-1).reshape(-1, 3), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])]
    last, count = len(vertices), 2 * rings
    ring = 1 + np.arange(rings - 1)[:, None] * count + np.arange(count + 1) % count
    faces = [
        face
        for a, b, c, d in zip(
            ring[:-1, :-1].flat, ring[:-1, 1:].flat, ring[1:, :-1].flat, ring[1:, 1:].flat, strict=True
        )
        for face in ((a, c, b), (b, c, d))
    ]
    faces += [(last - 1, a, b) for a, b in itertools.pairwise(ring[0])]
    faces += [(last, b, a) for a, b in itertools.pairwise(ring[-1])]
    lines = ["v {} {} {}".format(*(radius * vertex)) for vertex in vertices] + ["f {} {} {}".format(*f) for f in faces]
    path.write_text("\n".join(lines) + "\n")
    return f"fixtures={{ball: {{in: passive_base, {POST}, mesh: {{file: {path}}}}}}}"


def test_triangles_of_a_mesh_share_their_vertices_so_that_48_000_are_not_too_many(tmp_path: Path) -> None:
    file = cell(a_ball(tmp_path / "ball.obj", 110, 200.0))
    backend = next(runs := opened(file))
    move(backend, PASSIVE, LEANING)
    with pytest.raises(Contact, match="of right touches ball"):
        move(backend, PASSIVE, (np.radians(90), *LEANING[1:]))
    runs.close()


def test_a_mesh_that_pybullet_does_not_take_is_refused_by_its_key_and_nothing_is_left_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: object) -> None:
        raise pybullet.error("createCollisionShape failed.")

    monkeypatch.setattr(pybullet, "createCollisionShape", refuse)
    backend, before = SimulatorBackend("sim", cell(a_ball(tmp_path / "ball.obj", 10, 200.0))), worlds()
    with pytest.raises(CellFileError, match=r"fixtures\.ball\.mesh: too many triangles for PyBullet, 360; simplify"):
        backend.open(TIMEOUT)
    assert worlds() == before


def worlds() -> int:
    """Clients that PyBullet still serves."""
    return sum(pybullet.isConnected(client) for client in range(100))


@pytest.mark.parametrize("part", ["bullet.stepper.Nearness", "backend.Scene"])
def test_a_world_that_cannot_be_finished_is_given_up(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ValueError("no")

    monkeypatch.setattr(f"backends.simulator.{part}", fail)
    before = worlds()
    with pytest.raises(ValueError, match="no"):
        SimulatorBackend("sim", cell()).open(TIMEOUT)
    assert worlds() == before


def test_a_cell_whose_arms_touch_at_home_does_not_open() -> None:
    home = "[0, -45, 45, 0, 0, 0]"
    backend = SimulatorBackend("sim", cell(f"robots.left.home_deg={home}", f"robots.right.home_deg={home}"))
    before = worlds()
    with pytest.raises(Contact, match=r"^sim: open: .* of left touches .* of right; check home_deg"):
        backend.open(TIMEOUT)
    assert worlds() == before


# Distances


def test_the_distance_between_the_arms_is_recorded_30_times_a_second_while_one_moves(backend: SimulatorBackend) -> None:
    move(backend, ACTIVE, degrees(0, -20, 60, 0, 30, 0))
    backend.clock.wait(NEVER, backend.clock.now() + 5.0)
    moved = backend.clock.now() - 5.0
    distances = Distances.from_document(json.loads(json.dumps(backend.documents()["distances.json"])))
    np.testing.assert_allclose(np.diff(distances.times), 1 / 30)
    assert distances.times[-1] == pytest.approx(moved, abs=1 / 30)
    assert 0.2 < distances.distances[-1] < distances.distances[0] - 0.1
    assert all(first.endswith("of left") and second.endswith("of right") for first, second in distances.between)


def test_the_least_distance_is_told_with_its_parts_and_its_time() -> None:
    pairs = [("camera of left", "link 5 of right"), ("link 6 of left", "target of right"), ("a", "b")]
    distances = Distances([1.0, 12.34, 20.0], [0.2, 0.0612, 0.1], pairs)
    assert distances.least() == "61 mm: link 6 of left to target of right, at 12.3 s"


def test_of_a_run_that_went_on_the_least_distance_is_that_of_all_its_parts() -> None:
    first = Distances([1.0, 2.0], [0.2, 0.05], [("a", "b"), ("c", "d")], [(0.0, 2.5)])
    second = Distances([2.1, 4.0], [0.3, 0.1], [("a", "b"), ("a", "b")], [(2.0, 5.0)])
    both = Distances.from_document(json.loads(json.dumps(second.after(first).to_document())))
    assert both.least() == "50 mm: c to d, at 2.0 s"
    assert both.missing == 0.0


def test_a_part_that_was_killed_and_left_no_distances_is_told() -> None:
    resumed = Distances([31.0], [0.1], [("a", "b")], [(30.0, 50.0)])
    assert resumed.least() == "100 mm: a to b, at 31.0 s; not known for 30 s of a part that was killed"
    again = Distances([71.0], [0.2], [("a", "b")], [(60.0, 80.0)]).after(resumed)
    assert again.missing == 40.0
    assert Distances([], [], [], [(5.0, 5.0)]).least() == "not measured; not known for 5 s of a part that was killed"


# Runs


def dualcal(*arguments: object):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def sets(*overrides: str) -> list[str]:
    return [part for override in overrides for part in ("--set", override)]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bullet") / "session"
    result = dualcal("run", PAPER, "--out", folder, "--seed", 3, *sets(*SMALL, BULLET))
    assert result.exit_code == 0, result.output
    (folder / "output.txt").write_text(result.output)
    return folder


def test_a_run_keeps_the_distances_and_prints_the_least(session: Path) -> None:
    distances = Distances.from_document(json.loads((session / "distances.json").read_text()))
    assert min(distances.distances) > 0.02
    output = " ".join((session / "output.txt").read_text().split())
    assert f"least distance between the arms {distances.least()}" in output


@pytest.mark.usefixtures("undrawn")
def test_a_run_can_be_repeated_to_the_last_bit(session: Path, tmp_path: Path) -> None:
    assert dualcal("run", PAPER, "--out", tmp_path / "again", "--seed", 3, *sets(*SMALL, BULLET)).exit_code == 0
    first, second = (
        json.loads((folder / "captures.json").read_text())["captures"] for folder in (session, tmp_path / "again")
    )
    assert first == second


def test_a_run_whose_arms_meet_ends_with_exit_code_1_and_names_the_parts(tmp_path: Path) -> None:
    # The bases stand closer than the plan and its guard are told.
    closer = "simulation.truth.active_base_in_passive_base.translation_mm=[800, 0, 0]"
    options = sets(*SMALL, BULLET, closer, "procedure.first_looks=0")
    result = dualcal("run", PAPER, "--out", tmp_path / "session", *options)
    assert result.exit_code == 1
    assert " of left touches " in result.output
    distances = Distances.from_document(json.loads((tmp_path / "session" / "distances.json").read_text()))
    assert min(distances.distances) < 0.1


# PyBullet's absence and its greeting


@pytest.fixture
def _no_pybullet(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("backends.simulator.bullet")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pybullet", None)


@pytest.mark.usefixtures("_no_pybullet")
def test_without_pybullet_a_run_is_refused_with_what_to_do(tmp_path: Path) -> None:
    result = dualcal("run", PAPER, "--out", tmp_path / "session", "--set", BULLET)
    assert result.exit_code == 2
    output = " ".join(result.output.split())
    assert "pip install 'dualcal[bullet]'" in output
    assert "--set simulation.stepper=kinematic" in output
    assert not (tmp_path / "session").exists()


@pytest.mark.usefixtures("_no_pybullet")
def test_without_pybullet_a_cell_is_simulated_without_physics() -> None:
    with pytest.raises(CellFileError):
        SimulatorBackend("sim", cell())
    backend = next(runs := opened(cell("simulation.stepper=kinematic")))
    move(backend, ACTIVE, degrees(20, 0, 60, 0, 30, 0))
    assert backend.documents() == {}
    runs.close()


def test_pybullet_is_imported_for_a_world_alone_and_without_a_word() -> None:
    program = (
        "import sys; from dualcal_hal.cellfile import load_cell; from pathlib import Path; import tools.cli.run;"
        "from backends.simulator import SimulatorBackend; from tools.cli.app import app;"
        f"cell = load_cell(Path({str(PAPER)!r}), [{BULLET!r}]); assert 'pybullet' not in sys.modules;"
        "SimulatorBackend('sim', cell); assert 'pybullet' in sys.modules"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
