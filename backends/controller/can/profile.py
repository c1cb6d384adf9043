"""A course's waypoints as set-points of drives that make their own way (profile position)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from backends.controller.can.axis import Axis
from backends.controller.can.motion import SetPointLead, proportioned
from backends.controller.can.sdo import SdoNode
from backends.controller.course import Course
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceTimeout
from dualcal_hal.robot import Joints

_VELOCITY, _ACCELERATION, _DECELERATION = 0x6081, 0x6083, 0x6084
_SLACK = 3.0  # times as long as a way should take, and a second


def follow_waypoints(
    device: str,
    course: Course,
    start: Sequence[float],
    lead: SetPointLead,
    axes: Sequence[Axis],
    sdo: Mapping[int, SdoNode],
    clock: Clock,
) -> None:
    """Waypoint after waypoint, with a rest at each, all joints arriving together; returns early where it is stopped.

    start: where the joints stand, rad. DeviceTimeout, CommandRefused, LinkLost.
    """
    before: Joints = tuple(start)
    for number, waypoint in enumerate(course.waypoints, start=1):
        way = np.array(waypoint) - np.array(before)
        velocity, acceleration = proportioned(way, course.speed, course.acceleration)
        for axis, v, a in zip(axes, velocity.tolist(), acceleration.tolist(), strict=True):
            if lead.is_over:
                return
            _set_profile(sdo[axis.node], v * axis.scale.counts_per_rad, a * axis.scale.counts_per_rad)
        targets = [axis.scale.to_counts(angle) for axis, angle in zip(axes, waypoint, strict=True)]
        lead.go(targets, is_last=number == len(course.waypoints))
        lasts = _duration(way, course)
        if not clock.wait(lead.wake, clock.now() + _SLACK * lasts + 1.0):
            away = [a.name for a, target in zip(axes, targets, strict=True) if not lead.has_arrived(a, target)]
            why = f"not at waypoint {number} in time: {', '.join(away)}"
            raise DeviceTimeout(device, "move", why, "see the drive")
        before = waypoint


def _set_profile(sdo: SdoNode, velocity: float, acceleration: float) -> None:
    """Both in counts; rounded down, so that no bound is passed, but never to nothing."""
    sdo.write(_VELOCITY, 0, max(1, math.floor(velocity)), 4)
    for index in (_ACCELERATION, _DECELERATION):
        sdo.write(index, 0, max(1, math.floor(acceleration)), 4)


def _duration(way: np.ndarray, course: Course) -> float:
    """s from rest to rest."""
    velocity, acceleration = proportioned(way, course.speed, course.acceleration)
    moving = velocity > 0.0
    if not moving.any():
        return 0.0
    joint = int(np.argmax(moving))
    return float(abs(way[joint]) / velocity[joint] + velocity[joint] / acceleration[joint])
