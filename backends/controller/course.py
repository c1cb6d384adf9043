"""What an arm is to do, in the controller's own joints, as a function of time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from backends.controller.joint_map import JointMap
from dualcal_hal.robot import JointPath, Joints
from dualcal_hal.trajectory import Trajectory
from dualcal_hal.transforms import Array


class Course:
    """A path of straight segments with a rest at each waypoint, by trapezoids of velocity.

    duration: s. start, waypoints: the controller's joints, rad; arrivals: when each waypoint is reached, s since the
    begin. speed, acceleration: (n,) the largest that each of the controller's joints comes to, rad/s and rad/s^2.
    """

    def __init__(self, start: Array, path: JointPath, joint_map: JointMap) -> None:
        """``start`` (n,) rad and ``path`` are in the joints of the kinematics."""
        self._map = joint_map
        self._acceleration = np.array(path.acceleration)
        self._trajectory = Trajectory(start, self._acceleration)
        self._trajectory.follow(path, 0.0)
        self.duration = self._trajectory.end
        self.arrivals = self._trajectory.arrivals
        self.start: Joints = _joints(joint_map.to_controller(start))
        self.waypoints: tuple[Joints, ...] = tuple(
            _joints(joint_map.to_controller(np.array(w))) for w in path.waypoints
        )
        self.speed = joint_map.bound_to_controller(np.array(path.speed))
        self.acceleration = joint_map.bound_to_controller(self._acceleration)

    def sample(self, t: float) -> tuple[Array, Array]:
        """Where the joints (n,) are to be ``t`` s after the begin, rad, and their velocities (n,), rad/s."""
        q, velocity = self._trajectory.sample(t)
        return self._map.to_controller(q), self._map.velocity_to_controller(velocity)

    def brake(self, t: float) -> float:
        """Leave it ``t`` s after the begin: come to rest on the path as fast as the arm can; returns when it rests."""
        self._trajectory.brake(t)
        self.duration = self._trajectory.end
        return self.duration

    def times(self, longest: float) -> Iterator[float]:
        """Times at which to cut it into pieces of at most ``longest`` s: each waypoint's arrival is one of them."""
        before = 0.0
        for arrival in self.arrivals:
            pieces = int(np.ceil((arrival - before) / longest - 1e-9))
            for piece in range(1, pieces):
                yield before + (arrival - before) * piece / pieces
            if pieces:
                yield arrival
            before = arrival


def _joints(values: Array) -> Joints:
    return tuple(values.tolist())
