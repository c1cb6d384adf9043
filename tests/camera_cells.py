"""Cells whose camera is a real one, and a sender to be listened to."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import RealClock
from tests.cells import TINY

if TYPE_CHECKING:
    from backends.cameras.publisher import FramePublisher

SIZE = (512, 384)
"""Of the cell's intrinsics: width, height."""
CLOCK = RealClock()


def camera_cell(entry: str, *overrides: str) -> CellFile:
    """The tiny cell with its camera at this entry of ``backends``, named ``lens``."""
    return load_cell(TINY, (f"backends.lens={entry}", "camera.backend=lens", *overrides))


def picture(number: int, size: tuple[int, int] = SIZE) -> Image:
    """An image that tells its number: each pixel is that, modulo 256."""
    width, height = size
    return np.full((height, width), number % 256, np.uint8)


class Sender:
    """A thread that publishes frames, 50 a second; their numbers are those of the moments in ``exposed``."""

    def __init__(
        self,
        publisher: Callable[[], FramePublisher],
        size: tuple[int, int] = SIZE,
        delay: float = 0.0,
        period: float = 0.02,
    ) -> None:
        """``delay``: s from the exposure to its being sent."""
        self.exposed: dict[int, float] = {}
        self.endpoint = ""
        self._make, self._size, self._delay, self._period = publisher, size, delay, period
        self._started, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve, name="sender")

    def __enter__(self) -> Self:
        self._thread.start()
        assert self._started.wait(10)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()

    def end(self) -> None:
        """Publish nothing more, and be gone."""
        self._ended.set()
        self._thread.join()

    def _serve(self) -> None:
        with self._make() as publisher:
            self.endpoint = publisher.endpoint
            self._started.set()
            number = 0
            while not self._ended.is_set():
                number += 1
                exposed = self.exposed[number] = CLOCK.now()
                CLOCK.wait(self._ended, exposed + self._delay)
                publisher.publish(picture(number, self._size), exposed, number, exposure=0.004)
                CLOCK.wait(self._ended, exposed + max(self._delay, self._period))
