"""What the backends of all cameras have in common: one camera, no arm, real time."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from backends.cameras.camera import DrivenCamera
from backends.cameras.driver import Driver
from dualcal_hal.backend import Backend
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import UnknownDevice, UsageError
from dualcal_hal.robot import Robot

if TYPE_CHECKING:
    from dualcal_hal.cellfile import CellFile

CAMERA = "camera"


class CameraBackend(Backend):
    """Has one camera; a subclass says how its driver is opened."""

    time: ClassVar[Literal["drives", "real"]] = "real"
    simulated = False

    def __init__(self, name: str, cell: CellFile) -> None:
        super().__init__(name, cell)
        self._clock = RealClock()
        self._driver: Driver | None = None
        self._camera = DrivenCamera(CAMERA, name, cell.cell.camera.intrinsics.size, self._clock)

    @property
    def clock(self) -> RealClock:
        return self._clock

    @property
    def options(self) -> Any:
        """Its entry in the cell file, an instance of Options."""
        options = self.cell.cell.backends[self.name].checked
        assert isinstance(options, self.Options)
        return options

    @abstractmethod
    def connect(self, timeout: float) -> Driver:
        """Open the camera within ``timeout`` seconds, or raise a DeviceError and leave nothing open."""

    @property
    def is_open(self) -> bool:
        return self._driver is not None

    def open(self, timeout: float) -> None:
        if self._driver is not None:
            raise UsageError(f"{self.name}: open: it is open already; close it first")
        self._driver = self.connect(timeout)
        self._camera.opened(self._driver)

    def close(self) -> None:
        driver, self._driver = self._driver, None
        self._camera.opened(None)
        if driver is not None:
            driver.close()

    def robot(self, name: str) -> Robot:
        raise UnknownDevice(name, "find the arm", f"'{self.name}' has a camera and no arm", "check robots.*.backend")

    def camera(self, name: str) -> DrivenCamera:
        if name != CAMERA:
            raise UnknownDevice(name, "find the camera", f"'{self.name}' has {CAMERA}")
        return self._camera
