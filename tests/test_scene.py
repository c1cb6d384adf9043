"""What is seen behind the target, and before it, is where PyBullet has it; the target's own pixels stay as they are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import pytest

from backends.simulator import SimulatorBackend
from backends.simulator.bullet.bodies import BulletBodies
from backends.simulator.bullet.client import pybullet
from backends.simulator.pattern import Values
from backends.simulator.rendering import WHITE, Renderer
from backends.simulator.scene import FLOOR, SKY, Scene
from backends.simulator.truth import Truth
from dualcal_hal.camera import Intrinsics
from dualcal_hal.cellfile import load_cell
from dualcal_hal.config import CellConfig
from dualcal_hal.transforms import Array, Mask, inverse, quaternion_from_rotation, rotation_from_vector, transform
from tests.cells import NOISELESS, PAPER
from tests.reference_cell import DOCUMENT
from tests.rendered_corners import DISTORTION, corners_found, project, random_view

ACTIVE, PASSIVE = "left", "right"
CELL = load_cell(PAPER, ("simulation.stepper=bullet", *NOISELESS[:1]))
TARGET = CELL.cell.target
KNOWN = CELL.cell.camera.intrinsics
CAMERA = Intrinsics(KNOWN.matrix, DISTORTION, KNOWN.size)
CAPTURES = DOCUMENT["captures"]


@dataclass(frozen=True, eq=False)
class Cell:
    """The paper's cell in PyBullet, seen through a lens with distortion."""

    bodies: BulletBodies
    truth: Truth
    renderer: Renderer
    scene: Scene

    def stand(self, capture: int) -> Array:
        """Have the arms stand as in a reference capture; T_E_T (4, 4)."""
        q_a, q_p = (np.array(CAPTURES[capture][key]) for key in ("active_joints_rad", "passive_joints_rad"))
        self.bodies.put(ACTIVE, q_a)
        self.bodies.put(PASSIVE, q_p)
        return self.truth.T_E_T(q_a, q_p, 0.0)

    @property
    def T_P_E(self) -> Array:
        return self.bodies.link_pose(*self.bodies.tool(ACTIVE))

    def add_box(self, T_E_box: Array, size: Array) -> None:
        """A light box with edges (3,) in m, at ``T_E_box`` (4, 4)."""
        client = self.bodies.client
        T_P_box = self.T_P_E @ T_E_box
        shape = pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=(size / 2).tolist(), rgbaColor=(0.5, 0.5, 0.5, 1), physicsClientId=client
        )
        pybullet.createMultiBody(
            0,
            -1,
            shape,
            T_P_box[:3, 3].tolist(),
            quaternion_from_rotation(T_P_box[:3, :3]).tolist(),
            physicsClientId=client,
        )


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(TARGET.board, TARGET.margin, CAMERA, blur=0.6)


@pytest.fixture
def cell(renderer: Renderer) -> Iterator[Cell]:
    assert CELL.simulation is not None
    yield from built(Truth(CELL.cell, CELL.simulation), renderer)


def built(truth: Truth, renderer: Renderer, config: CellConfig = CELL.cell) -> Iterator[Cell]:
    bodies = BulletBodies(config, truth)
    yield Cell(bodies, truth, renderer, Scene(bodies, config, renderer.rays))
    bodies.close()


def hidden(cell: Cell, T_E_T: Array) -> Values:
    share = cell.scene.view(T_E_T).hidden
    assert share is not None
    return share


def within(outline: Array, T: Array) -> Mask:
    """The pixels within the image of ``outline`` (n, 3)."""
    filled = np.zeros(CAMERA.size[::-1], np.uint8)
    cv2.fillConvexPoly(filled, np.rint(project(outline, T, CAMERA)).astype(np.int32), 1)
    return filled.astype(bool)


def square(side: float) -> Array:
    return side / 2 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])


# Before the target


@pytest.mark.parametrize("capture", [0, 3, 6, 9, 21, 24, 25, 27])
def test_the_round_ends_of_the_links_that_carry_the_target_do_not_hide_it(cell: Cell, capture: int) -> None:
    assert cell.scene.view(cell.stand(capture)).hidden is None


@pytest.mark.parametrize("boom_mm", [80, 150])
def test_farther_before_a_target_they_do_hide_it(renderer: Renderer, boom_mm: float) -> None:
    """It faces its own wrist from the end of a boom; a radius of 45 mm nearer, the wrist is before it."""
    mount = f"{{translation_mm: [0, 0, {boom_mm}], rotation_vector_deg: [180, 0, 0]}}"
    file = load_cell(PAPER, ("simulation.stepper=bullet", f"robots.right.target_mount={mount}"))
    assert file.simulation is not None
    truth = Truth(file.cell, file.simulation)
    home = {name: truth.chains[name].forward(robot.home) for name, robot in file.cell.robots.items()}
    T_T_E = transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 0.45])
    truth.T_H_E = inverse(truth.T_P_A @ home[ACTIVE]) @ home[PASSIVE] @ truth.T_F_T @ T_T_E
    for cell in built(truth, renderer, file.cell):
        share = hidden(cell, inverse(T_T_E))[within(TARGET.plate_outline, inverse(T_T_E))]
        assert share.mean() > 0.5


def test_the_floor_of_one_arm_hides_nothing_of_the_other_however_wrong_the_bases_stand(renderer: Renderer) -> None:
    """Each arm has a floor under its own base alone; tilted with that base it passes above the other's target."""
    assert CELL.simulation is not None
    truth = Truth(CELL.cell, CELL.simulation)
    q_a, q_p = (np.array(CAPTURES[14][key]) for key in ("active_joints_rad", "passive_joints_rad"))
    T_P_E, arm = truth.T_P_E(q_a, 0.0), truth.chains[ACTIVE]
    truth.T_P_A = truth.T_P_A @ transform(rotation_from_vector([0.0, np.deg2rad(-12.0), 0.0]), [0.0, 0.0, 0.1])
    in_its_floor = inverse(truth.T_P_A) @ truth.chains[PASSIVE].forward(q_p) @ truth.T_F_T
    assert in_its_floor[2, 3] < -0.05
    flange = inverse(truth.T_P_A) @ T_P_E @ inverse(truth.T_H_E)
    (q_a,), (reached,) = arm.inverse(flange, [q_a], np.full(6, -np.pi), np.full(6, np.pi))
    assert reached
    for cell in built(truth, renderer):
        cell.bodies.put(ACTIVE, q_a)
        cell.bodies.put(PASSIVE, q_p)
        np.testing.assert_allclose(cell.T_P_E, T_P_E, atol=1e-6)
        assert cell.scene.view(truth.T_E_T(q_a, q_p, 0.0)).hidden is None


def test_the_passive_arm_hides_a_target_that_it_holds_behind_its_forearm(cell: Cell) -> None:
    T_E_T = cell.stand(12)
    share = hidden(cell, T_E_T)[within(TARGET.plate_outline, T_E_T)]
    assert 0.05 < share.mean() < 0.2


@pytest.mark.parametrize("offset", [[0.0, 0.0], [0.04, 0.03], [-0.045, 0.01]])
def test_a_box_before_the_target_hides_what_is_behind_it(cell: Cell, offset: list[float]) -> None:
    T_E_T = cell.stand(7)
    box = transform(np.eye(3), [*(0.5 * T_E_T[:2, 3] + 0.5 * np.array(offset)), 0.5 * T_E_T[2, 3]])
    cell.add_box(box, np.array([0.02, 0.02, 0.001]))
    share = hidden(cell, T_E_T)
    on_plate = within(TARGET.plate_outline, T_E_T)
    expected = within(square(0.02), box) & on_plate
    v, u = np.nonzero(expected)
    seen_v, seen_u = np.nonzero((share > 0.5) & on_plate)
    # A pixel of the reduced picture is four of the image.
    assert len(seen_u) == pytest.approx(len(u), rel=0.12)
    assert (seen_u.mean(), seen_v.mean()) == pytest.approx((u.mean(), v.mean()), abs=1.5)


@pytest.mark.parametrize("depth", [0.012, 0.03, 0.06])
def test_what_is_right_before_the_lens_hides_the_target_too(cell: Cell, depth: float) -> None:
    T_E_T = cell.stand(7)
    box = transform(np.eye(3), depth * T_E_T[:3, 3] / T_E_T[2, 3])
    side = 0.05 * depth
    cell.add_box(box, np.array([side, side, 0.0005]))
    assert np.sum(hidden(cell, T_E_T) > 0.5) == pytest.approx(np.sum(within(square(side), box)), rel=0.12)


def test_what_is_hidden_shows_what_hides_it(cell: Cell) -> None:
    T_E_T = cell.stand(7)
    box = transform(np.eye(3), 0.5 * T_E_T[:3, 3])
    cell.add_box(box, np.array([0.04, 0.04, 0.001]))
    view = cell.scene.view(T_E_T)
    inner = within(square(0.03), box)
    image = cell.renderer.render(T_E_T, view)
    np.testing.assert_allclose(image[inner], view.grey[inner], atol=1.0)
    assert np.ptp(image[inner]) < 10  # no black and white squares


def test_a_box_behind_the_target_hides_nothing(cell: Cell) -> None:
    T_E_T = cell.stand(7)
    cell.add_box(T_E_T @ transform(np.eye(3), [0.0, 0.0, -0.03]), np.array([0.3, 0.3, 0.01]))
    assert cell.scene.view(T_E_T).hidden is None


def test_corners_in_view_are_where_they_were_beside_hidden_ones(cell: Cell) -> None:
    rng = np.random.default_rng(3)
    cell.stand(7)
    board = TARGET.board
    cell.add_box(transform(np.eye(3), [0.02, 0.01, 0.2]), np.array([0.03, 0.08, 0.001]))
    errors, covered = [], 0
    for _ in range(60):
        T_E_T = random_view(rng, rng.uniform(0.3, 0.5))
        view = cell.scene.view(T_E_T)
        image = cell.renderer.render(T_E_T, view)
        for corner in project(board.corners, T_E_T, CAMERA):
            u, v = np.rint(corner).astype(int)
            # The fit looks 5 px far, at what is blurred over another 6.
            if view.hidden is not None and view.hidden[v - 11 : v + 12, u - 11 : u + 12].any():
                covered += 1
            else:
                errors.append(corners_found(image, corner[None] + rng.uniform(-0.3, 0.3, 2))[0] - corner)
    error = np.array(errors)
    assert covered > 30
    assert len(error) > 200
    assert np.sqrt(np.mean(error**2, axis=0)).max() <= 0.008
    assert np.abs(error.mean(axis=0)).max() <= 0.002


# Behind the target


def test_the_plates_own_pixels_do_not_show_what_is_behind(cell: Cell) -> None:
    T_E_T = cell.stand(20)
    inner = within(0.95 * TARGET.plate_outline, T_E_T)
    with_scene = cell.renderer.render(T_E_T, cell.scene.view(T_E_T))
    before_wall = cell.renderer.render(T_E_T)
    np.testing.assert_array_equal(with_scene[inner], before_wall[inner])
    assert np.abs(with_scene[~inner] - before_wall[~inner]).max() > 20


def test_the_arm_that_carries_the_target_is_seen_where_its_links_are(cell: Cell) -> None:
    T_E_T = cell.stand(5)
    grey = cell.scene.view(T_E_T).grey
    T_E_P = inverse(cell.T_P_E)
    seen = 0
    for link in (3, 4):
        pose = T_E_P @ cell.bodies.link_pose(cell.bodies.arms[PASSIVE], link)
        u, v = np.rint(project(pose[None, :3, 3], np.eye(4), CAMERA)[0]).astype(int)
        inside = 0 <= u < CAMERA.size[0] and 0 <= v < CAMERA.size[1]
        if inside and not within(1.1 * TARGET.plate_outline, T_E_T)[v, u]:
            patch = grey[max(0, v - 2) : v + 3, max(0, u - 2) : u + 3]
            assert np.abs(patch - SKY).min() > 5 or patch.std() > 1  # neither the empty sky
            seen += 1
    assert seen >= 1


def test_the_plate_itself_is_not_seen_beside_its_drawing(cell: Cell) -> None:
    T_E_T = cell.stand(5)
    rim = within(1.15 * TARGET.plate_outline, T_E_T) & ~within(1.02 * TARGET.plate_outline, T_E_T)
    assert cell.renderer.render(T_E_T, cell.scene.view(T_E_T))[rim].max() < WHITE - 10


def test_the_back_of_the_plate_is_seen_from_behind(cell: Cell) -> None:
    T_E_T = cell.stand(5)
    turned = T_E_T @ np.diag([-1.0, 1.0, -1.0, 1.0])
    inner = within(0.9 * TARGET.plate_outline, T_E_T)
    from_front, from_behind = (cell.scene.view(T_E_T).grey[inner] for T_E_T in (T_E_T, turned))
    # Seen from the front, the plate is left out.
    assert np.mean(np.abs(from_front - from_behind) > 5) > 0.2


def test_the_floor_is_seen_below_the_horizon(cell: Cell) -> None:
    T_E_T = cell.stand(13)
    grey = cell.scene.view(T_E_T).grey
    v, u = np.mgrid[8:768:40, 8:1024:40]
    rays = cell.renderer.rays[v.ravel(), u.ravel()].astype(float)
    T_P_E = cell.T_P_E
    down = (np.c_[rays, np.ones(len(rays))] @ T_P_E[:3, :3].T)[:, 2] < -0.25
    up = (np.c_[rays, np.ones(len(rays))] @ T_P_E[:3, :3].T)[:, 2] > 0.25
    shown = grey[v.ravel(), u.ravel()]
    assert np.mean(np.abs(shown[down] - FLOOR) < 3) > 0.3
    assert not np.any(np.abs(shown[up] - FLOOR) < 3)


def test_frames_of_a_cell_in_pybullet_show_its_floor() -> None:
    floor = {}
    for stepper in ("kinematic", "bullet"):
        backend = SimulatorBackend("sim", load_cell(PAPER, (f"simulation.stepper={stepper}", *NOISELESS)))
        backend.open(30.0)
        floor[stepper] = np.mean(backend.camera("camera").grab(0.0, 30.0).image == FLOOR)
        backend.close()
    assert floor["kinematic"] < 1e-3  # pixels between black and white
    assert floor["bullet"] > 0.05
