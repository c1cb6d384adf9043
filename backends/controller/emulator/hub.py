"""CAN buses where there is no CAN hardware: served as socketcand serves them, by TCP and on this machine alone.

One thread does all there is to do on the buses: it hears the clients, runs those who are attached in this process, and
sends what they say; so they need no locks, and no frame waits for another thread.
"""

from __future__ import annotations

import contextlib
import queue
import selectors
import socket
import threading
from collections.abc import Callable, Iterable

from backends.controller.promptness import prompt_interpreter, prompt_thread
from dualcal_hal.clock import Clock

TICK = 0.005
"""Seconds between calls of those who do something at times of their own."""

_PAUSE = 0.05
"""Seconds within a turn that are no work but a machine which did something else."""

_SHORTEST_SILENCE = 0.05
"""Seconds that a client which has sent nothing hears nothing: python-can takes a frame that comes together with the
reply to its last command for a wrong reply."""

_LONGEST_COMMAND = 1024  # bytes
_MOST_UNREAD = 1 << 18  # bytes that a client may leave unread before it is put out

Hears = Callable[[int, bytes], None]
"""What takes a frame: its identifier (11 bits) and its data."""


class _Client:
    """One TCP connection."""

    def __init__(self, connection: socket.socket) -> None:
        self.socket = connection
        self.bus: Bus | None = None
        self.received = b""
        self.unsent = bytearray(b"< hi >")
        self.hears_from: float | None = None  # None before it asked for frames
        self.gone = False

    def receive(self) -> bytes:
        """What has come since, empty if nothing; then it may be ``gone``."""
        try:
            received = self.socket.recv(65536)
        except BlockingIOError:
            return b""
        except OSError:
            received = b""
        self.gone = self.gone or not received
        return received

    def flush(self) -> None:
        try:
            del self.unsent[: self.socket.send(self.unsent)]
        except BlockingIOError:
            self.gone = self.gone or len(self.unsent) > _MOST_UNREAD
        except OSError:
            self.gone = True


class Bus:
    """One CAN bus: what one on it sends is heard by all others on it. Used on the hub's thread only."""

    def __init__(self, name: str, clock: Clock) -> None:
        self.name = name
        self._clock = clock
        self._clients: list[_Client] = []
        self._hears: list[Hears] = []
        self._lost = False

    def attach(self, hears: Hears) -> None:
        """Have ``hears`` called with each frame that comes from a client."""
        self._hears.append(hears)

    def send(self, can_id: int, data: bytes) -> None:
        """Send a frame to all clients; it leaves when the hub has done what it is about."""
        if self._clients:
            self._tell(b"%03X" % can_id, data, None)

    def lose(self) -> None:
        """Be gone: all clients are put out, and none can open it."""
        self._lost = True
        for client in self._clients:
            client.gone = True

    def mend(self) -> None:
        """Be there again."""
        self._lost = False

    def enter(self, client: _Client) -> bool:
        """Let a client on, unless the bus is lost."""
        if not self._lost:
            self._clients.append(client)
        return not self._lost

    def leave(self, client: _Client) -> None:
        self._clients.remove(client)

    def sent_by(self, client: _Client, can_id: int, extended: bool, data: bytes) -> None:
        """A client sends a frame. Those attached know no extended identifiers."""
        if client.gone:
            return
        if len(self._clients) > 1:
            self._tell((b"%08X" if extended else b"%03X") % can_id, data, client)
        if not extended:
            for hears in self._hears:
                hears(can_id, data)

    def _tell(self, identifier: bytes, data: bytes, sender: _Client | None) -> None:
        now = self._clock.now()
        line = b"< frame %b %.6f %b >" % (identifier, now, data.hex().upper().encode())
        for client in self._clients:
            if client is not sender and client.hears_from is not None and now >= client.hears_from:
                client.unsent += line


class Hub:
    """Serves buses on 127.0.0.1 to clients that speak socketcand's raw mode, as many as like."""

    def __init__(self, clock: Clock, names: Iterable[str], port: int = 0) -> None:
        """``names`` of the buses; ``port`` 0 takes a free one, see :attr:`port`. Serves from :meth:`start` on."""
        self.buses = {name: Bus(name, clock) for name in names}
        self._clock = clock
        self._clients: list[_Client] = []
        self._ticks: list[Callable[[float], None]] = []
        self._calls: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closing = False
        self._paused = False
        self._listener = socket.create_server(("127.0.0.1", port))
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="can hub", daemon=True)

    def on_tick(self, function: Callable[[float], None]) -> None:
        """Call ``function`` with the time every :data:`TICK`, on the hub's thread. To be asked for before the start."""
        self._ticks.append(function)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def soon(self, function: Callable[[], None]) -> None:
        """Have ``function`` called on the hub's thread, unless it is closed; from any thread."""
        self._calls.put(function)
        with contextlib.suppress(OSError):
            self._waker.send(b"\0")

    def close(self) -> None:
        """Put all clients out and end; any number of times."""
        if not self._closing:
            self._closing = True
            self._waker.send(b"\0")
            if self._thread.ident is not None:
                self._thread.join()
            for what in (self._selector, self._listener, self._waker, self._woken):
                what.close()

    def _run(self) -> None:
        try:
            next_tick = self._clock.now()
            with prompt_interpreter(), prompt_thread():
                while not self._closing:
                    next_tick = self._turn(next_tick)
        finally:
            # Whatever ends it, nobody is left to wait for frames that do not come.
            for client in self._clients:
                client.socket.close()

    def _turn(self, next_tick: float) -> float:
        """Do what has come, or wait for it until the next tick; returns when that is."""
        ready = self._selector.select(max(0.0, next_tick - self._clock.now()))
        begin = self._clock.now()
        # First of all: what was asked for before a frame was sent is done before it is heard.
        while not self._calls.empty():
            self._calls.get()()
        for key, _ in ready:
            if key.data is not None:
                self._hear(key.data)
            elif key.fileobj is self._listener:
                self._welcome()
            else:
                self._woken.recv(4096)
        # After a pause of its own what has come meanwhile is heard first, else those who look for it would miss it; but
        # not time and again, where so much comes.
        now = self._clock.now()
        self._paused = now - begin >= _PAUSE and not self._paused
        if now >= next_tick and not self._paused:
            next_tick = max(next_tick + TICK, now)
            for tick in self._ticks:
                tick(now)
        self._flush()
        return next_tick

    def _flush(self) -> None:
        for client in self._clients:
            if client.unsent and not client.gone:
                client.flush()
        if any(client.gone for client in self._clients):
            for client in [client for client in self._clients if client.gone]:
                self._put_out(client)

    def _welcome(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:  # it has gone again
            return
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MOST_UNREAD)
        client = _Client(connection)
        self._clients.append(client)
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _put_out(self, client: _Client) -> None:
        self._selector.unregister(client.socket)
        client.socket.close()
        self._clients.remove(client)
        if client.bus is not None:
            client.bus.leave(client)

    def _hear(self, client: _Client) -> None:
        *commands, client.received = (client.received + client.receive()).split(b">")
        for command in commands:
            words = command.split()
            if client.hears_from is not None and words[:2] == [b"<", b"send"]:
                self._send(client, words[2:])
            else:
                self._obey(client, words)
        if len(client.received) > _LONGEST_COMMAND:
            client.gone = True

    def _send(self, client: _Client, words: list[bytes]) -> None:
        client.hears_from = 0.0  # it has read all replies, else it would not send
        try:
            identifier, length, *octets = words
            data = bytes([int(octet, 16) for octet in octets])
            number = int(identifier, 16)
            right = len(data) == int(length, 16) <= 8 and number < (1 << 11 if len(identifier) == 3 else 1 << 29)
        except ValueError:
            right = False
        if client.bus is None or not right or len(identifier) not in (3, 8):
            client.unsent += b"< error syntax error >"
        else:
            client.bus.sent_by(client, number, len(identifier) == 8, data)

    def _obey(self, client: _Client, words: list[bytes]) -> None:
        match words:
            case [b"<", b"open", name] if client.bus is None:
                bus = self.buses.get(name.decode("ascii", "replace"))
                if bus is None or not bus.enter(client):
                    client.unsent += b"< error could not open bus >"
                    return
                client.bus = bus
            case [b"<", b"rawmode"] if client.bus is not None:
                client.hears_from = self._clock.now() + _SHORTEST_SILENCE
            case [b"<", b"echo"]:
                client.unsent += b"< echo >"
                return
            case _:
                client.unsent += b"< error unknown command >"
                return
        client.unsent += b"< ok >"
