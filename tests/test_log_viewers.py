"""What viewers see of a log: decoded by the plain reader with the schemas that the file carries."""

from __future__ import annotations

import json
import shutil
import subprocess

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from dualcal_hal.camera import Frame, Intrinsics
from dualcal_hal.robot import Mode, RobotState
from dualcal_hal.session.log import LogWriter, Note, foxglove
from dualcal_hal.session.log.layout import RECORD_TOPICS
from dualcal_hal.transforms import rotation_from_vector, transform
from tools.benchmarks.mutated_logs import STARTED, write_sample
from tools.golden import GOLDEN

SECOND = 10**9
IMAGE = np.random.default_rng(1).integers(0, 256, (30, 40), dtype=np.uint8)


@pytest.fixture(params=["png", "jpeg"])
def decoded(request, tmp_path):
    """Messages by topic: (mcap message, decoded)."""
    path = tmp_path / "log-0001.mcap"
    with LogWriter(path, STARTED, arms=("left",), frames=request.param, clock_started=100.0) as log:
        log.joint_states("left", RobotState((0.1, 1 / 3), (0.5, -1.0), Mode.READY, (), 101.5, 4))
        log.calibration(Intrinsics(np.array([[800, 0, 20], [0, 810, 15], [0, 0, 1.0]]), np.arange(5.0), (40, 30)), 100)
        log.frame(Frame(IMAGE, 102.0, 9))
        log.annotations((20.25, 15.5), (21.0, 16.0), 102.0)
        log.annotations((20.25, 15.5), None, 103.0)
        T = transform(rotation_from_vector(np.array([0, 0, np.pi / 2])), np.array([1.0, 2.0, 3.0]))
        log.transforms([("left", "camera", T)], 103.0)
        log.record(Note("warning", "mind the gap", 104.0))
    return _decode(path)


def _decode(path):
    topics = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            decoder = DecoderFactory().decoder_for(channel.message_encoding, schema)
            content = json.loads(message.data) if decoder is None else decoder(message.data)
            topics.setdefault(channel.topic, []).append((message, content))
    return topics


def test_joint_states_have_names_and_exact_values(decoded):
    ((message, states),) = decoded["/left/joint_states"]
    assert [(j.name, j.position, j.velocity) for j in states.joints] == [("left_1", 0.1, 0.5), ("left_2", 1 / 3, -1.0)]
    assert message.sequence == 4


def test_an_image_is_decoded_by_any_program(decoded):
    ((message, image),) = decoded["/camera/image"]
    assert message.sequence == 9
    assert image.frame_id == "camera"
    pixels = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image.format == "png":
        assert np.array_equal(pixels, IMAGE)
    else:
        assert image.format == "jpeg"
        assert np.abs(pixels.astype(int) - IMAGE).mean() < 10


def test_a_calibration_is_that_of_the_camera(decoded):
    ((_, calibration),) = decoded["/camera/calibration"]
    assert (calibration.width, calibration.height, calibration.distortion_model) == (40, 30, "plumb_bob")
    assert list(calibration.K) == [800, 0, 20, 0, 810, 15, 0, 0, 1]
    assert list(calibration.D) == [0, 1, 2, 3, 4]
    assert list(calibration.R) == [1, 0, 0, 0, 1, 0, 0, 0, 1]
    assert list(calibration.P) == [800, 0, 20, 0, 0, 810, 15, 0, 0, 0, 1, 0]


def test_two_circles_are_drawn_and_one_where_the_feature_is_not_seen(decoded):
    (_, both), (_, axis_alone) = decoded["/camera/annotations"]
    assert [(c.position.x, c.position.y) for c in both.circles] == [(20.25, 15.5), (21.0, 16.0)]
    assert [(c.position.x, c.position.y) for c in axis_alone.circles] == [(20.25, 15.5)]
    image = decoded["/camera/image"][0][1]
    assert foxglove.nanoseconds(both.timestamp) == foxglove.nanoseconds(image.timestamp), "they belong to that image"


def test_transforms_lead_from_the_childs_coordinates_to_the_parents(decoded):
    ((_, transforms),) = decoded["/tf"]
    (one,) = transforms.transforms
    assert (one.parent_frame_id, one.child_frame_id) == ("left", "camera")
    assert (one.translation.x, one.translation.y, one.translation.z) == (1, 2, 3)
    rotation = (one.rotation.x, one.rotation.y, one.rotation.z, one.rotation.w)
    assert np.allclose(rotation, (0, 0, np.sqrt(0.5), np.sqrt(0.5)))


def test_a_note_is_a_log_line(decoded):
    ((_, line),) = decoded["/log"]
    assert (line.message, line.level, line.name) == ("mind the gap", foxglove.Log.WARNING, "dualcal")


def test_time_is_the_beginning_of_the_run_and_the_seconds_since(decoded):
    began = int(STARTED.timestamp()) * SECOND
    message, image = decoded["/camera/image"][0]
    assert message.log_time == message.publish_time == began + 2 * SECOND
    assert foxglove.nanoseconds(image.timestamp) == began + 2 * SECOND
    # A state that was sampled earlier but arrives later keeps its own time; that of the log never goes back.
    calibration = decoded["/camera/calibration"][0][0]
    assert calibration.publish_time == began
    assert calibration.log_time == began + SECOND * 3 // 2


def test_every_topic_has_its_schema(tmp_path):
    write_sample(tmp_path / "log.mcap")
    with (tmp_path / "log.mcap").open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    by_topic = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    for kind, topic in RECORD_TOPICS.items():
        assert by_topic[topic].name == f"dualcal.{kind.__name__}"
        assert by_topic[topic].encoding == "jsonschema"
        assert json.loads(by_topic[topic].data)["type"] == "object"
    assert by_topic["/right/joint_states"].name == "foxglove.JointStates"
    assert {schema.encoding for topic, schema in by_topic.items() if not topic.startswith("/dualcal")} == {"protobuf"}


@pytest.mark.skipif(shutil.which("rerun") is None, reason="rerun is not installed")
def test_rerun_finds_nothing_wrong_with_it(tmp_path):
    sample = tmp_path / "log-0001.mcap"
    write_sample(sample)
    for path in (sample, GOLDEN / "log-0001.mcap"):
        done = subprocess.run(["rerun", "mcap", "check", path], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
