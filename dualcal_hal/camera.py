"""What a camera is to everybody else."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dualcal_hal.findings import Finding

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """Pinhole with OpenCV's distortion. Pixel centres are integers.

    matrix: (3, 3) in px; distortion: (k1, k2, p1, p2, k3); size: (width, height) in px.
    """

    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def principal_point(self) -> NDArray[np.float64]:
        """(2,) px: where the optical axis meets the raw image, since distortion is zero there."""
        return self.matrix[:2, 2]


@dataclass(frozen=True, eq=False)
class Frame:
    """One grey image (height, width); ``time``: seconds of the clock at the start of the exposure."""

    image: Image
    time: float
    sequence: int


class Camera(ABC):
    """Frames on demand."""

    name: str

    @abstractmethod
    def grab(self, not_before: float, timeout: float) -> Frame:
        """A frame whose exposure began at or after ``not_before`` (clock's seconds), never an older one.

        Raises DeviceTimeout, FrameRefused, LinkLost or NotOpen.
        """

    def findings(self) -> list[Finding]:
        """What an operator is told of it by a check: its rate, its exposure, whose clock its times are of."""
        return []
