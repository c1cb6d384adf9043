"""CAN buses without CAN hardware: what one client sends, all others on its bus hear, as socketcand has it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.controller.emulator.hub import Hub
from dualcal_hal.clock import RealClock

NEVER = threading.Event()


@pytest.fixture
def hub() -> Iterator[Hub]:
    hub = Hub(RealClock(), ["left", "right"])
    hub.start()
    yield hub
    hub.close()


class Client:
    """Speaks the protocol, and no more."""

    def __init__(self, hub: Hub, bus: str | None = None) -> None:
        self.socket = socket.socket()
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 14)
        self.socket.settimeout(10.0)
        self.socket.connect(("127.0.0.1", hub.port))
        self._received = b""
        assert self.line() == "< hi >"
        if bus is not None:
            self.say(f"< open {bus} >")
            assert self.line() == "< ok >"
            self.say("< rawmode >")
            assert self.line() == "< ok >"

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def say(self, text: str) -> None:
        self.socket.sendall(text.encode())

    def line(self) -> str:
        """The next that it is told, empty once it is put out."""
        while b">" not in self._received:
            try:
                received = self.socket.recv(4096)
            except ConnectionResetError:
                return ""
            if not received:
                return ""
            self._received += received
        line, _, self._received = self._received.partition(b">")
        return (line + b">").decode()

    def frame(self) -> tuple[str, str]:
        """The identifier and the data of the next frame, as written."""
        begin, word, identifier, time, *data, end = self.line().split(" ")
        assert (begin, word, end) == ("<", "frame", ">")
        assert float(time) > 0
        return identifier, "".join(data)

    def listen(self) -> Client:
        """From now on it hears all: one that has said something does at once."""
        self.say("< send 7FF 0 >< echo >")
        assert self.line() == "< echo >"
        return self


@contextmanager
def python_can(hub: Hub, bus: str = "left") -> Iterator[can.BusABC]:
    with can.Bus(
        interface="socketcand", host="127.0.0.1", port=hub.port, channel=bus, tcp_tune=True, ignore_config=True
    ) as opened:
        yield opened


def test_python_cans_clients_hear_each_other_and_not_themselves(hub: Hub) -> None:
    with Client(hub, "left").listen() as witness, python_can(hub) as one, python_can(hub) as other:
        other.send(can.Message(arbitration_id=0x7FF, is_extended_id=False))
        assert witness.frame() == ("7FF", "")  # so it listens from now on
        one.send(can.Message(arbitration_id=0x181, data=[1, 2, 255], is_extended_id=False))
        heard = other.recv(10.0)
        assert heard is not None
        assert (heard.arbitration_id, bytes(heard.data), heard.is_extended_id) == (0x181, b"\x01\x02\xff", False)
        other.send(can.Message(arbitration_id=0x201, data=[], is_extended_id=False))
        heard = one.recv(10.0)
        while heard is not None and heard.arbitration_id == 0x7FF:
            heard = one.recv(10.0)
        assert heard is not None
        assert (heard.arbitration_id, heard.dlc) == (0x201, 0)
        assert one.recv(0.05) is None


def test_frames_pass_unchanged_whatever_they_carry(hub: Hub) -> None:
    with Client(hub, "left") as one, Client(hub, "left").listen() as other:

        @given(st.integers(0, 0x7FF) | st.integers(0x800, 0x1FFFFFFF), st.binary(max_size=8))
        def passes(can_id: int, data: bytes) -> None:
            identifier = f"{can_id:03X}" if can_id < 0x800 else f"{can_id:08X}"
            one.say(f"< send {identifier} {len(data):X} {' '.join(f'{octet:x}' for octet in data)} >")
            assert other.frame() == (identifier, data.hex().upper())

        passes()


def test_each_bus_is_for_itself(hub: Hub) -> None:
    with Client(hub, "left") as one, Client(hub, "right").listen() as elsewhere, Client(hub, "left").listen() as other:
        one.say("< send 001 0 >")
        assert other.frame() == ("001", "")
        elsewhere.say("< echo >")
        assert elsewhere.line() == "< echo >"


def test_whoever_is_attached_in_the_process_hears_all_clients_and_is_heard_by_all(hub: Hub) -> None:
    bus = hub.buses["left"]
    with Client(hub, "left").listen() as one, Client(hub, "left").listen() as other:
        bus.attach(lambda can_id, data: bus.send(can_id + 1, data[::-1]))
        one.say("< send 100 2 1 2 >")
        assert [one.frame() for _ in range(2)] == [("7FF", ""), ("101", "0201")]
        assert [other.frame() for _ in range(2)] == [("100", "0102"), ("101", "0201")]


def test_clients_join_a_busy_bus_without_a_frame_between_the_replies(hub: Hub) -> None:
    hub.on_tick(lambda now: [hub.buses["left"].send(k, bytes(8)) for k in range(20)])
    for _ in range(5):
        with python_can(hub) as bus:  # it raises if a frame comes with a reply
            assert bus.recv(10.0) is not None


def test_commands_may_come_in_pieces_and_together(hub: Hub) -> None:
    with Client(hub) as one, Client(hub, "left").listen() as other:
        one.say("< open left >< rawmode >< se")
        assert [one.line(), one.line()] == ["< ok >", "< ok >"]
        one.say("nd 123 1 A")
        one.say("B >< send 124 0 >")
        assert [other.frame(), other.frame()] == [("123", "AB"), ("124", "")]


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("< open nowhere >", "< error could not open bus >"),
        ("< rawmode >", "< error unknown command >"),
        ("< send 100 0 >", "< error unknown command >"),
        ("< dance >", "< error unknown command >"),
        (">", "< error unknown command >"),
    ],
)
def test_what_cannot_be_done_before_a_bus_is_open_is_said(hub: Hub, command: str, reply: str) -> None:
    with Client(hub) as client:
        client.say(command)
        assert client.line() == reply
        client.say("< open left >")
        assert client.line() == "< ok >"


@pytest.mark.parametrize(
    "frame",
    [
        "100 9 1 2 3 4 5 6 7 8 9",
        "100 2 1",
        "1000 0",
        "800 0",
        "FFFFFFFF 0",
        "100 1 100",
        "100 1 -1",
        "xyz 0",
        "100",
        "",
    ],
)
def test_what_is_no_frame_is_not_sent(hub: Hub, frame: str) -> None:
    with Client(hub, "left").listen() as one, Client(hub, "left").listen() as other:
        assert one.frame() == ("7FF", "")
        one.say(f"< send {frame} >")
        assert one.line() == "< error syntax error >"
        one.say("< send 001 0 >")
        assert other.frame() == ("001", "")


def test_no_bytes_at_all_end_the_service(hub: Hub) -> None:
    @given(st.binary(max_size=200), st.booleans())
    def goes_on(data: bytes, opened: bool) -> None:
        with Client(hub, "right" if opened else None) as client:
            client.socket.sendall(data)
        with Client(hub, "left"):
            pass

    goes_on()


def test_a_client_that_never_ends_its_command_is_put_out(hub: Hub) -> None:
    with Client(hub) as client:
        client.say("< " + 2000 * "x")
        assert client.line() == ""


def test_a_client_that_does_not_read_is_put_out_and_the_others_hear_on(hub: Hub) -> None:
    with ExitStack() as stack:
        one, deaf, other = (stack.enter_context(Client(hub, "left").listen()) for _ in range(3))
        frames = 30_000  # 1.4 MB
        for _ in range(frames // 100):
            one.say(100 * "< send 123 8 0 1 2 3 4 5 6 7 >")
            for _ in range(100):
                assert other.frame()[0] == "123"
        heard = 0
        while deaf.line():
            heard += 1
        assert heard < frames


def test_a_lost_bus_puts_its_clients_out_and_takes_none_until_it_is_mended(hub: Hub) -> None:
    with Client(hub, "left") as lost, Client(hub, "right") as other:
        hub.soon(hub.buses["left"].lose)
        assert lost.line() == ""
        with Client(hub) as late:
            late.say("< open left >")
            assert late.line() == "< error could not open bus >"
        other.say("< echo >")
        assert other.line() == "< echo >"
        hub.soon(hub.buses["left"].mend)
        with Client(hub, "left"):
            pass


def test_what_came_while_the_hub_stood_still_is_heard_before_anybody_looks_for_it() -> None:
    hub = Hub(RealClock(), ["left"])
    seen: list[str] = []
    stands, goes_on = threading.Event(), threading.Event()

    def stand_still() -> None:
        stands.set()
        goes_on.wait()
        seen.append("goes on")

    hub.on_tick(lambda now: seen.append("tick"))
    hub.buses["left"].attach(lambda can_id, data: seen.append("frame"))
    hub.start()
    try:
        with Client(hub, "left").listen() as client:
            hub.soon(stand_still)
            stands.wait()
            client.say("< send 123 0 >")
            NEVER.wait(0.2)
            goes_on.set()
            client.say("< echo >")
            client.line()
    finally:
        hub.close()
    assert seen[seen.index("goes on") + 1] == "frame"


def test_a_hub_that_hears_without_end_ticks_all_the_same() -> None:
    hub = Hub(RealClock(), ["left"])
    seen: list[str] = []

    def hear_slowly(can_id: int, data: bytes) -> None:
        seen.append("frame")
        NEVER.wait(0.06)

    hub.on_tick(lambda now: seen.append("tick"))
    hub.buses["left"].attach(hear_slowly)
    hub.start()
    try:
        with Client(hub, "left") as client:
            for _ in range(20):
                client.say("< send 123 0 >")
                NEVER.wait(0.02)
            client.say("< echo >")
            client.line()
    finally:
        hub.close()
    within = seen[seen.index("frame") : len(seen) - seen[::-1].index("frame")]
    assert "tick" in within


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_hub_that_fails_leaves_nobody_waiting(hub: Hub) -> None:
    def fail() -> None:
        raise RuntimeError("nobody expects this")

    with Client(hub, "left") as client:
        hub.soon(fail)
        assert client.line() == ""


def test_it_is_closed_any_number_of_times_started_or_not() -> None:
    hub = Hub(RealClock(), ["left"])
    hub.close()
    hub.close()
    hub.soon(lambda: None)
    hub = Hub(RealClock(), ["left"])
    hub.start()
    with Client(hub, "left") as client:
        hub.close()
        hub.close()
        assert client.line() == ""


def test_a_port_that_is_taken_is_refused_at_once(hub: Hub) -> None:
    with pytest.raises(OSError, match="in use"):
        Hub(RealClock(), ["left"], hub.port)
