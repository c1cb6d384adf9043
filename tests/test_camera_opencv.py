"""Cameras that OpenCV opens: old frames are drained, settings are read back, folders show one image after another."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from backends.cameras.capture import CaptureStream, Connection, grey
from backends.cameras.freshness import FramesInFlight
from backends.cameras.opencv_backend import OpencvBackend
from backends.cameras.video import BUFFERS, IN_CAMERA, MOST_BUFFERS, set_up, without_password
from dualcal_hal.cellfile import standing_alone
from dualcal_hal.errors import (
    CellFileError,
    CommandRefused,
    DeviceTimeout,
    FrameRefused,
    LinkLost,
    NotOpen,
    UsageError,
)
from tests.camera_cells import CLOCK, SIZE, camera_cell, picture

AMPLE = 20.0


def opencv(options: str) -> OpencvBackend:
    return OpencvBackend("lens", camera_cell(f"{{type: opencv, {options}}}"))


def passing(seconds: float) -> None:
    CLOCK.wait(threading.Event(), CLOCK.now() + seconds)


# A folder of images


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for number in (3, 1, 2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(number))
    (tmp_path / "notes.txt").write_text("no image")
    return tmp_path


@pytest.fixture
def album(folder: Path) -> Iterator[OpencvBackend]:
    backend = opencv(f"folder: '{folder}'")
    backend.open(AMPLE)
    yield backend
    backend.close()


def test_images_of_a_folder_come_in_the_order_of_their_names_and_then_anew(album: OpencvBackend) -> None:
    frames = [album.camera("camera").grab(CLOCK.now(), AMPLE) for _ in range(4)]
    assert [frame.image[0, 0] for frame in frames] == [1, 2, 3, 1]
    assert [frame.sequence for frame in frames] == [1, 2, 3, 4]


def test_an_image_of_a_folder_is_exposed_when_it_is_asked_for(album: OpencvBackend) -> None:
    not_before = CLOCK.now() + 0.1
    frame = album.camera("camera").grab(not_before, AMPLE)
    assert not_before <= frame.time <= CLOCK.now()
    with pytest.raises(DeviceTimeout):
        album.camera("camera").grab(CLOCK.now() + 10.0, 0.05)
    with pytest.raises(CommandRefused):
        album.camera("camera").grab(math.nan, AMPLE)


def test_an_image_of_a_folder_is_grey_whole_and_read_only(tmp_path: Path) -> None:
    coloured = np.zeros((*SIZE[::-1], 3), np.uint8)
    coloured[..., 1] = 100
    cv2.imwrite(str(tmp_path / "a.png"), coloured)
    backend = opencv(f"folder: '{tmp_path}'")
    backend.open(AMPLE)
    image = backend.camera("camera").grab(0.0, AMPLE).image
    backend.close()
    assert image.shape == SIZE[::-1]
    assert image.dtype == np.uint8
    assert abs(int(image[0, 0]) - 59) <= 1  # what green weighs in grey
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0] = 0


def test_a_file_that_is_no_image_or_has_another_size_is_refused_by_name(folder: Path) -> None:
    (folder / "0.png").write_bytes(b"no image")
    cv2.imwrite(str(folder / "00.png"), picture(1, (64, 48)))
    backend = opencv(f"folder: '{folder}'")
    backend.open(AMPLE)
    with pytest.raises(FrameRefused, match=r"0\.png"):
        backend.camera("camera").grab(0.0, AMPLE)
    with pytest.raises(FrameRefused, match="64 x 48 px"):
        backend.camera("camera").grab(0.0, AMPLE)
    backend.camera("camera").grab(0.0, AMPLE)
    backend.close()


def test_a_folder_without_images_cannot_be_opened(tmp_path: Path) -> None:
    for where, why in ((tmp_path, "holds no image"), (tmp_path / "none", "cannot be read")):
        backend = opencv(f"folder: '{where}'")
        with pytest.raises(UsageError, match=why):
            backend.open(AMPLE)
        with pytest.raises(NotOpen):
            backend.camera("camera").grab(0.0, AMPLE)
        backend.close()


def test_a_folder_beside_the_cell_file_is_found_from_a_session_too() -> None:
    cell = camera_cell("{type: opencv, folder: pictures}")
    folder = cell.cell.backends["lens"].checked.folder  # type: ignore[attr-defined]
    text, _ = standing_alone(cell)
    assert folder.is_absolute()
    assert str(folder) in text


def test_closing_ends_a_wait_for_the_moment_of_exposure(album: OpencvBackend) -> None:
    errors: list[Exception] = []

    def wait() -> None:
        try:
            album.camera("camera").grab(CLOCK.now() + 60.0, 90.0)
        except NotOpen as error:
            errors.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    passing(0.05)
    album.close()
    thread.join(AMPLE)
    assert len(errors) == 1


def test_an_operator_is_told_that_a_folder_is_no_camera(album: OpencvBackend) -> None:
    said = [finding.said for finding in album.camera("camera").findings()]
    assert any("3 images" in line for line in said)


# A stream, over HTTP on loopback


class Film(BaseHTTPRequestHandler):
    """Motion JPEG: each image's grey value is its number, whose moments are kept."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=next")
        self.end_headers()
        server: Any = self.server
        number = 0
        while not server.ended.is_set():
            number = number % 250 + 1
            server.exposed[number] = CLOCK.now()
            _, packed = cv2.imencode(".jpg", np.full((*SIZE[::-1], 3), number, np.uint8))
            head = b"--next\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % packed.size
            try:
                self.wfile.write(head + packed.tobytes() + b"\r\n")
            except OSError:
                return
            CLOCK.wait(server.ended, CLOCK.now() + 0.03)

    def log_message(self, format: str, *args: Any) -> None:
        """Nobody reads it."""


@pytest.fixture
def film() -> Iterator[Any]:
    server: Any = ThreadingHTTPServer(("127.0.0.1", 0), Film)
    server.ended, server.exposed = threading.Event(), {}
    server.daemon_threads = False
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    yield server
    server.ended.set()
    server.shutdown()
    server.server_close()
    thread.join()


def test_frames_of_a_stream_are_waited_for_by_the_latency_that_it_may_have(film: Any) -> None:
    backend = opencv(f"url: 'http://127.0.0.1:{film.server_port}/film.mjpg', latency_ms: 1000")
    backend.open(AMPLE)
    try:
        not_before = CLOCK.now()
        frame = backend.camera("camera").grab(not_before, AMPLE)
        assert CLOCK.now() >= not_before + 1.0
        assert not_before <= frame.time <= film.exposed[int(frame.image[0, 0])]
        assert frame.image.shape == SIZE[::-1]
        film.ended.set()
        with pytest.raises(LinkLost, match="no more frames"):
            backend.camera("camera").grab(CLOCK.now(), AMPLE)
    finally:
        backend.close()


def test_a_stream_that_is_not_there_is_a_lost_link_that_tells_no_password() -> None:
    backend = opencv("url: 'http://me:secret@127.0.0.1:1/film', latency_ms: 500")
    with pytest.raises(LinkLost) as caught:
        backend.open(2.0)
    assert "127.0.0.1:1/film" in str(caught.value)
    assert "secret" not in str(caught.value)
    backend.close()
    assert without_password("rtsp://host/path@x") == "rtsp://host/path@x"


def test_a_device_that_is_not_there_is_a_lost_link() -> None:
    with pytest.raises(LinkLost, match="device /dev/no-such-video"):
        opencv("device: /dev/no-such-video").open(1.0)


# A device, of which there is none here: one as OpenCV would show it


class FakeDevice:
    """Exposes an image every 10 ms, of which it hands over the oldest of those that wait; 4 wait from the beginning."""

    def __init__(self, **settings: float) -> None:
        self.settings = settings
        self.refused: set[int] = set()
        self.lost = False
        self.released = False
        self.exposed: list[float] = []
        self._waiting: deque[int] = deque()
        for _ in range(4):
            self._expose()
        self._image: np.ndarray[Any, Any] | None = None

    def _expose(self) -> None:
        self.exposed.append(CLOCK.now())
        if len(self._waiting) < 4:
            self._waiting.append(len(self.exposed) - 1)

    def grab(self) -> bool:
        if self.lost:
            return False
        passing(0.01)
        self._expose()
        self._image = picture(self._waiting.popleft())
        return True

    def retrieve(self) -> tuple[bool, Any]:
        return self._image is not None, self._image

    def release(self) -> None:
        self.released = True

    def get(self, property_: int) -> float:
        return self.settings.get(str(property_), 0.0)

    def set(self, property_: int, value: float) -> bool:
        if property_ in self.refused:
            return False
        self.settings.setdefault(str(property_), value)
        return True


def connected(device: FakeDevice, in_flight: int = 5) -> CaptureStream:
    stream = CaptureStream("camera", CLOCK, lambda: Connection(device, FramesInFlight(in_flight), "so", ()))
    stream.serve()
    return stream


def test_frames_that_waited_in_a_device_are_dropped() -> None:
    device = FakeDevice()
    stream = connected(device)
    try:
        for _ in range(5):
            not_before = CLOCK.now()
            frame = stream.take(not_before, not_before + AMPLE)
            assert not_before <= frame.time <= device.exposed[int(frame.image[0, 0])]
    finally:
        stream.close()
    assert device.released


def test_with_fewer_frames_in_flight_than_there_are_old_ones_would_be_taken() -> None:
    """That the test before this one can fail."""
    device = FakeDevice()
    stream = connected(device, in_flight=1)
    try:
        not_before = CLOCK.now()
        frame = stream.take(not_before, not_before + AMPLE)
        assert device.exposed[int(frame.image[0, 0])] < not_before
    finally:
        stream.close()


def test_a_device_that_is_lost_says_so_and_is_opened_anew() -> None:
    devices = [FakeDevice(), FakeDevice()]
    opening = iter(devices)

    def connect() -> Connection:
        device = next(opening)
        return Connection(device, FramesInFlight(1), "so", ())

    stream = CaptureStream("camera", CLOCK, connect)
    stream.serve()
    try:
        stream.take(-math.inf, CLOCK.now() + AMPLE)
        devices[0].lost = True
        with pytest.raises(LinkLost, match="no more frames"):
            stream.take(CLOCK.now() + AMPLE, CLOCK.now() + AMPLE)
        deadline = CLOCK.now() + AMPLE
        frame = None
        while frame is None and CLOCK.now() < deadline:
            try:
                frame = stream.take(-math.inf, deadline)
            except LinkLost:
                passing(0.02)
    finally:
        stream.close()
    assert frame is not None
    assert devices[0].released
    assert devices[1].released


def test_a_frame_that_cannot_be_decoded_is_refused() -> None:
    device = FakeDevice()
    device.retrieve = lambda: (False, None)  # type: ignore[method-assign]
    stream = connected(device, 1)
    try:
        with pytest.raises(FrameRefused, match="cannot be decoded"):
            stream.take(-math.inf, CLOCK.now() + AMPLE)
    finally:
        stream.close()


def test_settings_are_read_back_and_told() -> None:
    device = FakeDevice(**{str(cv2.CAP_PROP_BUFFERSIZE): BUFFERS})
    connection = set_up(device, SIZE, exposure=0.008, gain=3.0)
    assert device.get(cv2.CAP_PROP_FRAME_WIDTH) == SIZE[0]
    assert device.get(cv2.CAP_PROP_FRAME_HEIGHT) == SIZE[1]
    assert device.get(cv2.CAP_PROP_EXPOSURE) == 80.0
    assert [finding.said for finding in connection.settings] == ["8 ms, as set", "3, as set"]
    assert connection.proof.startswith(f"{BUFFERS + IN_CAMERA} frames")


def test_of_a_device_that_does_not_tell_its_buffers_the_most_are_dropped() -> None:
    device = FakeDevice(**{str(cv2.CAP_PROP_BUFFERSIZE): -1.0})
    assert set_up(device, SIZE, None, None).proof.startswith(f"{MOST_BUFFERS + IN_CAMERA} frames")


def test_a_setting_that_a_device_does_not_take_is_an_error_in_words() -> None:
    other = FakeDevice(**{str(cv2.CAP_PROP_EXPOSURE): 156.0})
    with pytest.raises(CommandRefused, match=r"set exposure: 80 x 0\.1 ms is asked for, the device has 156"):
        set_up(other, SIZE, exposure=0.008, gain=None)
    without = FakeDevice()
    without.refused.add(cv2.CAP_PROP_GAIN)
    with pytest.raises(CommandRefused, match="set gain: 3 is asked for, the device has 0"):
        set_up(without, SIZE, exposure=None, gain=3.0)


def test_an_exposure_that_is_not_set_is_noted() -> None:
    notes = [finding for finding in set_up(FakeDevice(), SIZE, None, None).settings if finding.verdict == "note"]
    assert [finding.subject for finding in notes] == ["exposure"]


def test_colours_become_grey_and_what_is_no_image_is_refused() -> None:
    colours = np.zeros((3, 4, 3), np.uint8)
    colours[..., 2] = 200
    assert grey(colours).shape == (3, 4)
    assert grey(np.zeros((3, 4, 1), np.uint8)).shape == (3, 4)
    for wrong in (None, np.zeros((3, 4), np.uint16), np.zeros((3, 4, 2), np.uint8), np.zeros(4, np.uint8)):
        with pytest.raises(ValueError, match=r"bits|shape"):
            grey(wrong)


# The cell file


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("", "one of device, url, folder"),
        ("device: 0, folder: x", "one of device, url, folder"),
        ("url: 'rtsp://host/x'", "latency_ms belongs"),
        ("device: 0, latency_ms: 5", "latency_ms belongs"),
        ("folder: x, exposure_ms: 5", "set at a device"),
        ("url: 'rtsp://host/x', latency_ms: 5, gain: 1", "set at a device"),
        ("url: 'file:///etc/passwd', latency_ms: 5", "url"),
        ("device: video0", "device"),
        ("device: -1", "device"),
        ("device: 0, fps: 5", "fps"),
    ],
)
def test_options_that_do_not_go_together_are_refused(options: str, why: str) -> None:
    with pytest.raises(CellFileError, match=why):
        camera_cell("{type: opencv" + (f", {options}" if options else "") + "}")
