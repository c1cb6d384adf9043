"""The errors that real cells have, for the simulator to have them too."""

from __future__ import annotations

from dualcal_hal.config.image_errors import ImageErrorsConfig
from dualcal_hal.config.mechanical_errors import MechanicalErrorsConfig


class ErrorsConfig(MechanicalErrorsConfig, ImageErrorsConfig):
    """The errors that real cells have; all are off by default."""
