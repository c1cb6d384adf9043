"""When the feedback of an arm at a state port is late, and when its link is lost."""

from __future__ import annotations

import pytest

from backends.controller.tcp.state import Freshness
from backends.controller.tcp.transport import Address
from dualcal_hal.errors import LinkLost


@pytest.mark.parametrize(("period", "allowed"), [(0.004, 0.1), (0.1, 0.3), (0.5, 1.0)])
def test_feedback_is_late_after_three_periods_and_a_tenth_of_a_second(period: float, allowed: float) -> None:
    freshness = Freshness("left", Address("cell", 11002), 0.0)
    arrivals = [period * number for number in range(1, 100)]
    for time in arrivals:
        assert freshness.look(time - 1e-6) is None
        freshness.arrived(time)
    assert freshness.due() == pytest.approx(arrivals[-1] + allowed)
    assert freshness.look(arrivals[-1] + allowed - 1e-6) is None
    if allowed < 1.0:
        assert "ms old" in str(freshness.look(arrivals[-1] + allowed + 1e-6))
        assert freshness.look(arrivals[-1] + 1.0 - 1e-6) is None, "it is told once"
    with pytest.raises(LinkLost, match="no feedback"):
        freshness.look(arrivals[-1] + 1.0 + 1e-6)
