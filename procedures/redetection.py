"""Detection anew in the images of a finished run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.camera import Image
from dualcal_hal.config import CellConfig
from dualcal_hal.errors import LogMissing, UsageError
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.session.folder import Session
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.log import Picture, StepBegun, StepFinished
from dualcal_hal.session.log.attempts import FinishedAttempts, begun_segments
from dualcal_hal.session.result import Rejected
from procedures.detection import Detector, Missed
from procedures.detection.outcome import corners_from_record, corners_to_record


@dataclass(frozen=True)
class DetectedAnew:
    """captures: with what their images show now; missed: those whose images show no target now; rms: px by which the
    corners differ from the recorded ones, None where there is nothing to compare."""

    captures: Captures
    missed: tuple[Rejected, ...]
    rms: float | None

    @property
    def moved(self) -> str:
        """``rms`` in words."""
        if self.rms is None:
            return "no recorded corners to compare with"
        return f"{self.rms:.3g} px rms from the recorded corners" if self.rms else "the same corners to the last bit"


def detect_anew(session: Session, captures: Captures, cell: CellConfig) -> DetectedAnew:
    """From the images that the session keeps, or the frames of its log; UsageError where one is in neither."""
    detector = Detector(cell.target.board, cell.camera.intrinsics.size)
    kept, missed, moved = [], [], []
    for capture, image in _images(session, captures):
        before = None if capture.corners is None else corners_from_record(capture.corners)
        found = detector.detect(image, before if before is not None and np.all(np.isfinite(before)) else None)
        if isinstance(found, Missed) or not np.all(np.isfinite(found.feature)):
            why = str(found) if isinstance(found, Missed) else "the feature point is not seen"
            missed.append(Rejected(capture.id, f"not detected anew: {why}"))
            continue
        if before is not None:
            moved.append((found.corners - before).ravel())
        feature = (float(found.feature[0]), float(found.feature[1]))
        corners = corners_to_record(found.corners)
        kept.append(replace(capture, feature=feature, corners=corners, order_known=found.order_known, board_pose=None))
    rms = float(np.sqrt(np.nanmean(np.square(np.concatenate(moved))))) if moved else None
    return DetectedAnew(replace(captures, captures=tuple(kept)), tuple(missed), rms)


def _images(session: Session, captures: Captures) -> Iterator[tuple[CaptureRecord, Image]]:
    missing = {capture.id for capture in captures.captures if not session.image_path(capture.id).exists()}
    logged = dict(_logged(session, missing)) if missing else {}
    for capture in captures.captures:
        if capture.id not in missing:
            yield capture, session.read_image(capture.id)
        elif capture.id in logged:
            yield capture, logged[capture.id].decode()
        else:
            raise UsageError(f"{session.folder}: has no image of {capture.id}, neither in images/ nor in its log")


def _logged(session: Session, wanted: set[str]) -> Iterator[tuple[str, Picture]]:
    """The last picture of each point, which is the one that was captured."""
    try:
        paths = begun_segments(session.folder)
    except LogMissing:
        return
    key: StepKey | None = None
    last: Picture | None = None
    for _, item in FinishedAttempts(paths).items():
        match item:
            case StepBegun(key):
                last = None
            case Picture():
                last = item
            case StepFinished() if key is not None and last is not None:
                name = f"{key.constraint}/{key.position}"
                if key.kind == "point" and name in wanted:
                    yield name, last
