"""The target in images: its corners, and the board's poses that explain them."""

from procedures.detection.detector import Detector
from procedures.detection.outcome import Detection, Miss, Missed
from procedures.detection.pose import board_poses

__all__ = ["Detection", "Detector", "Miss", "Missed", "board_poses"]
