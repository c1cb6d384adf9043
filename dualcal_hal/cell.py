"""The cell with its devices open."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Self

from dualcal_hal.backend import Backend
from dualcal_hal.camera import Camera
from dualcal_hal.cellfile import CellFile
from dualcal_hal.clock import Clock, RealClock
from dualcal_hal.config import RobotConfig
from dualcal_hal.errors import UsageError
from dualcal_hal.geometry import CellGeometry
from dualcal_hal.guard import CellGuard, GuardedRobot, JointLimits
from dualcal_hal.kinematics import Chain
from dualcal_hal.registry import backend_class
from dualcal_hal.robot import Joints

OPEN_TIMEOUT = 10.0
CAMERA_NAME = "camera"


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot with what the cell file knows of it."""

    robot: GuardedRobot
    chain: Chain
    limits: JointLimits
    home: Joints
    encoder_sigma: float


class Cell:
    """Both arms and the camera, open; a context manager that closes what it opened, in reverse, on any exit."""

    def __init__(self, cell: CellFile) -> None:
        self._file = cell
        self._devices = ExitStack()
        self.clock: Clock
        self.active: Arm
        self.passive: Arm
        self.camera: Camera
        self.guard: CellGuard

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            backends = {name: self._opened(name, opening) for name in self._file.cell.backends}
            self.clock = _common_clock(backends)
            config = self._file.cell
            self.active = self._arm(config.active_name, config.active, backends)
            self.passive = self._arm(config.passive_name, config.passive, backends)
            self.camera = backends[config.camera.backend].camera(CAMERA_NAME)
            shapes, T_P_A = CellGeometry.of(config), config.nominal.T_P_A
            self.guard = CellGuard(self.active.robot, self.passive.robot, shapes, T_P_A, config.procedure.clearance)
            self._devices = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._devices.close()

    def arm(self, name: str) -> Arm:
        """The arm of that name in the cell file."""
        return {self.active.robot.name: self.active, self.passive.robot.name: self.passive}[name]

    def _opened(self, name: str, opening: ExitStack) -> Backend:
        backend = backend_class(self._file.cell.backends[name].type)(name, self._file)
        close: Callable[[], None] = backend.close
        opening.callback(close)
        backend.open(OPEN_TIMEOUT)
        return backend

    def _arm(self, name: str, config: RobotConfig, backends: dict[str, Backend]) -> Arm:
        limits = JointLimits(config.lower, config.upper, config.speed, config.acceleration)
        robot = GuardedRobot(backends[config.backend].robot(name), limits, self.clock)
        return Arm(robot, config.chain, limits, tuple(map(float, config.home)), config.encoder_sigma)


def _common_clock(backends: dict[str, Backend]) -> Clock:
    driving = [backend for backend in backends.values() if backend.time == "drives"]
    if not driving:
        return RealClock()
    if len(backends) > 1:
        raise UsageError(
            f"backend '{driving[0].name}' makes its own time and cannot be mixed with others "
            f"({', '.join(sorted(set(backends) - {driving[0].name}))}): use it for all devices"
        )
    return driving[0].clock
