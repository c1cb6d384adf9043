"""The numbers that a GenICam camera gives its frames: GigE Vision's wrap at 16 bits."""

from __future__ import annotations

_WRAP = 1 << 16
_MOST_LOST = _WRAP // 2


class FrameIds:
    """Makes numbers that grow of ids that wrap, and that begin anew with every acquisition."""

    def __init__(self) -> None:
        self._last: int | None = None
        self._number = 0

    def restart(self) -> None:
        """An acquisition begins: its ids have nothing to do with those before."""
        self._last = None

    def number(self, frame_id: int) -> int:
        """Of the frame with this id; ValueError if it is no newer than the one before."""
        step = 1 if self._last is None else _step(self._last, frame_id)
        if step <= 0:
            raise ValueError(f"frame {frame_id} came after frame {self._last}")
        self._last = frame_id
        self._number += step
        return self._number


def _step(last: int, new: int) -> int:
    """By how much an id has grown; not above 0 if it is an older one's."""
    if new >= last or last >= _WRAP:
        return new - last
    step = max(1, new - last + _WRAP - 1)  # GigE Vision leaves out 0; where it is used one frame less was lost
    return step if step <= _MOST_LOST else new - last
