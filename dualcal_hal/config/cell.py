"""The cell file as a whole, and what one section says of another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import Field

from dualcal_hal.config.backends import BackendEntry
from dualcal_hal.config.camera import CameraConfig
from dualcal_hal.config.fixtures import FixtureConfig
from dualcal_hal.config.nominal import NominalConfig
from dualcal_hal.config.procedure import ProcedureConfig
from dualcal_hal.config.references import (
    Location,
    backend_problems,
    mapping,
    named,
    simulated_only_problems,
    truth_problems,
)
from dualcal_hal.config.robots import RobotConfig
from dualcal_hal.config.session import SessionConfig
from dualcal_hal.config.simulation import SimulationConfig
from dualcal_hal.config.target import TargetConfig
from dualcal_hal.config.values import Number, Section

SessionName = Annotated[str, Field(pattern=r"^[^\s./\\:*?\"<>|][^/\\:*?\"<>|\x00-\x1f]*$")]


class CellConfig(Section):
    """Two arms facing each other, and what is to be done with them."""

    name: SessionName
    """Names the session's folder: no separators, none of : * ? " < > |, no dot or space first."""
    backends: dict[str, BackendEntry]
    """What the devices are reached through, by a name of your own."""
    robots: dict[str, RobotConfig]
    """The two arms, by a name of your own."""
    camera: CameraConfig
    target: TargetConfig
    nominal: NominalConfig
    procedure: ProcedureConfig
    floor_mm: Number | None = 0.0
    """Height of the floor in each arm's base frame, mm; null for none."""
    fixtures: dict[str, FixtureConfig] = Field(default={})
    """What stands about the arms and must not be touched, by a name of your own."""
    session: SessionConfig = SessionConfig()
    """How a run is recorded."""

    @property
    def floor(self) -> float | None:
        """Metres, or None."""
        return None if self.floor_mm is None else self.floor_mm / 1000

    @property
    def corridor(self) -> float:
        """How far (m) the arms' controllers may cut corners of a path: it is added to all clearance."""
        used = {robot.backend for robot in self.arms.values()}
        return max((getattr(self.backends[name].checked, "corridor", 0.0) for name in used), default=0.0)

    @property
    def clearance(self) -> float:
        """Smallest distance (m) that planned paths keep: what the procedure wants, and the corridor."""
        return self.procedure.clearance + self.corridor

    @property
    def arms(self) -> dict[str, RobotConfig]:
        """The robots that can move: all but a stand, which has no joints."""
        return {name: robot for name, robot in self.robots.items() if robot.chain.joints}

    @property
    def active_name(self) -> str:
        return self._name_by_role("active")

    @property
    def passive_name(self) -> str:
        return self._name_by_role("passive")

    @property
    def active(self) -> RobotConfig:
        return self.robots[self.active_name]

    @property
    def passive(self) -> RobotConfig:
        return self.robots[self.passive_name]

    def _name_by_role(self, role: str) -> str:
        return next(name for name, robot in self.robots.items() if robot.role == role)


class CellDocument(CellConfig):
    """A cell file for dualcal: two arms facing each other, one with a camera, one with a checkerboard."""

    simulation: SimulationConfig | None = None
    """The simulated world; a cell without a simulator has none."""

    @property
    def cell(self) -> CellConfig:
        """The cell without its simulation."""
        return CellConfig.model_construct(**{name: getattr(self, name) for name in CellConfig.model_fields})

    @property
    def world(self) -> SimulationConfig | None:
        """The simulation alone."""
        return self.simulation


# Names that must be found in another section


def reference_problems(document: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """Names in one section that another does not have, in a document whose other errors may still be many."""
    robots, camera = mapping(document.get("robots")), mapping(document.get("camera"))
    yield from backend_problems(document)
    if isinstance(document.get("robots"), Mapping) and len(robots) != 2:
        yield ("robots",), f"must be two arms, one active and one passive, not {len(robots)}"
    refined = mapping(document.get("procedure")).get("method") == "refined"
    yield from simulated_only_problems(document, refined=refined)
    yield from _stand_off_problems(document, robots)
    yield from _role_problems(robots, camera.get("mount"))
    yield from truth_problems(document, robots)


def _stand_off_problems(document: Mapping[str, Any], robots: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    stand_off = mapping(mapping(document.get("procedure")).get("stand_off"))
    for robot in map(mapping, robots.values()):
        key, limits = f"{robot.get('role')}_deg", robot.get("limits_deg")
        angles = stand_off.get(key)
        if not isinstance(angles, list) or not isinstance(limits, list):
            continue
        if len(angles) != len(limits):
            yield ("procedure", "stand_off", key), f"must have {len(limits)} entries, one a joint, has {len(angles)}"


def _role_problems(robots: Mapping[str, Any], mount: Any) -> Iterator[tuple[Location, str]]:
    roles = {name: mapping(robot).get("role") for name, robot in robots.items()}
    for role in ("active", "passive"):
        names = [name for name in roles if roles[name] == role]
        for name in names[1:]:
            yield ("robots", name, "role"), f"'{names[0]}' is the {role} arm already"
    if isinstance(mount, str) and roles and roles.get(mount) != "active":
        active = [name for name, role in roles.items() if role == "active"]
        yield ("camera", "mount"), f"must be the active arm ({named(active)}), not '{mount}'"
