"""How simulated arms and mounts differ from what is known of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from backends.simulator.noise import Key, generator
from dualcal_hal.geometry import link_capsules
from dualcal_hal.kinematics import Chain, Row
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array, rotation_from_vector, transform

if TYPE_CHECKING:
    from dualcal_hal.config import RobotConfig
    from dualcal_hal.config.mechanical_errors import MechanicalErrorsConfig

_NO_MOVE = 1e-12  # rad


@dataclass(frozen=True, eq=False)
class Approach:
    """How an arm came to its rest, or is coming: what backlash and swinging links depend on.

    slack: (n,) rad by which each motor is ahead of its link; way: (n,) how far each joint goes in the last stretch, by
    the one that goes farthest; end: the time in s from which on its set points rest.
    """

    slack: Array
    way: Array
    end: float = 0.0

    @staticmethod
    def at_rest(joints: int) -> Approach:
        """An arm that has not moved yet."""
        return Approach(np.zeros(joints), np.zeros(joints))

    def then(self, way: Array, gap: float, end: float) -> Approach:
        """After a further stretch ``way`` (n,) in rad that ends at ``end``, with a gap in rad in the gears.

        A link stays where it is until its motor has crossed the gap (the play operator of hysteresis).
        """
        farthest = float(np.max(np.abs(way)))
        if farthest < _NO_MOVE:
            return self
        return Approach(np.clip(self.slack + way, -gap / 2, gap / 2), way / farthest, end)


class JointErrors:
    """How far one arm's links stand from what its encoders read."""

    def __init__(self, name: str, robot: RobotConfig, chain: Chain, errors: MechanicalErrorsConfig, seed: int) -> None:
        self._zero = errors.joint_zero.offset(name)
        self._eccentricity = errors.encoder_eccentricity.amplitude
        self._phase = generator(seed, name, "encoder_eccentricity").uniform(-np.pi, np.pi, chain.joints)
        self._weight = Weight(chain, robot.link_radius)
        self._sag = errors.compliance.sag
        self._settle = errors.settle_time

    def deviation(self, read: Array, approach: Approach, when: float) -> Array:
        """(n,) rad to add to the angles (n,) that ideal encoders read at time ``when`` in s."""
        read_wrongly = self._zero + self._eccentricity * np.sin(read + self._phase)
        transmitted = self._settle.swing(when - approach.end) * approach.way - approach.slack
        return np.asarray(read_wrongly + transmitted + self._sag * self._weight.torque(read))


class Weight:
    """What the weight of an arm's links does to its joints; its base stands upright.

    The links are as heavy as their capsules are voluminous.
    """

    def __init__(self, chain: Chain, radii: Array) -> None:
        self._chain = chain
        links = link_capsules(chain, radii)
        length = np.linalg.norm(links.ends[:, 1] - links.ends[:, 0], axis=1)
        self._frame, self._centre = links.frame, links.ends.mean(axis=1)
        self._carried = links.frame > np.arange(chain.joints)[:, None]
        self._mass = links.radius**2 * (length + 4 / 3 * links.radius)
        # Stretched out level, a link's lever about the shoulder is the length of all links up to its middle.
        beyond = self._carried[min(1, chain.joints - 1)]
        lever = np.cumsum(length * beyond) - length / 2
        self._mass /= np.sum(self._mass * lever * beyond) or 1.0

    def torque(self, q: Array) -> Array:
        """(n,) about the joints' axes at angles (n,) rad; 1 is the shoulder's with the arm stretched out level."""
        frames = self._chain.frames(q)
        at = frames[self._frame]
        centre = np.einsum("cij,cj->ci", at[:, :3, :3], self._centre) + at[:, :3, 3]
        axes, origins = frames[:-1, :3, 2], frames[:-1, :3, 3]
        lever = centre - origins[:, None]
        # axis . (lever x force), with the force straight down.
        about = axes[:, None, 1] * lever[..., 0] - axes[:, None, 0] * lever[..., 1]
        return np.asarray(np.sum(about * self._carried * self._mass, axis=1))


def true_chain(name: str, known: Chain, errors: MechanicalErrorsConfig, seed: int) -> Chain:
    """The chain of an arm as it is where ``known`` is what it should be."""
    angle, length, scale = errors.kinematics.angle, errors.kinematics.length, errors.arm_scale.factor
    drawn = generator(seed, name, "kinematics").standard_normal((known.joints, 5))
    rows = []
    for row, (theta, alpha, beta, d, a) in zip(known.rows, drawn.tolist(), strict=True):
        hayati = row.beta is not None
        rows.append(
            Row(
                theta=row.theta + angle * theta,
                d=scale * row.d if hayati else scale * (row.d + length * d),
                a=scale * (row.a + length * a),
                alpha=row.alpha + angle * alpha,
                beta=None if row.beta is None else row.beta + angle * beta,
            )
        )
    return Chain(tuple(rows))


def unseen_error(seed: int, arm: str, target: Joints, sigma: float) -> Array:
    """(n,) rad, of that standard deviation, by which an arm that was sent to ``target`` stands from what is read."""
    return np.asarray(sigma * generator(seed, arm, "joint error", *target).standard_normal(len(target)))


def directions(*key: Key) -> Array:
    """(2, 3): two unit vectors drawn for ``key``, evenly over the sphere."""
    drawn = generator(*key).standard_normal((2, 3))
    return np.asarray(drawn / np.linalg.norm(drawn, axis=1, keepdims=True))


def displacement(directions: Array, translation: float, rotation: float) -> Array:
    """(4, 4): a shift by ``translation`` m in the first of the directions (2, 3), a turn by ``rotation`` rad about the
    second."""
    along, about = directions
    return transform(rotation_from_vector(rotation * about), translation * along)
