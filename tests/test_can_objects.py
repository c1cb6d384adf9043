"""Bytes of CiA 402 drives, made by hand, and what they mean."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.controller.can.objects import (
    Emergency,
    Feedback,
    NmtCommand,
    NmtState,
    Scale,
    State,
    pack_command,
    pack_nmt,
    state_of,
    unpack_command,
    unpack_heartbeat,
    words_of,
)

words16 = st.integers(0, 0xFFFF)
bytes8 = st.integers(-128, 127)
counts = st.integers(-(2**31), 2**31 - 1)


def test_command_is_controlword_mode_and_target_little_endian():
    # 6040 = 001F, 6060 = 1, 607A = -2
    assert pack_command(0x001F, 1, -2) == bytes.fromhex("1f 00 01 fe ff ff ff")
    assert pack_command(0x000F, 8, 0x01020304) == bytes.fromhex("0f 00 08 04 03 02 01")


def test_feedback_is_statusword_mode_and_position_little_endian():
    feedback = Feedback.unpack(bytes.fromhex("37 12 08 00 01 00 80"))
    assert feedback == Feedback(0x1237, 8, -(2**31) + 256)
    assert feedback.state is State.OPERATION_ENABLED


@given(words16, bytes8, counts)
def test_commands_come_back(word, operation, target):
    assert unpack_command(pack_command(word, operation, target)) == (word, operation, target)


@given(words16, bytes8, counts)
def test_feedback_comes_back(word, operation, position):
    feedback = Feedback(word, operation, position)
    assert Feedback.unpack(feedback.pack()) == feedback


@given(st.binary(max_size=8))
def test_frames_of_any_other_length_are_refused(data):
    for unpack, length in (
        (Feedback.unpack, 7),
        (unpack_command, 7),
        (Emergency.unpack, 8),
        (unpack_heartbeat, 1),
    ):
        if len(data) == length:
            unpack(data)
        else:
            with pytest.raises(ValueError, match="not"):
                unpack(data)


@pytest.mark.parametrize("target", [2**31, -(2**31) - 1])
def test_a_target_out_of_32_bits_is_refused_and_not_wrapped(target):
    with pytest.raises(ValueError, match="32 bits"):
        pack_command(0, 8, target)


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY),
        (0x0250, State.SWITCH_ON_DISABLED),
        (0x0270, State.SWITCH_ON_DISABLED),
        (0x0231, State.READY),
        (0x0233, State.SWITCHED_ON),
        (0x1637, State.OPERATION_ENABLED),
        (0x0217, State.QUICK_STOP),
        (0x021F, State.FAULT_REACTION),
        (0x0218, State.FAULT),
        (0x0238, State.FAULT),
    ],
)
def test_states_are_told_by_mask_and_value(statusword, state):
    assert state_of(statusword) is state


@given(words16)
def test_bits_that_are_no_part_of_a_state_change_none(word):
    assert state_of(word | 0xFF80) is state_of(word & 0x7F)


def test_an_angle_is_counts_by_their_scale_sign_and_offset():
    scale = Scale(counts_per_rad=1000.0, offset=0.5, sign=-1)
    assert scale.to_counts(0.5) == 0
    assert scale.to_counts(1.5) == -1000
    assert scale.to_angle(-1000) == 1.5


@given(
    st.floats(100.0, 1e7), st.floats(-3.0, 3.0), st.sampled_from([-1, 1]), st.integers(-1_000_000_000, 1_000_000_000)
)
def test_counts_come_back_from_their_angle(per_rad, offset, sign, count):
    scale = Scale(per_rad, offset, sign)
    # Doubles keep a count as long as there are less of them than the offset leaves digits for.
    assert abs(scale.to_counts(scale.to_angle(count)) - count) <= 1


def test_an_emergency_is_code_register_and_the_makers_bytes():
    emergency = Emergency.unpack(bytes.fromhex("11 86 21 01 02 03 04 05"))
    assert emergency == Emergency(0x8611, 0x21, bytes((1, 2, 3, 4, 5)))
    assert emergency.pack() == bytes.fromhex("11 86 21 01 02 03 04 05")
    assert str(emergency) == "code 0x8611 following error"
    assert not emergency.is_over
    assert Emergency.unpack(bytes(8)).is_over


@given(words16, st.integers(0, 255), st.binary(min_size=5, max_size=5))
def test_emergencies_come_back(code, register, maker):
    emergency = Emergency(code, register, maker)
    assert Emergency.unpack(emergency.pack()) == emergency


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (0x3220, "code 0x3220 under voltage of the DC link"),
        (0x8130, "code 0x8130 heartbeat of this program missed"),
        (0x2399, "code 0x2399 current at the output"),  # the class, where the code itself is none of CiA's
        (0x7399, "code 0x7399 additional modules"),
        (0xA001, "code 0xA001 unknown error"),
    ],
)
def test_codes_have_words(code, words):
    assert words_of(code) == words


@pytest.mark.parametrize(
    ("byte", "state"),
    [
        (0x00, NmtState.BOOT_UP),
        (0x05, NmtState.OPERATIONAL),
        (0x85, NmtState.OPERATIONAL),
        (0x7F, NmtState.PRE_OPERATIONAL),
        (0x04, NmtState.STOPPED),
    ],
)
def test_heartbeats_tell_the_state_without_the_toggle_bit(byte, state):
    assert unpack_heartbeat(bytes((byte,))) == state


def test_network_commands_are_command_and_node():
    assert pack_nmt(NmtCommand.PRE_OPERATIONAL, 5) == bytes.fromhex("80 05")
