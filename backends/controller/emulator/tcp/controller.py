"""A controller as its operator sees it: power, key switch, emergency stop, errors; and the arms that it moves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from backends.controller.emulator.tcp.packets import AUTO, JOINTS, MANUAL, OFF, ON, UNKNOWN, Status
from backends.controller.joint_map import JointMap
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.controller.emulator.arm import EmulatedArm
    from backends.controller.options import TcpArm

CONTACT, DRIVE_FAULT, SERVER_FAULT = 50056, 34252, 41595
"""Codes of an arm that touches something, of a drive's fault, and of a server that got what it cannot take."""


class ServedArm:
    """An emulated arm in the controller's own joints."""

    def __init__(self, arm: EmulatedArm, config: TcpArm) -> None:
        self.arm = arm
        self.name = arm.name
        self.map = JointMap(config.joint_map, arm.joints)

    def state(self) -> tuple[list[float], list[float]]:
        """Positions in rad and velocities in rad/s, as they are sent."""
        reading = self.arm.read()
        positions = self.map.to_controller(reading.positions)
        return positions.tolist(), self.map.velocity_to_controller(reading.velocities).tolist()

    def place(self, joints: tuple[float, ...]) -> Array:
        """(n,) rad of the kinematics, from a message's (10,)."""
        return self.map.from_controller(_values(joints, self.arm.joints))

    def velocity(self, joints: tuple[float, ...]) -> Array:
        """(n,) rad/s of the kinematics, from a message's (10,)."""
        return self.map.velocity_from_controller(_values(joints, self.arm.joints))


class Controller:
    """``arms``: by the groups that messages name. tells_mode: whether its status has mode and motion_possible.

    ready: whether a program is there that takes points.
    """

    def __init__(self, arms: Mapping[int, ServedArm], tells_mode: bool = True) -> None:
        self.arms = arms
        self._tells_mode = tells_mode
        self.powered = True
        self.e_stopped = False
        self.automatic = True
        self.ready = True
        self.error = 0

    @property
    def motion_possible(self) -> bool:
        """Whether it would carry out a motion."""
        return self.powered and self.automatic and self.ready and not self.e_stopped and not self.error

    @property
    def in_motion(self) -> bool:
        return any(served.arm.in_motion for served in self.arms.values())

    def status(self) -> Status:
        """What it says of itself."""
        told = self._tells_mode
        return Status(
            drives_powered=_tri(self.powered),
            e_stopped=_tri(self.e_stopped),
            error_code=self.error,
            in_error=_tri(self.error != 0),
            in_motion=_tri(self.in_motion),
            mode=(AUTO if self.automatic else MANUAL) if told else UNKNOWN,
            motion_possible=_tri(self.motion_possible) if told else UNKNOWN,
        )

    def fail(self, code: int) -> None:
        """It has an error: its arms stop, the drives' power is cut."""
        self.error = self.error or code
        self._stand_still()

    def press_e_stop(self) -> None:
        """Until :meth:`release_e_stop`."""
        self.e_stopped = True
        self._stand_still()

    def release_e_stop(self) -> None:
        """The power comes back, as where an operator has switched it on again."""
        self.e_stopped = False
        self.powered = True

    def turn_key(self, automatic: bool) -> None:
        """To manual its arms stop."""
        self.automatic = automatic
        if not automatic:
            self.halt()

    def reset(self) -> None:
        """Errors are acknowledged."""
        self.error = 0

    def halt(self) -> None:
        """All its arms brake."""
        for served in self.arms.values():
            served.arm.hold()

    def _stand_still(self) -> None:
        self.powered = False
        self.halt()


def _tri(known: bool) -> int:
    return ON if known else OFF


def _values(joints: tuple[float, ...], count: int) -> Array:
    assert len(joints) == JOINTS
    return np.array(joints[:count])
