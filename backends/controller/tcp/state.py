"""A controller's state port: how its server writes, and what it tells of each arm."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn, Protocol

from backends.controller.tcp.codec import (
    ByteOrder,
    CodecError,
    FrameSplitter,
    Judgement,
    Message,
    Real,
    Wire,
    decode,
    judge,
)
from backends.controller.tcp.port import Port
from backends.controller.tcp.transport import Address, Connection, Rhythm
from dualcal_hal.clock import Clock
from dualcal_hal.errors import DeviceError, DeviceTimeout, LinkLost

LOST_AFTER = 1.0
"""Seconds without feedback after which a link is lost."""
LATE_PERIODS, LATE_AT_LEAST = 3, 0.1
"""Feedback is late once it is older than so many of its periods, and than so many seconds."""


class Freshness:
    """How old an arm's feedback is; ``rhythm`` is that of its arrivals."""

    def __init__(self, arm: str, port: Address, now: float) -> None:
        self.rhythm = Rhythm()
        self._arm = arm
        self._port = port
        self._last = now
        self._late = False

    def arrived(self, time: float) -> None:
        """Feedback came at ``time``, s."""
        if self._late:  # a gap is no period
            self.rhythm.clear()
        self._last, self._late = time, False
        self.rhythm.beat(time)

    @property
    def limit(self) -> float:
        """Seconds after which it is late."""
        period = self.rhythm.period
        return LOST_AFTER if period is None else min(LOST_AFTER, max(LATE_AT_LEAST, LATE_PERIODS * period))

    def due(self) -> float:
        """When to look next, s."""
        return self._last + (LOST_AFTER if self._late else self.limit)

    def look(self, now: float) -> DeviceTimeout | None:
        """That it is late, once each time; LinkLost once it is so late that the link is."""
        age = now - self._last
        if age >= LOST_AFTER:
            why = f"no feedback at {self._port} for {age:.1f} s"
            raise LinkLost(self._arm, "read", why, "check cable and address, and that the server program runs")
        if age < self.limit or self._late:
            return None
        self._late = True
        return DeviceTimeout(
            self._arm, "read", f"feedback is {1000 * age:.0f} ms old", "check the network and the controller's load"
        )


class Listener(Protocol):
    """An arm whose joints a state port tells. All calls come from the port's thread."""

    def connected(self, now: float) -> None:
        """A new connection is read."""

    def message(self, message: Message, time: float) -> None:
        """It came at ``time``, s."""

    def look(self, now: float) -> float:
        """See whether the arm's feedback is late, LinkLost if the link is; returns when to look next, s."""

    def lost(self, error: DeviceError) -> None:
        """The connection broke; another will be made."""


class StatePort(Port):
    """``wire``: how the server writes, by what it has sent; None while that is not known.

    expected: byte order and reals by the cell file, each None where it says nothing.
    """

    def __init__(
        self, arm: str, address: Address, expected: tuple[ByteOrder | None, Real | None], clock: Clock
    ) -> None:
        super().__init__(arm, address, clock)
        self.wire: Wire | None = None
        self._expected = expected
        self._listeners: tuple[Listener, ...] = ()

    def add(self, listener: Listener) -> Callable[[], None]:
        """Tell ``listener`` from here on; returns what ends that."""
        with self._lock:
            self._listeners = (*self._listeners, listener)

        def remove() -> None:
            with self._lock:
                self._listeners = tuple(other for other in self._listeners if other is not listener)

        return remove

    def close(self) -> None:
        super().close()
        self.wire = None

    def _prepare(self) -> None:
        self.wire = None

    def _lost(self, error: DeviceError) -> None:
        self.wire = None
        for listener in self._listeners:
            listener.lost(error)

    def _serve(self, connection: Connection) -> NoReturn:
        for listener in self._listeners:
            listener.connected(self._clock.now())
        try:
            self._read(connection)
        except CodecError as error:
            why = f"{self.address} sent what is no message: {error}"
            raise LinkLost(self._arm, "read", why, "check port, byte order and network") from error

    def _read(self, connection: Connection) -> NoReturn:
        begin = self._clock.now()
        head = b""
        while len(head) < 8:
            data = connection.receive(begin + LOST_AFTER)
            if not data:
                why = f"{self.address} was reached, and sent nothing for {LOST_AFTER:g} s"
                raise LinkLost(self._arm, "read", why, "check that this is the state port, and nobody else holds it")
            head += data
        judgement = judge(head)
        self._hold(judgement)
        splitter, data = FrameSplitter(judgement.byte_order), head
        while True:
            now = self._clock.now()
            for frame in splitter.feed(data):
                connection.statistics.messages_in += 1
                if judgement.real is None:
                    judgement = judge(len(frame).to_bytes(4, judgement.byte_order) + frame)
                    self._hold(judgement)
                # What comes before the size of reals is known has none.
                message = decode(frame, self.wire or Wire(judgement.byte_order, "f32"))
                for listener in self._listeners:
                    listener.message(message, now)
            due = min((listener.look(now) for listener in self._listeners), default=now + LOST_AFTER)
            data = connection.receive(due)

    def _hold(self, judgement: Judgement) -> None:
        """Hold it against the cell file, and keep it once it is whole."""
        order, real = self._expected
        if order not in (None, judgement.byte_order) or (judgement.real and real not in (None, judgement.real)):
            expected = ", ".join(
                filter(None, (f"byte_order: {order}" if order else "", f"real: {real}" if real else ""))
            )
            raise DeviceError(
                self._arm, "read", f"{self.address} writes {judgement}, the cell file says {expected}", "correct it"
            )
        if judgement.real is not None:
            self.wire = Wire(judgement.byte_order, judgement.real)
