"""How a run is recorded."""

from __future__ import annotations

from typing import Literal

from dualcal_hal.config.values import Section


class SessionConfig(Section):
    """How a run is recorded."""

    frames: Literal["png", "jpeg"] = "png"
    """How the log keeps images: png without loss; jpeg is smaller, and a replay serves the recorded detections."""
