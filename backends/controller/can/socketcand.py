"""A CAN bus in a network, as socketcand serves it by TCP.

python-can has a client, too, and its ``tcp_tune`` is what is done here. But it waits for a greeting for ever, does not
notice that the connection was closed, takes a frame that comes together with a reply for a wrong reply, and sends each
frame by a call of its own: with a busy interpreter, that alone makes a cycle late.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from typing import NamedTuple

_LONGEST = 4096  # bytes of a message; a frame has 70 at most
_SEND = 0.2  # s within which the connection must take what is sent


class Frame(NamedTuple):
    """What arrives: a data frame with an 11-bit identifier, or with ``is_error`` what tells of an error."""

    identifier: int
    data: bytes
    is_error: bool = False


def address_of(channel: str) -> tuple[str, int, str]:
    """Host, port and bus of ``HOST:PORT/BUS``; ValueError if it is none."""
    place, slash, bus = channel.partition("/")
    host, colon, port = place.rpartition(":")
    if not (slash and colon and host and bus and port.isdecimal() and 0 < int(port) < 65536):
        raise ValueError(f"must be HOST:PORT/BUS, as 192.168.0.5:29536/can0, not {channel}")
    return host.removeprefix("[").removesuffix("]"), int(port), bus


class SocketcandWire:
    """One connection in raw mode. One thread receives, one at a time sends; OSError for all that goes wrong."""

    def __init__(self, channel: str, timeout: float) -> None:
        """Connect within about ``timeout`` s. ValueError for a channel that is none."""
        host, port, bus = address_of(channel)
        self._received = b""
        self._waits: float | None = None
        self._socket = socket.create_connection((host, port), timeout=timeout)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._expect(b"hi")
            for command in (f"open {bus}", "rawmode"):
                self._socket.sendall(f"< {command} >".encode("ascii"))
                self._expect(b"ok")
            self._socket.settimeout(None)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _timeval(_SEND))
        except BaseException:
            self._socket.close()
            raise

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """All in one piece."""
        self._socket.sendall(b"".join(map(_send_command, frames)))

    def receive(self, timeout: float) -> list[Frame]:
        """What has arrived, after waiting for it for up to ``timeout`` s. ConnectionError once it was closed."""
        if b">" not in self._received:
            self._wait_at_most(timeout)
            try:
                self._read()
            except BlockingIOError:  # nothing has arrived
                return []
        *messages, self._received = self._received.split(b">")
        return [frame for message in messages if (frame := _frame(message)) is not None]

    def close(self) -> None:
        self._socket.close()

    def _wait_at_most(self, timeout: float) -> None:
        # By the kernel: to wait and to read by two calls is to wait for a busy interpreter twice.
        if timeout != self._waits:
            self._waits = timeout
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _timeval(timeout))

    def _read(self) -> None:
        received = self._socket.recv(65536)
        if not received:
            raise ConnectionResetError("socketcand has closed the connection")
        self._acknowledge_soon()
        self._received += received
        if len(self._received) - self._received.rfind(b">") > _LONGEST:
            raise ConnectionError("what comes from there is not socketcand's")

    def _acknowledge_soon(self) -> None:
        # Else the other side may wait 40 ms for an acknowledgement before it sends more.
        if (quick := getattr(socket, "TCP_QUICKACK", None)) is not None:
            self._socket.setsockopt(socket.IPPROTO_TCP, quick, 1)

    def _expect(self, word: bytes) -> None:
        """The reply to a command; frames of a busy bus may follow it at once."""
        while b">" not in self._received:
            self._read()
        message, _, self._received = self._received.partition(b">")
        if message.split() != [b"<", word]:
            said = message.decode("ascii", "replace").strip("< ")
            raise ConnectionRefusedError(f"socketcand says '{said}', not '{word.decode()}'")


def _send_command(frame: tuple[int, bytes]) -> bytes:
    identifier, data = frame
    octets = b" " + data.hex(" ").encode() if data else b""
    return b"< send %03X %X%b >" % (identifier, len(data), octets)


def _frame(message: bytes) -> Frame | None:
    """None for what is no data frame with an 11-bit identifier, nor tells of an error."""
    words = message.split()
    if words[:2] == [b"<", b"error"]:
        return Frame(0, b"", is_error=True)
    if len(words) < 4 or words[:2] != [b"<", b"frame"] or len(words[2]) > 3:
        return None
    try:
        return Frame(int(words[2], 16), bytes.fromhex(b"".join(words[4:]).decode("ascii")))
    except ValueError:
        return None


def _timeval(seconds: float) -> bytes:
    return struct.pack("ll", int(seconds), int(1e6 * (seconds % 1)))
