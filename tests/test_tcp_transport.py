"""One TCP connection: deadlines are kept, a close wakes whoever waits, and every error names arm and address."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator

import pytest

from backends.controller.tcp.transport import Address, Connection, Rhythm
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import LinkLost

CLOCK = RealClock()


@pytest.fixture
def listener() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as made:
        yield made


@pytest.fixture
def pair(listener: socket.socket) -> Iterator[tuple[Connection, socket.socket]]:
    """A connection, and the controller's end of it."""
    connection = connection_to(listener)
    connection.connect(soon())
    peer, _ = listener.accept()
    yield connection, peer
    connection.close()
    peer.close()


def connection_to(listener: socket.socket) -> Connection:
    return Connection("left", Address("127.0.0.1", listener.getsockname()[1]), CLOCK)


def soon(seconds: float = 10.0) -> float:
    return CLOCK.now() + seconds


def test_bytes_go_both_ways_and_are_counted(pair: tuple[Connection, socket.socket]) -> None:
    connection, peer = pair
    connection.send(b"question", soon())
    assert peer.recv(100) == b"question"
    peer.sendall(b"answer")
    assert connection.receive(soon()) == b"answer"
    counted = connection.statistics
    assert (counted.bytes_out, counted.messages_out, counted.bytes_in) == (8, 1, 6)


def test_a_message_leaves_at_once_and_not_with_the_next(pair: tuple[Connection, socket.socket]) -> None:
    connection, _ = pair
    made = connection._socket
    assert made is not None
    assert made.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_nothing_received_by_the_deadline_is_no_error(pair: tuple[Connection, socket.socket]) -> None:
    connection, _ = pair
    begin = CLOCK.now()
    assert connection.receive(begin + 0.05) == b""
    assert CLOCK.now() >= begin + 0.05


def test_what_has_come_is_received_even_past_the_deadline(pair: tuple[Connection, socket.socket]) -> None:
    connection, peer = pair
    peer.sendall(b"late reader")
    connection.receive(soon())
    peer.sendall(b"again")
    CLOCK.wait(threading.Event(), soon(0.05))
    assert connection.receive(CLOCK.now() - 1.0) == b"again"


def test_a_peer_that_closes_is_a_lost_link(pair: tuple[Connection, socket.socket]) -> None:
    connection, peer = pair
    peer.close()
    with pytest.raises(LinkLost, match=rf"left: receive: {connection.address}: the controller closed the connection"):
        connection.receive(soon())


def test_a_port_where_nobody_listens_is_a_lost_link() -> None:
    with socket.create_server(("127.0.0.1", 0)) as gone:
        connection = connection_to(gone)
    with pytest.raises(LinkLost, match=rf"left: connect: {connection.address}: Connection refused"):
        connection.connect(soon())


def test_a_name_that_is_none_is_a_lost_link() -> None:
    with pytest.raises(LinkLost, match=r"left: connect: robot\.\.cell:11000: "):
        Connection("left", Address("robot..cell", 11000), CLOCK).connect(soon())


def full(listener: socket.socket) -> list[socket.socket]:
    """Have the listener take no more connections: those beyond its backlog are not answered."""
    taken = []
    for _ in range(8):
        made = socket.socket()
        made.setblocking(False)
        made.connect_ex(listener.getsockname())
        taken.append(made)
    return taken


def test_a_controller_that_does_not_answer_is_lost_at_the_deadline() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as listener:
        taken = full(listener)
        begin = CLOCK.now()
        with pytest.raises(LinkLost, match="no answer"):
            connection_to(listener).connect(begin + 0.2)
        assert CLOCK.now() >= begin + 0.2
        for made in taken:
            made.close()


def lost_on_another_thread(call: Callable[[], object]) -> tuple[threading.Thread, list[LinkLost]]:
    lost: list[LinkLost] = []

    def run() -> None:
        try:
            call()
        except LinkLost as error:
            lost.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    return thread, lost


def test_closing_wakes_a_thread_that_receives(pair: tuple[Connection, socket.socket]) -> None:
    connection, _ = pair
    thread, lost = lost_on_another_thread(lambda: connection.receive(soon(60)))
    CLOCK.wait(threading.Event(), soon(0.05))
    connection.close()
    thread.join(10)
    assert not thread.is_alive()
    assert "closed" in str(lost[0])


def test_closing_wakes_a_thread_that_connects() -> None:
    with socket.create_server(("127.0.0.1", 0), backlog=0) as listener:
        taken = full(listener)
        connection = connection_to(listener)
        thread, lost = lost_on_another_thread(lambda: connection.connect(soon(60)))
        CLOCK.wait(threading.Event(), soon(0.1))
        connection.close()
        thread.join(10)
        assert not thread.is_alive()
        assert "closed" in str(lost[0])
        for made in taken:
            made.close()


def test_a_controller_that_does_not_read_is_lost_by_the_deadline(pair: tuple[Connection, socket.socket]) -> None:
    connection, _ = pair
    with pytest.raises(LinkLost, match="does not read"):
        connection.send(bytes(50_000_000), soon(0.2))


def test_a_closed_connection_neither_sends_nor_receives(pair: tuple[Connection, socket.socket]) -> None:
    connection, _ = pair
    connection.close()
    connection.close()
    with pytest.raises(LinkLost, match="send"):
        connection.send(b"x", soon())
    with pytest.raises(LinkLost, match="receive"):
        connection.receive(soon())


def test_a_connection_closed_before_it_was_made_is_not_made(listener: socket.socket) -> None:
    connection = connection_to(listener)
    connection.close()
    with pytest.raises(LinkLost, match="closed"):
        connection.connect(soon())


def test_rate_and_jitter_are_those_of_the_latest_arrivals() -> None:
    rhythm = Rhythm()
    for number in range(500):
        rhythm.beat(1.0 if number < 300 else 1.0 + 0.1 * (number - 300))
    assert rhythm.period == pytest.approx(0.1)
    assert rhythm.jitter == pytest.approx(0.0, abs=1e-9)
    for number in range(64):
        rhythm.beat(30.0 + 0.1 * number + 0.01 * (number % 2))
    assert rhythm.period == pytest.approx(0.1, abs=1e-3)
    assert rhythm.jitter == pytest.approx(0.01, rel=0.05)


def test_three_arrivals_tell_no_rate() -> None:
    rhythm = Rhythm()
    for time in (0.0, 1.0, 2.0):
        rhythm.beat(time)
    assert rhythm.period is None
    assert rhythm.jitter is None
