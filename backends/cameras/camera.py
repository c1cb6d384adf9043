"""A camera as all others see it, whatever its driver."""

from __future__ import annotations

import math
import threading

from backends.cameras.driver import Driver
from dualcal_hal.camera import Camera, Frame
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, FrameRefused, NotOpen
from dualcal_hal.findings import Finding

_LOOKS = 6
_LOOKING = 5.0  # s at most
_SIZE_ADVICE = "set the camera's size, or calibrate its intrinsics for this one"


class DrivenCamera(Camera):
    """Asks its driver while that is open; ``size``: (width, height) in px that the intrinsics are of."""

    def __init__(self, name: str, backend: str, size: tuple[int, int], clock: Clock) -> None:
        self.name = name
        self._backend = backend
        self._size = size
        self._clock = clock
        self._driver: Driver | None = None
        self._one_at_a_time = threading.Lock()

    def opened(self, driver: Driver | None) -> None:
        """Have it be open with this driver, or closed with none."""
        self._driver = driver

    def grab(self, not_before: float, timeout: float) -> Frame:
        frame = self._take(not_before, timeout)
        if (why := self._wrong_size(frame)) is not None:
            raise FrameRefused(self.name, "grab", why, _SIZE_ADVICE)
        return frame

    def findings(self) -> list[Finding]:
        """Takes a few frames."""
        begun = self._clock.now()
        frames: list[Frame] = []
        try:
            while len(frames) < _LOOKS and self._clock.now() < begun + _LOOKING:
                frames.append(self._take(self._clock.now(), _LOOKING))
        except DeviceError as error:
            return [Finding("frames", str(error), "problem", error.advice), *self._driver_findings()]
        took = self._clock.now() - begun
        each = Finding("frames", f"{len(frames) / took:.1f} a second, each exposed after it was asked for")
        return [each, self._size_finding(frames[-1]), *self._driver_findings()]

    def _take(self, not_before: float, timeout: float) -> Frame:
        driver = self._driver
        if driver is None:
            raise NotOpen(self.name, "grab", f"backend '{self._backend}' is not open", "open it first")
        if not math.isfinite(not_before):
            raise CommandRefused(self.name, "grab", f"not_before is {not_before}", "give a time of the clock")
        deadline = self._clock.now() + timeout
        if not self._one_at_a_time.acquire(timeout=max(0.0, timeout)):
            raise DeviceTimeout(self.name, "grab", f"another frame was waited for during {timeout:g} s")
        try:
            return driver.take(not_before, deadline)
        finally:
            self._one_at_a_time.release()

    def _driver_findings(self) -> list[Finding]:
        return [] if self._driver is None else self._driver.findings()

    def _wrong_size(self, frame: Frame) -> str | None:
        height, width = frame.image.shape
        if (width, height) == self._size:
            return None
        return f"frames are {width} x {height} px, the cell file's intrinsics are of {self._size[0]} x {self._size[1]}"

    def _size_finding(self, frame: Frame) -> Finding:
        why = self._wrong_size(frame)
        if why is None:
            return Finding("frame size", f"{self._size[0]} x {self._size[1]} px, as the intrinsics'")
        return Finding("frame size", why, "problem", _SIZE_ADVICE)
