"""A controller's motion port: one request at a time, each with its reply, and a stop that waits for nobody long."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import NoReturn

from backends.controller.tcp.codec import Code, CodecError, FrameSplitter, Message, Wire, decode, encode
from backends.controller.tcp.dialects import Dialect, ping
from backends.controller.tcp.port import Port, named
from backends.controller.tcp.transport import Address, Connection
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost, MotionFailed

PING_EVERY = 1.0
"""Seconds without traffic after which a server that takes a PING is asked whether it is there."""

_STOP_WAITS = 0.02  # s for the reply to what was sent before: not all controllers take two messages at once
_SEND_WITHIN = 0.1  # s
_LATE = 0.5  # s after its time that a reply may still come; then nobody knows which reply is whose
_LOOK_EVERY = 0.25  # s


class Request:
    """A message that is answered. ``reply`` or ``error`` once ``ended`` is set."""

    def __init__(self, arm: str, message: Message, packet: bytes, deadline: float) -> None:
        self.arm = arm
        self.message = message
        self.packet = packet
        self.deadline = deadline
        self.sent, self.ended = threading.Event(), threading.Event()
        self.reply: Message | None = None
        self.error: DeviceError | None = None

    def end(self, outcome: Message | DeviceError) -> None:
        """What became of it; what comes after the first end changes nothing."""
        if self.ended.is_set():
            return
        if isinstance(outcome, DeviceError):
            self.error = outcome
        else:
            self.reply = outcome
        self.ended.set()


class MotionPort(Port):
    """Sends nothing but motion messages, and a PING where the dialect has one.

    wire: how the server writes, None while its state is not known: then it is not connected anew.
    """

    def __init__(
        self, arm: str, address: Address, dialect: Dialect, wire: Callable[[], Wire | None], clock: Clock
    ) -> None:
        super().__init__(arm, address, clock)
        self.unasked = 0
        """Messages that answered nothing."""
        self._dialect = dialect
        self._wire = wire
        self._written: Wire | None = None
        self._waiting: deque[Request] = deque()
        self._sent: deque[Request] = deque()
        self._traffic = 0.0
        self._listeners: tuple[Callable[[DeviceError], None], ...] = ()

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        """Tell ``function`` each time the connection breaks, or what was taken is refused afterwards, on the port's
        thread; returns what ends that."""
        with self._lock:
            self._listeners = (*self._listeners, function)

        def remove() -> None:
            with self._lock:
                self._listeners = tuple(other for other in self._listeners if other is not function)

        return remove

    def close(self) -> None:
        super().close()
        self._fail_all(self._not_connected("move"))

    def packet(self, arm: str, message: Message) -> bytes:
        """The bytes of a message; CommandRefused if it cannot be any, LinkLost before there was a connection."""
        if self._written is None:
            raise self._not_connected("move")
        try:
            return encode(message, self._written)
        except CodecError as error:
            raise CommandRefused(arm, "move", str(error), "check the path and the joint map") from error

    def request(self, arm: str, message: Message, packet: bytes, within: float) -> Request:
        """Send it as soon as nothing else waits for its reply, which is to come within so many seconds; LinkLost."""
        request = Request(arm, message, packet, self._clock.now() + within)
        with self._lock:
            self._connected("move")
            self._waiting.append(request)
            self._advance()
        return request

    def reply(self, request: Request) -> Message:
        """Wait for the reply; DeviceTimeout, LinkLost, or the error that it was cancelled with."""
        if not self._clock.wait(request.ended, request.deadline):
            self.cancel(
                request,
                DeviceTimeout(
                    request.arm,
                    "move",
                    f"{self.address} sent no reply in time",
                    "check the controller's motion program",
                ),
            )
        if request.error is not None:
            raise request.error
        assert request.reply is not None
        return request.reply

    def cancel(self, request: Request, error: DeviceError) -> None:
        """Do not send it if it was not sent, and await no reply."""
        with self._lock:
            if request in self._waiting:
                self._waiting.remove(request)
            request.end(error)

    def stop(self, arm: str, message: Message) -> None:
        """Put a stop on the wire before all else: after a reply that is awaited, if that comes soon; LinkLost."""
        packet = self.packet(arm, message)
        now = self._clock.now()
        request = Request(arm, message, packet, now + self._dialect.acknowledges_within)
        with self._lock:
            self._connected("stop")
            if any(now >= before.deadline for before in self._sent):
                # A reply is missing already: if it stays so, the connection is soon made anew.
                request.deadline = now
            self._waiting.appendleft(request)
            self._advance()
        # The thread that reads replies must not wait for one.
        if threading.current_thread() is not self._thread:
            self._clock.wait(request.sent, self._clock.now() + _STOP_WAITS)
        with self._lock:
            if request in self._waiting:
                self._waiting.remove(request)
                self._put(request)
        if request.error is not None:
            raise request.error

    # -- on the port's thread -----------------------------------------------------------------------------------

    def _prepare(self) -> None:
        # As the server writes now: it may be another than the one before.
        self._written = self._wire() or self._written

    def _may_connect(self) -> bool:
        return self._wire() is not None

    def _lost(self, error: DeviceError) -> None:
        self._fail_all(error)
        self._tell(error)

    def _tell(self, error: DeviceError) -> None:
        for function in self._listeners:
            function(error)

    def _serve(self, connection: Connection) -> NoReturn:
        wire = self._written
        if wire is None:
            raise self._not_connected("read")
        splitter = FrameSplitter(wire.byte_order)
        self._traffic = self._clock.now()
        while True:
            data = connection.receive(self._clock.now() + _LOOK_EVERY)
            try:
                for frame in splitter.feed(data):
                    connection.statistics.messages_in += 1
                    error = self._take(decode(frame, wire))
                    if error is not None:
                        self._tell(error)
            except CodecError as damage:
                why = f"{self.address} sent what is no message: {damage}"
                raise LinkLost(self._arm, "read", why, "check port and network") from damage
            self._look(self._clock.now())

    def _take(self, message: Message) -> DeviceError | None:
        """Find the request that it answers; the error that it is where it answers none."""
        with self._lock:
            self._traffic = self._clock.now()
            for place, request in enumerate(self._sent):
                if not self._dialect.answers(message, request.message):
                    continue
                for _ in range(place):  # replies come in order: theirs come no more
                    why = f"{self.address} left its reply out"
                    self._sent.popleft().end(DeviceTimeout(request.arm, "move", why, "check the controller"))
                self._sent.popleft().end(message)
                self._advance()
                return None
            self.unasked += 1
        if message.code != Code.FAILURE:
            return None
        why = f"{self.address} refused what it had taken"
        return MotionFailed(self._arm, "move", why, "see the controller's messages: a point may be out of reach")

    def _look(self, now: float) -> None:
        with self._lock:
            if self._sent and now >= min(request.deadline for request in self._sent) + _LATE:
                why = f"{self.address} does not answer"
                raise LinkLost(self._arm, "read", why, "check the controller's motion program and the network")
            if self._dialect.pings and not self._sent and now >= self._traffic + PING_EVERY:
                message = ping()
                within = self._dialect.acknowledges_within
                self._put(Request(self._arm, message, self.packet(self._arm, message), now + within))

    # -- with the lock held -------------------------------------------------------------------------------------

    def _advance(self) -> None:
        if self._waiting and not self._sent:
            self._put(self._waiting.popleft())

    def _put(self, request: Request) -> None:
        now = self._clock.now()
        connection = self._connection
        try:
            if connection is None:
                raise self._not_connected("send")
            connection.send(request.packet, now + _SEND_WITHIN)
        except LinkLost as error:
            request.end(error)
            if connection is not None:
                connection.close()
            return
        self._traffic = now
        self._sent.append(request)
        request.sent.set()

    def _connected(self, attempted: str) -> None:
        if self.connected_at is None:
            raise self._not_connected(attempted)

    def _fail_all(self, error: DeviceError) -> None:
        with self._lock:
            for request in (*self._sent, *self._waiting):
                request.end(named(error, request.arm))
            self._sent.clear()
            self._waiting.clear()

    def _not_connected(self, attempted: str) -> LinkLost:
        return LinkLost(
            self._arm, attempted, f"{self.address} is not connected", "check cable, address and the server program"
        )
