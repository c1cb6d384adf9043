"""What one section of a cell file says of another, in a document whose other errors may still be many."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from dualcal_hal import registry

Location = tuple[str | int, ...]
"""The keys and list indices that lead to a value of the file."""


def backend_problems(document: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """Devices that are to be reached through what is not there."""
    backends = mapping(document.get("backends"))
    for location, device in devices_of(document).items():
        backend = mapping(device).get("backend")
        if isinstance(backend, str) and backend not in backends:
            yield (*location, "backend"), f"no backend '{backend}' in this file; there are: {named(backends)}"


def devices_of(document: Mapping[str, Any]) -> dict[Location, Any]:
    """Arms and camera, by where they stand."""
    robots = mapping(document.get("robots"))
    return {**{("robots", name): robot for name, robot in robots.items()}, ("camera",): document.get("camera")}


def simulated_only_problems(document: Mapping[str, Any], *, refined: bool) -> Iterator[tuple[Location, str]]:
    """What a cell with real arms must say, or may not; refined: whether its result is to say what it is worth."""
    backends = mapping(document.get("backends"))
    used = [mapping(device).get("backend") for device in devices_of(document).values()]
    types = {mapping(backends.get(name)).get("type") for name in used if isinstance(name, str)}
    if all(_is_simulated(type_) for type_ in types):
        return
    if "uncertainty" not in mapping(document.get("nominal")):
        yield ("nominal", "uncertainty"), "missing key; only a cell that is simulated goes without"
    if mapping(document.get("procedure")).get("first_looks") == 0:
        yield ("procedure", "first_looks"), "must be at least 3; only a cell that is simulated goes without looks"
    procedure = mapping(document.get("procedure"))
    verification = mapping(procedure.get("verification"))
    if refined and verification.get("required_accuracy_mm") is None:
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


def truth_problems(document: Mapping[str, Any], robots: Mapping[str, Any]) -> Iterator[tuple[Location, str]]:
    """What the simulation says of single arms and joints."""
    simulation = mapping(document.get("simulation"))
    kinematics = mapping(mapping(simulation.get("truth")).get("kinematics"))
    for name, given in kinematics.items():
        location = ("simulation", "truth", "kinematics", name)
        yield from _per_joint_problems(location, mapping(given).get("dh"), robots, ("dh",))
    offsets = mapping(mapping(mapping(simulation.get("errors")).get("joint_zero")).get("offset_deg"))
    for name, given in offsets.items():
        yield from _per_joint_problems(("simulation", "errors", "joint_zero", "offset_deg", name), given, robots)


def _per_joint_problems(
    arm: Location, given: Any, robots: Mapping[str, Any], below: Location = ()
) -> Iterator[tuple[Location, str]]:
    """Of a list with an entry a joint, at or ``below`` a location whose last key is the arm's name."""
    if arm[-1] not in robots:
        yield arm, f"no arm of that name; there are: {named(robots)}"
        return
    own = mapping(mapping(robots[str(arm[-1])]).get("kinematics")).get("dh")
    if isinstance(given, list) and isinstance(own, list) and len(given) != len(own):
        yield (*arm, *below), f"must have {len(own)} entries, as the arm's own, has {len(given)}"


def mapping(value: Any) -> Mapping[str, Any]:
    """The value if it is one."""
    return value if isinstance(value, Mapping) else {}


def named(names: Any) -> str:
    """In a row."""
    return ", ".join(names) or "none"
