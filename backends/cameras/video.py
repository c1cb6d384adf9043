"""Video4Linux devices and streams by url, opened by OpenCV and set up as a cell file asks."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Protocol

import cv2

from backends.cameras.backend import CAMERA
from backends.cameras.capture import Capture, Connection
from backends.cameras.freshness import FramesInFlight, LargestLatency
from dualcal_hal.errors import CommandRefused, LinkLost
from dualcal_hal.findings import Finding

BUFFERS = 2
"""Frames that the kernel is to keep for us; with one of them every second frame would be lost."""
MOST_BUFFERS = 10
"""That OpenCV has it keep, where a device does not tell."""
IN_CAMERA = 3
"""Frames begun and not yet with the kernel: one being exposed, one read out or compressed, one transferred."""

READ_TIMEOUT_MS = 2000
CLOSENESS = 0.01
"""Share by which a device's own steps may have its setting differ from what was asked."""

_UNITS_PER_SECOND = 1e4  # of Video4Linux' exposure: 100 us each
_MANUAL_EXPOSURE = 1.0  # V4L2_EXPOSURE_MANUAL


class SettableCapture(Capture, Protocol):
    """A capture with settings, as cv2.VideoCapture."""

    def get(self, propId: int) -> float: ...
    def set(self, propId: int, value: float) -> bool: ...


def open_url(url: str, latency: float, timeout: float) -> Connection:
    """An RTSP or HTTP stream whose frames arrive at most ``latency`` s after their exposure began.

    Waits ``timeout`` s at most; LinkLost if it cannot be opened.
    """
    limits = [
        *(cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, max(1, round(timeout * 1e3))),
        *(cv2.CAP_PROP_READ_TIMEOUT_MSEC, READ_TIMEOUT_MS),
    ]
    capture = _opened(lambda: cv2.VideoCapture(url, cv2.CAP_FFMPEG, limits), without_password(url))
    proof = f"frames are taken to arrive {latency * 1e3:g} ms after their exposure began at the latest (latency_ms)"
    finding = Finding("exposure", "a stream does not tell it", "note")
    return Connection(capture, LargestLatency(latency), proof, (finding,))


def open_device(device: int | str, size: tuple[int, int], exposure: float | None, gain: float | None) -> Connection:
    """A Video4Linux device, asked for frames of ``size`` (width, height) px; exposure in s, gain in its own unit.

    LinkLost if it cannot be opened, CommandRefused if it does not take a setting.
    """
    capture = _opened(lambda: cv2.VideoCapture(device, cv2.CAP_V4L2), f"device {device}")
    try:
        return set_up(capture, size, exposure, gain)
    except BaseException:
        capture.release()
        raise


def set_up(capture: SettableCapture, size: tuple[int, int], exposure: float | None, gain: float | None) -> Connection:
    """An open device with all of it set; CommandRefused if it does not take a setting."""
    capture.set(cv2.CAP_PROP_BUFFERSIZE, BUFFERS)
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    settings = []
    if exposure is not None:
        capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)  # where it has none it is manual already
        got = _set(capture, cv2.CAP_PROP_EXPOSURE, exposure * _UNITS_PER_SECOND, "exposure", "x 0.1 ms")
        settings.append(Finding("exposure", f"{got / _UNITS_PER_SECOND * 1e3:g} ms, as set"))
    else:
        advice = "set exposure_ms: one that the camera chooses may change during a run"
        settings.append(Finding("exposure", "the camera's own", "note", advice))
    if gain is not None:
        settings.append(Finding("gain", f"{_set(capture, cv2.CAP_PROP_GAIN, gain, 'gain', ''):g}, as set"))
    buffers = round(capture.get(cv2.CAP_PROP_BUFFERSIZE))
    most = (buffers if 0 < buffers <= MOST_BUFFERS else MOST_BUFFERS) + IN_CAMERA
    proof = f"{most} frames are dropped first, as no more of them can be under way"
    return Connection(capture, FramesInFlight(most), proof, tuple(settings))


def _set(capture: SettableCapture, property_: int, asked: float, what: str, unit: str) -> float:
    """What the device has once it was set."""
    taken = capture.set(property_, asked)
    got = capture.get(property_)
    if not taken or abs(got - asked) > max(CLOSENESS * abs(asked), 0.5):
        why = f"{asked:g} {unit} is asked for, the device has {got:g} {unit}".replace("  ", " ").rstrip()
        raise CommandRefused(CAMERA, f"set {what}", why, "ask for a value that it has, or leave it out")
    return got


def _opened(opener: Callable[[], cv2.VideoCapture], what: str) -> cv2.VideoCapture:
    try:
        capture = opener()
    except cv2.error as error:
        raise LinkLost(CAMERA, f"open {what}", str(error)) from error
    if capture.isOpened():
        return capture
    capture.release()
    raise LinkLost(CAMERA, f"open {what}", "OpenCV cannot open it", "check that it is there, and nobody else uses it")


def without_password(url: str) -> str:
    """The url as it may be shown."""
    return re.sub(r"//[^/@]*@", "//...@", url)
