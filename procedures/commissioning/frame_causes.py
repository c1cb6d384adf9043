"""Frames that are not what they are taken for: an active tool or work object, another form of rotation, kinematics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dualcal_hal.kinematics import Row
from dualcal_hal.transforms import (
    Array,
    inverse,
    nearest_rotation,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from procedures.commissioning.causes import Cause, Deviation, Kind, Poses, fitted

_LENGTHS = np.linspace(-0.5, 0.5, 101)
_ANGLES = np.deg2rad(np.arange(-180.0, 180.0, 5.0))

_FLANGES_OWN = "have the pendant show the flange in the arm's base: no tool and no work object or user frame active"


def frame_causes(poses: Poses) -> Iterator[Cause]:
    """Each of them, fitted to the poses."""
    yield _tool(poses)
    yield _work_object(poses)
    yield from _conventions(poses)
    for row in range(poses.chain.joints):
        yield from _kinematics(poses, row)


def _tool(poses: Poses) -> Cause:
    """A constant transform on the flange's side."""
    ours = poses.chain.forward(poses.joints)
    to_flange = np.swapaxes(ours[:, :3, :3], 1, 2)
    R = nearest_rotation(np.sum(to_flange @ poses.flange[:, :3, :3], axis=0))
    shift = np.mean(to_flange @ (poses.flange[:, :3, 3:] - ours[:, :3, 3:]), axis=0)[:, 0]
    return Cause(
        Kind.TOOL,
        f"a tool is active at the controller, or its flange's axes are not ours: {_in_words(R, shift)} in the flange",
        _FLANGES_OWN,
        (),
        6,
        0.0,
        Deviation.between(ours @ transform(R, shift), poses.flange),
    )


def _work_object(poses: Poses) -> Cause:
    """A constant transform on the base's side."""
    ours = poses.chain.forward(poses.joints)
    R = nearest_rotation(np.sum(poses.flange[:, :3, :3] @ np.swapaxes(ours[:, :3, :3], 1, 2), axis=0))
    shift = np.mean(poses.flange[:, :3, 3] - ours[:, :3, 3] @ R.T, axis=0)
    return Cause(
        Kind.FRAME,
        "a work object or user frame is active at the controller, or its base stands elsewhere than ours: "
        f"{_in_words(R, shift)} in the base",
        _FLANGES_OWN,
        (),
        6,
        0.0,
        Deviation.between(transform(R, shift) @ ours, poses.flange),
    )


def _in_words(R: Array, shift: Array) -> str:
    x, y, z = 1e3 * shift
    turn = vector_from_rotation(R)
    angle = float(np.linalg.norm(turn))
    if angle < np.deg2rad(0.2):
        return f"shifted by ({x:.1f}, {y:.1f}, {z:.1f}) mm"
    about = ", ".join(f"{part:.2f}" for part in turn / angle)
    return f"shifted by ({x:.1f}, {y:.1f}, {z:.1f}) mm and turned by {np.degrees(angle):.2f} deg about ({about})"


def _conventions(poses: Poses) -> Iterator[Cause]:
    """Orientations typed in another form than was said."""
    R = poses.flange[:, :3, :3]
    rotation = Rotation.from_matrix(R)
    angles, quaternion = _angles(R), rotation.as_quat()
    ours = poses.chain.forward(poses.joints)
    for what, meant in (
        ("the three angles in the opposite order, as W P R for A B C", Rotation.from_euler("ZYX", angles[:, ::-1])),
        ("A B C or W P R as a rotation vector", Rotation.from_rotvec(angles[:, ::-1])),
        ("a rotation vector as W P R", Rotation.from_euler("xyz", rotation.as_rotvec())),
        ("the quaternion's scalar first where it stands last", Rotation.from_quat(np.roll(quaternion, 1, axis=1))),
        ("the quaternion's scalar last where it stands first", Rotation.from_quat(np.roll(quaternion, -1, axis=1))),
        ("the base in the flange for the flange in the base", rotation.inv()),
    ):
        yield Cause(
            Kind.CONVENTION,
            f"the orientation was typed in another form than was said: {what}",
            "say with --rotation which form the pendant shows",
            (),
            0,
            6.0,
            Deviation.between(ours, transform(meant.as_matrix(), poses.flange[:, :3, 3])),
        )


def _angles(R: Array) -> Array:
    """Turns (k, 3) in rad about z, the new y and the new x; where y is 90 deg, some of those that there are."""
    y = -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0))
    return np.stack([np.arctan2(R[:, 1, 0], R[:, 0, 0]), y, np.arctan2(R[:, 2, 1], R[:, 2, 2])], axis=1)


def _kinematics(poses: Poses, index: int) -> Iterator[Cause]:
    """One number of one row; its theta is the joint's zero."""
    frames = poses.chain.frames(poses.joints)
    row = poses.chain.rows[index]
    turned = transform(rotation_from_vector(_about_z(poses.joints[:, index] + row.theta)), np.zeros(3))
    before = frames[:, index] @ turned
    behind = inverse(frames[:, index + 1]) @ frames[:, -1]
    # Hayati's rows have a beta in place of a d.
    names = ("a", "alpha", "d") if row.beta is None else ("a", "alpha", "beta")
    for name in names:
        length = name in ("a", "d")
        flange = _varied(row, name, before, behind)
        value, deviation = fitted(flange, poses.flange, _LENGTHS if length else _ANGLES)
        key, more = (f"{name}_mm", 1e3 * value) if length else (f"{name}_deg", np.degrees(value))
        yield Cause(
            Kind.KINEMATICS,
            f"the kinematics differ: {key} of row {index + 1} is {more:+.2f} more at the controller",
            "check that these are this arm's kinematics, and in which form its maker states them",
            (index + 1,),
            1,
            20.0,
            deviation,
        )


def _varied(row: Row, name: str, before: Array, behind: Array) -> Callable[[Array], Array]:
    """Poses (m, k, 4, 4) of the flange with numbers (m,) added to one of the row."""

    def flange(values: Array) -> Array:
        rows = (replace(row, **{name: getattr(row, name) + float(x)}) for x in values)
        after = np.stack([changed.after_joint() for changed in rows])
        return np.asarray(before @ after[:, None] @ behind)

    return flange


def _about_z(angles: Array) -> Array:
    return np.stack([np.zeros_like(angles), np.zeros_like(angles), angles], axis=-1)
