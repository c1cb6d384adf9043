"""What goes wrong at a controller while its arms move: they stop, an error says where, and nothing moves unasked."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from dualcal_hal.errors import DeviceError
from tests.guarded_cell import ARMS, MOTION, guarded
from tests.simple_message_client import PATIENCE

AWAY = (0.8, 0.1)
PING = 1


def test_a_drive_that_tells_an_emergency_stops_its_arm_by_name_and_code() -> None:
    with guarded("can") as cell:
        motion = cell.start("left", *AWAY)
        cell.served.faults.strike("emergency", "left")
        with pytest.raises(DeviceError, match=r"left: .*joint 2 \(node 2\).*0x4210"):
            motion.wait(PATIENCE)
        where = cell.comes_to_rest()
        assert "left" in cell.served.faults.stops
        cell.stays(where)


def test_the_lost_link_of_an_arm_that_stands_stops_the_one_that_moves() -> None:
    with guarded("rep") as cell:
        motion = cell.start("left", *AWAY)
        mend = cell.served.faults.strike("lost-link", "right")
        with pytest.raises(DeviceError, match=r"^right: "):
            motion.wait(PATIENCE)
        where = cell.comes_to_rest()
        assert cell.served.faults.stops[0] == "left"
        mend()
        cell.reads("right")
        cell.stays(where)
        cell.start("right", 0.2).wait(PATIENCE)


def test_a_server_that_is_restarted_with_its_arm_elsewhere_gets_no_motion_but_the_next_that_is_asked_for() -> None:
    with guarded("rep") as cell:
        motion = cell.start("left", *AWAY)
        cell.kill()
        with pytest.raises(DeviceError, match=r"left: "):
            motion.wait(PATIENCE)
        cell.serve("robots.left.home_deg=[20, 0, 60, 0, 30, 0]")
        state = cell.reads("left")
        assert np.rad2deg(state.positions[0]) == pytest.approx(20, abs=0.1)
        cell.reads("right")
        cell.stays(cell.served.places(), 1.0)
        for arm in ARMS:
            assert all(identity == PING for identity in messages(cell.relays[arm, MOTION].sent[-1]))
        cell.start("left", -0.2).wait(PATIENCE)
        assert np.rad2deg(cell.reads("left").positions[0]) == pytest.approx(20 - np.rad2deg(0.2), abs=0.1)


def messages(data: bytes, order: Literal["big", "little"] = "little") -> list[int]:
    """The types of the messages that were sent."""
    types = []
    while data:
        length = int.from_bytes(data[:4], order)
        types.append(int.from_bytes(data[4:8], order))
        data = data[4 + length :]
    return types
