"""One TCP connection: bytes with deadlines, and how regularly they come. What the bytes mean is not its business."""

from __future__ import annotations

import select
import socket
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from dualcal_hal.clock import Clock
from dualcal_hal.errors import LinkLost

_CHUNK = 65536
_WINDOW = 64  # arrivals that rate and jitter are taken from

# s: what the kernel asks a silent peer, so that one that is gone is noticed without a byte of ours.
_KEEPALIVE = {"TCP_KEEPIDLE": 1, "TCP_KEEPINTVL": 1, "TCP_KEEPCNT": 3}
_UNACKNOWLEDGED_MS = 2000


class Address(NamedTuple):
    """Where a server listens."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class Rhythm:
    """How regularly something arrives, from its latest arrivals."""

    def __init__(self) -> None:
        self._times: deque[float] = deque(maxlen=_WINDOW)

    def beat(self, time: float) -> None:
        """It arrived at ``time``, s."""
        self._times.append(time)

    def clear(self) -> None:
        """What comes next is another series."""
        self._times.clear()

    @property
    def period(self) -> float | None:
        """Mean of the intervals, s; None before there are three."""
        times = tuple(self._times)
        return (times[-1] - times[0]) / (len(times) - 1) if len(times) > 3 else None

    @property
    def jitter(self) -> float | None:
        """Standard deviation of the intervals, s; None before there are three."""
        times = tuple(self._times)
        return float(np.std(np.diff(times))) if len(times) > 3 else None


@dataclass
class Statistics:
    """What went over a connection: bytes, and messages as its user counts them."""

    bytes_in: int = 0
    bytes_out: int = 0
    messages_in: int = 0
    messages_out: int = 0


class Connection:
    """A connection of one arm, or of arms that share a port. Any thread may send or close; one at a time receives."""

    def __init__(self, arm: str, address: Address, clock: Clock) -> None:
        self.address = address
        self.statistics = Statistics()
        self._arm = arm
        self._clock = clock
        self._sending, self._receiving = threading.Lock(), threading.Lock()
        self._closed = False
        self._socket: socket.socket | None = None

    def connect(self, deadline: float) -> None:
        """Reach the server; LinkLost if it cannot be reached by ``deadline``."""
        with self._receiving:
            try:
                made = self._reach(deadline)
                made.setblocking(False)
                made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                _watch(made)
            except (OSError, UnicodeError) as error:  # the latter for what is no host's name
                self._release()
                why = "no answer" if isinstance(error, TimeoutError) else getattr(error, "strerror", None) or str(error)
                raise self._lost("connect", "the connection is closed" if self._closed else why) from error
            if self._closed:  # while it was being made
                self._release()

    def _reach(self, deadline: float) -> socket.socket:
        error: OSError = TimeoutError()
        for family, kind, protocol, _, where in socket.getaddrinfo(*self.address, type=socket.SOCK_STREAM):
            left = deadline - self._clock.now()
            if self._closed or left <= 0:
                break
            self._socket = made = socket.socket(family, kind, protocol)
            made.settimeout(left)
            try:
                made.connect(where)
                return made
            except OSError as failed:
                made.close()
                error = failed
        raise error

    def send(self, message: bytes, deadline: float) -> None:
        """Put a whole message on the wire, in one piece; LinkLost."""
        with self._sending:
            connected = self._connected("send")
            try:
                sent = 0
                while sent < len(message):
                    # A message goes in one call but where the peer has not read for long.
                    with suppress(BlockingIOError):
                        sent += connected.send(message[sent:])
                    if sent < len(message) and not self._wait(select.POLLOUT, deadline):
                        raise self._lost("send", "the controller does not read what it is sent")
            except LinkLost:
                raise
            except OSError as error:
                raise self._gone("send", error) from error
        self.statistics.bytes_out += len(message)
        self.statistics.messages_out += 1

    def receive(self, deadline: float) -> bytes:
        """What has come, at least a byte; nothing if nothing has come by ``deadline``. LinkLost."""
        with self._receiving:
            connected = self._connected("receive")
            try:
                while self._wait(select.POLLIN, deadline):
                    with suppress(BlockingIOError):
                        data = connected.recv(_CHUNK)
                        if not data:
                            raise self._lost("receive", "the controller closed the connection")
                        self.statistics.bytes_in += len(data)
                        return data
            except LinkLost:
                raise
            except OSError as error:
                raise self._gone("receive", error) from error
        return b""

    def close(self) -> None:
        """Release it; a thread that waits on it gets LinkLost at once. Any number of times."""
        self._closed = True
        if self._socket is None:
            return
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        # Only once nobody waits on its number any more, which another socket may be given.
        with self._sending, self._receiving:
            self._release()

    def _release(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _wait(self, event: int, deadline: float) -> bool:
        assert self._socket is not None
        waiting = select.poll()
        waiting.register(self._socket, event)
        return bool(waiting.poll(max(0.0, deadline - self._clock.now()) * 1000))

    def _connected(self, attempted: str) -> socket.socket:
        if self._socket is None or self._closed:
            raise self._lost(attempted, "the connection is closed")
        return self._socket

    def _gone(self, attempted: str, error: OSError) -> LinkLost:
        return self._lost(attempted, "the connection is closed" if self._closed else error.strerror or str(error))

    def _lost(self, attempted: str, why: str) -> LinkLost:
        return LinkLost(
            self._arm, attempted, f"{self.address}: {why}", "check cable, address and that the server program runs"
        )


def _watch(made: socket.socket) -> None:
    """Have the kernel notice a peer that is gone."""
    made.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (*_KEEPALIVE.items(), ("TCP_USER_TIMEOUT", _UNACKNOWLEDGED_MS)):
        if hasattr(socket, name):  # not every system has all of them
            made.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
