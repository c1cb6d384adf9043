"""A recorded session played back: the arms and the camera answer from its log, in recorded time."""

from backends.replay.backend import ReplayBackend

__all__ = ["ReplayBackend"]
