"""Ports that controllers' servers listen at, their connections, and what goes wrong on them."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import Awaitable, Callable
from contextlib import suppress

_APART = 0.03  # s between two pieces of a message
_MOST = 4096  # bytes that are received at once

Serve = Callable[["Connection"], Awaitable[None]]


class Line:
    """What is wrong with one arm's connections now; on the servers' thread only."""

    def __init__(self) -> None:
        self._drops = self._corrupts = 0
        self._prompt: asyncio.Event | None = None  # what replies wait for, if anything
        self.splitting = self.merging = self.stale = False
        self.ports: list[Port] = []
        self._held: dict[Connection, bytes] = {}

    def drop_one(self) -> None:
        """The next reply is not sent."""
        self._drops += 1

    def delay(self) -> None:
        """Replies wait."""
        self._prompt = self._prompt or asyncio.Event()

    def go_on(self) -> None:
        """They wait no more."""
        if self._prompt is not None:
            self._prompt.set()
            self._prompt = None

    def corrupt_one(self) -> None:
        """The next state begins with nonsense."""
        self._corrupts += 1

    def deaden(self) -> None:
        """Nothing is said or heard any more on the connections that there are."""
        for port in self.ports:
            for connection in port.connections:
                connection.dead = True

    def down(self) -> None:
        """The connections break, and nobody can connect."""
        for port in self.ports:
            port.down()

    def up(self) -> None:
        """It can be reached again."""
        for port in self.ports:
            port.up()

    async def reply(self, connection: Connection, data: bytes) -> None:
        """Send a reply, unless that goes wrong."""
        if self._drops:
            self._drops -= 1
            return
        if self._prompt is not None:
            await self._prompt.wait()
        await self._send(connection, data)

    async def state(self, connection: Connection, data: bytes) -> None:
        """Send a state, unless that goes wrong."""
        if self.stale:
            return
        if self._corrupts:
            self._corrupts -= 1
            data = b"\x7f\xee\xdd\xcc" + data[4:]
        if self.merging and connection not in self._held:
            self._held[connection] = data
            return
        await self._send(connection, self._held.pop(connection, b"") + data)

    async def _send(self, connection: Connection, data: bytes) -> None:
        if self.splitting:
            first = len(data) // 3
            await connection.send(data[:first])
            await asyncio.sleep(_APART)
            data = data[first:]
        await connection.send(data)


class Connection:
    """With one client. dead: nothing is said or heard on it any more, though it is there."""

    def __init__(self, client: socket.socket) -> None:
        self._socket = client
        self._loop = asyncio.get_running_loop()
        self.dead = False

    async def receive(self, most: int = _MOST) -> bytes:
        """What is there, in one piece; empty at its end."""
        while True:
            data = await self._loop.sock_recv(self._socket, most)
            if not self.dead or not data:
                return data

    async def receive_exactly(self, count: int) -> bytes:
        """So many bytes; fewer at its end."""
        data = b""
        while len(data) < count:
            piece = await self._loop.sock_recv(self._socket, count - len(data))
            if not piece:
                break
            data += b"" if self.dead else piece
        return data

    def waiting(self) -> bytes:
        """What has come and was not received yet."""
        try:
            return self._socket.recv(_MOST, socket.MSG_PEEK)
        except OSError:
            return b""

    async def send(self, data: bytes) -> None:
        if not self.dead:
            await self._loop.sock_sendall(self._socket, data)

    def breaks(self) -> None:
        """Have its end be an error to the client, if it has not ended yet."""
        with suppress(OSError):
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    def close(self) -> None:
        self._socket.close()


class Port:
    """Listens on this machine alone, and has ``serve`` talk to whoever connects.

    alone: whether a new client takes the place of the one before.
    """

    def __init__(self, host: str, number: int, serve: Serve, alone: bool) -> None:
        """``number`` 0 takes a free one. OSError if it cannot be listened to."""
        self._host = host
        self._serve, self._alone = serve, alone
        self._listening: socket.socket | None = _listen(host, number)
        self.number: int = self._listening.getsockname()[1]
        self._accepting: asyncio.Task[None] | None = None
        self._tasks: dict[asyncio.Task[None], Connection] = {}

    @property
    def connections(self) -> list[Connection]:
        return list(self._tasks.values())

    def up(self) -> None:
        """Accept clients."""
        if self._listening is None:
            self._listening = _listen(self._host, self.number)
        if self._accepting is None:
            self._accepting = asyncio.create_task(self._accept(self._listening))

    def down(self) -> None:
        """Put all clients out, and accept none."""
        if self._accepting is not None:
            self._accepting.cancel()
            self._accepting = None
        if self._listening is not None:
            asyncio.get_running_loop().remove_reader(self._listening)
            self._listening.close()
            self._listening = None
        for task, connection in self._tasks.items():
            connection.breaks()
            task.cancel()

    def give_up(self) -> None:
        """Before :meth:`up`: listen no more."""
        if self._listening is not None:
            self._listening.close()
            self._listening = None

    async def closed(self) -> None:
        """After :meth:`down`: until nobody is served any more."""
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            client, _ = await loop.sock_accept(listening)
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if self._alone:
                for before in self._tasks:
                    before.cancel()
            connection = Connection(client)
            task = asyncio.create_task(self._talk(connection))
            self._tasks[task] = connection
            task.add_done_callback(self._forget)

    async def _talk(self, connection: Connection) -> None:
        try:
            with suppress(OSError):
                await self._serve(connection)
        finally:
            connection.close()

    def _forget(self, task: asyncio.Task[None]) -> None:
        connection = self._tasks.pop(task)
        connection.close()
        if not task.cancelled() and (error := task.exception()) is not None:
            asyncio.get_running_loop().call_exception_handler({"message": "a server failed", "exception": error})


def _listen(host: str, number: int) -> socket.socket:
    listening = socket.create_server((host, number))
    listening.setblocking(False)
    return listening
