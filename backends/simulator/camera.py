"""The simulated camera as a device."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from backends.simulator.noise import normal_image
from backends.simulator.pattern import Values
from backends.simulator.rendering import Renderer
from backends.simulator.scene import Scene
from backends.simulator.world import World
from dualcal_hal.camera import Camera, Frame, Image
from dualcal_hal.errors import CommandRefused, DeviceTimeout, NotOpen
from dualcal_hal.transforms import Array

LATENCY = 0.02  # s of simulated time from the start of the exposure to the frame

POSES = 9
"""Poses that the target is drawn at during an exposure that takes time."""


@dataclass(frozen=True, eq=False)
class Sight:
    """What there is to see, and how it is drawn; without a scene there is the target alone."""

    world: World
    renderer: Renderer
    scene: Scene | None


class SimulatedCamera(Camera):
    """``opened(device, attempted)`` gives what it looks at, or raises NotOpen; ``exposure``: s the shutter is open.

    frames: how many it has taken.
    """

    def __init__(self, name: str, opened: Callable[[str, str], Sight], exposure: float) -> None:
        self.name = name
        self._opened = opened
        self._exposure = exposure
        self._latency = max(LATENCY, exposure)
        self.frames = 0

    def grab(self, not_before: float, timeout: float) -> Frame:
        """What is behind the target, or before it, is where it was at the exposure's start."""
        sight = self._opened(self.name, "grab")
        world = sight.world
        if not math.isfinite(not_before):
            raise CommandRefused(self.name, "grab", f"not_before is {not_before}", "give a time of the clock")
        deadline = world.clock.now() + timeout
        if max(not_before, world.clock.now()) + self._latency > deadline:
            self._wait(world, deadline)
            raise DeviceTimeout(self.name, "grab", f"no frame within {timeout:g} s", "allow more time")
        self._wait(world, not_before)
        with world.lock:
            self._require_open(world)
            begin = world.clock.now()
            T_E_T = world.T_E_T(begin)
            view = None if sight.scene is None else sight.scene.view(T_E_T)
            noise = world.sample_noise(self.name, "frame")
            self.frames += 1
            sequence = self.frames
        image = sight.renderer.expose([T_E_T, *self._later_poses(world, begin)], view)
        self._wait(world, begin + self._latency)
        return Frame(with_noise(image, noise, world.noise.image_grey), begin, sequence)

    def _later_poses(self, world: World, begin: float) -> list[Array]:
        """The target in the camera (4, 4) at further times of an exposure, none if that takes no time."""
        if self._exposure == 0.0:
            return []
        poses = []
        for when in np.linspace(begin, begin + self._exposure, POSES)[1:].tolist():
            self._wait(world, when)
            poses.append(world.T_E_T(when))
        return poses

    def _wait(self, world: World, until: float) -> None:
        world.clock.wait(world.closed, until)
        self._require_open(world)

    def _require_open(self, world: World) -> None:
        if world.closed.is_set():
            raise NotOpen(self.name, "grab", "it was closed meanwhile", "open its backend again")


def with_noise(image: Values, source: np.random.Generator, sigma: float) -> Image:
    """The grey values with noise, rounded to 8 bits; read-only."""
    noise = normal_image(source, image.shape)
    exposed = np.asarray(cv2.addWeighted(image, 1.0, noise, sigma, 0.0, dtype=cv2.CV_8U), dtype=np.uint8)
    exposed.setflags(write=False)
    return exposed
