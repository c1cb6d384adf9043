"""Where the board stands to the camera, from its corners."""

from __future__ import annotations

import cv2
import numpy as np
from cv2.typing import MatLike

from dualcal_hal.camera import Intrinsics
from dualcal_hal.errors import DegenerateCaptures, UsageError
from dualcal_hal.target import Target
from dualcal_hal.transforms import Array, transform


def board_poses(corners_px: Array, board: Target, intrinsics: Intrinsics) -> list[tuple[Array, float]]:
    """The poses ``T_E_T`` (4, 4), lengths in m, that explain the corners, with their rms residual in px.

    corners_px: (n, 2) px in the distorted image, in the board's order, NaN for a corner that was not seen. A plane
    seen from afar has two poses of nearly equal residual (infinitesimal plane-based pose estimation, Collins and
    Bartoli 2014); each is refined by least squares (Levenberg-Marquardt) on the residuals in the image, and the
    better comes first. The rms is per axis. Raises UsageError for corners of the wrong number or fewer than four
    seen, DegenerateCaptures where they determine no pose.
    """
    pixels = np.asarray(corners_px, dtype=float)
    if pixels.shape != (len(board.corners), 2) or np.isinf(pixels).any() or np.isfinite(pixels[:, 0]).sum() < 4:
        raise UsageError(
            f"a board's pose needs {len(board.corners)} corners, of which at least 4 are finite and the others NaN,"
            f" got shape {pixels.shape}"
        )
    seen = np.isfinite(pixels[:, 0])
    pixels, points = pixels[seen], board.corners[seen]
    lens = (intrinsics.matrix, intrinsics.distortion)
    try:
        # IPPE wants its points about the origin of their plane, which those seen need not be.
        middle = points.mean(axis=0)
        _, rotations, translations, _ = cv2.solvePnPGeneric(points - middle, pixels, *lens, flags=cv2.SOLVEPNP_IPPE)
        poses = [
            _refined(pixels, points, lens, r, t - cv2.Rodrigues(r)[0] @ middle[:, None])
            for r, t in zip(rotations, translations, strict=True)
        ]
    except cv2.error as error:
        raise DegenerateCaptures(f"the corners determine no pose of the board: {error.err}") from error
    poses = [(T, rms) for T, rms in poses if np.isfinite(rms)]
    if not poses:
        raise DegenerateCaptures("the corners determine no pose of the board")
    return sorted(poses, key=lambda pose: pose[1])


def _refined(
    pixels: Array, points: Array, lens: tuple[Array, Array], rvec: MatLike, tvec: MatLike
) -> tuple[Array, float]:
    refined, position = cv2.solvePnPRefineLM(points, pixels, *lens, rvec, tvec)
    projected, _ = cv2.projectPoints(points, refined, position, *lens)
    residuals = projected.reshape(-1, 2) - pixels
    rotation, _ = cv2.Rodrigues(refined)
    return transform(rotation, position.ravel()), float(np.sqrt(np.mean(residuals**2)))
