"""Both arms of a cell at an industrial controller."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import BaseModel, ValidationError

from backends.controller.joint_map import JointMap
from backends.controller.link import ArmLink
from backends.controller.options import CAN_NEEDS, ControllerOptions, Link
from backends.controller.promptness import before_others, spare_the_heap
from backends.controller.robot import ControlledRobot, OwnSpeed
from dualcal_hal.backend import Backend
from dualcal_hal.camera import Camera
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import CellFileError, Problem, UnknownDevice, UsageError
from dualcal_hal.limits import JointLimits
from dualcal_hal.registry import require_extra
from dualcal_hal.robot import Joints

if TYPE_CHECKING:
    from dualcal_hal.cellfile import CellFile


class ControllerBackend(Backend):
    """Reached by simple message over TCP or by CANopen; CellFileError if the options are none of the cell's arms.

    Opening moves nothing and enables nothing. ``simulated`` once it was told to use an emulator.
    """

    time: ClassVar[Literal["drives", "real"]] = "real"
    simulated = False
    Options: ClassVar[type[BaseModel]] = ControllerOptions

    def __init__(self, name: str, cell: CellFile) -> None:
        super().__init__(name, cell)
        options = cell.cell.backends[name].checked
        assert isinstance(options, ControllerOptions)
        self._link = options.link
        self._clock = RealClock()
        if self._link.can is not None:
            require_extra(f"backends.{name}.link.can", "can", CAN_NEEDS)
        self._maps = _joint_maps(name, cell, self._link)
        speed = _own_speed(self._link)
        self._robots = {
            arm: ControlledRobot(arm, JointLimits.of(cell.cell.robots[arm]), joint_map, self._clock, speed)
            for arm, joint_map in self._maps.items()
        }
        self._open: ExitStack | None = None

    @property
    def clock(self) -> RealClock:
        return self._clock

    def use_emulator(self, endpoints: Mapping[str, Any]) -> None:
        self._link = _redirected(self.name, self._link, endpoints)
        self.simulated = True

    def open(self, timeout: float) -> None:
        self._open_arms(sorted(self._robots), timeout)

    def open_alone(self, device: str, timeout: float) -> None:
        self._open_arms([self.robot(device).name], timeout)

    def _open_arms(self, arms: list[str], timeout: float) -> None:
        if self._open is not None:
            raise UsageError(f"{self.name}: open: it is open already; close it first")
        deadline = self._clock.now() + timeout
        links = self._links()
        # Before the first cycle begins: a large heap is searched for longer than drives go without a heartbeat.
        spare_the_heap()
        with ExitStack() as if_it_fails:
            if_it_fails.enter_context(before_others())
            for arm, link in ((arm, links[arm]) for arm in arms):
                if_it_fails.callback(link.close)
                link.open(deadline)
                if_it_fails.callback(self._robots[arm].detach)
                self._robots[arm].attach(link)
            self._open = if_it_fails.pop_all()

    def close(self) -> None:
        opened, self._open = self._open, None
        if opened is not None:
            opened.close()

    def robot(self, name: str) -> ControlledRobot:
        if name not in self._robots:
            raise UnknownDevice(name, "find the arm", f"'{self.name}' has {', '.join(sorted(self._robots))}")
        return self._robots[name]

    def camera(self, name: str) -> Camera:
        raise UnknownDevice(name, "find the camera", f"'{self.name}' is a controller of arms and has no camera")

    def _links(self) -> Mapping[str, ArmLink]:
        joints = {arm: self._robots[arm].joints for arm in self._robots}
        if self._link.tcp is not None:
            from backends.controller import tcp

            return tcp.links(self._link.tcp, joints, self._clock, self._top_speeds())
        assert self._link.can is not None
        from backends.controller import can

        return can.links(self._link.can, joints, self._clock)

    def _top_speeds(self) -> dict[str, Joints]:
        """The most that each arm's controller's joints can, rad/s."""
        limits = {arm: JointLimits.of(self.cell.cell.robots[arm]).speed for arm in self._maps}
        return {arm: tuple(self._maps[arm].bound_to_controller(speed).tolist()) for arm, speed in limits.items()}


def _own_speed(link: Link) -> OwnSpeed | None:
    if link.tcp is None or not link.tcp.ignores_velocity:
        return None
    confirmed = link.tcp.controller_speed_confirmed
    return OwnSpeed(None if confirmed is None else confirmed.mm_s / 1000)


def _joint_maps(name: str, cell: CellFile, link: Link) -> dict[str, JointMap]:
    """The map of each arm that this backend moves."""
    robots = {arm: config for arm, config in cell.cell.robots.items() if config.backend == name}
    kind, arms = ("tcp", link.tcp.arms) if link.tcp is not None else ("can", link.can.arms if link.can else {})
    where = f"backends.{name}.link.{kind}.arms"
    problems = [Problem(where, f"missing key: '{arm}', whose backend this is") for arm in robots if arm not in arms]
    problems += [
        Problem(
            f"{where}.{arm}", f"no arm of that name is reached by '{name}'; there are: {', '.join(robots) or 'none'}"
        )
        for arm in arms
        if arm not in robots
    ]
    maps = {}
    for arm in robots.keys() & arms.keys():
        given, joints = arms[arm], robots[arm].chain.joints
        drives = getattr(given, "drives", None)
        if drives is not None and len(drives) != joints:
            problems.append(Problem(f"{where}.{arm}.drives", f"must have {joints} entries, has {len(drives)}"))
        try:
            maps[arm] = JointMap(given.joint_map, joints)
        except ValueError as error:
            problems.append(Problem(f"{where}.{arm}.joint_map", str(error)))
    if problems:
        raise CellFileError(problems)
    return dict(sorted(maps.items()))


def _redirected(name: str, link: Link, endpoints: Mapping[str, Any]) -> Link:
    """The link with the addresses of an emulator in place of its own."""
    document = link.model_dump(exclude_none=True)
    kind = "tcp" if link.tcp is not None else "can"
    try:
        told = endpoints[kind]
        arms = told if kind == "tcp" else told["arms"]
        if kind == "can":
            document["can"]["interface"] = told["interface"]
            document["can"].pop("bitrate", None)  # the emulator's bus has none
        addresses = ("host", "motion_port", "state_port") if kind == "tcp" else ("channel",)
        for arm in document[kind]["arms"]:
            # All of them: none of a real controller's addresses may be left.
            document[kind]["arms"][arm].update({address: arms[arm][address] for address in addresses})
        return Link.model_validate(document)
    except (KeyError, TypeError, ValidationError) as error:
        raise UsageError(f"{name}: the emulator does not say where to reach it by {kind}: {error!r}") from error
