"""What a log is made of: its version, its topics, and the limits within which it is read."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dualcal_hal.session.log.records import (
    Arrived,
    Call,
    MotionEnded,
    Note,
    Record,
    Reply,
    RunEnded,
    StepBegun,
    StepFinished,
    Worked,
    schema_of,
)
from dualcal_hal.session.plain import Fields, parse

FORMAT_NAME, FORMAT_VERSION = "dualcal.log", 1
PROFILE = f"{FORMAT_NAME}/{FORMAT_VERSION}"
METADATA_NAME = "dualcal.log"

LARGEST_RECORD = 1 << 26
"""Bytes of one record of the file, so of a message, a chunk or an attachment."""

SEQUENCES = 1 << 32
"""A message's number in the file is that of its image or state modulo this."""

LARGEST_JOINT_STATES = 1 << 14
"""Bytes of the states of an arm's joints, which may take a hundred times as many in memory; of six joints 200."""

MOST_ARMS = 16
"""A log that names more is none."""

LONGEST_NAME = 1000
"""Letters of a device's name: it is in a topic, and all topics are in every copy of a log."""

RECORD_TOPICS: dict[type[Record], str] = {
    Call: "/dualcal/calls",
    Reply: "/dualcal/replies",
    MotionEnded: "/dualcal/motions",
    Arrived: "/dualcal/arrivals",
    StepBegun: "/dualcal/steps/begun",
    StepFinished: "/dualcal/steps/finished",
    Worked: "/dualcal/work",
    Note: "/dualcal/notes",
    RunEnded: "/dualcal/end",
}
RECORD_KINDS = {topic: kind for kind, topic in RECORD_TOPICS.items()}

TRANSFORMS_TOPIC = "/tf"
LOG_TOPIC = "/log"
_JOINT_STATES, _IMAGE = "/joint_states", "/image"


def joint_states_topic(arm: str) -> str:
    return f"/{arm}{_JOINT_STATES}"


def image_topic(camera: str) -> str:
    return f"/{camera}{_IMAGE}"


def calibration_topic(camera: str) -> str:
    return f"/{camera}/calibration"


def annotations_topic(camera: str) -> str:
    return f"/{camera}/annotations"


def arm_of(topic: str) -> str | None:
    """The arm whose joint states a topic has, or None."""
    return topic[1 : -len(_JOINT_STATES)] if topic.endswith(_JOINT_STATES) else None


def camera_of(topic: str) -> str | None:
    """The camera whose images a topic has, or None."""
    return topic[1 : -len(_IMAGE)] if topic.endswith(_IMAGE) else None


@dataclass(frozen=True)
class Channel:
    """A topic with its number in the file, how its messages are written and the name of their schema."""

    number: int
    topic: str
    encoding: str
    schema: str
    schema_data: Callable[[], bytes]


@dataclass(frozen=True)
class Layout:
    """The devices of a log. They determine its channels and their numbers, so a log whose list of channels is lost
    can still be read.
    """

    arms: tuple[str, ...]
    camera: str

    def __post_init__(self) -> None:
        if len(self.arms) > MOST_ARMS:
            raise ValueError(f"{len(self.arms)} arms are too many")

    def channels(self) -> list[Channel]:
        """All of them, in the order of their numbers, which begin with 1."""
        from dualcal_hal.session.log import foxglove

        kinds: list[tuple[str, Any]] = [(topic, kind) for kind, topic in RECORD_TOPICS.items()]
        kinds += [
            (image_topic(self.camera), foxglove.CompressedImage),
            (calibration_topic(self.camera), foxglove.CameraCalibration),
            (annotations_topic(self.camera), foxglove.ImageAnnotations),
            (TRANSFORMS_TOPIC, foxglove.FrameTransforms),
            (LOG_TOPIC, foxglove.Log),
        ]
        kinds += [(joint_states_topic(arm), foxglove.JointStates) for arm in self.arms]
        return [_channel(number, topic, kind) for number, (topic, kind) in enumerate(kinds, start=1)]

    def to_text(self) -> str:
        """As the log's metadata has it."""
        return json.dumps({"arms": list(self.arms), "camera": self.camera})

    @staticmethod
    def from_text(text: str) -> Layout:
        """And back; ValueError if it is none."""
        try:
            fields = Fields(parse(text.encode()), "the list of devices")
            arms, camera = fields.texts("arms"), fields.text("camera")
        except ValueError as error:
            raise ValueError(f"the list of devices is damaged: {error}") from error
        if any(len(name) > LONGEST_NAME for name in (*arms, camera)):
            raise ValueError(f"a device's name has more than {LONGEST_NAME} letters")
        return Layout(arms, camera)

    @staticmethod
    def of_topics(topics: list[str]) -> Layout:
        """From the topics of a file; ValueError for more than any has."""
        arms = tuple(arm for topic in topics if (arm := arm_of(topic)) is not None)
        cameras = [camera for topic in topics if (camera := camera_of(topic)) is not None]
        return Layout(arms, cameras[0] if cameras else "camera")


def _channel(number: int, topic: str, kind: Any) -> Channel:
    if topic in RECORD_KINDS:
        return Channel(number, topic, "json", f"dualcal.{kind.__name__}", lambda: json.dumps(schema_of(kind)).encode())
    return Channel(number, topic, "protobuf", kind.DESCRIPTOR.full_name, lambda: _protobuf_schema(kind))


def _protobuf_schema(kind: Any) -> bytes:
    """The message's file and all that it needs, each once and after what it needs itself."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    files = FileDescriptorSet()
    known: set[str] = set()

    def add(file: Any) -> None:
        if file.name in known:
            return
        known.add(file.name)
        for needed in file.dependencies:
            add(needed)
        file.CopyToProto(files.file.add())

    add(kind.DESCRIPTOR.file)
    return bytes(files.SerializeToString(deterministic=True))
