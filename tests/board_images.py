"""Images of a checkerboard with known corners, and clutter without one."""

from __future__ import annotations

import cv2
import numpy as np

from backends.simulator.rendering import Renderer
from dualcal_hal.camera import Image, Intrinsics
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array
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
    """Images of one board by one camera, with noise in grey levels from ``rng``."""

    def __init__(self, board: Checkerboard, camera: Intrinsics, rng: np.random.Generator, blur: float = 0.6) -> None:
        self._board, self._camera, self._rng = board, camera, rng
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
        noisy = grey + NOISE * self._rng.standard_normal(grey.shape, dtype=np.float32)
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def clutter(rng: np.random.Generator, size: tuple[int, int] = (1024, 768)) -> Image:
    """Boxes, grids, discs, lines and text: a workshop without a target."""
    width, height = size
    image = np.full((height, width), int(rng.integers(60, 180)), np.uint8)
    for _ in range(120):
        grey = int(rng.integers(0, 256))
        x, y = (int(c) for c in rng.integers(0, size))
        extent = int(rng.integers(10, 150))
        match rng.integers(5):
            case 0:
                box = cv2.boxPoints(((x, y), (extent, float(rng.uniform(0.4, 1.6) * extent)), rng.uniform(0, 90)))
                cv2.fillConvexPoly(image, np.rint(box).astype(np.int32), grey, cv2.LINE_AA)
            case 1:
                cv2.circle(image, (x, y), extent // 2, grey, -1, cv2.LINE_AA)
            case 2:
                cv2.line(image, (x, y), tuple(int(c) for c in rng.integers(0, size)), grey, extent // 12 + 1)
            case 3:
                cv2.putText(image, "cell 42", (x, y), cv2.FONT_HERSHEY_SIMPLEX, extent / 40, grey, 3)
            case _:  # black boxes in a row or a grid, the nearest to a checkerboard that is none
                side = max(extent // 4, 6)
                for i, j in np.ndindex(int(rng.integers(1, 5)), int(rng.integers(1, 5))):
                    if rng.random() < 0.8:
                        corner = (x + 2 * side * j, y + 2 * side * i)
                        cv2.rectangle(image, corner, (corner[0] + side, corner[1] + side), grey, -1)
    blurred = cv2.GaussianBlur(image, (0, 0), 0.6) + 2.0 * rng.standard_normal(image.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)
