"""Frames to whoever may listen, over ZeroMQ."""

from __future__ import annotations

import os
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import zmq
from zmq.auth.thread import ThreadAuthenticator

from backends.cameras.curve import ServerKeys, host_of, is_loopback, secret_key
from backends.cameras.whose_clock import own_clock
from backends.cameras.wire import MOST_MARKS, Header, encode, is_mark
from dualcal_hal.camera import Image
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import UsageError

MOST_WAITING = 2
"""Frames that wait for a listener that is slow; further ones are dropped."""

HEARTBEAT_MS, SILENCE_MS = 500, 2000
"""How often either end is asked for a sign of life, and how long it may keep silent, ms."""

_LARGEST_REQUEST = 1 << 11  # bytes; a handshake with keys takes some 500
_MOST_REQUESTS = 256  # between two frames


class FramePublisher:
    """Publishes one camera's frames; a context manager. It and what it returns belong to one thread.

    endpoint: ``tcp://HOST:PORT``, port 0 for any that is free; camera: the name that listeners check; keys: needed
    where others than this machine's may connect. Times are those of a RealClock.
    """

    def __init__(self, endpoint: str, camera: str, keys: ServerKeys | None = None) -> None:
        """UsageError if it may not be served there, or cannot."""
        if keys is None and not is_loopback(endpoint):
            raise UsageError(
                f"{endpoint}: others than this machine's could listen there: name the server's key and a folder with "
                "the keys of those who may, or serve on 127.0.0.1"
            )
        self._camera = camera
        self._clock = RealClock()
        self._publisher = os.urandom(8)
        self._topics: set[bytes] = set()
        self._marks: dict[bytes, float] = {}
        with ExitStack() as opening:
            context = zmq.Context()
            opening.callback(context.term)
            if keys is not None:
                opening.callback(_only_for(keys, context).stop)
            self._socket = opening.enter_context(context.socket(zmq.XPUB))
            _set_up(self._socket, endpoint, keys)
            try:
                self._socket.bind(endpoint)
            except zmq.ZMQError as error:
                raise UsageError(f"{endpoint}: cannot be served: {error}") from error
            self.endpoint: str = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
            self._opened = opening.pop_all()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Any number of times."""
        self._opened.close()

    @property
    def subscribed(self) -> bool:
        """Whether anybody listens."""
        self._hear()
        return bool(self._topics)

    def publish(self, image: Image, exposed_at: float, sequence: int, exposure: float | None = None) -> None:
        """Send one grey image (height, width) to all who listen, never waiting for them.

        exposed_at: seconds of the real clock at the start of the exposure, or not later; exposure: s. Raises
        ValueError for what is no grey image.
        """
        self._hear()
        height, width = image.shape
        clock = own_clock()
        header = Header(
            camera=self._camera,
            publisher=self._publisher,
            sequence=sequence,
            exposed_at=exposed_at,
            exposure=exposure,
            host=clock.host,
            boot=clock.boot,
            width=width,
            height=height,
            marks=list(self._marks.items()),
        )
        self._socket.send_multipart(encode(header, image))  # copied: not to is a thread more, for the process's life

    def _hear(self) -> None:
        """Take what listeners have asked for meanwhile; as much as may be, or one could keep all others waiting."""
        for _ in range(_MOST_REQUESTS):
            try:
                request = self._socket.recv(zmq.NOBLOCK)
            except zmq.Again:
                return
            asked, topic = request[:1] == b"\x01", request[1:]
            if is_mark(topic):
                self._note(topic, asked)
            elif asked:
                self._topics.add(topic)
            else:
                self._topics.discard(topic)

    def _note(self, mark: bytes, asked: bool) -> None:
        self._marks.pop(mark, None)
        if asked:
            self._marks[mark] = self._clock.now()
            while len(self._marks) > MOST_MARKS:
                del self._marks[next(iter(self._marks))]


def _set_up(socket: zmq.Socket[bytes], endpoint: str, keys: ServerKeys | None) -> None:
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDHWM, MOST_WAITING)
    socket.setsockopt(zmq.MAXMSGSIZE, _LARGEST_REQUEST)
    socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, SILENCE_MS)
    if ":" in host_of(endpoint):
        socket.setsockopt(zmq.IPV6, 1)
    if keys is not None:
        socket.curve_publickey, socket.curve_secretkey = secret_key(keys.secret)
        socket.curve_server = True


def _only_for(keys: ServerKeys, context: zmq.Context[zmq.Socket[bytes]]) -> ThreadAuthenticator:
    """Without it CURVE would let in whoever has a key, whichever that is."""
    secret_key(keys.secret)  # refused now, before a thread is begun
    if not any(keys.clients.glob("*.key")):
        raise UsageError(f"{keys.clients}: holds no public key (*.key), so nobody could listen")
    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    try:
        authenticator.configure_curve(domain="*", location=keys.clients)
    except (OSError, ValueError) as error:
        authenticator.stop()
        raise UsageError(f"{keys.clients}: its keys cannot be read: {error}") from error
    return authenticator
