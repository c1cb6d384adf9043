"""Industrial cameras: a frame is triggered after it was asked for, settings are read back, damaged buffers are refused.

Against the fake producer that the ``genicam`` wheel brings, which has neither triggers nor an exposure; those are held
against a camera in this process that answers as harvesters does.
"""

from __future__ import annotations

import importlib.util
import math
import threading
from collections import deque
from collections.abc import Iterator
from enum import Enum
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("harvesters.core", reason="the genicam camera is an extra: pip install 'dualcal[genicam]'")
gentl = pytest.importorskip("genicam.gentl", reason="the genicam camera is an extra: pip install 'dualcal[genicam]'")
genapi = pytest.importorskip("genicam.genapi", reason="the genicam camera is an extra: pip install 'dualcal[genicam]'")

from backends.cameras.frame_ids import FrameIds  # noqa: E402 - what it needs may be missing
from backends.cameras.genicam_backend import GenicamBackend, GenicamOptions, set_up  # noqa: E402
from backends.cameras.genicam_driver import GenicamDriver  # noqa: E402
from dualcal_hal.cellfile import standing_alone  # noqa: E402
from dualcal_hal.errors import (  # noqa: E402
    CellFileError,
    CommandRefused,
    DeviceTimeout,
    FrameRefused,
    LinkLost,
    NotOpen,
    UnknownDevice,
    UsageError,
)
from tests.camera_cells import CLOCK, camera_cell  # noqa: E402

AMPLE = 20.0
SIZE = (400, 400)
"""Of the fake producer's images."""


def _producer() -> Path:
    found = importlib.util.find_spec("genicam")
    assert found is not None
    assert found.origin is not None
    return Path(found.origin).with_name("viky.cti")


needs_producer = pytest.mark.skipif(
    not _producer().exists(), reason="the installed genicam wheel brings no fake producer (viky.cti)"
)


def genicam(options: str = "serial: '0', trigger: acquisition", cti: Path | None = None) -> GenicamBackend:
    entry = f"{{type: genicam, cti: ['{cti or _producer()}'], {options}}}"
    size = ("camera.size_px=[400, 400]", "camera.matrix=[[406, 0, 199.5], [0, 406, 199.5], [0, 0, 1]]")
    return GenicamBackend("lens", camera_cell(entry, *size))


@pytest.fixture
def viky() -> Iterator[GenicamBackend]:
    backend = genicam()
    backend.open(AMPLE)
    yield backend
    backend.close()


# Against the fake producer


@needs_producer
def test_it_opens_closes_and_opens_again() -> None:
    backend = genicam()
    backend.close()
    before = set(threading.enumerate())
    for _ in range(2):
        backend.open(AMPLE)
        with pytest.raises(UsageError, match="open already"):
            backend.open(AMPLE)
        backend.camera("camera").grab(0.0, AMPLE)
        backend.close()
        backend.close()
        assert set(threading.enumerate()) == before
        with pytest.raises(NotOpen):
            backend.camera("camera").grab(0.0, AMPLE)


@needs_producer
def test_frames_are_grey_whole_read_only_and_exposed_when_asked_for(viky: GenicamBackend) -> None:
    frames = []
    for wait in (0.0, 0.1, 0.0):
        not_before = CLOCK.now() + wait
        frames.append(viky.camera("camera").grab(not_before, AMPLE))
        assert not_before <= frames[-1].time <= CLOCK.now()
    assert all(a.sequence < b.sequence for a, b in pairwise(frames))
    for frame in frames:
        assert frame.image.shape == SIZE[::-1]
        assert frame.image.dtype == np.uint8
        assert not frame.image.flags.writeable
    assert not np.array_equal(frames[0].image, frames[1].image)  # a ball moves in it


@needs_producer
def test_a_frame_that_cannot_come_in_time_is_a_timeout_and_the_next_one_comes(viky: GenicamBackend) -> None:
    with pytest.raises(DeviceTimeout):
        viky.camera("camera").grab(CLOCK.now() + 5.0, 0.1)
    with pytest.raises(DeviceTimeout):
        viky.camera("camera").grab(CLOCK.now(), 0.001)
    for not_before in (math.nan, math.inf):
        with pytest.raises(CommandRefused):
            viky.camera("camera").grab(not_before, AMPLE)
    viky.camera("camera").grab(CLOCK.now(), AMPLE)


@needs_producer
def test_an_operator_is_told_what_it_is_and_does(viky: GenicamBackend) -> None:
    said = {finding.subject: finding.said for finding in viky.camera("camera").findings()}
    assert "Viky serial 0" in said["camera"]
    assert said["frame size"].startswith("400 x 400 px")
    assert "does not tell" in said["exposure"]
    assert "acquisition" in said["proof of exposure"]


@needs_producer
def test_one_of_several_cameras_has_to_be_named() -> None:
    for options, why in (("trigger: acquisition", "more than one"), ("serial: '77'", "none of those")):
        with pytest.raises(UnknownDevice, match=f"{why}.*serial 0.*serial 1.*serial 2"):
            genicam(options).open(AMPLE)
    backend = genicam("id: VikyTL_DEV_blue, trigger: acquisition")
    backend.open(AMPLE)
    backend.close()


@needs_producer
@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("serial: '0'", "set TriggerMode to On: the camera has no such feature"),
        ("serial: '0', trigger: acquisition, exposure_us: 100", "set ExposureTime to 100 us: the camera has no such"),
        ("serial: '0', trigger: acquisition, gain_db: 1", "set Gain to 1 dB: the camera has no such feature"),
    ],
)
def test_what_the_camera_does_not_have_cannot_be_set_and_it_can_be_opened_without(options: str, why: str) -> None:
    backend = genicam(options)
    with pytest.raises(CommandRefused, match=why):
        backend.open(AMPLE)
    with pytest.raises(NotOpen):
        backend.camera("camera").grab(0.0, AMPLE)
    backend.close()
    other = genicam()
    other.open(AMPLE)
    other.close()


@needs_producer
def test_frames_of_another_size_are_refused() -> None:
    cell = camera_cell(f"{{type: genicam, cti: ['{_producer()}'], serial: '0', trigger: acquisition}}")
    backend = GenicamBackend("lens", cell)
    backend.open(AMPLE)
    with pytest.raises(FrameRefused, match=r"400 x 400 px.*512 x 384"):
        backend.camera("camera").grab(0.0, AMPLE)
    backend.close()


def test_a_producer_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(LinkLost, match="there is no such producer"):
        genicam(cti=tmp_path / "none.cti").open(AMPLE)
    (tmp_path / "text.cti").write_text("no library")
    with pytest.raises(LinkLost, match="no camera is found"):
        genicam(cti=tmp_path / "text.cti").open(AMPLE)


# Against a camera with trigger, exposure and gain


class Node:
    """A feature; ``becomes`` is what it makes of what is set."""

    def __init__(self, value: Any, symbolics: tuple[str, ...] = (), step: float = 0.0, most: float = math.inf) -> None:
        self._value, self.symbolics = value, symbolics
        self._step, self._most = step, most

    @property
    def value(self) -> Any:
        return self._value

    @value.setter
    def value(self, value: Any) -> None:
        if not isinstance(value, str) and value > self._most:
            raise genapi.OutOfRangeException(f"Value {value} must be smaller than or equal {self._most}. : thrown in")
        self._value = round(value / self._step) * self._step if self._step else value


class FakeCamera:
    """An acquirer as harvesters makes it; each trigger exposes an image that tells its number."""

    Events = Enum("Events", ["INCOMPLETE_BUFFER"])

    def __init__(self) -> None:
        self.nodes: dict[str, Any] = {
            "PixelFormat": Node("BayerRG8", ("BayerRG8", "Mono8")),
            "AcquisitionMode": Node("Continuous", ("Continuous",)),
            "ExposureAuto": Node("Continuous", ("Off", "Continuous")),
            "ExposureTime": Node(20000.0, step=10.0, most=1e6),
            "GainAuto": Node("Off", ("Off",)),
            "Gain": Node(0.0, step=0.5),
            "TriggerSelector": Node("AcquisitionStart", ("AcquisitionStart", "FrameStart")),
            "TriggerMode": Node("Off", ("Off", "On")),
            "TriggerSource": Node("Line1", ("Line1", "Software")),
            "TriggerSoftware": SimpleNamespace(execute=self._trigger),
        }
        self.remote_device = SimpleNamespace(
            node_map=SimpleNamespace(has_node=lambda name: name in self.nodes, **self.nodes)
        )
        self.num_buffers = 0
        self.exposed: list[float] = []
        self.deaf = 0  # so many triggers bring a frame only after it is looked for twice
        self.doubled = 0  # so many triggers bring a second frame with them
        self.damaged = 0  # so many frames do not come whole
        self.error: Exception | None = None
        self.data_format = "Mono8"
        self.driver: GenicamDriver | None = None
        self.id_offset = 0
        self.acquisitions = 0
        self.released = False
        self._acquiring = False
        self._waiting: deque[tuple[int, int]] = deque()

    def is_acquiring(self) -> bool:
        return self._acquiring

    def start(self) -> None:
        self._acquiring = True
        self.acquisitions += 1

    def stop(self) -> None:
        self._acquiring = False
        self._waiting.clear()

    def _trigger(self) -> None:
        assert self._acquiring
        self.exposed.append(CLOCK.now())
        self._waiting.append((len(self.exposed) - 1, 1 if self.deaf else 0))
        self.deaf = max(0, self.deaf - 1)
        if self.doubled:
            self.doubled -= 1
            self._trigger()

    def try_fetch(self, timeout: float) -> Any:
        assert timeout > 0
        if self.error is not None:
            raise self.error
        if not self._waiting or self._waiting[0][1]:
            CLOCK.wait(threading.Event(), CLOCK.now() + timeout)
            if self._waiting:
                self._waiting[0] = (self._waiting[0][0], 0)
            return None
        number, _ = self._waiting.popleft()
        if self.damaged:
            self.damaged -= 1
            assert self.driver is not None
            self.driver.told_incomplete()
            return None
        return self._buffer(number)

    def _buffer(self, number: int) -> Any:
        component = SimpleNamespace(
            data_format=self.data_format, width=4, height=3, data=np.full(12, number, dtype=np.uint8)
        )
        return SimpleNamespace(
            module=SimpleNamespace(frame_id=number + 1 + self.id_offset),
            payload=SimpleNamespace(components=[component]),
            queue=lambda: None,
        )

    def release(self) -> None:
        self.released = True


def options(**given: Any) -> GenicamOptions:
    return GenicamOptions.model_validate({"cti": ["x.cti"], **given})


@pytest.fixture
def camera() -> FakeCamera:
    return FakeCamera()


@pytest.fixture
def driver(camera: FakeCamera) -> Iterator[GenicamDriver]:
    asking, settings = set_up(camera, options())
    camera.driver = GenicamDriver("camera", CLOCK, camera, asking, tuple(settings), camera.release)
    yield camera.driver
    if not camera.released:
        camera.driver.close()


def test_each_frame_is_of_a_trigger_that_was_sent_when_it_was_asked_for(
    camera: FakeCamera, driver: GenicamDriver
) -> None:
    assert camera.nodes["TriggerMode"].value == "On"
    assert camera.nodes["TriggerSource"].value == "Software"
    assert camera.nodes["TriggerSelector"].value == "FrameStart"
    for wait in (0.0, 0.05, 0.0):
        not_before = CLOCK.now() + wait
        frame = driver.take(not_before, not_before + AMPLE)
        assert not_before <= frame.time <= camera.exposed[int(frame.image[0, 0])]
    assert len(camera.exposed) == 3
    assert camera.acquisitions == 1


def test_the_frame_of_a_trigger_that_came_too_late_is_not_taken_for_the_next_ones(
    camera: FakeCamera, driver: GenicamDriver
) -> None:
    camera.deaf = 1
    with pytest.raises(DeviceTimeout, match="no frame came"):
        driver.take(CLOCK.now(), CLOCK.now() + 0.05)
    not_before = CLOCK.now()
    frame = driver.take(not_before, not_before + AMPLE)
    assert camera.exposed[int(frame.image[0, 0])] >= not_before


def test_a_frame_that_nobody_asked_for_is_not_taken_for_the_next_one(camera: FakeCamera, driver: GenicamDriver) -> None:
    camera.doubled = 1
    driver.take(CLOCK.now(), CLOCK.now() + AMPLE)
    not_before = CLOCK.now()
    frame = driver.take(not_before, not_before + AMPLE)
    assert camera.exposed[int(frame.image[0, 0])] >= not_before
    assert any("not asked for" in finding.said for finding in driver.findings())


def test_a_frame_that_did_not_come_whole_is_asked_for_again(camera: FakeCamera, driver: GenicamDriver) -> None:
    camera.damaged = 2
    assert driver.take(CLOCK.now(), CLOCK.now() + AMPLE).image[0, 0] == 2
    assert any("2 did not come whole" in finding.said for finding in driver.findings())


def test_where_no_frame_comes_whole_that_is_the_error(camera: FakeCamera, driver: GenicamDriver) -> None:
    camera.damaged = 1_000_000
    with pytest.raises(FrameRefused, match="did not come whole"):
        driver.take(CLOCK.now(), CLOCK.now() + 0.05)


def test_an_image_of_other_pixels_is_refused(camera: FakeCamera, driver: GenicamDriver) -> None:
    camera.data_format = "Mono12"
    with pytest.raises(FrameRefused, match="Mono12, not of Mono8"):
        driver.take(CLOCK.now(), CLOCK.now() + AMPLE)


def test_the_same_frame_twice_is_refused(camera: FakeCamera, driver: GenicamDriver) -> None:
    driver.take(CLOCK.now(), CLOCK.now() + AMPLE)
    camera.id_offset = -1
    with pytest.raises(FrameRefused, match="frame 1 came after frame 1"):
        driver.take(CLOCK.now(), CLOCK.now() + AMPLE)


@pytest.mark.parametrize("error", [gentl.IoException("gone"), genapi.RuntimeException("gone"), AttributeError("gone")])
def test_what_the_producer_raises_is_a_lost_link(camera: FakeCamera, driver: GenicamDriver, error: Exception) -> None:
    camera.error = error
    with pytest.raises(LinkLost, match="gone"):
        driver.take(CLOCK.now(), CLOCK.now() + AMPLE)
    camera.error = None
    not_before = CLOCK.now()
    frame = driver.take(not_before, not_before + AMPLE)
    assert camera.exposed[int(frame.image[0, 0])] >= not_before


def test_closing_ends_a_wait(camera: FakeCamera, driver: GenicamDriver) -> None:
    camera.deaf = 1
    errors: list[Exception] = []

    def wait() -> None:
        try:
            driver.take(CLOCK.now() + 60.0, CLOCK.now() + 90.0)
        except NotOpen as error:
            errors.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    CLOCK.wait(threading.Event(), CLOCK.now() + 0.05)
    driver.close()
    thread.join(AMPLE)
    assert len(errors) == 1
    assert camera.released


def test_exposure_and_gain_are_set_and_read_back(camera: FakeCamera) -> None:
    _, settings = set_up(camera, options(exposure_us=5003.0, gain_db=6.0))
    assert camera.nodes["ExposureAuto"].value == "Off"
    assert [finding.said for finding in settings] == ["5000 us, as set", "6 dB, as set"]
    assert all(finding.verdict == "good" for finding in settings)


def test_an_exposure_that_the_camera_chooses_is_noted(camera: FakeCamera) -> None:
    _, settings = set_up(camera, options())
    assert [(finding.verdict, finding.said) for finding in settings] == [
        ("note", "20000 us, the camera's own"),
        ("note", "0 dB, the camera's own"),
    ]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"exposure_us": 14.0}, "set ExposureTime to 14 us: it is 10 us then"),
        ({"exposure_us": 2e6}, "set ExposureTime to 2e.06 us: Value 2000000.0 must be smaller"),
        ({"gain_db": 0.3}, "set Gain to 0.3 dB: it is 0.5 dB then"),
    ],
)
def test_a_setting_that_is_something_else_then_is_an_error_in_words(
    camera: FakeCamera, given: dict[str, float], why: str
) -> None:
    with pytest.raises(CommandRefused, match=why):
        set_up(camera, options(**given))


def test_a_camera_without_grey_images_is_refused(camera: FakeCamera) -> None:
    camera.nodes["PixelFormat"].symbolics = ("BayerRG8",)
    with pytest.raises(CommandRefused, match="set PixelFormat to Mono8: it has BayerRG8"):
        set_up(camera, options())


# Frame ids


def test_ids_that_wrap_at_16_bits_make_numbers_that_grow() -> None:
    ids = FrameIds()
    assert [ids.number(frame_id) for frame_id in (65533, 65534, 65535, 1, 2)] == [1, 2, 3, 4, 5]
    zero_based = FrameIds()
    assert [zero_based.number(frame_id) for frame_id in (65534, 65535, 0, 1)] == [1, 2, 3, 4]


def test_ids_of_64_bits_do_not_wrap() -> None:
    ids = FrameIds()
    assert [ids.number(frame_id) for frame_id in (65535, 65536, 65540)] == [1, 2, 6]
    with pytest.raises(ValueError, match="came after"):
        ids.number(1)


def test_an_older_frame_is_no_wrap() -> None:
    ids = FrameIds()
    ids.number(100)
    with pytest.raises(ValueError, match="frame 99 came after frame 100"):
        ids.number(99)
    ids.restart()
    assert ids.number(1) == 2


@given(first=st.integers(1, 65535), lost=st.lists(st.integers(0, 1000), min_size=1, max_size=50))
def test_numbers_tell_how_many_frames_were_lost(first: int, lost: list[int]) -> None:
    ids = FrameIds()
    count = first
    numbers = [ids.number(first)]
    for missing in lost:
        count += missing + 1
        numbers.append(ids.number((count - 1) % 65535 + 1))
    assert [b - a - 1 for a, b in pairwise(numbers)] == lost


# The cell file


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ("cti: []", "cti"),
        ("cti: [x.cti], trigger: hardware", "trigger"),
        ("cti: [x.cti], exposure_ms: 5", "exposure_ms"),
    ],
)
def test_options_that_are_wrong_are_refused(given: str, why: str) -> None:
    with pytest.raises(CellFileError, match=why):
        camera_cell(f"{{type: genicam, {given}}}")


def test_a_producer_beside_the_cell_file_is_found_from_a_session_too() -> None:
    cell = camera_cell("{type: genicam, cti: [vendor/x.cti]}")
    (file,) = cell.cell.backends["lens"].checked.cti  # type: ignore[attr-defined]
    text, _ = standing_alone(cell)
    assert file.is_absolute()
    assert str(file) in text
