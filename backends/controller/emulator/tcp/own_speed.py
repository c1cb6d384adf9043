"""Controllers that move at the speed that is set at them, whatever they are sent."""

from __future__ import annotations

import numpy as np

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array

_SAMPLES = 9  # of a stretch
_STEP = 1e-4  # of a stretch, to see how far the tool goes


class OwnSpeed:
    """The speed set at a controller: its arm's own, or less where the tool would go faster than ``tool_speed``, m/s."""

    def __init__(self, chain: Chain, tool: Array, speed: Array, tool_speed: float | None) -> None:
        """``tool`` (4, 4): in the flange; ``speed`` (n,): rad/s."""
        self._chain, self._tool = chain, tool
        self._speed, self._tool_speed = speed, tool_speed

    def along(self, start: Array, goal: Array) -> Array:
        """(n,) rad/s for a straight stretch between joint angles (n,)."""
        way = goal - start
        if self._tool_speed is None or not np.any(way):
            return self._speed
        joints = float(np.min(self._speed / np.maximum(np.abs(way), 1e-12)))  # stretches a second
        shares = np.linspace(0.0, 1.0 - _STEP, _SAMPLES)
        tool = max(self._moved(start + s * way, start + (s + _STEP) * way) / _STEP for s in shares)  # m a stretch
        rate = min(joints, self._tool_speed / max(tool, 1e-9))
        return np.asarray(self._speed * rate / joints)

    def _moved(self, before: Array, after: Array) -> float:
        """How far flange or tool go, m."""
        first, second = self._chain.forward(before), self._chain.forward(after)
        flange = np.linalg.norm(second[:3, 3] - first[:3, 3])
        tool = np.linalg.norm((second @ self._tool)[:3, 3] - (first @ self._tool)[:3, 3])
        return float(max(flange, tool))
