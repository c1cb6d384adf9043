"""Images of a board with known corners, in front of clutter or without."""

from __future__ import annotations

import cv2
import numpy as np

from backends.simulator.rendering import Renderer
from dualcal_hal.camera import Image, Intrinsics
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array
from tools.benchmarks.clutter import clutter
from tools.benchmarks.corners import DISTORTION, FACING, project, random_view

MARGIN = 0.6  # squares of white around the pattern
NOISE = 2.0  # grey levels


def intrinsics(size: tuple[int, int] = (1024, 768), distorted: bool = True) -> Intrinsics:
    width, height = size
    f = 812.0 * width / 1024
    matrix = np.array([[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]])
    distortion = DISTORTION if distorted else np.zeros(5)
    return Intrinsics(matrix, distortion, size)


__all__ = ["FACING", "MARGIN", "NOISE", "Scene", "clutter", "intrinsics", "project", "random_view"]


class Scene:
    """Images of one board by one camera, with ``noise`` in grey levels from ``rng``."""

    def __init__(
        self, board: Target, camera: Intrinsics, rng: np.random.Generator, blur: float = 0.6, noise: float = NOISE
    ) -> None:
        self._board, self._camera, self._rng, self._noise = board, camera, rng, noise
        self._renderer = Renderer(board, MARGIN * board.square, camera, blur)

    def image(self, T_E_T: Array, background: Image | None = None) -> Image:
        """The board at ``T_E_T``, in front of ``background`` if there is one."""
        grey = self._renderer.render(T_E_T)
        if background is not None:
            outwards = np.sign(self._board.outline - self._board.outline.mean(axis=0))
            plate = self._board.outline + (MARGIN - 0.1) * self._board.square * outwards
            outline = np.rint(project(self._board, self._camera, T_E_T, plate)).astype(np.int32)
            on_plate = cv2.fillConvexPoly(np.zeros(grey.shape, np.uint8), outline, 1)
            grey = np.where(on_plate, grey, background)
        noisy = grey + self._noise * self._rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
