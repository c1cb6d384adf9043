"""The cell file as a whole, and what one section says of another."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from pydantic import Field

from dualcal_hal import registry
from dualcal_hal.config.backends import BackendEntry
from dualcal_hal.config.camera import CameraConfig
from dualcal_hal.config.fixtures import FixtureConfig
from dualcal_hal.config.nominal import NominalConfig
from dualcal_hal.config.procedure import ProcedureConfig
from dualcal_hal.config.robots import RobotConfig
from dualcal_hal.config.session import SessionConfig
from dualcal_hal.config.simulation import SimulationConfig
from dualcal_hal.config.target import TargetConfig
from dualcal_hal.config.values import Number, Section

Location = tuple[str | int, ...]
"""The keys and list indices that lead to a value of the file."""


class CellConfig(Section):
    """Two arms facing each other, and what is to be done with them."""

    name: Annotated[str, Field(pattern=r"^[^\s./\\:*?\"<>|][^/\\:*?\"<>|\x00-\x1f]*$")]
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
        used = {robot.backend for robot in self.robots.values()}
        return max((getattr(self.backends[name].checked, "corridor", 0.0) for name in used), default=0.0)

    @property
    def clearance(self) -> float:
        """Smallest distance (m) that planned paths keep: what the procedure wants, and the corridor."""
        return self.procedure.clearance + self.corridor

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


# Names that must be found in another section


def reference_problems(document: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """Names in one section that another does not have, in a document whose other errors may still be many."""
    backends, robots = _mapping(document.get("backends")), _mapping(document.get("robots"))
    camera = _mapping(document.get("camera"))
    devices: dict[Location, Any] = {("robots", name): robot for name, robot in robots.items()}
    for location, device in {**devices, ("camera",): camera}.items():
        backend = _mapping(device).get("backend")
        if isinstance(backend, str) and backend not in backends:
            yield (*location, "backend"), f"no backend '{backend}' in this file; there are: {_names(backends)}"
    if isinstance(document.get("robots"), Mapping) and len(robots) != 2:
        yield ("robots",), f"must be two arms, one active and one passive, not {len(robots)}"
    yield from _simulated_only_problems(document, [_mapping(device).get("backend") for device in devices.values()])
    yield from _stand_off_problems(document, robots)
    yield from _role_problems(robots, camera.get("mount"))
    yield from _truth_problems(document, robots)


def _simulated_only_problems(document: Mapping[str, Any], used: list[Any]) -> Iterator[tuple[Location, str]]:
    """What a cell with real arms must say, or may not."""
    backends = _mapping(document.get("backends"))
    types = {_mapping(backends.get(name)).get("type") for name in used if isinstance(name, str)}
    if all(_is_simulated(type_) for type_ in types):
        return
    if "uncertainty" not in _mapping(document.get("nominal")):
        yield ("nominal", "uncertainty"), "missing key; only a cell that is simulated goes without"
    if _mapping(document.get("procedure")).get("first_looks") == 0:
        yield ("procedure", "first_looks"), "must be at least 3; only a cell that is simulated goes without looks"
    procedure = _mapping(document.get("procedure"))
    verification = _mapping(procedure.get("verification"))
    if procedure.get("method") == "refined" and verification.get("required_accuracy_mm") is None:
        location = ("procedure", "verification", "required_accuracy_mm")
        yield location, "missing key; only a cell that is simulated goes without"


def _is_simulated(type_: Any) -> bool:
    """Whether a backend simulates; one that cannot be told, because its type is wrong, is a problem of its own."""
    if type_ not in registry.backend_names():
        return True
    try:
        return registry.backend_class(type_).simulated
    except ImportError:
        return True


def _stand_off_problems(document: Mapping[str, Any], robots: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    stand_off = _mapping(_mapping(document.get("procedure")).get("stand_off"))
    for robot in map(_mapping, robots.values()):
        key, limits = f"{robot.get('role')}_deg", robot.get("limits_deg")
        angles = stand_off.get(key)
        if not isinstance(angles, list) or not isinstance(limits, list):
            continue
        if len(angles) != len(limits):
            yield ("procedure", "stand_off", key), f"must have {len(limits)} entries, one a joint, has {len(angles)}"


def _role_problems(robots: Mapping[str, Any], mount: Any) -> Iterator[tuple[Location, str]]:
    roles = {name: _mapping(robot).get("role") for name, robot in robots.items()}
    for role in ("active", "passive"):
        names = [name for name in roles if roles[name] == role]
        for name in names[1:]:
            yield ("robots", name, "role"), f"'{names[0]}' is the {role} arm already"
    if isinstance(mount, str) and roles and roles.get(mount) != "active":
        active = [name for name, role in roles.items() if role == "active"]
        yield ("camera", "mount"), f"must be the active arm ({_names(active)}), not '{mount}'"


def _truth_problems(document: Mapping[str, Any], robots: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """What the simulation says of single arms and joints."""
    simulation = _mapping(document.get("simulation"))
    kinematics = _mapping(_mapping(simulation.get("truth")).get("kinematics"))
    for name, given in kinematics.items():
        location = ("simulation", "truth", "kinematics", name)
        yield from _per_joint_problems(location, _mapping(given).get("dh"), robots, ("dh",))
    offsets = _mapping(_mapping(_mapping(simulation.get("errors")).get("joint_zero")).get("offset_deg"))
    for name, given in offsets.items():
        yield from _per_joint_problems(("simulation", "errors", "joint_zero", "offset_deg", name), given, robots)


def _per_joint_problems(
    arm: Location, given: Any, robots: Mapping[str, Any], below: Location = ()
) -> Iterator[tuple[Location, str]]:
    """Of a list with an entry a joint, at or ``below`` a location whose last key is the arm's name."""
    if arm[-1] not in robots:
        yield arm, f"no arm of that name; there are: {_names(robots)}"
        return
    own = _mapping(_mapping(robots[str(arm[-1])]).get("kinematics")).get("dh")
    if isinstance(given, list) and isinstance(own, list) and len(given) != len(own):
        yield (*arm, *below), f"must have {len(own)} entries, as the arm's own, has {len(given)}"


def _mapping(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _names(names: Any) -> str:
    return ", ".join(names) or "none"
