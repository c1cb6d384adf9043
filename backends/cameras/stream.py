"""Cameras that send frames all the time: one thread takes each as it arrives, and keeps what was asked for."""

from __future__ import annotations

import threading
from abc import abstractmethod
from collections import deque
from collections.abc import Callable
from itertools import pairwise

from backends.cameras.driver import Driver
from dualcal_hal.camera import Frame, Image
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, NotOpen
from dualcal_hal.findings import Finding

TICK = 0.05
"""s after which a thread that waits for a frame looks whether it is to end."""

_COUNTED = 200  # arrivals that the rate is of


class _Request:
    """For a frame; answered by the thread that takes them."""

    def __init__(self, not_before: float) -> None:
        self.not_before = not_before
        self.answered = threading.Event()
        self.frame: Frame | None = None
        self.error: DeviceError | None = None
        self.too_early = 0


class Stream(Driver):
    """``serve`` begins the thread, which calls :meth:`receive` again and again."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self.clock = clock
        self.arrivals: deque[float] = deque(maxlen=_COUNTED)
        self.ending = threading.Event()
        self._lock = threading.Lock()
        self._request: _Request | None = None
        self._down: Callable[[], DeviceError] | None = None
        self._thread = threading.Thread(target=self._serve, name=f"frames of {name}", daemon=True)

    @property
    @abstractmethod
    def proof(self) -> str:
        """How it is known when an exposure began, for an operator."""

    @abstractmethod
    def receive(self) -> None:
        """Wait about TICK for a frame at most; call :meth:`offer` with it, :meth:`refuse`, :meth:`set_down`."""

    def serve(self) -> None:
        """Begin to take frames."""
        self._thread.start()

    def take(self, not_before: float, deadline: float) -> Frame:
        request = _Request(not_before)
        with self._lock:
            if self._down is not None:
                raise self._down()
            self._request = request
        try:
            self.clock.wait(request.answered, deadline)
        finally:
            with self._lock:
                self._request = None
        if request.error is not None:
            raise request.error
        if request.frame is None:
            raise self._too_late(request)
        return request.frame

    def close(self) -> None:
        def closed() -> DeviceError:
            return NotOpen(self.name, "grab", "it was closed meanwhile", "open its backend again")

        with self._lock:
            self.ending.set()
            self._down = closed
        self.refuse(closed())
        if self._thread.is_alive():
            self._thread.join()

    # Called by the thread that takes frames

    def offer(self, earliest: float, sequence: int, image: Callable[[], Image]) -> None:
        """A frame has arrived whose exposure began at ``earliest`` or later; ``image`` gives it if it is wanted."""
        self.arrivals.append(self.clock.now())
        with self._lock:
            request = self._request
        if request is None:
            return
        if earliest < request.not_before:
            request.too_early += 1
            return
        try:
            picture = image()
        except DeviceError as error:
            request.error = error
        else:
            picture.setflags(write=False)
            request.frame = Frame(picture, earliest, sequence)
        self._answered(request)

    def refuse(self, error: DeviceError) -> None:
        """What arrived must not be used; told to whoever waits."""
        with self._lock:
            request = self._request
        if request is not None:
            request.error = error
            self._answered(request)

    def set_down(self, error: Callable[[], DeviceError] | None) -> None:
        """No frame comes from here on, to whoever waits or asks; with None they come again."""
        with self._lock:
            if self.ending.is_set():
                return
            self._down = error
        if error is not None:
            self.refuse(error())

    def _answered(self, request: _Request) -> None:
        """Once: what comes after it is for the next request."""
        with self._lock:
            if self._request is request:
                self._request = None
        request.answered.set()

    def _serve(self) -> None:
        try:
            while not self.ending.is_set():
                self.receive()
        except BaseException as error:
            why = f"an error of this program ended the taking of frames: {error!r}"
            self.set_down(lambda: DeviceError(self.name, "grab", why))
            raise

    def _too_late(self, request: _Request) -> DeviceTimeout:
        if request.too_early:
            why = f"{request.too_early} frames came, and for none of them it is proven that it was exposed late enough"
            return DeviceTimeout(self.name, "grab", why, "allow more time")
        return DeviceTimeout(self.name, "grab", "no frame came", "check the camera, or allow more time")

    # For findings

    @property
    def rate(self) -> float | None:
        """Frames a second as they arrived, None before there are enough."""
        arrivals = list(self.arrivals)
        return (len(arrivals) - 1) / (arrivals[-1] - arrivals[0]) if len(arrivals) > 2 else None

    def findings(self) -> list[Finding]:
        """Rate and longest gap as frames arrived, and how exposures are proven."""
        found = [Finding("proof of exposure", self.proof)]
        if (rate := self.rate) is not None:
            arrivals = list(self.arrivals)
            gap = max(b - a for a, b in pairwise(arrivals))
            found.insert(0, Finding("camera rate", f"{rate:.1f} frames a second, longest gap {gap * 1e3:.0f} ms"))
        return found
