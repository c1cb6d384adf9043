"""Files that options name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo

from dualcal_hal.config.fixtures import FOLDER


def _beside_the_cell_file(value: Path, info: ValidationInfo) -> Path:
    return Path((info.context or {}).get(FOLDER, "")).joinpath(value).absolute()


BesideTheCellFile = Annotated[Path, AfterValidator(_beside_the_cell_file)]
"""Relative to the cell file's folder, or whole."""
