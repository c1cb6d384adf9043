"""How a controller's joints relate to those of the arm's kinematics."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from dualcal_hal.config.values import AtLeast1, Number, Section
from dualcal_hal.transforms import Array


class Coupling(Section):
    """A controller's joint that another one takes along, as joint 3 by joint 2 on FANUC's and ABB's controllers."""

    joint: AtLeast1
    """The controller's joint that is changed, counted from 1."""
    from_joint: AtLeast1
    """The controller's joint whose angle is added to it, counted from 1."""
    factor: Number
    """How much of it is added: J3 += factor * J2."""


class JointMapConfig(Section):
    """From the joints of the kinematics to the controller's: order, then sign and offset, then coupling."""

    order: tuple[AtLeast1, ...] | None = None
    """For each joint of the controller the joint of the kinematics that it is, counted from 1; the same if left out."""
    sign: tuple[Annotated[Number, Field(ge=-1, le=1)], ...] | None = None
    """1 or -1 for each joint of the controller; all 1 where left out."""
    offset_deg: tuple[Number, ...] | None = None
    """What a joint of the controller shows where that of the kinematics is at zero, degrees; all 0 where left out."""
    coupling: tuple[Coupling, ...] = ()
    """Joints that take others along, one after the other."""

    @model_validator(mode="after")
    def _is_a_map(self) -> Self:
        if self.order is not None and sorted(self.order) != list(range(1, len(self.order) + 1)):
            raise ValueError(f"order must name each joint once, from 1 to {len(self.order)}, not {list(self.order)}")
        if self.sign is not None and not set(map(abs, self.sign)) <= {1.0}:
            raise ValueError(f"sign must be 1 or -1 for each joint, not {list(self.sign)}")
        for coupling in self.coupling:
            if coupling.joint == coupling.from_joint:
                raise ValueError(f"coupling: joint {coupling.joint} cannot take itself along")
        return self

    def problem(self, joints: int) -> str | None:
        """Why it is no map of an arm of so many joints, None if it is one."""
        for key in ("order", "sign", "offset_deg"):
            given = getattr(self, key)
            if given is not None and len(given) != joints:
                return f"{key} must have {joints} entries, one a joint, has {len(given)}"
        for coupling in self.coupling:
            if max(coupling.joint, coupling.from_joint) > joints:
                return f"coupling: there is no joint {max(coupling.joint, coupling.from_joint)}, only {joints}"
        return None


class JointMap:
    """c = C (S P q + o): q (..., n) in rad of the kinematics, c (..., n) in rad of the controller.

    P is the order, S the signs, o the offsets, and C what the couplings do one after the other.
    """

    def __init__(self, config: JointMapConfig | None, joints: int) -> None:
        """ValueError if it is no map of an arm of so many ``joints``."""
        config = config or JointMapConfig()
        if (why := config.problem(joints)) is not None:
            raise ValueError(why)
        order = np.array(config.order or range(1, joints + 1)) - 1
        sign = np.array(config.sign or [1.0] * joints)
        linear = sign[:, None] * np.eye(joints)[order]
        constant = np.radians(config.offset_deg or [0.0] * joints)
        for coupling in config.coupling:
            step = np.eye(joints)
            step[coupling.joint - 1, coupling.from_joint - 1] = coupling.factor
            linear, constant = step @ linear, step @ constant
        self._linear: Array = linear
        self._constant: Array = constant
        self._inverse: Array = np.linalg.inv(linear)

    def to_controller(self, q: Array) -> Array:
        """The controller's angles (..., n) in rad of those (..., n) of the kinematics."""
        return np.asarray(q @ self._linear.T + self._constant)

    def from_controller(self, c: Array) -> Array:
        """And back."""
        return np.asarray((c - self._constant) @ self._inverse.T)

    def velocity_to_controller(self, v: Array) -> Array:
        """Velocities (..., n), rad/s."""
        return np.asarray(v @ self._linear.T)

    def bound_to_controller(self, bound: Array) -> Array:
        """The most (n,) that the controller's joints come to where those of the kinematics keep below ``bound``."""
        return np.asarray(np.abs(self._linear) @ bound)

    def velocity_from_controller(self, v: Array) -> Array:
        """And back."""
        return np.asarray(v @ self._inverse.T)
