"""Single backends opened where a command needs no whole cell."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dualcal_hal.backend import Backend
from dualcal_hal.cell import CAMERA_NAME, OPEN_TIMEOUT
from dualcal_hal.cellfile import CellFile
from dualcal_hal.config import CellConfig
from dualcal_hal.registry import backend_class


@contextmanager
def opened_alone(file: CellFile, device: str) -> Iterator[Backend]:
    """The backend of an arm or the camera, open for this device while this lasts."""
    name = backend_of(file.cell, device)
    backend = backend_class(file.cell.backends[name].type)(name, file)
    try:
        backend.open_alone(device, OPEN_TIMEOUT)
        yield backend
    finally:
        backend.close()


def backend_of(cell: CellConfig, device: str) -> str:
    """The name of the backend that an arm, or :data:`CAMERA_NAME`, is reached through."""
    return cell.camera.backend if device == CAMERA_NAME else cell.robots[device].backend


def is_simulated(cell: CellConfig) -> bool:
    """Whether no real device stands behind any of them."""
    names = {*(robot.backend for robot in cell.arms.values()), cell.camera.backend}
    return all(backend_class(cell.backends[name].type).simulated for name in names)
