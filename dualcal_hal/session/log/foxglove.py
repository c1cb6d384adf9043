"""Our types as the messages that viewers understand: pure functions to protobuf ``foxglove.*``.

``when`` is the time in ns since 1970, UTC.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CircleAnnotation_pb2 import CircleAnnotation
from foxglove_schemas_protobuf.Color_pb2 import Color
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.Point2_pb2 import Point2
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp

from dualcal_hal.camera import Intrinsics
from dualcal_hal.robot import RobotState
from dualcal_hal.session.log.records import Level
from dualcal_hal.transforms import Array, quaternion_from_rotation

_AXIS_COLOUR = Color(r=0.1, g=0.8, b=0.2, a=1.0)
_FEATURE_COLOUR = Color(r=0.9, g=0.2, b=0.1, a=1.0)
_AXIS_DIAMETER, _FEATURE_DIAMETER, _THICKNESS = 24.0, 12.0, 1.5  # px

_LEVELS = {"debug": Log.DEBUG, "info": Log.INFO, "warning": Log.WARNING, "error": Log.ERROR}


def stamp(when: int) -> Timestamp:
    """The time as protobuf has it."""
    return Timestamp(seconds=when // 10**9, nanos=when % 10**9)


def nanoseconds(timestamp: Timestamp) -> int:
    """And back."""
    return int(timestamp.seconds) * 10**9 + int(timestamp.nanos)


def joint_states(arm: str, state: RobotState, when: int) -> JointStates:
    """The joints are named ``<arm>_1`` and so on; rad and rad/s."""
    return JointStates(
        timestamp=stamp(when),
        joints=[
            JointState(name=f"{arm}_{number}", position=position, velocity=velocity)
            for number, (position, velocity) in enumerate(zip(state.positions, state.velocities, strict=True), start=1)
        ],
    )


def compressed_image(camera: str, data: bytes, image_format: str, when: int) -> CompressedImage:
    """An encoded image, in the frame of its camera."""
    return CompressedImage(timestamp=stamp(when), frame_id=camera, data=data, format=image_format)


def camera_calibration(camera: str, intrinsics: Intrinsics, when: int) -> CameraCalibration:
    """Pinhole with OpenCV's five coefficients; the image is not rectified."""
    width, height = intrinsics.size
    return CameraCalibration(
        timestamp=stamp(when),
        frame_id=camera,
        width=width,
        height=height,
        distortion_model="plumb_bob",
        D=map(float, intrinsics.distortion),
        K=map(float, intrinsics.matrix.ravel()),
        R=map(float, np.eye(3).ravel()),
        P=map(float, np.hstack([intrinsics.matrix, np.zeros((3, 1))]).ravel()),
    )


def image_annotations(axis: Iterable[float], feature: Iterable[float] | None, when: int) -> ImageAnnotations:
    """Two circles (px): green about where the optical axis is, red about where the feature is seen, if it is."""
    circles = [_circle(axis, _AXIS_DIAMETER, _AXIS_COLOUR, when)]
    if feature is not None:
        circles.append(_circle(feature, _FEATURE_DIAMETER, _FEATURE_COLOUR, when))
    return ImageAnnotations(timestamp=stamp(when), circles=circles)


def frame_transforms(transforms: Iterable[tuple[str, str, Array]], when: int) -> FrameTransforms:
    """From (parent, child, T (4, 4) in m, from the child's coordinates to the parent's)."""
    return FrameTransforms(transforms=[_transform(parent, child, T, when) for parent, child, T in transforms])


def log(level: Level, text: str, when: int) -> Log:
    """A line for a person."""
    return Log(timestamp=stamp(when), level=_LEVELS[level], message=text, name="dualcal")


def _circle(centre: Iterable[float], diameter: float, colour: Color, when: int) -> CircleAnnotation:
    u, v = map(float, centre)
    return CircleAnnotation(
        timestamp=stamp(when),
        position=Point2(x=u, y=v),
        diameter=diameter,
        thickness=_THICKNESS,
        fill_color=Color(a=0.0),
        outline_color=colour,
    )


def _transform(parent: str, child: str, T: Array, when: int) -> FrameTransform:
    x, y, z = map(float, T[:3, 3])
    qx, qy, qz, qw = map(float, quaternion_from_rotation(T[:3, :3]))
    return FrameTransform(
        timestamp=stamp(when),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )


__all__ = [
    "CameraCalibration",
    "CompressedImage",
    "FrameTransforms",
    "ImageAnnotations",
    "JointStates",
    "Log",
    "camera_calibration",
    "compressed_image",
    "frame_transforms",
    "image_annotations",
    "joint_states",
    "log",
    "nanoseconds",
    "stamp",
]
