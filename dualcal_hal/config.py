"""What a cell file says, as checked and frozen models.

Fields are named as in the file, unit included; properties without suffix give SI and radians. A section
forbids keys it does not know and numbers that are not finite.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
    model_validator,
)

from dualcal_hal import registry
from dualcal_hal.camera import Intrinsics
from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import (
    Array,
    is_rotation,
    nearest_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    transform,
)

METHODS = ("paper",)
"""The estimators a cell file may name."""

Location = tuple[str | int, ...]
"""The keys and list indices that lead to a value of the file."""

Number = Annotated[float, Strict()]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]


def _whole(value: Any) -> Any:
    return int(value) if isinstance(value, float) and value.is_integer() else value


# The bound comes before the validator: behind it, pydantic would write it into the schema by a wrong name.
Natural = Annotated[int, Strict(), Field(ge=0), BeforeValidator(_whole)]
AtLeast1 = Annotated[int, Strict(), Field(ge=1), BeforeValidator(_whole)]
AtLeast3 = Annotated[int, Strict(), Field(ge=3), BeforeValidator(_whole)]
Vector = tuple[Number, Number, Number]
Vector4 = tuple[Number, Number, Number, Number]
Matrix3 = tuple[Vector, Vector, Vector]
Matrix4 = tuple[Vector4, Vector4, Vector4, Vector4]


class Section(BaseModel):
    """A mapping of the cell file."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


# Values


def _ascending(pair: tuple[float, float]) -> tuple[float, float]:
    if not pair[0] < pair[1]:
        raise ValueError(f"the lower value {pair[0]:g} must be below the upper one {pair[1]:g}")
    return pair


Range = Annotated[tuple[Number, Number], AfterValidator(_ascending)]


def _rotation(matrix: Matrix3) -> Matrix3:
    _require_rotation(np.array(matrix))
    return matrix


def _rigid(matrix: Matrix4) -> Matrix4:
    _require_rotation(np.array(matrix)[:3, :3])
    if matrix[3] != (0.0, 0.0, 0.0, 1.0):
        raise ValueError("is no rigid transform: its last row must be 0 0 0 1")
    return matrix


def _require_rotation(R: Array) -> None:
    if not is_rotation(R):
        raise ValueError("is no rotation: its columns must be orthonormal and right-handed to 1e-6")


def _unit(quaternion: Vector4) -> Vector4:
    if abs(np.linalg.norm(quaternion) - 1.0) > 1e-6:
        raise ValueError("is no rotation: a quaternion must have length 1 to 1e-6")
    return quaternion


def _camera_matrix(matrix: Matrix3) -> Matrix3:
    (fx, skew, _), (below_fx, fy, _), last = matrix
    if fx <= 0 or fy <= 0 or skew != 0 or below_fx != 0 or last != (0.0, 0.0, 1.0):
        raise ValueError("is no camera matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0")
    return matrix


def _number_or_auto(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    # The union's own errors would name a branch for each alternative.
    try:
        return handler(value)
    except ValidationError:
        raise ValueError(f"must be a number greater than 0, or auto, not {value!r}") from None


Tolerance = Annotated[Positive | Literal["auto"], WrapValidator(_number_or_auto)]


class TransformConfig(Section):
    """A rigid transform: `translation_mm` and one form of rotation, or `matrix` alone."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {"required": ["translation_mm", "rotation_vector_deg"]},
                {"required": ["translation_mm", "quaternion_xyzw"]},
                {"required": ["translation_mm", "rotation_matrix"]},
                {"required": ["matrix"]},
            ]
        }
    )

    translation_mm: Vector | None = None
    """Origin of the one frame in the other, mm."""
    rotation_vector_deg: Vector | None = None
    """Axis times angle, degrees."""
    quaternion_xyzw: Annotated[Vector4, AfterValidator(_unit)] | None = None
    """Unit quaternion (x, y, z, w)."""
    rotation_matrix: Annotated[Matrix3, AfterValidator(_rotation)] | None = None
    """Three rows of the rotation matrix."""
    matrix: Annotated[Matrix4, AfterValidator(_rigid)] | None = None
    """Four rows of the homogeneous matrix, translation in m, as in result.json."""

    @model_validator(mode="after")
    def _has_one_form(self) -> Self:
        rotations = [self.rotation_vector_deg, self.quaternion_xyzw, self.rotation_matrix]
        given = sum(rotation is not None for rotation in rotations)
        one_form = given == 1 and self.translation_mm is not None
        if self.matrix is not None:
            one_form = given == 0 and self.translation_mm is None
        if not one_form:
            raise ValueError(
                "must have translation_mm and one of rotation_vector_deg, quaternion_xyzw, "
                "rotation_matrix; or matrix alone"
            )
        return self

    @property
    def T(self) -> Array:
        """(4, 4), m; its rotation is the nearest exact one."""
        if self.matrix is not None:
            matrix = np.array(self.matrix)
            return transform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])
        return transform(self._R, np.array(self.translation_mm) / 1000)

    @property
    def _R(self) -> Array:
        if self.rotation_vector_deg is not None:
            return rotation_from_vector(np.radians(self.rotation_vector_deg))
        if self.quaternion_xyzw is not None:
            return rotation_from_quaternion(self.quaternion_xyzw)
        return nearest_rotation(np.array(self.rotation_matrix))


# Sections


class BackendEntry(BaseModel):
    """A backend and its options, which are those of its type."""

    model_config = ConfigDict(extra="allow", frozen=True, use_attribute_docstrings=True)

    type: str
    """The backend's registered name, for instance simulator."""

    @field_validator("type")
    @classmethod
    def _is_registered(cls, value: str) -> str:
        if value not in registry.backend_names():
            raise ValueError(f"unknown backend '{value}'; there are: {', '.join(registry.backend_names())}")
        return value

    @model_validator(mode="after")
    def _options_fit(self) -> Self:
        try:
            backend = registry.backend_class(self.type)
        except ImportError as error:
            raise ValueError(f"backend '{self.type}' cannot be imported: {error}") from error
        backend.Options.model_validate(self.options)
        return self

    @property
    def options(self) -> dict[str, Any]:
        """The entry without its type, as written."""
        return dict(self.model_extra or {})


class DhRow(Section):
    """One joint: Rz(theta + q) Tz(d) Tx(a) Rx(alpha); with beta Rz(theta + q) Tx(a) Rx(alpha) Ry(beta)."""

    theta_deg: Number
    """Offset of the joint angle, degrees."""
    a_mm: Number
    """Link length, mm."""
    alpha_deg: Number
    """Link twist, degrees."""
    beta_deg: Number | None = None
    """Hayati's rotation about y, degrees; such a row has no d_mm."""
    d_mm: Number | None = Field(default=None, validate_default=True)
    """Link offset, mm; left out in a row with beta_deg."""

    @field_validator("d_mm")
    @classmethod
    def _d_or_beta(cls, value: float | None, info: ValidationInfo) -> float | None:
        if "beta_deg" not in info.data:  # a wrong beta is reported by itself
            return value
        hayati = info.data["beta_deg"] is not None
        if value is None and not hayati:
            raise ValueError("missing key; only a row with beta_deg goes without")
        if value and hayati:
            raise ValueError("must be left out: a row with beta_deg has no d_mm")
        return value

    @property
    def row(self) -> Row:
        """The row in m and rad."""
        theta, alpha = (float(np.radians(angle)) for angle in (self.theta_deg, self.alpha_deg))
        beta = None if self.beta_deg is None else float(np.radians(self.beta_deg))
        return Row(theta, (self.d_mm or 0.0) / 1000, self.a_mm / 1000, alpha, beta)


class KinematicsConfig(Section):
    """An arm's calibrated kinematics."""

    dh: Annotated[tuple[DhRow, ...], Field(min_length=1)]
    """One row a joint, from base to flange."""

    @cached_property
    def chain(self) -> Chain:
        return Chain(tuple(row.row for row in self.dh))


class RobotConfig(Section):
    """One arm. Lists have one entry a joint."""

    backend: str
    """The entry under backends that moves it."""
    role: Literal["active", "passive"]
    """The active arm carries the camera, the passive arm the target."""
    kinematics: KinematicsConfig
    """Calibrated before; taken as true by the method."""
    limits_deg: tuple[Range, ...]
    """Lower and upper limit of each joint, degrees."""
    speed_deg_s: tuple[Positive, ...]
    """Highest speed of each joint, degrees per second."""
    acceleration_deg_s2: tuple[Positive, ...]
    """Highest acceleration of each joint, degrees per second squared."""
    home_deg: tuple[Number, ...]
    """Where a run begins and ends, degrees."""
    encoder_sigma_mrad: NotNegative
    """Standard deviation of one reading of a joint, mrad."""
    joint_sigma_mrad: NotNegative
    """Standard deviation of a joint's error after arriving, which its encoder does not show, mrad."""
    repeatability_mm: NotNegative
    """The maker's repeatability, mm; only warned with."""
    link_radius_mm: tuple[Positive, ...] | None = None
    """Radius of the capsule about each link, mm; where left out 55 for the first three and 45 for the wrist's."""
    target_mount: TransformConfig | None = Field(default=None, validate_default=True)
    """Target in the passive flange; the passive arm's alone."""

    @field_validator("limits_deg", "speed_deg_s", "acceleration_deg_s2", "home_deg", "link_radius_mm")
    @classmethod
    def _one_entry_a_joint(cls, value: tuple[Any, ...] | None, info: ValidationInfo) -> Any:
        kinematics = info.data.get("kinematics")
        if value is not None and kinematics is not None and len(value) != len(kinematics.dh):
            raise ValueError(f"must have {len(kinematics.dh)} entries, one a joint, has {len(value)}")
        return value

    @field_validator("home_deg")
    @classmethod
    def _home_within_limits(cls, value: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        limits = info.data.get("limits_deg", ())
        outside = [
            f"joint {joint}: {angle:g} is outside {lower:g} to {upper:g}"
            for joint, (angle, (lower, upper)) in enumerate(zip(value, limits, strict=False), start=1)
            if not lower <= angle <= upper
        ]
        if outside:
            raise ValueError("; ".join(outside))
        return value

    @field_validator("target_mount")
    @classmethod
    def _passive_arm_has_mount(cls, value: TransformConfig | None, info: ValidationInfo) -> Any:
        role = info.data.get("role")
        if role == "passive" and value is None:
            raise ValueError("missing key: the passive arm carries the target")
        if role == "active" and value is not None:
            raise ValueError("must be left out: the active arm carries the camera")
        return value

    @property
    def chain(self) -> Chain:
        return self.kinematics.chain

    @property
    def lower(self) -> Array:
        """(n,) rad."""
        return np.radians([limits[0] for limits in self.limits_deg])

    @property
    def upper(self) -> Array:
        """(n,) rad."""
        return np.radians([limits[1] for limits in self.limits_deg])

    @property
    def speed(self) -> Array:
        """(n,) rad/s."""
        return np.radians(self.speed_deg_s)

    @property
    def acceleration(self) -> Array:
        """(n,) rad/s^2."""
        return np.radians(self.acceleration_deg_s2)

    @property
    def home(self) -> Array:
        """(n,) rad."""
        return np.radians(self.home_deg)

    @property
    def encoder_sigma(self) -> float:
        """Radians."""
        return self.encoder_sigma_mrad / 1000

    @property
    def joint_sigma(self) -> float:
        """Radians."""
        return self.joint_sigma_mrad / 1000

    @property
    def repeatability(self) -> float:
        """Metres."""
        return self.repeatability_mm / 1000

    @property
    def link_radius(self) -> Array:
        """(n,) m."""
        joints = len(self.kinematics.dh)
        return np.array(self.link_radius_mm or [55.0 if i < 3 else 45.0 for i in range(joints)]) / 1000

    @property
    def target_mount_transform(self) -> Array:
        """T_F_T (4, 4) of the passive arm; ValueError on the active one."""
        if self.target_mount is None:
            raise ValueError("the active arm carries no target")
        return self.target_mount.T


class CameraBody(Section):
    """A capsule about the camera's optical axis, for clearance."""

    radius_mm: Positive = 35.0
    """Radius, mm."""
    length_mm: NotNegative = 20.0
    """Length between the centres of its ends, mm."""


class CameraConfig(Section):
    """The camera on the active arm, calibrated before."""

    backend: str
    """The entry under backends that grabs its frames."""
    mount: str
    """The arm that carries it: the active one."""
    matrix: Annotated[Matrix3, AfterValidator(_camera_matrix)]
    """[[fx, 0, cx], [0, fy, cy], [0, 0, 1]], px; pixel centres are integers."""
    distortion: tuple[Number, Number, Number, Number, Number]
    """OpenCV's k1, k2, p1, p2, k3."""
    size_px: tuple[AtLeast1, AtLeast1]
    """Width and height, px."""
    sigma_px: NotNegative
    """Standard deviation of a detected corner in each axis, px."""
    body: CameraBody = CameraBody()
    """Its housing."""

    @property
    def intrinsics(self) -> Intrinsics:
        return Intrinsics(np.array(self.matrix), np.array(self.distortion), self.size_px)

    @property
    def body_radius(self) -> float:
        """Metres."""
        return self.body.radius_mm / 1000

    @property
    def body_length(self) -> float:
        """Metres."""
        return self.body.length_mm / 1000


class TargetConfig(Section):
    """The checkerboard on the passive arm."""

    kind: Literal["checkerboard"]
    """The pattern."""
    corners: tuple[AtLeast3, AtLeast3]
    """Rows and columns of inner corners, at least 3 each: with fewer no detector works."""
    square_mm: Positive
    """Side of a square, mm."""
    feature_corner: tuple[Natural, Natural] | None = Field(default=None, validate_default=True)
    """Row and column of the feature point, from 0; the middlemost corner where left out and there is one."""
    margin_mm: NotNegative = 10.0
    """Width of the plate beyond the outer squares, mm."""

    @field_validator("feature_corner")
    @classmethod
    def _is_on_board(cls, value: tuple[int, int] | None, info: ValidationInfo) -> Any:
        corners = info.data.get("corners")
        if corners is None:
            return value
        rows, columns = corners
        if value is None and (rows % 2 == 0 or columns % 2 == 0):
            raise ValueError(f"missing key: {rows} x {columns} corners have no middlemost one")
        if value is not None and (value[0] >= rows or value[1] >= columns):
            raise ValueError(f"is outside rows 0 to {rows - 1} and columns 0 to {columns - 1}")
        return value

    @property
    def board(self) -> Checkerboard:
        rows, columns = self.corners
        row, column = self.feature_corner or (rows // 2, columns // 2)
        return Checkerboard(rows, columns, self.square_mm / 1000, row * columns + column)

    @property
    def margin(self) -> float:
        """Metres."""
        return self.margin_mm / 1000


class NominalConfig(Section):
    """What the operator knows before the calibration."""

    active_base_in_passive_base: TransformConfig
    """T_P_A."""
    camera_in_active_flange: TransformConfig
    """T_H_E; the camera's frame has z out of the lens, x right, y down."""

    @property
    def T_P_A(self) -> Array:
        """(4, 4), m."""
        return self.active_base_in_passive_base.T

    @property
    def T_H_E(self) -> Array:
        """(4, 4), m."""
        return self.camera_in_active_flange.T


class VerificationConfig(Section):
    """The poses that prove the result; the estimate does not use them."""

    constraints: Natural
    """How many directions of the optical axis; 0 leaves the result unverified."""
    positions: AtLeast1
    """How many positions of the feature point on each axis."""
    limit_mm: Positive
    """Largest mean mismatch that passes, mm."""

    @property
    def limit(self) -> float:
        """Metres."""
        return self.limit_mm / 1000


def _known_method(value: str) -> str:
    if value not in METHODS:
        raise ValueError(f"unknown method '{value}'; there are: {', '.join(METHODS)}")
    return value


def _none_or_three(value: int) -> int:
    if value not in (0, *range(3, value + 1)):
        raise ValueError(f"must be 0 or at least 3, not {value}")
    return value


def _above_zero(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] <= 0:
        raise ValueError(f"must be greater than 0, not {value[0]:g}")
    return value


class ProcedureConfig(Section):
    """How poses are chosen, aligned and estimated from."""

    seed: Natural
    """Of the choice of poses."""
    method: Annotated[str, AfterValidator(_known_method), Field(json_schema_extra={"enum": list(METHODS)})]
    """The estimator."""
    constraints: AtLeast3
    """How many directions of the optical axis."""
    positions: AtLeast3
    """How many positions of the feature point on each axis."""
    first_looks: Annotated[Natural, AfterValidator(_none_or_three)] = 5
    """How many images to plan from, at least 3; 0 plans from the nominal transforms."""
    distance_mm: Annotated[Range, AfterValidator(_above_zero)]
    """Smallest and largest distance between camera and feature point, mm."""
    tilt_max_deg: Annotated[Number, Field(gt=0, lt=90)]
    """Largest angle between the target's normal and the optical axis, degrees."""
    tolerance_px: Tolerance
    """Largest offset of an aligned feature point in each axis, px; auto follows the scatter of arrivals."""
    clearance_mm: NotNegative = 20.0
    """Smallest distance kept between arms, camera, target and floor, mm."""
    verification: VerificationConfig
    """The proof."""

    @property
    def distance(self) -> tuple[float, float]:
        """Metres."""
        return self.distance_mm[0] / 1000, self.distance_mm[1] / 1000

    @property
    def tilt_max(self) -> float:
        """Radians."""
        return float(np.radians(self.tilt_max_deg))

    @property
    def clearance(self) -> float:
        """Metres."""
        return self.clearance_mm / 1000


class TruthConfig(NominalConfig):
    """The simulated cell as it is."""

    kinematics: dict[str, KinematicsConfig] = {}
    """The true kinematics of an arm, by its name; the cell's own where left out."""

    def chains(self, cell: CellConfig) -> dict[str, Chain]:
        """The true chain of each arm of the cell."""
        return {name: self.kinematics.get(name, arm.kinematics).chain for name, arm in cell.robots.items()}


class NoiseConfig(Section):
    """Standard deviations of the simulated errors."""

    joint_mrad: NotNegative = 0.03
    """Error of a joint for each commanded target, which its encoder does not show, mrad."""
    encoder_mrad: NotNegative = 0.005
    """Error of a reading of a joint, mrad."""
    image_grey: NotNegative = 2.0
    """Noise of a pixel, grey levels of 255."""
    blur_px: NotNegative = 0.6
    """Sigma of the lens's blur, px."""

    @property
    def joint(self) -> float:
        """Radians."""
        return self.joint_mrad / 1000

    @property
    def encoder(self) -> float:
        """Radians."""
        return self.encoder_mrad / 1000


class SimulationConfig(Section):
    """The simulated world; neither plan nor estimate may see it."""

    seed: Natural
    """Of the noise."""
    stepper: Literal["kinematic"]
    """What moves the simulated arms."""
    truth: TruthConfig
    """The cell as it is."""
    noise: NoiseConfig = NoiseConfig()
    """What disturbs it."""


class CellConfig(Section):
    """Two arms facing each other, and what is to be done with them."""

    name: Annotated[str, Field(pattern=r"^[^\s./\\:*?\"<>|][^/\\:*?\"<>|\x00-\x1f]*$")]
    """Names the session's folder: no separators, none of : * ? " < > |, no dot or space first."""
    backends: dict[str, BackendEntry]
    """What the devices are reached through, by a name of your own."""
    robots: dict[str, RobotConfig]
    """The two arms, by a name of your own."""
    camera: CameraConfig
    target: TargetConfig
    nominal: NominalConfig
    procedure: ProcedureConfig
    floor_mm: Number | None = 0.0
    """Height of the floor in each arm's base frame, mm; null for none."""

    @property
    def floor(self) -> float | None:
        """Metres, or None."""
        return None if self.floor_mm is None else self.floor_mm / 1000

    @property
    def active_name(self) -> str:
        return self._name_by_role("active")

    @property
    def passive_name(self) -> str:
        return self._name_by_role("passive")

    @property
    def active(self) -> RobotConfig:
        return self.robots[self.active_name]

    @property
    def passive(self) -> RobotConfig:
        return self.robots[self.passive_name]

    def _name_by_role(self, role: str) -> str:
        return next(name for name, robot in self.robots.items() if robot.role == role)


class CellDocument(CellConfig):
    """A cell file for dualcal: two arms facing each other, one with a camera, one with a checkerboard."""

    simulation: SimulationConfig | None = None
    """The simulated world; a cell without a simulator has none."""

    @property
    def cell(self) -> CellConfig:
        """The cell without its simulation."""
        return CellConfig.model_construct(**{name: getattr(self, name) for name in CellConfig.model_fields})


# Names that must be found in another section


def reference_problems(document: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """Names in one section that another does not have, in a document whose other errors may still be many."""
    backends, robots = _mapping(document.get("backends")), _mapping(document.get("robots"))
    camera = _mapping(document.get("camera"))
    devices: dict[Location, Any] = {("robots", name): robot for name, robot in robots.items()}
    for location, device in {**devices, ("camera",): camera}.items():
        backend = _mapping(device).get("backend")
        if isinstance(backend, str) and backend not in backends:
            yield (*location, "backend"), f"no backend '{backend}' in this file; there are: {_names(backends)}"
    if isinstance(document.get("robots"), Mapping) and len(robots) != 2:
        yield ("robots",), f"must be two arms, one active and one passive, not {len(robots)}"
    yield from _role_problems(robots, camera.get("mount"))
    yield from _truth_problems(document, robots)


def _role_problems(robots: Mapping[str, Any], mount: Any) -> Iterator[tuple[Location, str]]:
    roles = {name: _mapping(robot).get("role") for name, robot in robots.items()}
    for role in ("active", "passive"):
        names = [name for name in roles if roles[name] == role]
        for name in names[1:]:
            yield ("robots", name, "role"), f"'{names[0]}' is the {role} arm already"
    if isinstance(mount, str) and roles and roles.get(mount) != "active":
        active = [name for name, role in roles.items() if role == "active"]
        yield ("camera", "mount"), f"must be the active arm ({_names(active)}), not '{mount}'"


def _truth_problems(document: Mapping[str, Any], robots: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    truth = _mapping(_mapping(document.get("simulation")).get("truth"))
    for name, kinematics in _mapping(truth.get("kinematics")).items():
        location: Location = ("simulation", "truth", "kinematics", name)
        if name not in robots:
            yield location, f"no arm of that name; there are: {_names(robots)}"
            continue
        rows = _mapping(kinematics).get("dh")
        own = _mapping(_mapping(robots[name]).get("kinematics")).get("dh")
        if isinstance(rows, list) and isinstance(own, list) and len(rows) != len(own):
            yield (*location, "dh"), f"must have {len(own)} entries, as the arm's own, has {len(rows)}"


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _names(names: Any) -> str:
    return ", ".join(names) or "none"
