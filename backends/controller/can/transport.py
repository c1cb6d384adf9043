"""CAN frames in and out of one bus.

Opens it with exact options, stamps what arrives on the clock, and hands it over; whatever python-can or a vendor's
library raises becomes an error of ours.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import can

from backends.controller.can.socketcand import Frame, SocketcandWire, address_of
from backends.controller.promptness import prompt_thread
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost

_RECEIVE = 0.05  # s; how long the reader waits before it looks whether it is to end

# What python-can and canopen log is told by our errors; without a handler it would go to the operator's terminal.
for _library in ("can", "canopen"):
    logging.getLogger(_library).addHandler(logging.NullHandler())


@dataclass(frozen=True, slots=True)
class BusAddress:
    """Which bus, and by what: as in the cell file."""

    interface: str
    channel: str
    bitrate: int | None = None

    def __str__(self) -> str:
        return f"{self.interface} {self.channel}"


@dataclass(slots=True)
class BusStatistics:
    """Frames since the bus was opened."""

    received: int = 0
    sent: int = 0
    error_frames: int = 0


class Wire(Protocol):
    """A bus that is open. One thread receives, one at a time sends; they raise whatever their library does."""

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Frames (identifier, data), in their order."""

    def receive(self, timeout: float) -> list[Frame]:
        """What has arrived, after waiting for up to ``timeout`` s for it."""

    def close(self) -> None: ...


class PythonCanWire:
    """A bus of any of python-can's interfaces."""

    def __init__(self, address: BusAddress) -> None:
        options: dict[str, Any] = {} if address.bitrate is None else {"bitrate": address.bitrate}
        # python-can takes any misspelt option without a word, so there are no others; and without ignore_config it
        # would mix in settings of the home folder and the environment.
        self._bus = can.Bus(interface=address.interface, channel=address.channel, ignore_config=True, **options)

    def send(self, frames: Sequence[tuple[int, bytes]]) -> None:
        for identifier, data in frames:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def receive(self, timeout: float) -> list[Frame]:
        message = self._bus.recv(timeout)
        if message is None or message.is_remote_frame or (message.is_extended_id and not message.is_error_frame):
            return []
        return [Frame(message.arbitration_id, bytes(message.data), message.is_error_frame)]

    def close(self) -> None:
        self._bus.shutdown()


Dispatch = Callable[[int, bytes, float], None]


class Transport:
    """One open bus. Sends from any thread; its reader hands each data frame to ``dispatch`` as (id, data, arrival).

    ``on_loss`` is told once, on the reader's thread, when nothing more will arrive.
    """

    def __init__(
        self, device: str, address: BusAddress, clock: Clock, dispatch: Dispatch, on_loss: Callable[[DeviceError], None]
    ) -> None:
        self._device = device
        self._address = address
        self._clock = clock
        self._dispatch = dispatch
        self._on_loss = on_loss
        self._wire: Wire | None = None
        self._sending = threading.Lock()
        self._closing = threading.Event()
        self._reader: threading.Thread | None = None
        self.statistics = BusStatistics()

    def open(self, deadline: float) -> None:
        """Open the bus. DeviceTimeout, LinkLost, CommandRefused (an option that does not fit)."""
        self._wire = _opened(self._device, self._address, self._clock, deadline)
        self._closing.clear()
        self.statistics = BusStatistics()
        name = f"{self._device} CAN reader"
        self._reader = threading.Thread(target=self._read, args=(self._wire,), name=name, daemon=True)
        self._reader.start()

    def close(self) -> None:
        """End the reader and release the bus; any number of times."""
        self._closing.set()
        reader = self._reader
        if reader is not None and reader is not threading.current_thread():
            reader.join()
        with self._sending:
            wire, self._wire, self._reader = self._wire, None, None
        if wire is not None:
            _release(wire)

    def send(self, identifier: int, data: bytes) -> None:
        """LinkLost where the bus does not take it."""
        self.send_all(((identifier, data),))

    def send_all(self, frames: Sequence[tuple[int, bytes]]) -> None:
        """Frames in their order, no other between them. LinkLost where the bus does not take one."""
        with self._sending:
            if (wire := self._wire) is None:
                raise LinkLost(self._device, "send", "the bus is closed")
            try:
                wire.send(frames)
            except Exception as error:  # vendors' libraries raise anything
                raise self._lost("send", error) from error
            self.statistics.sent += len(frames)

    def _read(self, wire: Wire) -> None:
        try:
            with prompt_thread():
                while not self._closing.is_set():
                    self._take(wire.receive(_RECEIVE), self._clock.now())
        except Exception as error:  # noqa: BLE001 - whatever ends the reader must be told
            if not self._closing.is_set():
                self._on_loss(self._lost("receive", error))

    def _take(self, frames: list[Frame], arrival: float) -> None:
        self.statistics.received += len(frames)
        for frame in frames:
            if frame.is_error:
                self.statistics.error_frames += 1
            else:
                self._dispatch(frame.identifier, frame.data, arrival)

    def _lost(self, attempted: str, error: Exception) -> LinkLost:
        return LinkLost(
            self._device,
            attempted,
            f"the bus {self._address} failed: {_words(error)}",
            "check the adapter, its cable and the bus (power, termination, bit rate)",
        )


def _refuse_unless_exact(device: str, address: BusAddress) -> None:
    """What python-can would take without a word, or tell otherwise."""
    advice = "correct the cell file"
    if address.interface not in can.VALID_INTERFACES:
        why, advice = (
            f"python-can has no interface {address.interface}",
            "it has " + ", ".join(sorted(can.VALID_INTERFACES)),
        )
        raise CommandRefused(device, "open the bus", why, advice)
    if address.interface == "socketcand":
        try:
            address_of(address.channel)
        except ValueError as error:
            raise CommandRefused(device, "open the bus", f"channel {error}", advice) from error


def _opened(device: str, address: BusAddress, clock: Clock, deadline: float) -> Wire:
    _refuse_unless_exact(device, address)
    timeout = max(0.01, deadline - clock.now())
    opening = _Opening(address, timeout)
    late = not clock.wait(opening.done, deadline)
    if late and opening.abandon():
        raise DeviceTimeout(device, "open the bus", f"{address} did not open in time", _advice(address))
    if opening.wire is not None:
        return opening.wire
    error = DeviceTimeout if isinstance(opening.error, TimeoutError) else LinkLost
    raise error(device, "open the bus", f"{address}: {_words(opening.error)}", _advice(address)) from opening.error


class _Opening:
    """A bus that is being opened, on a thread of its own: libraries take as long as they like."""

    def __init__(self, address: BusAddress, timeout: float) -> None:
        self.wire: Wire | None = None
        self.error: Exception | None = None
        self.done = threading.Event()
        self._abandoned = False
        self._lock = threading.Lock()
        threading.Thread(target=self._open, args=(address, timeout), name="CAN bus opening", daemon=True).start()

    def _open(self, address: BusAddress, timeout: float) -> None:
        try:
            wire: Wire = (
                SocketcandWire(address.channel, timeout)
                if address.interface == "socketcand"
                else PythonCanWire(address)
            )
        except Exception as error:  # noqa: BLE001 - a missing vendor library raises anything
            self.error = error
        else:
            with self._lock:
                if self._abandoned:
                    _release(wire)
                else:
                    self.wire = wire
        self.done.set()

    def abandon(self) -> bool:
        """Nobody waits for it any more; whether it really is not done."""
        with self._lock:
            self._abandoned = not self.done.is_set() and self.wire is None
            return self._abandoned


def _advice(address: BusAddress) -> str:
    if address.interface == "socketcan":
        return f"is the interface there and up? ip link show {address.channel}"
    if address.interface == "socketcand":
        return "is socketcand running there, and does it serve this bus?"
    return "is the adapter there, and its driver or library installed?"


def _release(wire: Wire) -> None:
    try:
        wire.close()
    except Exception:  # noqa: BLE001 - it is given up; what a library says of that is of no use
        return


def _words(error: BaseException | None) -> str:
    return " ".join(str(error).split()) or type(error).__name__
