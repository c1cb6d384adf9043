"""A cell with one arm: the camera is on it and watches a target that stands, or stands and watches a target on it.

What stands is taken for an arm without joints, so that a cell of one arm is one of two for all that moves and looks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

import numpy as np
from pydantic import Field

from dualcal_hal.config.backends import BackendEntry
from dualcal_hal.config.camera import CameraConfig
from dualcal_hal.config.cell import CellConfig, SessionName
from dualcal_hal.config.fixtures import FixtureConfig, SolidConfig
from dualcal_hal.config.nominal import NominalConfig, UncertaintyConfig
from dualcal_hal.config.procedure import Distances, Looks, ProcedureConfig, Tilt, VerificationConfig
from dualcal_hal.config.references import (
    Location,
    backend_problems,
    mapping,
    named,
    simulated_only_problems,
    truth_problems,
)
from dualcal_hal.config.robots import ArmConfig, KinematicsConfig, RobotConfig
from dualcal_hal.config.session import SessionConfig
from dualcal_hal.config.simulation import SimulatedConfig, SimulationConfig, TruthConfig
from dualcal_hal.config.target import TargetConfig
from dualcal_hal.config.values import AtLeast3, Natural, NotNegative, Number, Positive, Section, TransformConfig
from dualcal_hal.geometry.capsules import PLATE_THICKNESS
from dualcal_hal.transforms import Array

FIXED = "fixed"
"""Where a camera is mounted that is on no arm."""

STAND = "stand"
"""The name of what stands, as an arm without joints."""

ON_ARM_NAMES = ("camera_in_flange", "target_in_base")
FIXED_NAMES = ("camera_in_base", "target_in_flange")
"""Where camera and target are, for a camera on the arm and for one that stands."""


class OneArmTransforms(Section):
    """Where camera and target are: in flange and base with the camera on the arm, in base and flange with the target
    on it.
    """

    camera_in_flange: TransformConfig | None = None
    """Of a camera on the arm; its frame has z out of the lens, x right, y down."""
    target_in_base: TransformConfig | None = None
    """Of a target that stands; its frame has its origin in the feature point, x right and y up when looked at from the
    front, z towards the viewer."""
    camera_in_base: TransformConfig | None = None
    """Of a camera that stands."""
    target_in_flange: TransformConfig | None = None
    """Of a target on the arm."""

    @property
    def camera(self) -> Array:
        """(4, 4), m: in the flange or the base."""
        return _one_of(self.camera_in_flange, self.camera_in_base)

    @property
    def target(self) -> Array:
        """(4, 4), m: in the base or the flange."""
        return _one_of(self.target_in_base, self.target_in_flange)


def _one_of(first: TransformConfig | None, second: TransformConfig | None) -> Array:
    given = first or second
    if given is None:
        raise ValueError("a cell file that was not checked")
    return given.T


class OneArmNominalConfig(OneArmTransforms):
    """What the operator knows before the calibration."""

    uncertainty: UncertaintyConfig = UncertaintyConfig(translation_mm=50.0, rotation_deg=6.0)
    """Of what stands, at its own origin, at most: paths before the first looks are clear whatever the error within it.
    Must be given on a cell that is not simulated."""
    mount_uncertainty: UncertaintyConfig = UncertaintyConfig(translation_mm=10.0, rotation_deg=6.0)
    """Of what the arm carries, in the flange, at most."""


class OneArmVerificationConfig(Section):
    """The views that prove the result; the estimate does not use them."""

    views: Natural = 6
    """How many; 0 leaves the result unverified."""
    required_accuracy_mm: Positive | None = None
    """What the predicted 3D error (95 %) of a point that the camera sees where the target was may be, mm; 1 where left
    out, which only a cell that is simulated may."""


class OneArmProcedureConfig(Section):
    """How views are chosen and estimated from."""

    seed: Natural
    """Of the choice of views."""
    views: AtLeast3
    """How many to estimate from."""
    first_looks: Looks = 4
    """How many images to plan from, at least 3; 0 plans from the nominal transforms, on simulated cells only."""
    distance_mm: Distances
    """Smallest and largest distance between camera and feature point, mm."""
    tilt_max_deg: Tilt
    """Largest angle between the target's normal and the line of sight, degrees."""
    clearance_mm: NotNegative = 20.0
    """Smallest distance kept between arm, camera, target and floor, mm."""
    knowns: Literal["estimate", "propagate"] = "estimate"
    """What knowns that carry a sigma are: estimated with it as what is known of them, or left as they are and only
    reckoned with in the result's uncertainty."""
    verification: OneArmVerificationConfig = OneArmVerificationConfig()
    """The proof."""


class OneArmTruthConfig(OneArmTransforms):
    """The simulated cell as it is."""

    kinematics: dict[str, KinematicsConfig] = Field(default={})
    """The true kinematics of the arm, by its name; the cell's own where left out."""


class OneArmSimulationConfig(SimulatedConfig):
    """The simulated world; neither plan nor estimate may see it."""

    truth: OneArmTruthConfig
    """The cell as it is."""


class OneArmConfig(Section):
    """One arm with a camera or a target, and what is to be done with it."""

    name: SessionName
    """Names the session's folder: no separators, none of : * ? " < > |, no dot or space first."""
    backends: dict[str, BackendEntry]
    """What the devices are reached through, by a name of your own."""
    robots: dict[str, ArmConfig]
    """The arm, by a name of your own; it has no role."""
    camera: CameraConfig
    target: TargetConfig
    nominal: OneArmNominalConfig
    procedure: OneArmProcedureConfig
    floor_mm: Number | None = 0.0
    """Height of the floor in the arm's base frame, mm; null for none."""
    fixtures: dict[str, SolidConfig] = Field(default={})
    """What stands about the arm and must not be touched, by a name of your own."""
    session: SessionConfig = SessionConfig()
    """How a run is recorded."""

    @property
    def arm_name(self) -> str:
        return next(iter(self.robots))

    @property
    def arm(self) -> ArmConfig:
        return self.robots[self.arm_name]

    @property
    def camera_on_arm(self) -> bool:
        """Whether the arm carries the camera; else it carries the target."""
        return self.camera.mount != FIXED

    @property
    def names(self) -> tuple[str, str]:
        """What the transforms of camera and target are called."""
        return ON_ARM_NAMES if self.camera_on_arm else FIXED_NAMES

    def known_as(
        self, camera: Array, target: Array, uncertainty: tuple[float, float], mount_uncertainty: tuple[float, float]
    ) -> OneArmConfig:
        """The same with camera and target (4, 4) known to be there, to within these errors (m, rad)."""
        names = self.names
        nominal = OneArmNominalConfig(
            uncertainty=_uncertainty(*uncertainty),
            mount_uncertainty=_uncertainty(*mount_uncertainty),
            **{name: TransformConfig(matrix=T.tolist()) for name, T in zip(names, (camera, target), strict=True)},
        )
        return self.model_copy(update={"nominal": nominal})

    def as_two_arms(self) -> OneArmCell:
        """The cell with a stand without joints in the other arm's place.

        With the camera on the arm the stand's base is the arm's, and what is not known of the target is the error of
        that placement; with the target on the arm the stand's base is the camera.
        """
        on_arm, nominal, base = self.camera_on_arm, self.nominal, np.eye(4)
        arm_role, stand_role = ("active", "passive") if on_arm else ("passive", "active")
        arm: dict[str, Any] = {name: getattr(self.arm, name) for name in ArmConfig.model_fields}
        mounts = (None, _given(nominal.target)) if on_arm else (_given(nominal.target), None)
        uncertainty = nominal.uncertainty
        if on_arm:
            # A placement's error turns about the active base, far from the target: so the plate is let go everywhere
            # that it can come to by turning about itself.
            reach = float(np.linalg.norm(self.target.plate_outline, axis=1).max()) + PLATE_THICKNESS
            turned = 2 * np.sin(uncertainty.rotation / 2) * reach
            uncertainty = _uncertainty(uncertainty.translation + turned, 0.0)
        return OneArmCell.model_construct(
            name=self.name,
            backends=self.backends,
            robots={
                self.arm_name: RobotConfig.model_construct(role=arm_role, target_mount=mounts[0], **arm),
                STAND: RobotConfig.model_construct(role=stand_role, target_mount=mounts[1], **_NO_JOINTS),
            },
            camera=self.camera,
            target=self.target,
            nominal=NominalConfig.model_construct(
                uncertainty=uncertainty,
                active_base_in_passive_base=_given(base if on_arm else nominal.camera),
                camera_in_active_flange=_given(nominal.camera if on_arm else np.eye(4)),
            ),
            procedure=self._as_constraints(),
            floor_mm=self.floor_mm,
            fixtures={
                name: FixtureConfig.model_construct(base=f"{arm_role}_base", **dict(solid))
                for name, solid in self.fixtures.items()
            },
            session=self.session,
            one_arm=self,
        )

    def _as_constraints(self) -> ProcedureConfig:
        """Each view is a constraint of one position that is not aligned."""
        given = self.procedure
        return ProcedureConfig.model_construct(
            seed=given.seed,
            method="refined",
            constraints=given.views,
            positions=1,
            first_looks=given.first_looks,
            distance_mm=given.distance_mm,
            tilt_max_deg=given.tilt_max_deg,
            tolerance_px="auto",
            clearance_mm=given.clearance_mm,
            verification=VerificationConfig.model_construct(
                constraints=given.verification.views,
                positions=1,
                required_accuracy_mm=given.verification.required_accuracy_mm,
            ),
        )


_NO_JOINTS: dict[str, Any] = {
    "backend": "",
    "kinematics": KinematicsConfig.model_construct(dh=()),
    "limits_deg": (),
    "speed_deg_s": (),
    "acceleration_deg_s2": (),
    "home_deg": (),
    "encoder_sigma_mrad": 0.0,
    "joint_sigma_mrad": 0.0,
    "repeatability_mm": 0.0,
}


class OneArmCell(CellConfig):
    """A cell of one arm as one of two, of which one is a stand."""

    one_arm: OneArmConfig
    """As the cell file has it."""


class OneArmDocument(OneArmConfig):
    """A cell file for dualcal: one arm, with a camera that watches a target, or with a target that a camera watches."""

    simulation: OneArmSimulationConfig | None = None
    """The simulated world; a cell without a simulator has none."""

    @property
    def cell(self) -> OneArmCell:
        """The cell without its simulation."""
        fields = {name: getattr(self, name) for name in OneArmConfig.model_fields}
        return OneArmConfig.model_construct(**fields).as_two_arms()

    @property
    def world(self) -> SimulationConfig | None:
        """The simulation of the cell as one of two arms."""
        if self.simulation is None:
            return None
        given, base = self.simulation, np.eye(4)
        truth = given.truth
        world = {name: getattr(given, name) for name in SimulatedConfig.model_fields}
        return SimulationConfig.model_construct(
            truth=StandTruthConfig.model_construct(
                active_base_in_passive_base=_given(base if self.camera_on_arm else truth.camera),
                camera_in_active_flange=_given(truth.camera if self.camera_on_arm else np.eye(4)),
                kinematics=truth.kinematics,
                transforms=truth,
            ),
            **world,
        )


class StandTruthConfig(TruthConfig):
    """The truth of a cell with a stand."""

    transforms: OneArmTransforms
    """As the cell file has it."""

    def target_mount(self, cell: CellConfig) -> Array:
        return self.transforms.target


def _given(T: Array) -> TransformConfig:
    return TransformConfig(matrix=T.tolist())


def _uncertainty(translation: float, rotation: float) -> UncertaintyConfig:
    return UncertaintyConfig(translation_mm=1000 * translation, rotation_deg=float(np.degrees(rotation)))


# What one section says of another


def is_of_one_arm(document: Mapping[str, Any]) -> bool:
    """Whether a document, whose errors may be many, is that of a cell of one arm: a single one, which has no role."""
    robots = mapping(document.get("robots"))
    return len(robots) == 1 and all("role" not in mapping(robot) for robot in robots.values())


def one_arm_problems(document: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """As ``reference_problems`` of a cell of two arms."""
    robots, camera = mapping(document.get("robots")), mapping(document.get("camera"))
    yield from backend_problems(document)
    for name, what in ((STAND, "what the other arm's place is called"), (FIXED, "where a camera is that no arm has")):
        if name in robots:
            yield ("robots", name), f"must have another name: '{name}' is {what}"
    mount = camera.get("mount")
    if isinstance(mount, str) and mount != FIXED and mount not in robots:
        yield ("camera", "mount"), f"must be the arm ({named(robots)}) or {FIXED}, not '{mount}'"
    elif isinstance(mount, str):
        for section in (("nominal",), ("simulation", "truth")):
            yield from _transform_problems(section, document, on_arm=mount != FIXED)
    yield from simulated_only_problems(document, refined=True)
    yield from truth_problems(document, robots)


def _transform_problems(
    section: Location, document: Mapping[str, Any], *, on_arm: bool
) -> Iterator[tuple[Location, str]]:
    """What has to be told of camera and target, and what has not."""
    told: Any = document
    for key in section:
        told = mapping(told).get(str(key))
    if not isinstance(told, Mapping):
        return
    where = "is on the arm" if on_arm else "stands"
    for needed, other in zip(*((ON_ARM_NAMES, FIXED_NAMES) if on_arm else (FIXED_NAMES, ON_ARM_NAMES)), strict=True):
        if other in told:
            yield (*section, other), f"must be left out: the camera {where}, so it is {needed}"
        if needed not in told:
            yield (*section, needed), f"missing key: the camera {where}"
