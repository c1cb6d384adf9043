"""An industrial controller: its arms over TCP or CAN."""

from backends.controller.backend import ControllerBackend

__all__ = ["ControllerBackend"]
