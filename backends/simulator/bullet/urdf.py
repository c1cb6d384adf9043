"""An arm as URDF, the format in which PyBullet takes one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from backends.simulator.bullet.solids import Solid, ball, capsule, numbers
from dualcal_hal.geometry import Capsules, link_capsules
from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, apply, rotation_from_vector, transform

_SECOND = ", second part"
_STAND = 0.02  # m, the radius of what a stand weighs as
_FREE = {"lower": "-100", "upper": "100", "effort": "1e4", "velocity": "100"}  # others mind the limits


@dataclass(frozen=True, eq=False)
class Tool:
    """What is on the flange: a ``solid`` in a frame that stands at ``T`` (4, 4) in the flange's."""

    name: str
    T: Array
    solid: Solid


def link_name(frame: int) -> str:
    """Of the link that moves with a frame of the chain."""
    return "base" if frame == 0 else f"link {frame}"


def part_names(capsules: Capsules) -> list[str]:
    """Of an arm's capsules: a second one on a link is a link of its own, fixed to the first."""
    frames = capsules.frame.tolist()
    return [link_name(frame) + (_SECOND if frame in frames[:i] else "") for i, frame in enumerate(frames)]


def arm_urdf(chain: Chain, radii: Array, tool: Tool) -> str:
    """An arm on its base with its tool, its links capsules of the given radii (n,) in m.

    A link's frame is the joint's, turned: what follows the turn in a Denavit-Hartenberg row is the next joint's origin.
    Each capsule is a part of its own: of two on one link one may touch a neighbour by its make, and the other may not.
    """
    names = [*(link_name(frame) for frame in range(chain.joints + 1)), tool.name]
    after = [np.eye(4), *(row.after_joint() for row in chain.rows)]
    robot = ElementTree.Element("robot", name="arm")
    for name, solids in zip(names, [*_links(chain, radii, after), [tool.solid]], strict=True):
        # A link without length is a joint's housing: it weighs something, and its neighbours' round ends cover it.
        link = _add_link(robot, name, solids[0] if solids else ball(float(radii.min()) if len(radii) else _STAND))
        if solids:
            _add_shape(link, solids[0])
        for second in solids[1:]:
            _add_shape(_add_link(robot, name + _SECOND, second), second)
            _add_joint(robot, "fixed", name, name + _SECOND, np.eye(4))
    for row, T, (parent, child) in zip(chain.rows, after, itertools.pairwise(names), strict=False):
        joint = _add_joint(robot, "revolute", parent, child, T @ _turned(row.theta))
        ElementTree.SubElement(joint, "axis", xyz="0 0 1")
        ElementTree.SubElement(joint, "limit", _FREE)
    _add_joint(robot, "fixed", names[-2], names[-1], after[-1] @ tool.T)
    ElementTree.indent(robot)  # PyBullet breaks lines of more than 1023 characters, within numbers as well
    return ElementTree.tostring(robot, encoding="unicode")


def _links(chain: Chain, radii: Array, after: Sequence[Array]) -> list[list[Solid]]:
    """The solids of base and links, each in its link's frame."""
    links: list[list[Solid]] = [[] for _ in after]
    capsules = link_capsules(chain, radii)
    for frame, ends, radius in zip(capsules.frame, capsules.ends, capsules.radius, strict=True):
        links[frame].append(capsule(apply(after[frame], ends), float(radius)))
    return links


def _add_link(robot: ElementTree.Element, name: str, weight: Solid) -> ElementTree.Element:
    link = ElementTree.SubElement(robot, "link", name=name)
    tensor = weight.inertia
    inertial = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=numbers(weight.T[:3, 3]), rpy="0 0 0")
    ElementTree.SubElement(inertial, "mass", value=repr(weight.mass))
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": repr(float(tensor[i, j])) for i in range(3) for j in range(i, 3)}
    ElementTree.SubElement(inertial, "inertia", entries)
    return link


def _add_shape(link: ElementTree.Element, solid: Solid) -> None:
    for purpose in ("visual", "collision"):
        part = ElementTree.SubElement(link, purpose)
        _add_origin(part, solid.T)
        ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), solid.shape, dict(solid.sizes))


def _add_joint(robot: ElementTree.Element, kind: str, parent: str, child: str, T: Array) -> ElementTree.Element:
    joint = ElementTree.SubElement(robot, "joint", name=f"{parent} to {child}", type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    _add_origin(joint, T)
    return joint


def _add_origin(parent: ElementTree.Element, T: Array) -> None:
    ElementTree.SubElement(parent, "origin", xyz=numbers(T[:3, 3]), rpy=numbers(_roll_pitch_yaw(T[:3, :3])))


def _roll_pitch_yaw(R: Array) -> Array:
    """Angles (3,) in rad with R = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = np.arctan2(-R[2, 0], np.hypot(R[0, 0], R[1, 0]))
    yaw = np.arctan2(R[1, 0], R[0, 0])
    # Roll from what the other two leave, so that it is right where the pitch is upright as well.
    y = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    roll = np.arctan2(-y @ R[:, 2], y @ R[:, 1])
    return np.array([roll, pitch, yaw])


def _turned(angle: float) -> Array:
    return transform(rotation_from_vector([0.0, 0.0, angle]), np.zeros(3))
