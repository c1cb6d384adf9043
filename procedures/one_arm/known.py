"""What is known of a cell of one arm: where camera and target are, and how wrong that may be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.config import OneArmConfig
from dualcal_hal.geometry import ArmBody, CellGeometry
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array, inverse, rotation_from_vector, transform
from procedures.estimation.refined.one_arm import OneArm
from procedures.planning.belief import LEAST_ERROR, Belief
from procedures.planning.model import ArmModel, CellModel, Posture

_ERRORS = 24
"""Of camera and target together, that views are tried with: all as large as they may be, in random directions."""

Size = tuple[float, float]
"""Of an error: m and rad."""


@dataclass(frozen=True)
class Known:
    """config: its nominal transforms are what is known now, by ``source``."""

    config: OneArmConfig
    source: str
    looked: bool = False
    """Whether that is what views have shown."""

    @staticmethod
    def nominal(config: OneArmConfig) -> Known:
        """What the cell file says; without looks, as simulated cells may, it is taken as exact."""
        given = config.nominal
        if not config.procedure.first_looks:
            config = config.known_as(given.camera, given.target, (0.0, 0.0), (0.0, 0.0))
        return Known(config, "the nominal transforms")

    def by_views(self, found: OneArm) -> Known:
        """By an estimate from so many views: to within three sigma of it, and what is always allowed for."""
        camera, target = (_largest(found.covariance_of(name)) for name in found.placement.names)
        stands, carried = (target, camera) if self.config.camera_on_arm else (camera, target)
        config = self.config.known_as(found.camera, found.target, stands, carried)
        return Known(config, f"{int(np.sum(found.used))} views", looked=True)

    @cached_property
    def model(self) -> CellModel:
        """As one of two arms, what the arm carries thicker by what its mount may be off."""
        cell = self.config.as_two_arms()
        geometry = CellGeometry.of(cell)
        body, on_arm = cell.camera, self.config.camera_on_arm
        plate = float(np.linalg.norm(cell.target.plate_outline, axis=1).max())
        reach = body.body_radius + body.body_length if on_arm else plate
        error = _moved(_size(self.config, carried=True), reach)
        if on_arm:
            geometry = replace(geometry, active=_thicker(geometry.active, error, cell.clearance))
        else:
            geometry = replace(geometry, passive=_thicker(geometry.passive, error, cell.clearance))
        return CellModel(cell).but(geometry=geometry)

    @cached_property
    def belief(self) -> Belief:
        return replace(self.model.nominal, source=self.source)

    @property
    def arm(self) -> ArmModel:
        """The one that moves."""
        return self.model.active if self.config.camera_on_arm else self.model.passive

    def posture(self, q: ArrayLike) -> Posture:
        """With the arm at joint angles (n,) in rad, and the stand."""
        return Posture.of(q, ()) if self.config.camera_on_arm else Posture.of((), q)

    def joints(self, posture: Posture) -> Joints:
        """Of the arm in a posture."""
        return posture.active if self.config.camera_on_arm else posture.passive

    def both(self, q: Array) -> tuple[Array, Array]:
        """Joint angles (k, n) of the arm as those of the active and of the passive one."""
        none = np.zeros((len(q), 0))
        return (q, none) if self.config.camera_on_arm else (none, q)

    def flange(self, T_E_T: Array) -> Array:
        """(k, 4, 4): of the arm, in its base, where the target is at (k, 4, 4) in the camera."""
        camera, target = self.config.nominal.camera, self.config.nominal.target
        if self.config.camera_on_arm:
            return target @ inverse(T_E_T) @ inverse(camera)
        return camera @ T_E_T @ inverse(target)

    def possible(self, T_E_T: Array) -> Array:
        """(s, k, 4, 4): where the target may be that is thought to be at (k, 4, 4) in the camera."""
        stands, carried = (_size(self.config, carried=carried) for carried in (False, True))
        camera, target = (carried, stands) if self.config.camera_on_arm else (stands, carried)
        rng = np.random.default_rng(0)
        of_camera, of_target = _errors(rng, camera), _errors(rng, target)
        return np.asarray(inverse(of_camera)[:, None] @ T_E_T @ of_target[:, None])


def _size(config: OneArmConfig, *, carried: bool) -> Size:
    given = config.nominal.mount_uncertainty if carried else config.nominal.uncertainty
    return given.translation, given.rotation


def _errors(rng: np.random.Generator, size: Size) -> Array:
    """(s, 4, 4), the first of them none."""
    translation, axis = (_unit(rng.standard_normal((_ERRORS, 3))) for _ in range(2))
    errors = transform(rotation_from_vector(size[1] * axis), size[0] * translation)
    errors[0] = np.eye(4)
    return errors


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


def _largest(covariance: Array) -> Size:
    sigmas = [float(np.sqrt(np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1])) for i in (0, 3)]
    translation, rotation = (max(3 * sigma, least) for sigma, least in zip(sigmas, LEAST_ERROR, strict=True))
    return translation, min(rotation, np.pi)


def _moved(size: Size, reach: float) -> float:
    """m by which a point so far from the origin of an error may be off."""
    return float(size[0] + 2 * np.sin(min(size[1], np.pi) / 2) * reach)


def _thicker(body: ArmBody, error: float, clearance: float) -> ArmBody:
    tool = replace(body.tool, radius=body.tool.radius + error)
    return ArmBody(body.chain, body.links, tool, body.floor, body.fixtures, clearance)


def turns(known: Known, joints: Sequence[Joints]) -> Array:
    """(k, 3, 3): orientations of the flange at joint angles (rad)."""
    return known.arm.chain.forward(np.array(joints).reshape(-1, known.arm.chain.joints))[:, :3, :3]
