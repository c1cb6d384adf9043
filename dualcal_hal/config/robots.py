"""The arms."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from dualcal_hal.config.values import NotNegative, Number, Positive, Range, Section, TransformConfig
from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.transforms import Array

LIMIT_MARGIN_DEG = 3.0
"""How far a procedure stays inside the limits of each joint where the cell file does not say, degrees."""


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


class RowSigma(Section):
    """How exact the rows of an arm's kinematics are: 1 sigma of each parameter."""

    length_mm: NotNegative = 0.0
    """Of each a and d, mm."""
    angle_deg: NotNegative = 0.0
    """Of each alpha and beta, degrees."""


class TransformSigma(Section):
    """How exact a transform is: 1 sigma in each axis."""

    translation_mm: NotNegative = 0.0
    """Of the translation along each axis, mm."""
    rotation_deg: NotNegative = 0.0
    """Of the rotation about each axis, degrees."""


class KinematicsConfig(Section):
    """An arm's calibrated kinematics."""

    dh: Annotated[tuple[DhRow, ...], Field(min_length=1)]
    """One row a joint, from base to flange."""
    joint_zero_sigma_deg: tuple[NotNegative, ...] | None = None
    """How exact the zero of each joint is, 1 sigma, degrees; exact where left out."""
    dh_sigma: RowSigma | None = None
    """How exact the other parameters of all rows are; exact where left out."""

    @field_validator("joint_zero_sigma_deg")
    @classmethod
    def _one_entry_a_joint(cls, value: tuple[float, ...] | None, info: ValidationInfo) -> Any:
        rows = info.data.get("dh")
        if value is not None and rows is not None and len(value) != len(rows):
            raise ValueError(f"must have {len(rows)} entries, one a joint, has {len(value)}")
        return value

    @cached_property
    def chain(self) -> Chain:
        return Chain(tuple(row.row for row in self.dh))


class ArmConfig(Section):
    """The arm of a cell that has one. Lists have one entry a joint."""

    backend: str
    """The entry under backends that moves it."""
    kinematics: KinematicsConfig
    """Calibrated before; taken as true by the method."""
    limits_deg: tuple[Range, ...]
    """Lower and upper limit of each joint, degrees."""
    limit_margin_deg: tuple[NotNegative, ...] | None = None
    """How far a procedure stays inside the limits of each joint, for cables and hoses, degrees; where left out 3."""
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

    @field_validator(
        "limits_deg", "limit_margin_deg", "speed_deg_s", "acceleration_deg_s2", "home_deg", "link_radius_mm"
    )
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
        margins = info.data.get("limit_margin_deg") or [LIMIT_MARGIN_DEG] * len(limits)
        outside = []
        for joint, (angle, (lower, upper), margin) in enumerate(zip(value, limits, margins, strict=False), start=1):
            if not lower <= angle <= upper:
                outside.append(f"joint {joint}: {angle:g} is outside {lower:g} to {upper:g}")
            elif not lower + margin <= angle <= upper - margin:
                outside.append(
                    f"joint {joint}: {angle:g} is less than limit_margin_deg, {margin:g}, inside {lower:g} to {upper:g}"
                )
        if outside:
            raise ValueError("; ".join(outside))
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
    def limit_margin(self) -> Array:
        """(n,) rad."""
        return np.radians(self.limit_margin_deg or [LIMIT_MARGIN_DEG] * len(self.limits_deg))

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


class RobotConfig(ArmConfig):
    """One arm. Lists have one entry a joint."""

    role: Literal["active", "passive"]
    """The active arm carries the camera, the passive arm the target."""
    target_mount: TransformConfig | None = Field(default=None, validate_default=True)
    """Target in the passive flange; the passive arm's alone."""
    target_mount_sigma: TransformSigma | None = None
    """How exact target_mount is; exact where left out."""

    @field_validator("target_mount")
    @classmethod
    def _passive_arm_has_mount(cls, value: TransformConfig | None, info: ValidationInfo) -> Any:
        role = info.data.get("role")
        if role == "passive" and value is None:
            raise ValueError("missing key: the passive arm carries the target")
        if role == "active" and value is not None:
            raise ValueError("must be left out: the active arm carries the camera")
        return value

    @field_validator("target_mount_sigma")
    @classmethod
    def _of_a_mount(cls, value: TransformSigma | None, info: ValidationInfo) -> Any:
        if value is not None and info.data.get("role") == "active":
            raise ValueError("must be left out: the active arm carries the camera")
        return value

    @property
    def target_mount_transform(self) -> Array:
        """T_F_T (4, 4) of the passive arm; ValueError on the active one."""
        if self.target_mount is None:
            raise ValueError("the active arm carries no target")
        return self.target_mount.T
