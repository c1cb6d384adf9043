"""What the emulated controllers put on the wire, and take from it: REP I0006's own packets."""

from __future__ import annotations

import struct

import pytest

from backends.controller.emulator.tcp.packets import (
    JOINT_TRAJ_PT,
    REQUEST,
    UNKNOWN,
    NotAMessage,
    Packing,
    Status,
)

BIG = Packing(big=True, double=False)

# Appendix A of REP I0006, which is in the public domain.
JOINT_POSITION_PACKET = bytes.fromhex(
    "00000038 0000000A 00000001 00000000 00000000 B81AD9FA B6836312 B7C043F5 B8B81516 B865D055 B8B6365E"
    "00000000 00000000 00000000 00000000"
)
JOINT_TRAJ_PT_PACKET = bytes.fromhex(
    "00000040 0000000B 00000002 00000000 00000001 A7600000 3EA7CDE8 BF5D9E57 C0490FDB 3F34815F C0490FDB"
    "00000000 00000000 00000000 00000000 3DCCCCCD 40A00000"
)
STATUS_PACKET = bytes.fromhex(
    "00000028 0000000D 00000001 00000000 00000001 FFFFFFFF 00000000 00000000 00000000 00000002 00000001"
)


def test_joints_are_sent_as_in_the_rep() -> None:
    joints = struct.unpack(">6f", JOINT_POSITION_PACKET[20:44])
    assert joints[0] == pytest.approx(-0.000036919, abs=1e-9)
    assert BIG.joint_position(joints) == JOINT_POSITION_PACKET


def test_a_point_is_read_as_in_the_rep() -> None:
    message = BIG.message(JOINT_TRAJ_PT_PACKET)
    assert (message.kind, message.comm, message.reply) == (JOINT_TRAJ_PT, REQUEST, 0)
    point = BIG.point(message.body)
    assert point.sequence == 1
    assert point.joints[:6] == pytest.approx(
        (0.0, 0.327742815, -0.865697324, -3.141592741, 0.705099046, -3.141592741), abs=1e-8
    )
    assert point.joints[6:] == (0.0,) * 4
    assert point.velocity == pytest.approx(0.1)
    assert point.duration == 5.0


def test_a_status_is_sent_as_in_the_rep() -> None:
    status = Status(
        drives_powered=1, e_stopped=UNKNOWN, error_code=0, in_error=0, in_motion=0, mode=2, motion_possible=1
    )
    assert BIG.status(status) == STATUS_PACKET


@pytest.mark.parametrize("double", [False, True])
@pytest.mark.parametrize("big", [False, True])
def test_lengths_are_those_of_the_rep(big: bool, double: bool) -> None:
    packing, real = Packing(big, double), 8 if double else 4
    assert len(packing.joint_position([0.0] * 6)) == 4 + 12 + 4 + 10 * real
    assert len(packing.joint_feedback(0, 0.0, [0.0] * 6, [0.0] * 6)) == 4 + 12 + 8 + 31 * real
    assert len(packing.motion_reply(0, 0, 0, 0, 0)) == 4 + 12 + 20 + 10 * real


@pytest.mark.parametrize("cut", [3, 15, 40, len(JOINT_TRAJ_PT_PACKET) - 1])
def test_a_piece_of_a_message_is_none(cut: int) -> None:
    with pytest.raises(NotAMessage):
        BIG.message(JOINT_TRAJ_PT_PACKET[:cut])


def test_the_other_byte_order_is_no_message() -> None:
    with pytest.raises(NotAMessage):
        Packing(big=False, double=False).message(JOINT_TRAJ_PT_PACKET)


def test_a_body_of_another_size_is_none() -> None:
    body = BIG.message(JOINT_TRAJ_PT_PACKET).body
    with pytest.raises(NotAMessage):
        BIG.point(body[:-4])
    with pytest.raises(NotAMessage):
        Packing(big=True, double=True).point(body)
