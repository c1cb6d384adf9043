"""A relay between a client and whatever server there is at the moment, that keeps what the client sends."""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading


class Relay:
    """Listens on a port of its own. ``target``: the server's (host, port), None while there is none.

    sent: what each connection's client has sent, in the order in which they were made.
    """

    def __init__(self) -> None:
        self.target: tuple[str, int] | None = None
        self.sent: list[bytearray] = []
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._waker, self._woken = socket.socketpair()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listening, selectors.EVENT_READ)
        self._selector.register(self._woken, selectors.EVENT_READ)
        self._lock = threading.Lock()
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    @property
    def port(self) -> int:
        return int(self._listening.getsockname()[1])

    def close(self) -> None:
        self._waker.send(b"\0")
        self._thread.join()
        for pair in self._pairs:
            for end in pair:
                end.close()
        self._selector.close()
        for end in (self._listening, self._waker, self._woken):
            end.close()

    def _run(self) -> None:
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is self._woken:
                    return
                if key.fileobj is self._listening:
                    self._welcome()
                elif key.data[0].fileno() >= 0:  # its pair has not been ended meanwhile
                    self._pass_on(*key.data)

    def _welcome(self) -> None:
        client, _ = self._listening.accept()
        try:
            if self.target is None:
                raise ConnectionRefusedError("there is no server")
            server = socket.create_connection(self.target)
        except OSError:
            client.close()
            return
        for end in (client, server):
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.sent.append(sent := bytearray())
        self._pairs.append((client, server))
        self._selector.register(client, selectors.EVENT_READ, (client, server, sent))
        self._selector.register(server, selectors.EVENT_READ, (server, client, None))

    def _pass_on(self, source: socket.socket, drain: socket.socket, sent: bytearray | None) -> None:
        try:
            data = source.recv(65536)
            if sent is not None:
                sent += data
            if data:
                drain.sendall(data)
                return
        except OSError:
            pass
        # One end is gone, and so is the other.
        for end in (source, drain):
            with contextlib.suppress(KeyError):
                self._selector.unregister(end)
            end.close()
        self._pairs = [pair for pair in self._pairs if source not in pair]
