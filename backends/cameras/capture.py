"""Cameras that OpenCV opens and that send frames by themselves: Video4Linux devices, RTSP and HTTP streams.

OpenCV hands over what has waited longest, not what is newest, so a thread takes out all frames as they come.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np

from backends.cameras.freshness import FramesInFlight, LargestLatency
from backends.cameras.stream import Stream
from dualcal_hal.camera import Image
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, FrameRefused, LinkLost
from dualcal_hal.findings import Finding

FIRST_PAUSE, LONGEST_PAUSE = 0.25, 5.0
"""s between attempts to open a camera anew that was lost."""


class Capture(Protocol):
    """What is used of cv2.VideoCapture."""

    def grab(self) -> bool: ...
    def retrieve(self) -> tuple[bool, Any]: ...
    def release(self) -> None: ...


@dataclass(frozen=True)
class Connection:
    """An open camera, what proves its exposures, and what an operator is told of both."""

    capture: Capture
    rule: FramesInFlight | LargestLatency
    proof: str
    settings: tuple[Finding, ...]


class CaptureStream(Stream):
    """``connect`` opens the camera with all its settings, or raises a DeviceError; called again when it was lost."""

    def __init__(self, name: str, clock: Clock, connect: Callable[[], Connection]) -> None:
        super().__init__(name, clock)
        self._connect = connect
        self._connection = connect()
        self._lost = False
        self._number = 0
        self._pause = FIRST_PAUSE

    @property
    def proof(self) -> str:
        return self._connection.proof

    def receive(self) -> None:
        if self._lost:
            self._open_anew()
            return
        connection = self._connection
        if not connection.capture.grab():
            self._lost = True
            connection.capture.release()
            self.set_down(self._no_more)
            return
        self._number += 1
        earliest = connection.rule.arrived(self.clock.now())
        self.offer(earliest, self._number, lambda: self._image(connection.capture))

    def _open_anew(self) -> None:
        if self.clock.wait(self.ending, self.clock.now() + self._pause):
            return
        try:
            self._connection = self._connect()
        except DeviceError:
            self._pause = min(2 * self._pause, LONGEST_PAUSE)
            return
        self._lost, self._pause = False, FIRST_PAUSE
        self.set_down(None)

    def _no_more(self) -> LinkLost:
        return LinkLost(self.name, "grab", "it sends no more frames", "check its cable or network")

    def _image(self, capture: Capture) -> Image:
        try:
            decoded, image = capture.retrieve()
            if decoded:
                return grey(image)
        except (cv2.error, ValueError) as error:
            raise FrameRefused(self.name, "grab", f"its frame cannot be used: {error}") from error
        raise FrameRefused(self.name, "grab", "its frame cannot be decoded", "check its cable or network")

    def findings(self) -> list[Finding]:
        """Besides what every stream has: what was set."""
        return [*super().findings(), *self._connection.settings]

    def close(self) -> None:
        super().close()
        self._connection.capture.release()


def grey(image: Any) -> Image:
    """(height, width) of what OpenCV decodes: grey, or blue, green and red; ValueError for all else."""
    if image is None or image.dtype != np.uint8:
        raise ValueError("it has no 8 bits a pixel")
    if image.ndim == 2:
        return np.asarray(image, dtype=np.uint8)
    if image.ndim == 3 and image.shape[2] == 1:
        return np.asarray(image[:, :, 0], dtype=np.uint8)
    if image.ndim == 3 and image.shape[2] == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
    raise ValueError(f"its shape is {image.shape}")
