"""Simple message as bytes: the packets of REP I0006, every message in every variant, and bytes that are none."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.controller.tcp.codec import (
    KINDS,
    LONGEST,
    Acknowledgement,
    Code,
    CodecError,
    Comm,
    FrameError,
    FrameSplitter,
    JointFeedback,
    JointPosition,
    JointTrajPt,
    Judgement,
    LengthError,
    Message,
    MotoMotionReply,
    Ping,
    Status,
    Unknown,
    ValueRefused,
    Wire,
    decode,
    encode,
    judge,
    ten,
)
from tools.benchmarks.fuzz_messages import Fuzzer

BIG = Wire("big", "f32")
WIRES = [Wire(order, real) for order in ("big", "little") for real in ("f32", "f64")]

# -- REP I0006, appendix A ------------------------------------------------------------------------------------------

JOINT_POSITION = """
    00000038 0000000A 00000001 00000000 00000000 B81AD9FA B6836312 B7C043F5
    B8B81516 B865D055 B8B6365E 00000000 00000000 00000000 00000000"""
JOINT_TRAJ_PT = """
    00000040 0000000B 00000002 00000000 00000001 A7600000 3EA7CDE8 BF5D9E57 C0490FDB
    3F34815F C0490FDB 00000000 00000000 00000000 00000000 3DCCCCCD 40A00000"""
STATUS = "00000028 0000000D 00000001 00000000 00000001 FFFFFFFF 00000000 00000000 00000000 00000002 00000001"


def golden(text: str) -> bytes:
    return bytes.fromhex(text)


def swapped(packet: bytes) -> bytes:
    """The same packet of a server with 32-bit reals and the other byte order."""
    return b"".join(packet[place : place + 4][::-1] for place in range(0, len(packet), 4))


def test_the_rep_s_joint_position_is_read() -> None:
    message = decode(golden(JOINT_POSITION)[4:], BIG)
    assert isinstance(message, JointPosition)
    assert (message.comm, message.code, message.sequence) == (Comm.TOPIC, Code.UNUSED, 0)
    expected = [-0.000036919, -0.000003916, -0.000022920, -0.000087777, -0.000054792, -0.000086886, 0, 0, 0, 0]
    assert message.positions == pytest.approx(expected, abs=5e-10)


def test_the_rep_s_trajectory_point_is_read() -> None:
    message = decode(golden(JOINT_TRAJ_PT)[4:], BIG)
    assert isinstance(message, JointTrajPt)
    assert (message.comm, message.sequence) == (Comm.REQUEST, 1)
    expected = [0, 0.327742815, -0.865697324, -3.141592741, 0.705099046, -3.141592741, 0, 0, 0, 0]
    assert message.positions == pytest.approx(expected, abs=5e-10)
    assert (message.velocity, message.duration) == (pytest.approx(0.1), 5.0)


def test_the_rep_s_status_is_read() -> None:
    assert decode(golden(STATUS)[4:], BIG) == Status(
        drives_powered=1, e_stopped=-1, error_code=0, in_error=0, in_motion=0, mode=2, motion_possible=1
    )


@pytest.mark.parametrize("text", [JOINT_POSITION, JOINT_TRAJ_PT, STATUS])
@pytest.mark.parametrize("order", ["big", "little"])
def test_the_rep_s_packets_are_written_byte_for_byte(text: str, order: Any) -> None:
    packet = golden(text) if order == "big" else swapped(golden(text))
    wire = Wire(order, "f32")
    assert encode(decode(packet[4:], wire), wire) == packet


# -- every message in every variant ---------------------------------------------------------------------------------

INTEGERS = st.integers(-(2**31), 2**31 - 1)
SINGLES = st.floats(allow_nan=False, allow_infinity=False, width=32)  # as every wire can carry them


def of_kind(kind: type[Message]) -> st.SearchStrategy[Message]:
    fields = {}
    for name, layout in kind.BODY:
        value = INTEGERS if layout[-1] == "i" else SINGLES
        fields[name] = value if len(layout) == 1 else st.tuples(*[value] * int(layout[:-1]))
    # A reply to a point says no more than its code.
    comms = [Comm.TOPIC, Comm.REQUEST] if kind.ID in (1, 11, 14) else list(Comm)
    return st.builds(
        lambda comm, **values: kind(comm=comm, code=Code.SUCCESS if comm is Comm.REPLY else Code.UNUSED, **values),
        st.sampled_from(comms),
        **fields,
    )


MESSAGES = st.one_of(
    *map(of_kind, KINDS.values()),
    st.builds(Acknowledgement, id=st.sampled_from(sorted(KINDS)), code=st.sampled_from([Code.SUCCESS, Code.FAILURE])),
    st.builds(
        Unknown, id=INTEGERS.filter(lambda identity: identity not in KINDS), body=st.binary(max_size=LONGEST - 12)
    ),
)


@given(MESSAGES, st.sampled_from(WIRES))
def test_every_message_comes_back_as_it_was_sent(message: Message, wire: Wire) -> None:
    packet = encode(message, wire)
    assert int.from_bytes(packet[:4], wire.byte_order) == len(packet) - 4
    assert decode(packet[4:], wire) == message


@pytest.mark.parametrize(
    ("kind", "f32", "f64"),
    [(1, 52, 52), (10, 56, 96), (11, 64, 112), (13, 40, 40), (14, 148, 272), (15, 144, 268), (2001, 64, 104)],
)
def test_messages_have_the_lengths_that_servers_count_on(kind: int, f32: int, f64: int) -> None:
    values = {name: (0,) * 10 if len(layout) > 1 else 0 for name, layout in KINDS[kind].BODY}
    message = KINDS[kind](**values)  # type: ignore[arg-type]
    assert [len(encode(message, Wire("big", real))) - 4 for real in ("f32", "f64")] == [f32, f64]


@pytest.mark.parametrize("wire", WIRES, ids=str)
@pytest.mark.parametrize("body", [b"", b"\xff" * 40, b"\xff" * 80], ids=["header alone", "40 bytes", "80 bytes"])
def test_a_reply_to_a_point_is_read_with_or_without_its_dummies(wire: Wire, body: bytes) -> None:
    sign = {"big": ">", "little": "<"}[wire.byte_order]
    frame = struct.pack(sign + "3i", 11, 3, 1) + body
    assert decode(frame, wire) == Acknowledgement(id=11, code=Code.SUCCESS)


def test_the_body_of_a_failure_may_be_anything() -> None:
    frame = struct.pack(">3i", 2002, 3, 2) + b"\xff" * 60
    assert decode(frame, BIG) == Acknowledgement(id=2002, code=Code.FAILURE)


def test_messages_of_other_kinds_pass_through() -> None:
    frame = struct.pack(">3i", 2017, 1, 0) + b"anything"
    assert decode(frame, BIG) == Unknown(id=2017, body=b"anything")


def test_what_a_motoman_answers_is_its_own_message() -> None:
    frame = struct.pack(">3i5i10f", 2002, 3, 1, 0, 7, 14, 5, 5006, *[0.0] * 10)
    message = decode(frame, BIG)
    assert isinstance(message, MotoMotionReply)
    assert (message.sequence, message.command, message.result, message.subcode) == (7, 14, 5, 5006)


# -- what is no message ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e39], ids=str)
def test_a_number_that_is_none_is_not_sent(value: float) -> None:
    point = JointTrajPt(sequence=0, positions=ten([value]), velocity=0.5, duration=1.0)
    with pytest.raises(ValueRefused):
        encode(point, BIG)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf], ids=str)
@pytest.mark.parametrize("real", ["f32", "f64"])
def test_a_number_that_is_none_is_not_read(value: float, real: Any) -> None:
    letter = {"f32": "f", "f64": "d"}[real]
    frame = struct.pack(f">3i2i{31}{letter}", 15, 1, 0, 0, 7, *[0.0] * 12, value, *[0.0] * 18)
    with pytest.raises(ValueRefused, match="velocities"):
        decode(frame, Wire("big", real))


def test_more_joints_than_an_array_has_are_not_sent() -> None:
    with pytest.raises(LengthError, match="positions has 10 entries, not 11"):
        encode(JointPosition(positions=ten(range(11))), BIG)


def test_an_integer_beyond_32_bits_is_not_sent() -> None:
    with pytest.raises(ValueRefused):
        encode(JointPosition(sequence=2**31, positions=ten(())), BIG)


def test_nothing_longer_than_any_message_is_sent() -> None:
    with pytest.raises(LengthError):
        encode(Unknown(id=3000, body=bytes(LONGEST)), BIG)


def test_a_length_that_fits_the_other_size_of_reals_says_so() -> None:
    with pytest.raises(LengthError, match="the sender's reals are not f64"):
        decode(golden(JOINT_POSITION)[4:], Wire("big", "f64"))


@pytest.mark.parametrize("length", [0, 11, LONGEST + 1])
def test_a_frame_of_no_message_s_length_is_refused(length: int) -> None:
    with pytest.raises(LengthError):
        decode(bytes(length), BIG)


@pytest.mark.parametrize("body", [4, 41, 44])
def test_a_reply_to_a_point_of_another_length_is_refused(body: int) -> None:
    with pytest.raises(LengthError):
        decode(struct.pack(">3i", 11, 3, 1) + bytes(body), BIG)


@pytest.mark.parametrize(
    ("comm", "code"),
    [(0, 0), (4, 0), (-1, 0), (1, 1), (2, 2), (3, 0), (3, 3)],
)
def test_a_header_that_the_rep_does_not_allow_is_refused(comm: int, code: int) -> None:
    with pytest.raises(ValueRefused):
        decode(struct.pack(">3i", 13, comm, code) + bytes(28), BIG)


# -- frames out of a stream -----------------------------------------------------------------------------------------


@given(
    st.lists(st.binary(min_size=12, max_size=200), max_size=8),
    st.lists(st.integers(1, 60), min_size=1),
    st.sampled_from(["big", "little"]),
)
def test_frames_come_out_however_the_stream_is_cut(frames: list[bytes], cuts: list[int], order: Any) -> None:
    stream = b"".join(len(frame).to_bytes(4, order) + frame for frame in frames)
    splitter, found = FrameSplitter(order), []
    for number in range(len(stream)):
        size = cuts[number % len(cuts)]
        found += splitter.feed(stream[:size])
        stream = stream[size:]
    assert found == frames
    assert splitter.held == 0


def test_a_splitter_holds_no_more_than_a_frame() -> None:
    splitter = FrameSplitter("big")
    frame = bytes(LONGEST)
    for _ in range(100):
        assert list(splitter.feed(LONGEST.to_bytes(4, "big") + frame[:-1])) == []
        assert splitter.held == 4 + LONGEST - 1
        assert list(splitter.feed(b"\0")) == [frame]


@pytest.mark.parametrize("length", [-1, 0, 11, LONGEST + 1, 2**31 - 1])
def test_a_length_that_no_message_has_ends_a_stream_for_good(length: int) -> None:
    good = golden(STATUS)
    splitter = FrameSplitter("big")
    frames = splitter.feed(good + length.to_bytes(4, "big", signed=True))
    assert next(frames) == good[4:]
    with pytest.raises(FrameError):
        next(frames)
    with pytest.raises(FrameError):
        list(splitter.feed(good))


# -- how a server writes --------------------------------------------------------------------------------------------


def feedback(wire: Wire) -> bytes:
    return encode(JointFeedback(group=0, valid=2, time=0.0, positions=ten(()), velocities=ten(())), wire)


@pytest.mark.parametrize("wire", WIRES, ids=str)
@pytest.mark.parametrize("packet", [lambda wire: encode(JointPosition(positions=ten(())), wire), feedback])
def test_a_server_is_judged_by_its_first_joints(wire: Wire, packet: Callable[[Wire], bytes]) -> None:
    assert judge(packet(wire)[:8]) == Judgement(wire.byte_order, wire.real)


@pytest.mark.parametrize("packet", [golden(STATUS), encode(Ping(), BIG), encode(Unknown(id=2017, body=b""), BIG)])
def test_a_first_message_without_reals_tells_the_byte_order_alone(packet: bytes) -> None:
    assert judge(packet) == Judgement("big", None)
    assert judge(swapped(packet)) == Judgement("little", None)


def test_a_judgement_is_said_in_words() -> None:
    assert str(judge(golden(JOINT_POSITION))) == "big-endian, 32-bit reals (f32)"
    assert str(judge(golden(STATUS))) == "big-endian, reals of a size not known yet"


@pytest.mark.parametrize(
    "first",
    [b"HTTP/1.1", bytes(8), b"\xff" * 8, struct.pack(">2i", 56, 0), struct.pack(">2i", 56, -10), b"SSH-2.0-"],
    ids=["web server", "zeros", "ones", "id 0", "negative id", "ssh"],
)
def test_a_port_that_sends_something_else_is_no_state_port(first: bytes) -> None:
    with pytest.raises(CodecError, match="is this the state port"):
        judge(first)


def test_joints_of_a_length_that_fits_no_reals_are_refused() -> None:
    with pytest.raises(LengthError, match="neither"):
        judge(struct.pack(">2i", 60, 10))


@given(st.integers(12, LONGEST), st.integers(1, 65535))
def test_no_length_is_plausible_in_both_byte_orders(length: int, identity: int) -> None:
    for sign, order in ((">", "big"), ("<", "little")):
        if identity not in (10, 15):
            assert judge(struct.pack(sign + "2i", length, identity)).byte_order == order


# -- damage ---------------------------------------------------------------------------------------------------------


def test_damaged_and_random_bytes_give_messages_or_typed_errors() -> None:
    fuzzer = Fuzzer(seed=1)
    fuzzer.run(20_000)
    assert set(fuzzer.outcomes) == {"read", "FrameError", "LengthError", "ValueRefused"}
    assert min(fuzzer.outcomes.values()) > 50, "each way of being no message is among them"
    assert fuzzer.slowest < 1.0
