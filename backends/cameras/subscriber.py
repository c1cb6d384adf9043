"""Frames from a FramePublisher."""

from __future__ import annotations

import math
from collections import deque
from contextlib import ExitStack
from statistics import median

import zmq
from zmq.utils.monitor import parse_monitor_message

from backends.cameras.curve import ClientKeys, host_of, public_key, secret_key
from backends.cameras.freshness import SenderClock
from backends.cameras.publisher import HEARTBEAT_MS, MOST_WAITING, SILENCE_MS
from backends.cameras.stream import TICK, Stream
from backends.cameras.whose_clock import own_clock
from backends.cameras.wire import LARGEST_AREA, Header, Malformed, decode, new_mark
from dualcal_hal.camera import Image
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceTimeout, FrameRefused, LinkLost
from dualcal_hal.findings import Finding

PATIENCE = 2.0
"""s within which somebody must serve at the endpoint."""
_ENCRYPTION = 64  # bytes that it adds to a part
MOST_PARTS = 3
"""One more than a frame has: enough to see that it is none."""
MARK_EVERY = 1.0
"""s from one mark to the next, where the sender's clock is another."""

_LOST = {
    zmq.EVENT_DISCONNECTED: "the connection was lost",
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL: "the other side refused the connection: its key is another",
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL: "the other side does not speak this protocol, or not with keys as set here",
    zmq.EVENT_HANDSHAKE_FAILED_AUTH: "the other side does not let this key in",
}
_EVENTS = zmq.EVENT_HANDSHAKE_SUCCEEDED | sum(_LOST)
_ADVICE = "check that dualcal serve-camera runs there, and network and keys"


class Subscriber(Stream):
    """Listens to ``endpoint`` and takes frames of the camera of that name, and of no other."""

    def __init__(self, name: str, clock: Clock, endpoint: str, camera: str, keys: ClientKeys | None) -> None:
        """UsageError for keys that cannot be read; waits for nothing."""
        super().__init__(name, clock)
        self._endpoint, self._expected = endpoint, camera
        self._connected = False
        self._why_not = "nobody serves there"
        self._sender = _Sender(b"", 0)
        self._taken = -1
        self._lost = 0
        self._mark: tuple[bytes, float] | None = None
        self._next_mark = -math.inf
        with ExitStack() as opening:
            context = zmq.Context()
            opening.callback(context.term)
            self._socket = opening.enter_context(context.socket(zmq.SUB))
            _set_up(self._socket, endpoint, keys)
            self._monitor = opening.enter_context(self._socket.get_monitor_socket(_EVENTS))
            opening.callback(self._socket.disable_monitor)
            self._socket.connect(endpoint)
            self._opened = opening.pop_all()
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._monitor, zmq.POLLIN)

    @property
    def proof(self) -> str:
        return "the sender's time stamps"

    def await_first(self, timeout: float) -> None:
        """Wait for a frame.

        Raises LinkLost if nobody serves there, DeviceTimeout if no frame comes, FrameRefused if it is another camera's.
        """
        deadline = self.clock.now() + timeout
        try:
            self.take(-math.inf, min(deadline, self.clock.now() + PATIENCE))
        except DeviceTimeout as error:
            if not self._connected:
                raise LinkLost(self.name, f"connect to {self._endpoint}", self._why_not, _ADVICE) from error
            self.take(-math.inf, deadline)

    def close(self) -> None:
        super().close()
        self._opened.close()

    def receive(self) -> None:
        ready = dict(self._poller.poll(round(TICK * 1e3)))
        if self._monitor in ready:
            self._hear_of_link()
        if self._socket in ready:
            now = self.clock.now()
            try:
                header, image = decode(self._parts())
                self._arrived(header, image, now)
            except Malformed as error:
                self.refuse(FrameRefused(self.name, "grab", f"what came is no frame: {error}", _ADVICE))

    def _parts(self) -> list[memoryview]:
        """Of one message; those too many are not kept."""
        parts = [self._socket.recv(copy=False).buffer]
        while self._socket.getsockopt(zmq.RCVMORE):
            part = self._socket.recv(copy=False)
            if len(parts) < MOST_PARTS:
                parts.append(part.buffer)
        return parts

    def _hear_of_link(self) -> None:
        event = parse_monitor_message(self._monitor.recv_multipart())["event"]
        self._connected = event == zmq.EVENT_HANDSHAKE_SUCCEEDED
        if self._connected:
            self.set_down(None)
            return
        self._why_not = why = _LOST[zmq.Event(event)]
        self.set_down(lambda: LinkLost(self.name, "grab", f"{self._endpoint}: {why}", _ADVICE))

    def _arrived(self, header: Header, image: Image, now: float) -> None:
        if header.camera != self._expected:
            why = f"this is an image of camera '{header.camera}', not of '{self._expected}'"
            self.refuse(FrameRefused(self.name, "grab", why, f"check what is served at {self._endpoint}"))
            return
        if header.publisher != self._sender.publisher:
            self._sender = _Sender(header.publisher, 0 if header.sequence > self._taken else self._taken + 1)
        sequence = self._sender.first + header.sequence
        if sequence <= self._taken:
            why = f"image {header.sequence} came after image {self._taken - self._sender.first}"
            self.refuse(FrameRefused(self.name, "grab", why, _ADVICE))
            return
        self._lost += self._sender.lost(header)
        self._taken = sequence
        earliest = self._earliest(header, now)
        if earliest > now:
            why = f"it is stamped {earliest - now:.3f} s later than it came"
            self.refuse(FrameRefused(self.name, "grab", why, "check the sender's time stamps"))
            return
        self.offer(earliest, sequence, lambda: image)

    def _earliest(self, header: Header, now: float) -> float:
        """When the exposure can have begun, of the own clock."""
        sender = self._sender
        sender.header = header
        if header.clock.is_comparable_with(own_clock()):
            sender.delays.append(now - header.exposed_at)
            return header.exposed_at
        if self._mark is not None and (heard := header.heard(self._mark[0])) is not None:
            sender.clock.heard(self._mark[1], heard)
            self._socket.unsubscribe(self._mark[0])
            self._mark = None
        if self._mark is None and now >= self._next_mark:
            self._mark = new_mark(), now
            self._next_mark = now + MARK_EVERY
            self._socket.subscribe(self._mark[0])
        return sender.clock.arrived(header.exposed_at, now)

    def findings(self) -> list[Finding]:
        """Besides what every stream has: exposure, whose clock the time stamps are of, how far off, and losses."""
        return [*super().findings(), *self._sender.findings(), *self._loss()]

    def _loss(self) -> list[Finding]:
        if not self._lost:
            return []
        advice = "check the network, or have the camera send fewer frames"
        return [Finding("lost frames", f"{self._lost} did not come since it was opened", "note", advice)]


class _Sender:
    """What is known of one publisher; ``first``: what is added to its numbers, so that they grow after another's."""

    def __init__(self, publisher: bytes, first: int) -> None:
        self.publisher = publisher
        self.first = first
        self.clock = SenderClock()
        self.header: Header | None = None
        self.delays: deque[float] = deque(maxlen=100)

    def lost(self, header: Header) -> int:
        """How many frames were sent between the last one and this."""
        return 0 if self.header is None else header.sequence - self.header.sequence - 1

    def findings(self) -> list[Finding]:
        if self.header is None:
            return []
        exposure = self.header.exposure
        said = "not told by the sender" if exposure is None else f"{exposure * 1e3:.2f} ms"
        return [self._clock_finding(self.header), Finding("exposure", said)]

    def _clock_finding(self, header: Header) -> Finding:
        if self.delays:
            delay = f"{median(self.delays) * 1e3:.1f} ms after the exposure's beginning"
            return Finding("clock", f"time stamps are of this machine's own clock; frames come {delay}")
        low, high = self.clock.behind
        if not math.isfinite(low):
            return Finding("clock", f"time stamps are of {header.host}'s clock, and it has not answered yet", "note")
        off = f"between {low:.3f} and {high:.3f} s behind this one's"
        return Finding("clock", f"time stamps are of {header.host}'s clock, {off}; exposures are proven by its answers")


def _set_up(socket: zmq.Socket[bytes], endpoint: str, keys: ClientKeys | None) -> None:
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.RCVHWM, MOST_WAITING)
    socket.setsockopt(zmq.MAXMSGSIZE, LARGEST_AREA + _ENCRYPTION)
    socket.setsockopt(zmq.RECONNECT_IVL, 100)
    socket.setsockopt(zmq.RECONNECT_IVL_MAX, 2000)
    socket.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
    socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, SILENCE_MS)
    if ":" in host_of(endpoint):
        socket.setsockopt(zmq.IPV6, 1)
    if keys is not None:
        socket.curve_serverkey = public_key(keys.server)
        socket.curve_publickey, socket.curve_secretkey = secret_key(keys.secret)
    socket.subscribe(b"")
