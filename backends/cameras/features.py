"""Settings of a GenICam camera, by the names of the Standard Features Naming Convention, set and read back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from dualcal_hal.errors import CommandRefused, DeviceError, LinkLost

CLOSENESS = 0.01
"""Share by which a camera's own steps may have its setting differ from what was asked."""


@contextmanager
def translated(device: str, attempted: str) -> Iterator[None]:
    """Whatever the producer or the camera raises becomes a LinkLost: it does not answer as a camera does."""
    foreign = (
        import_module("genicam.gentl").GenericException,
        import_module("genicam.genapi").GenericException,
        *(AttributeError, OSError, ValueError),  # what harvesters makes of answers it does not expect
    )
    try:
        yield
    except DeviceError:
        raise
    except foreign as error:
        why = str(error).strip() or type(error).__name__
        raise LinkLost(device, attempted, why, "check the camera's cable and power, and its producer (cti)") from error


class Features:
    """Of one open camera; ``node_map``: as harvesters gives it."""

    def __init__(self, device: str, node_map: Any) -> None:
        self._device, self._nodes = device, node_map

    def has(self, name: str) -> bool:
        """Whether the camera has a feature of that name, now."""
        return bool(self._nodes.has_node(name)) and getattr(self._nodes, name, None) is not None

    def choose(self, name: str, value: str) -> None:
        """Set one of several; CommandRefused if it is not among them, or another is set then."""
        node = self._node(name, f"set {name} to {value}")
        if value not in node.symbolics:
            why = f"it has {', '.join(node.symbolics)}"
            raise CommandRefused(self._device, f"set {name} to {value}", why)
        if node.value == value:
            return  # it may not even be settable then
        self._set(node, value, f"set {name} to {value}")
        if node.value != value:
            raise CommandRefused(self._device, f"set {name} to {value}", f"it is {node.value} then")

    def set_number(self, name: str, value: float, unit: str) -> float:
        """Set a number, and give back what the camera made of it; CommandRefused if that is something else."""
        attempted = f"set {name} to {value:g} {unit}"
        node = self._node(name, attempted)
        self._set(node, value, attempted)
        got = float(node.value)
        if abs(got - value) > CLOSENESS * abs(value):
            raise CommandRefused(self._device, attempted, f"it is {got:g} {unit} then", "ask for a value that it has")
        return got

    def number(self, name: str) -> float | None:
        """What it is set to; None if there is no such feature."""
        return float(getattr(self._nodes, name).value) if self.has(name) else None

    def execute(self, name: str) -> None:
        """Have the camera carry out a command."""
        getattr(self._nodes, name).execute()

    def _node(self, name: str, attempted: str) -> Any:
        if not self.has(name):
            raise CommandRefused(self._device, attempted, "the camera has no such feature", "leave it out")
        return getattr(self._nodes, name)

    def _set(self, node: Any, value: Any, attempted: str) -> None:
        try:
            node.value = value
        except import_module("genicam.genapi").GenericException as error:
            why = str(error).partition(" : ")[0]  # what follows is where in its library
            raise CommandRefused(self._device, attempted, why) from error
