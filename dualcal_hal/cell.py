"""The cell with its devices open."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Literal, Self

from dualcal_hal.backend import Answer, Backend
from dualcal_hal.camera import Camera
from dualcal_hal.cellfile import CellFile
from dualcal_hal.clock import Clock, RealClock
from dualcal_hal.config import RobotConfig
from dualcal_hal.errors import FormatError, Problem, UsageError
from dualcal_hal.geometry import CellGeometry
from dualcal_hal.guard import CellGuard, GuardedRobot
from dualcal_hal.kinematics import Chain
from dualcal_hal.limits import JointLimits
from dualcal_hal.pace import FULL_PACE, REDUCED_SPEED, Pace
from dualcal_hal.registry import backend_class
from dualcal_hal.robot import Joints, Mode
from dualcal_hal.session.log.recording import Recording
from dualcal_hal.stand import Stand

OPEN_TIMEOUT = 10.0
"""Seconds that a backend may take to open."""

ENABLE_TIMEOUT = 10.0
"""Seconds within which an arm's drives are to be on."""

CAMERA_NAME = "camera"


@dataclass(frozen=True, eq=False)
class Arm:
    """A robot with what the cell file knows of it.

    encoder_sigma, joint_sigma: rad that its readings and its arrivals scatter by; repeats_targets: as its backend's.
    """

    robot: GuardedRobot
    chain: Chain
    limits: JointLimits
    home: Joints
    encoder_sigma: float
    joint_sigma: float
    repeats_targets: bool


class Cell:
    """Both arms and the camera, open; a context manager that closes what it opened, in reverse, on any exit."""

    def __init__(self, cell: CellFile, pace: Pace | None = None) -> None:
        """Refuses what the backends cannot serve; opens nothing yet.

        pace: how fast the arms may be; where left out as fast as they are if they are simulated, else reduced.
        """
        self._file = cell
        self._pace = pace
        config = cell.cell
        used = {config.active.backend, config.passive.backend, config.camera.backend}
        types = {name: config.backends[name].type for name in config.backends if name in used}
        self._backends = {name: backend_class(type_)(name, cell) for name, type_ in types.items()}
        self.clock = _common_clock(self._backends)
        self._devices = ExitStack()
        self._recording = Recording()
        self.active: Arm
        self.passive: Arm
        self.camera: Camera
        self.guard: CellGuard

    def record(self, recording: Recording) -> None:
        """Have all that passes between this program and the devices told to ``recording``; before they are opened."""
        self._recording = recording

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            for backend in self._backends.values():
                opening.callback(backend.close)
                backend.open(OPEN_TIMEOUT)
            opening.callback(self._recording.leave)
            config = self._file.cell
            self.active = self._arm(config.active_name, config.active)
            self.passive = self._arm(config.passive_name, config.passive)
            self.camera = self._recording.camera(self._backends[config.camera.backend].camera(CAMERA_NAME))
            shapes, nominal = CellGeometry.of(config), config.nominal.placement
            self.guard = CellGuard(
                self.active.robot,
                self.passive.robot,
                shapes,
                nominal,
                config.procedure.clearance,
                self.pace,
                config.corridor,
                watched=self.time == "real",
            )
            self._devices = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._devices.close()

    def arm(self, name: str) -> Arm:
        """The arm of that name in the cell file."""
        return {self.active.robot.name: self.active, self.passive.robot.name: self.passive}[name]

    def answer(self, what: str, asked: Any) -> Answer | None:
        """What a replay has for a piece of work, see :meth:`Backend.answer`; None where it is to be done."""
        answers = (backend.answer(what, asked) for backend in self._backends.values())
        return next((answer for answer in answers if answer is not None), None)

    def procedure_ended(self) -> None:
        """Tell the backends that the procedure asks nothing more, see :meth:`Backend.procedure_ended`."""
        for backend in self._backends.values():
            backend.procedure_ended()

    def documents(self) -> dict[str, dict[str, Any]]:
        """What the backends want kept beside the run, by file name; asked for while the cell is open."""
        return {name: document for backend in self._backends.values() for name, document in backend.documents().items()}

    def left(self) -> dict[str, dict[str, Any]]:
        """What the backends need to go on from here in another process, by their names; asked for while it is open."""
        return {name: state for name, backend in self._backends.items() if (state := backend.left())}

    def go_on_from(self, states: Mapping[str, Any]) -> None:
        """Have the backends go on from what :meth:`left` gave, before they are opened; FormatError for other states."""
        for name, state in states.items():
            if name not in self._backends or not isinstance(state, Mapping):
                raise FormatError(
                    [Problem(f"backends.{name}", "the cell has no such backend, or this is no state of it")]
                )
            self._backends[name].go_on_from(state)

    @property
    def recording(self) -> Recording:
        """What is told of all that happens."""
        return self._recording

    def use_emulator(self, endpoints: Mapping[str, Any]) -> None:
        """Reach all devices at an emulator started for this run, by the backends' names; before they are opened."""
        for name, backend in self._backends.items():
            if name not in endpoints:
                raise UsageError(f"the emulator does not say where it serves backend '{name}'")
            backend.use_emulator(endpoints[name])

    def enable_arms(self) -> list[str]:
        """Switch the drives of both arms on where they are off: the operator's command, before a procedure begins.

        Returns the arms that were switched on. It passes by the recording, as it is no part of what a procedure does.
        """
        enabled = []
        for name in self._file.cell.arms:
            robot = self._backends[self._file.cell.robots[name].backend].robot(name)
            if robot.read(ENABLE_TIMEOUT).mode is not Mode.READY:
                robot.enable(ENABLE_TIMEOUT)
                enabled.append(name)
        return enabled

    @property
    def pace(self) -> Pace:
        """How fast its arms may be."""
        if self._pace is not None:
            return self._pace
        return FULL_PACE if self.simulated else Pace(largest=REDUCED_SPEED)

    @property
    def time(self) -> Literal["drives", "real"]:
        """Whether its backends make time or live in it."""
        return "real" if all(backend.time == "real" for backend in self._backends.values()) else "drives"

    @property
    def simulated(self) -> bool:
        """Whether no real device stands behind any backend."""
        return all(backend.simulated for backend in self._backends.values())

    def _arm(self, name: str, config: RobotConfig) -> Arm:
        limits = JointLimits.of(config)
        home = tuple(map(float, config.home))
        if not config.chain.joints:
            stand = GuardedRobot(Stand(name, self.clock), limits, self.clock)
            return Arm(stand, config.chain, limits, home, 0.0, 0.0, repeats_targets=True)
        device = self._backends[config.backend].robot(name)
        self._recording.watch(device)
        robot = GuardedRobot(self._recording.robot(device), limits, self.clock)
        repeats = self._backends[config.backend].repeats_targets
        return Arm(robot, config.chain, limits, home, config.encoder_sigma, config.joint_sigma, repeats)


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
