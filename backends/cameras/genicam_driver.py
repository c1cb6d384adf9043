"""An industrial camera by GenICam, asked for one frame at a time.

Two ways of asking, each of which proves that the exposure began after it: a software trigger, or an acquisition that
is begun for the frame and ended after it. Neither holds while a frame of an earlier asking may still come: after
whatever went wrong the acquisition is begun anew, which throws away all that is under way.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from backends.cameras.driver import Driver
from backends.cameras.features import Features, translated
from backends.cameras.frame_ids import FrameIds
from dualcal_hal.camera import Frame, Image
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, FrameRefused, NotOpen
from dualcal_hal.findings import Finding

PIXELS = "Mono8"

_LOOK = 0.1  # s after which a wait for a buffer looks whether it is to end
_GLANCE = 1e-3  # s for a buffer that is there already
_NETWORK = "check cable and network: jumbo frames, packet delay, a port of its own"


class Asking(ABC):
    """How a camera is asked for a frame; ``acquirer``: as harvesters makes it."""

    said: str
    """For an operator."""

    def __init__(self, acquirer: Any, features: Features) -> None:
        self.acquirer, self.features = acquirer, features

    @abstractmethod
    def prepare(self) -> None:
        """Once the camera is set up."""

    @abstractmethod
    def ask(self) -> bool:
        """For a frame that is exposed from now on; says whether the camera's frame ids begin anew."""

    @abstractmethod
    def answered(self) -> None:
        """The frame has come."""

    def forget(self) -> None:
        """Throw away what was asked for."""
        self.acquirer.stop()


class SoftwareTrigger(Asking):
    """The camera waits for triggers all the time."""

    said = "each frame by a software trigger"

    def prepare(self) -> None:
        if self.features.has("TriggerSelector"):
            self.features.choose("TriggerSelector", "FrameStart")
        self.features.choose("TriggerMode", "On")
        self.features.choose("TriggerSource", "Software")

    def ask(self) -> bool:
        begins = not self.acquirer.is_acquiring()
        if begins:
            self.acquirer.start()
        self.features.execute("TriggerSoftware")
        return begins

    def answered(self) -> None:
        """It waits for the next trigger."""


class OwnAcquisition(Asking):
    """The camera runs freely, but only while a frame is waited for."""

    said = "an acquisition of its own for each frame"

    def prepare(self) -> None:
        if self.features.has("TriggerMode"):
            self.features.choose("TriggerMode", "Off")

    def ask(self) -> bool:
        if self.acquirer.is_acquiring():
            return False  # its first frame did not come whole: what comes now is later still
        self.acquirer.start()
        return True

    def answered(self) -> None:
        self.acquirer.stop()


class GenicamDriver(Driver):
    """``described`` is for an operator, ``release`` lets go of the acquirer and its producer."""

    def __init__(
        self,
        name: str,
        clock: Clock,
        acquirer: Any,
        asking: Asking,
        described: tuple[Finding, ...],
        release: Callable[[], None],
    ) -> None:
        self._name, self._clock = name, clock
        self._acquirer, self._asking = acquirer, asking
        self._described, self._release = described, release
        self._ids = FrameIds()
        self._incomplete = self._unasked = 0
        self._in_use = threading.Lock()
        self._closed = threading.Event()

    def told_incomplete(self) -> None:
        """Called by harvesters for a buffer that did not come whole; it is thrown away."""
        self._incomplete += 1

    def take(self, not_before: float, deadline: float) -> Frame:
        with self._in_use, translated(self._name, "grab"):
            self._clock.wait(self._closed, min(not_before, deadline))
            self._require_open()
            if self._clock.now() < not_before:
                raise DeviceTimeout(self._name, "grab", "the time it is to be exposed at is later", "allow more time")
            try:
                self._leave_none_waiting()
                return self._whole_frame(deadline)
            except BaseException:
                # What was asked for may still come, and must not be taken for what is asked for next.
                with suppress(DeviceError), translated(self._name, "grab"):
                    self._asking.forget()
                raise

    def _leave_none_waiting(self) -> None:
        """A camera that sends more than it is asked for, as by a trigger of something else, would be a frame ahead."""
        if self._acquirer.is_acquiring() and (unasked := self._acquirer.try_fetch(timeout=_GLANCE)) is not None:
            unasked.queue()
            self._unasked += 1
            self._asking.forget()

    def _whole_frame(self, deadline: float) -> Frame:
        """Asks again where a frame did not come whole."""
        refused = 0
        asked = self._clock.now()
        while True:
            if self._asking.ask():
                self._ids.restart()
            before = self._incomplete
            buffer = self._buffer(before, deadline)
            if buffer is not None:
                try:
                    return self._frame(buffer, asked)
                finally:
                    buffer.queue()
                    self._asking.answered()
            refused += self._incomplete - before
            if self._incomplete == before or self._clock.now() >= deadline:
                self._require_open()
                raise self._too_late(refused)

    def _buffer(self, incomplete: int, deadline: float) -> Any:
        """None if the time is over, it was closed, or what came was not whole."""
        while (left := deadline - self._clock.now()) > 0 and not self._closed.is_set():
            buffer = self._acquirer.try_fetch(timeout=min(left, _LOOK))
            if buffer is not None or self._incomplete > incomplete:
                return buffer
        return None

    def _frame(self, buffer: Any, asked: float) -> Frame:
        try:
            number = self._ids.number(int(buffer.module.frame_id))
            return Frame(_image(buffer), asked, number)
        except ValueError as error:
            raise FrameRefused(self._name, "grab", str(error), "check the camera's settings") from error

    def _too_late(self, refused: int) -> DeviceError:
        if refused:
            return FrameRefused(self._name, "grab", f"{refused} frames did not come whole, and none that did", _NETWORK)
        return DeviceTimeout(self._name, "grab", "no frame came", "check the camera, or allow more time")

    def _require_open(self) -> None:
        if self._closed.is_set():
            raise NotOpen(self._name, "grab", "it was closed meanwhile", "open its backend again")

    def findings(self) -> list[Finding]:
        found = [*self._described, Finding("proof of exposure", self._asking.said)]
        if self._incomplete:
            found.append(Finding("lost frames", f"{self._incomplete} did not come whole", "note", _NETWORK))
        if self._unasked:
            why = f"{self._unasked} times a frame came that was not asked for, and was thrown away"
            found.append(Finding("trigger", why, "note", "see what else triggers it, and how many frames a trigger is"))
        return found

    def close(self) -> None:
        self._closed.set()
        with self._in_use, translated(self._name, "close"):
            self._release()


def _image(buffer: Any) -> Image:
    """(height, width), a copy; ValueError if the buffer holds none."""
    components = buffer.payload.components
    if not components:
        raise ValueError("its buffer holds no image")
    image = components[0]
    if image.data_format != PIXELS:
        raise ValueError(f"its image is of {image.data_format}, not of {PIXELS}")
    width, height = int(image.width), int(image.height)
    if image.data.size != width * height:
        raise ValueError(f"{image.data.size} bytes came for {width} x {height} px")
    copy = np.array(image.data, dtype=np.uint8).reshape(height, width)
    copy.setflags(write=False)
    return copy
