"""Images of a workshop without a target, to be told from one."""

from __future__ import annotations

import cv2
import numpy as np

from dualcal_hal.camera import Image


def clutter(rng: np.random.Generator, size: tuple[int, int] = (1024, 768)) -> Image:
    """Boxes, grids, discs, lines, text, gratings and a checkerboard of another size: a workshop without a target."""
    width, height = size
    image = np.full((height, width), int(rng.integers(60, 180)), np.uint8)
    for _ in range(120):
        grey = int(rng.integers(0, 256))
        x, y = (int(c) for c in rng.integers(0, size))
        extent = int(rng.integers(10, 150))
        match rng.integers(6):
            case 0:
                box = cv2.boxPoints(((x, y), (extent, float(rng.uniform(0.4, 1.6) * extent)), rng.uniform(0, 90)))
                cv2.fillConvexPoly(image, np.rint(box).astype(np.int32), grey, cv2.LINE_AA)
            case 1:
                cv2.circle(image, (x, y), extent // 2, grey, -1, cv2.LINE_AA)
            case 2:
                cv2.line(image, (x, y), tuple(int(c) for c in rng.integers(0, size)), grey, extent // 12 + 1)
            case 3:
                cv2.putText(image, "cell 42", (x, y), cv2.FONT_HERSHEY_SIMPLEX, extent / 40, grey, 3)
            case 4:
                patch = image[y : y + extent, x : x + extent]
                patch[:] = _grating(rng, patch.shape)
            case _:  # black boxes in a row or a grid, the nearest to a checkerboard that is none
                side = max(extent // 4, 6)
                for i, j in np.ndindex(int(rng.integers(1, 5)), int(rng.integers(1, 5))):
                    if rng.random() < 0.8:
                        corner = (x + 2 * side * j, y + 2 * side * i)
                        cv2.rectangle(image, corner, (corner[0] + side, corner[1] + side), grey, -1)
    _draw_other_checkerboard(rng, image)
    blurred = cv2.GaussianBlur(image, (0, 0), 0.6) + 2.0 * rng.standard_normal(image.shape)
    return np.clip(np.rint(blurred), 0, 255).astype(np.uint8)


def _grating(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Parallel stripes, smooth or sharp, or two sets of them laid over each other like a tartan's."""
    v, u = np.indices(shape)
    waves = []
    for _ in range(int(rng.integers(1, 3))):
        direction, period = rng.uniform(0, np.pi), rng.uniform(6, 40)
        waves.append(np.sin(2 * np.pi * (u * np.cos(direction) + v * np.sin(direction)) / period))
    wave = np.max(waves, axis=0)
    if rng.random() < 0.5:
        wave = np.clip(3 * wave, -1, 1)
    return np.asarray(np.rint(128 + rng.uniform(20, 120) * wave), dtype=np.uint8)


def _draw_other_checkerboard(rng: np.random.Generator, image: Image) -> None:
    """A checkerboard of any size but 3 x 3 inner corners, whole, in any direction."""
    rows, columns = 3, 3
    while (rows, columns) == (3, 3):
        rows, columns = (int(n) for n in rng.integers(1, 8, 2))
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    dark, bright = rng.uniform(0, 80), rng.uniform(120, 255)
    board = np.full((rows + 3, columns + 3), bright)
    board[1:-1, 1:-1] = np.where(squares == 0, dark, bright)
    side, cell = float(rng.uniform(12, 40)), 16
    large = np.kron(board, np.ones((cell, cell))).astype(np.uint8)
    turn = cv2.getRotationMatrix2D((large.shape[1] / 2, large.shape[0] / 2), rng.uniform(0, 360), side / cell)
    half = 0.5 * side * np.hypot(*board.shape)
    middle = [rng.uniform(min(half, n / 2), max(n - half, n / 2)) for n in image.shape[::-1]]
    turn[:, 2] = turn[:, 2] + np.array(middle) - np.array(large.shape[::-1]) / 2
    size = image.shape[::-1]
    covered = cv2.warpAffine(np.full_like(large, 255), turn, size) > 127
    image[covered] = cv2.warpAffine(large, turn, size, flags=cv2.INTER_LINEAR)[covered]
