"""The cell's bodies in PyBullet: both arms with camera and target, the floor and the fixtures."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from backends.simulator.bullet.client import pybullet
from backends.simulator.bullet.solids import box
from backends.simulator.bullet.urdf import Tool, arm_urdf, link_name, part_names
from dualcal_hal.errors import CellFileError, Problem
from dualcal_hal.geometry import (
    ArmBody,
    Block,
    Cylinder,
    HalfSpace,
    Mesh,
    Solid,
    camera_box,
    camera_capsule,
    link_capsules,
    plate_box,
    plate_capsules,
)
from dualcal_hal.transforms import Array, quaternion_from_rotation, transform

if TYPE_CHECKING:
    from backends.simulator.truth import Truth
    from dualcal_hal.config import CellConfig

Part = tuple[int, int]
"""A body and a link of it, as PyBullet numbers them; -1 is its base."""

STEP = 1 / 240
"""Seconds of simulated time."""

_GRAVITY = -9.81  # m/s^2
_POSITION_GAIN = 0.3
# With PyBullet's own 50 iterations and 1e-7 some postures keep an error of 0.1 mrad, or never come to rest.
_ITERATIONS, _RESIDUAL = 500, 1e-9
_FORCE = 2000.0  # N m; the drives are never too weak


class BulletBodies:
    """Placed by the truth, in the passive base's frame; moved by the arms' motors alone, not by contact.

    client: PyBullet's number of this world. arms: the body of each arm by its name. shapes: of each arm, as it truly
    is; links: of each arm the one with each of these capsules, all of what it carries on the last. names: of all
    parts. standing: for each arm the bodies that it must not touch, with the links that this goes for; floors: those
    that stand for a floor. Raises CellFileError for a mesh that PyBullet does not take.
    """

    def __init__(self, cell: CellConfig, truth: Truth) -> None:
        self.client: int = pybullet.connect(pybullet.DIRECT)
        self.names: dict[Part, str] = {}
        self.arms: dict[str, int] = {}
        self.shapes: dict[str, ArmBody] = {}
        self.links: dict[str, list[int]] = {}
        self.standing: dict[str, list[tuple[int, frozenset[int]]]] = {name: [] for name in cell.robots}
        self.floors: list[int] = []
        self._motors: dict[str, dict[str, Any]] = {}
        with ExitStack() as if_it_fails:
            if_it_fails.callback(self.close)
            self._set_physics()
            bases = {cell.active_name: truth.T_P_A, cell.passive_name: np.eye(4)}
            self._add_arms(cell, truth, bases)
            self._add_surroundings(cell, bases)
            if_it_fails.pop_all()

    def _set_physics(self) -> None:
        pybullet.setGravity(0, 0, _GRAVITY, physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=STEP,
            numSolverIterations=_ITERATIONS,
            solverResidualThreshold=_RESIDUAL,
            physicsClientId=self.client,
        )

    def _add_arms(self, cell: CellConfig, truth: Truth, bases: Mapping[str, Array]) -> None:
        housing = box(*camera_box(cell.camera.body_radius, cell.camera.body_length))
        plate = box(*plate_box(cell.target.plate_outline))
        tools = {
            cell.active_name: Tool("camera", truth.T_H_E, housing),
            cell.passive_name: Tool("target", truth.T_F_T, plate),
        }
        camera = camera_capsule(cell.active.chain.joints, truth.T_H_E, cell.camera.body_radius, cell.camera.body_length)
        target = plate_capsules(cell.passive.chain.joints, truth.T_F_T, cell.target.plate_outline)
        carried = {cell.active_name: camera, cell.passive_name: target}
        for name, robot in sorted(cell.robots.items()):
            chain, tool = truth.chains[name], tools[name]
            self.shapes[name] = ArmBody(chain, link_capsules(chain, robot.link_radius), carried[name], None)
            self._load(name, arm_urdf(chain, robot.link_radius, tool), bases[name])
            self._number(name, tool)
            self.put(name, robot.home)

    def _load(self, arm: str, urdf: str, T_P_base: Array) -> None:
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "arm.urdf"
            file.write_text(urdf)
            body = self.arms[arm] = pybullet.loadURDF(
                str(file),
                *_pose(T_P_base),
                useFixedBase=True,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=self.client,
            )
        for link in range(-1, pybullet.getNumJoints(body, physicsClientId=self.client)):
            pybullet.changeDynamics(
                body, link, linearDamping=0, angularDamping=0, jointDamping=0, physicsClientId=self.client
            )
            # Contact is looked for, and ends everything: nothing is left for the physics to push apart.
            pybullet.setCollisionFilterGroupMask(body, link, 0, 0, physicsClientId=self.client)

    def _number(self, arm: str, tool: Tool) -> None:
        """Find the links by their names: PyBullet numbers them in an order of its own."""
        body, shape = self.arms[arm], self.shapes[arm]
        links = {"base": -1}
        for link in range(pybullet.getNumJoints(body, physicsClientId=self.client)):
            links[pybullet.getJointInfo(body, link, physicsClientId=self.client)[12].decode()] = link
        parts = part_names(shape.links)
        self.links[arm] = [links[part] for part in parts] + [links[tool.name]] * len(shape.tool)
        for part, frame in zip(parts, shape.links.frame, strict=True):
            self.names[body, links[part]] = f"{link_name(frame)} of {arm}"
        self.names[body, links[tool.name]] = f"{tool.name} of {arm}"
        joints = shape.chain.joints
        self._motors[arm] = {
            "bodyUniqueId": body,
            "jointIndices": [links[link_name(frame)] for frame in range(1, joints + 1)],
            "controlMode": pybullet.POSITION_CONTROL,
            "forces": [_FORCE] * joints,
            "positionGains": [_POSITION_GAIN] * joints,
            "velocityGains": [1.0] * joints,
            "physicsClientId": self.client,
        }

    def _add_surroundings(self, cell: CellConfig, bases: Mapping[str, Array]) -> None:
        roles = {"active_base": cell.active_name, "passive_base": cell.passive_name}
        for name, fixture in cell.fixtures.items():
            owner = roles[fixture.base]
            body = self._add_shape(fixture.solid, bases[owner] @ fixture.T, name)
            for arm, shape in self.shapes.items():
                self._must_clear(arm, body, shape.moving if arm == owner else shape.above_floor)
        if cell.floor is not None:
            for arm, T_P_base in bases.items():
                if arm not in cell.arms:
                    continue  # under a stand there is none
                level = T_P_base @ transform(np.eye(3), [0.0, 0.0, cell.floor])
                floor = self._add_shape(HalfSpace(), level, "floor")
                self.floors.append(floor)
                self._must_clear(arm, floor, self.shapes[arm].above_floor)

    def _must_clear(self, arm: str, body: int, capsules: Iterable[int]) -> None:
        self.standing[arm].append((body, frozenset(self.links[arm][i] for i in capsules)))

    def _add_shape(self, solid: Solid, T_P_solid: Array, name: str) -> int:
        try:
            shape = pybullet.createCollisionShape(**_shape(solid), physicsClientId=self.client)
        except pybullet.error as error:
            if not isinstance(solid, Mesh):
                raise
            what = f"too many triangles for PyBullet, {len(solid.corners)}; simplify it"
            raise CellFileError([Problem(f"fixtures.{name}.mesh", what)]) from error
        position, quaternion = _pose(T_P_solid)
        body: int = pybullet.createMultiBody(
            baseCollisionShapeIndex=shape,
            basePosition=position,
            baseOrientation=quaternion,
            physicsClientId=self.client,
        )
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self.client)
        self.names[body, -1] = name
        return body

    def put(self, arm: str, q: Array) -> None:
        """Have an arm stand at joint angles (n,) in rad, and hold them."""
        for joint, angle in zip(self._motors[arm]["jointIndices"], q.tolist(), strict=True):
            pybullet.resetJointState(self.arms[arm], joint, angle, physicsClientId=self.client)
        self.drive(arm, q, np.zeros_like(q))

    def drive(self, arm: str, q: Array, velocity: Array) -> None:
        """Set the motors' set points: (n,) in rad and rad/s. A stand has no motors."""
        if not len(q):
            return
        pybullet.setJointMotorControlArray(
            targetPositions=q.tolist(), targetVelocities=velocity.tolist(), **self._motors[arm]
        )

    def joints(self, arm: str) -> tuple[Array, Array]:
        """An arm's joint angles (n,) in rad and velocities (n,) in rad/s."""
        motors = self._motors[arm]
        if not motors["jointIndices"]:
            return np.zeros(0), np.zeros(0)
        states = pybullet.getJointStates(motors["bodyUniqueId"], motors["jointIndices"], physicsClientId=self.client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def step(self) -> None:
        """Let STEP seconds pass."""
        pybullet.stepSimulation(physicsClientId=self.client)

    def tool(self, arm: str) -> Part:
        """What an arm carries: the camera, whose link's frame is E, or the target's plate, whose link's is T."""
        return self.arms[arm], self.links[arm][-1]

    def link_pose(self, body: int, link: int) -> Array:
        """(4, 4): a link's frame in the passive base."""
        # The first entries are of the centre of mass.
        position, quaternion = pybullet.getLinkState(
            body, link, computeForwardKinematics=True, physicsClientId=self.client
        )[4:6]
        R = np.reshape(pybullet.getMatrixFromQuaternion(quaternion), (3, 3))
        return transform(R, position)

    def close(self) -> None:
        """Give the world up."""
        pybullet.disconnect(physicsClientId=self.client)


def _pose(T: Array) -> tuple[list[float], list[float]]:
    """Position and quaternion (x, y, z, w)."""
    return T[:3, 3].tolist(), quaternion_from_rotation(T[:3, :3]).tolist()


def _shape(solid: Solid) -> dict[str, Any]:
    """What PyBullet makes a collision shape from."""
    match solid:
        case Block(sizes):
            return {"shapeType": pybullet.GEOM_BOX, "halfExtents": (sizes / 2).tolist()}
        case Cylinder(radius, length):
            return {"shapeType": pybullet.GEOM_CYLINDER, "radius": radius, "height": length}
        case HalfSpace():
            return {"shapeType": pybullet.GEOM_PLANE}
        case Mesh(corners):
            # Their number is limited: one that triangles share is told once.
            vertices, indices = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
            return {
                "shapeType": pybullet.GEOM_MESH,
                "vertices": vertices.tolist(),
                "indices": indices.ravel().tolist(),
                "flags": pybullet.GEOM_FORCE_CONCAVE_TRIMESH,
            }
    raise TypeError(f"{solid!r} is no shape of a fixture")
