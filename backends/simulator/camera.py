"""The simulated camera as a device."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import cv2
import numpy as np

from backends.simulator.noise import normal_image
from backends.simulator.pattern import Values
from backends.simulator.rendering import Renderer
from backends.simulator.world import World
from dualcal_hal.camera import Camera, Frame, Image
from dualcal_hal.errors import CommandRefused, DeviceTimeout, NotOpen

LATENCY = 0.02  # s of simulated time from the start of the exposure to the frame


class SimulatedCamera(Camera):
    """``opened(device, attempted)`` gives the world and its renderer, or raises NotOpen."""

    def __init__(self, name: str, opened: Callable[[str, str], tuple[World, Renderer]]) -> None:
        self.name = name
        self._opened = opened
        self._sequence = itertools.count(1)

    def grab(self, not_before: float, timeout: float) -> Frame:
        """The exposure takes no time: the image shows where everything was at its start."""
        world, renderer = self._opened(self.name, "grab")
        if not math.isfinite(not_before):
            raise CommandRefused(self.name, "grab", f"not_before is {not_before}", "give a time of the clock")
        deadline = world.clock.now() + timeout
        if max(not_before, world.clock.now()) + LATENCY > deadline:
            self._wait(world, deadline)
            raise DeviceTimeout(self.name, "grab", f"no frame within {timeout:g} s", "allow more time")
        self._wait(world, not_before)
        with world.lock:
            begin = world.clock.now()
            T_E_T = world.T_E_T(begin)
            noise = world.sample_noise(self.name, "frame")
            sequence = next(self._sequence)
        self._wait(world, begin + LATENCY)
        return Frame(_exposed(renderer.render(T_E_T), noise, world.noise.image_grey), begin, sequence)

    def _wait(self, world: World, until: float) -> None:
        if world.clock.wait(world.closed, until):
            raise NotOpen(self.name, "grab", "it was closed meanwhile", "open its backend again")


def _exposed(image: Values, source: np.random.Generator, sigma: float) -> Image:
    """The grey values with noise, rounded to 8 bits; read-only."""
    noise = normal_image(source, image.shape)
    exposed = np.asarray(cv2.addWeighted(image, 1.0, noise, sigma, 0.0, dtype=cv2.CV_8U), dtype=np.uint8)
    exposed.setflags(write=False)
    return exposed
