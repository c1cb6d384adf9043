"""A folder of images as a camera, to try things out with: each is one frame, exposed when it is asked for."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np

from backends.cameras.driver import Driver
from dualcal_hal.camera import Frame
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceTimeout, FrameRefused, NotOpen, UsageError
from dualcal_hal.findings import Finding

SUFFIXES = (".bmp", ".jpeg", ".jpg", ".pgm", ".png", ".tif", ".tiff")

# As the sensor saw it: a note on how to hold the picture would exchange the axes.
_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION


class Folder(Driver):
    """Images in the order of their names; after the last one the first comes again."""

    def __init__(self, name: str, clock: Clock, folder: Path) -> None:
        """UsageError if the folder holds none."""
        self._name, self._clock, self._folder = name, clock, folder
        try:
            self._files = sorted(file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES)
        except OSError as error:
            raise UsageError(f"{folder}: cannot be read: {error.strerror}") from error
        if not self._files:
            raise UsageError(f"{folder}: holds no image ({', '.join(SUFFIXES)})")
        self._served = 0
        self._closed = threading.Event()

    def take(self, not_before: float, deadline: float) -> Frame:
        if self._clock.wait(self._closed, min(not_before, deadline)):
            raise NotOpen(self._name, "grab", "it was closed meanwhile", "open its backend again")
        exposed = self._clock.now()
        if exposed < not_before:
            raise DeviceTimeout(self._name, "grab", "the time it is to be exposed at is later", "allow more time")
        file = self._files[self._served % len(self._files)]
        self._served += 1
        try:
            image = cv2.imread(str(file), _AS_STORED)
        except cv2.error as error:
            raise FrameRefused(self._name, "grab", f"{file}: {error}") from error
        if image is None:
            raise FrameRefused(self._name, "grab", f"{file}: is no image that can be read")
        grey = image.astype(np.uint8, copy=False)
        grey.setflags(write=False)
        return Frame(grey, exposed, self._served)

    def findings(self) -> list[Finding]:
        said = f"{len(self._files)} images of {self._folder}, each once, then anew"
        return [Finding("camera", said, "note", "this is no camera: it shows what was there before")]

    def close(self) -> None:
        self._closed.set()
