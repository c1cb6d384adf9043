"""A bus opens with exact options or not at all, and what goes wrong with it is always told, and in our own errors."""

from __future__ import annotations

import itertools
import socket
import threading
from contextlib import contextmanager

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from backends.controller.can.socketcand import Frame, SocketcandWire, address_of
from backends.controller.can.transport import BusAddress, Transport
from backends.controller.promptness import prompt_interpreter, prompt_thread
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost

CLOCK = RealClock()
PATIENCE = 10.0
_channels = itertools.count()


class Heard:
    """A transport, and what came by it."""

    def __init__(self, interface, channel, bitrate=None):
        self.frames, self.losses = [], []
        self.arrived, self.lost = threading.Event(), threading.Event()
        self.transport = Transport("left", BusAddress(interface, channel, bitrate), CLOCK, self._hear, self._lose)

    def _hear(self, identifier, data, arrival):
        self.frames.append((identifier, data, arrival))
        self.arrived.set()

    def _lose(self, error):
        self.losses.append(error)
        self.lost.set()

    def open(self, timeout=PATIENCE):
        self.transport.open(CLOCK.now() + timeout)


@contextmanager
def opened(*address):
    heard = Heard(*address)
    heard.open()
    try:
        yield heard
    finally:
        heard.transport.close()


@contextmanager
def server(serve):
    """What ``serve`` does with the first connection; its port."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        connections = []

        def run():
            connection, _ = listener.accept()
            connections.append(connection)
            with connection:
                serve(connection)

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            thread.join(PATIENCE)


def greet(connection, and_then=b""):
    connection.sendall(b"< hi >")
    assert b"open can0" in connection.recv(100)
    connection.sendall(b"< ok >")
    assert b"rawmode" in connection.recv(100)
    connection.sendall(b"< ok >" + and_then)


def until_closed(connection):
    received = b""
    while part := connection.recv(4096):
        received += part
    return received


# Any interface of python-can


def test_frames_go_out_in_their_order_and_come_in_stamped_on_arrival():
    channel = f"bus {next(_channels)}"
    other = can.Bus(interface="virtual", channel=channel, ignore_config=True)
    with opened("virtual", channel) as heard:
        heard.transport.send_all([(0x201, b"\1\2"), (0x080, b"")])
        assert [(m.arbitration_id, bytes(m.data)) for m in (other.recv(PATIENCE), other.recv(PATIENCE))] == [
            (0x201, b"\1\2"),
            (0x080, b""),
        ]
        before = CLOCK.now()
        other.send(can.Message(arbitration_id=0x12345, is_extended_id=True))
        other.send(can.Message(arbitration_id=0x181, data=b"\3", is_extended_id=False))
        assert heard.arrived.wait(PATIENCE)
        [(identifier, data, arrival)] = heard.frames
        assert (identifier, data) == (0x181, b"\3")
        assert before <= arrival <= CLOCK.now()
        assert (heard.transport.statistics.sent, heard.transport.statistics.received) == (2, 1)
    other.shutdown()


@pytest.mark.parametrize(
    ("address", "words"),
    [
        (("sockecan", "can0"), "no interface sockecan"),
        (("socketcand", "can0"), "HOST:PORT/BUS"),
    ],
)
def test_options_that_do_not_fit_are_refused(address, words):
    with pytest.raises(CommandRefused, match=words):
        Heard(*address).open()


@pytest.mark.parametrize("interface", ["socketcan", "slcan", "pcan", "vector", "ixxat"])
def test_an_interface_that_is_not_there_or_has_no_library_is_an_error_of_ours(interface):
    bitrate = None if interface == "socketcan" else 500_000
    with pytest.raises(LinkLost, match=rf"left: open the bus: {interface} no-such-thing: .*\bthere\b"):
        Heard(interface, "no-such-thing", bitrate).open()


def test_a_library_that_takes_for_ever_is_not_waited_for(monkeypatch):
    release, shut_down = threading.Event(), threading.Event()

    class Slow:
        def __init__(self, **options):
            release.wait(PATIENCE)

        def shutdown(self):
            shut_down.set()

    monkeypatch.setattr(can, "Bus", Slow)
    with pytest.raises(DeviceTimeout, match="did not open in time"):
        Heard("pcan", "x").open(0.05)
    release.set()
    assert shut_down.wait(PATIENCE), "a bus that opens later is released again"


def test_a_bus_is_opened_with_exact_options_alone(monkeypatch):
    given_to = {}

    def bus(**options):
        given_to.update(options)
        raise can.CanInitializationError("not here")

    monkeypatch.setattr(can, "Bus", bus)
    with pytest.raises(LinkLost, match="not here"):
        Heard("slcan", "/dev/ttyACM0", 1_000_000).open()
    assert given_to == {
        "interface": "slcan",
        "channel": "/dev/ttyACM0",
        "bitrate": 1_000_000,
        "ignore_config": True,
    }


def test_whatever_ends_the_reader_is_told(monkeypatch):
    with opened("virtual", f"bus {next(_channels)}") as heard:

        def fails(timeout):
            raise KeyError("a vendor's own")

        monkeypatch.setattr(heard.transport._wire, "receive", fails)
        assert heard.lost.wait(PATIENCE)
        [error] = heard.losses
        assert isinstance(error, LinkLost)
        assert "a vendor's own" in str(error)


def test_a_dispatch_that_raises_is_told_and_not_swallowed():
    channel = f"bus {next(_channels)}"
    other = can.Bus(interface="virtual", channel=channel, ignore_config=True)
    with opened("virtual", channel) as heard:
        heard.transport._dispatch = lambda *frame: 1 / 0
        other.send(can.Message(arbitration_id=1, is_extended_id=False))
        assert heard.lost.wait(PATIENCE)
    other.shutdown()


def test_sending_on_a_closed_bus_is_a_lost_link():
    with opened("virtual", f"bus {next(_channels)}") as heard:
        heard.transport.close()
        with pytest.raises(LinkLost, match="closed"):
            heard.transport.send(1, b"")


def test_what_a_library_raises_at_sending_is_a_lost_link(monkeypatch):
    with opened("virtual", f"bus {next(_channels)}") as heard:

        def full(frames):
            raise can.CanOperationError("buffer full")

        monkeypatch.setattr(heard.transport._wire, "send", full)
        with pytest.raises(LinkLost, match="buffer full"):
            heard.transport.send(1, b"")


# socketcand


def test_socketcand_sends_and_hears_frames():
    sent = []

    def serve(connection):
        greet(connection, and_then=b"< frame 181 12.5 370F08 >")  # together with the reply
        sent.append(connection.recv(100))
        connection.sendall(b"< fra")
        connection.sendall(b"me 705 12.6 05 >< frame 12345678 1.0 00 >< error 1 2.0 >< frame 80 13.0 >")
        sent.append(until_closed(connection))

    with server(serve) as port, opened("socketcand", f"127.0.0.1:{port}/can0") as heard:
        heard.transport.send_all([(0x201, bytes.fromhex("0f00081027")), (0x80, b"")])
        deadline = CLOCK.now() + PATIENCE
        while len(heard.frames) < 3 and CLOCK.now() < deadline:
            CLOCK.wait(threading.Event(), CLOCK.now() + 0.01)
        assert [(identifier, data.hex()) for identifier, data, _ in heard.frames] == [
            (0x181, "370f08"),
            (0x705, "05"),
            (0x080, ""),
        ]
        assert heard.transport.statistics.error_frames == 1
        heard.transport.close()
    assert sent[0] == b"< send 201 5 0f 00 08 10 27 >< send 080 0 >"


def test_a_connection_that_was_closed_is_noticed():
    with server(greet) as port, opened("socketcand", f"127.0.0.1:{port}/can0") as heard:
        assert heard.lost.wait(PATIENCE)
        assert "closed the connection" in str(heard.losses[0])


def test_a_port_nobody_listens_at_is_told_with_advice():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(LinkLost, match=rf"127.0.0.1:{port}/can0: .*refused.*is socketcand running"):
        Heard("socketcand", f"127.0.0.1:{port}/can0").open()


def test_a_server_that_says_nothing_is_not_waited_for_longer_than_asked():
    with server(until_closed) as port, pytest.raises(DeviceTimeout):
        Heard("socketcand", f"127.0.0.1:{port}/can0").open(0.2)


@pytest.mark.parametrize("greeting", [b"SSH-2.0-OpenSSH >", b"< error could not open bus >", b"x" * 5000])
def test_what_is_no_socketcand_is_refused(greeting):
    def serve(connection):
        connection.sendall(greeting)
        until_closed(connection)

    with server(serve) as port, pytest.raises(LinkLost, match="socketcand"):
        Heard("socketcand", f"127.0.0.1:{port}/can0").open()


@given(st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=5), st.data())
def test_frames_come_whole_in_whatever_pieces_they_arrive(frames, data):
    stream = b"".join(b"< frame %03X 1.5 %b >" % (identifier, payload.hex().encode()) for identifier, payload in frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=6)))
    pieces = [stream[a:b] for a, b in itertools.pairwise([0, *cuts, len(stream)])]
    wire = object.__new__(SocketcandWire)
    wire._received, wire._waits = b"", 0.0
    wire._wait_at_most = lambda timeout: None

    def read():
        wire._received += pieces.pop(0)

    wire._read = read
    found = []
    while pieces:
        found += wire.receive(0.0)
    found += wire.receive(0.0) if b">" in wire._received else []
    assert found == [Frame(*frame) for frame in frames]


@given(st.binary(max_size=200))
def test_no_bytes_whatever_make_a_wrong_frame_or_an_error(noise):
    wire = object.__new__(SocketcandWire)
    wire._received, wire._waits = noise + b">", 0.0
    for frame in wire.receive(0.0):
        assert 0 <= frame.identifier <= 0xFFF


def test_addresses():
    assert address_of("10.0.0.5:29536/can0") == ("10.0.0.5", 29536, "can0")
    assert address_of("[::1]:29536/can0") == ("::1", 29536, "can0")
    for wrong in ("can0", "10.0.0.5/can0", "10.0.0.5:0/can0", "10.0.0.5:99999/can0", ":1/can0", "h:1/"):
        with pytest.raises(ValueError, match="HOST:PORT/BUS"):
            address_of(wrong)


# What keeps threads on time


def test_the_interpreter_is_left_as_it_was_found():
    import sys

    before = sys.getswitchinterval()
    with prompt_interpreter():
        with prompt_interpreter():
            assert sys.getswitchinterval() < before
        assert sys.getswitchinterval() < before
    assert sys.getswitchinterval() == before


def test_a_threads_priority_is_left_as_it_was_found():
    import os

    before = os.sched_getscheduler(0)
    with prompt_thread() as granted:
        assert granted is (os.sched_getscheduler(0) != before)
    assert os.sched_getscheduler(0) == before


def test_all_errors_are_of_our_own_tree():
    for address in (("sockecan", "x"), ("socketcan", "no-such-can")):
        with pytest.raises(DeviceError):
            Heard(*address).open()
