"""The simulator: a virtual cell that stands in for both arms and the camera."""

from backends.simulator.backend import SimulatorBackend

__all__ = ["SimulatorBackend"]
