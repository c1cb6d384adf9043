"""CAN frames in and out of one bus, by python-can.

Opens a bus with exact options, stamps what arrives on the clock, and hands it over; whatever python-can or a vendor's
library raises becomes an error of ours.
"""

from __future__ import annotations

import logging
import socket
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import can

from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, LinkLost

_RECEIVE = 0.05  # s; how long the reader waits before it looks whether it is to end
_BITRATE_ELSEWHERE = {
    "socketcan": "set it by: ip link set CHANNEL type can bitrate N",
    "socketcand": "it is set where socketcand runs",
    "virtual": "a virtual bus has none",
    "udp_multicast": "a bus in a network has none",
}

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
        self._bus: can.BusABC | None = None
        self._sending = threading.Lock()
        self._closing = threading.Event()
        self._reader: threading.Thread | None = None
        self.statistics = BusStatistics()

    def open(self, deadline: float) -> None:
        """Open the bus. DeviceTimeout, LinkLost, CommandRefused (an option that does not fit)."""
        self._bus = _open_bus(self._device, self._address, self._clock, deadline)
        self._closing.clear()
        self.statistics = BusStatistics()
        self._reader = threading.Thread(target=self._read, args=(self._bus,), name=f"{self._device} CAN reader")
        self._reader.daemon = True
        self._reader.start()

    def close(self) -> None:
        """End the reader and release the bus; any number of times."""
        self._closing.set()
        reader, bus = self._reader, self._bus
        if reader is not None and reader is not threading.current_thread():
            reader.join()
        with self._sending:
            self._bus = self._reader = None
        if bus is not None:
            _shut_down(bus)

    def send(self, identifier: int, data: bytes) -> None:
        """LinkLost where the bus does not take it."""
        self.send_all(((identifier, data),))

    def send_all(self, frames: Iterable[tuple[int, bytes]]) -> None:
        """Frames in their order, no other between them. LinkLost where the bus does not take one."""
        with self._sending:
            if (bus := self._bus) is None:
                raise LinkLost(self._device, "send", "the bus is closed")
            for identifier, data in frames:
                message = can.Message(arbitration_id=identifier, data=data, is_extended_id=False)
                try:
                    bus.send(message)
                except Exception as error:  # vendors' libraries raise anything
                    raise self._lost("send", error) from error
                self.statistics.sent += 1

    def _read(self, bus: can.BusABC) -> None:
        try:
            while not self._closing.is_set():
                message = bus.recv(_RECEIVE)
                if message is not None:
                    self._take(message, self._clock.now())
        except Exception as error:  # noqa: BLE001 - whatever ends the reader must be told
            if not self._closing.is_set():
                self._on_loss(self._lost("receive", error))

    def _take(self, message: can.Message, arrival: float) -> None:
        self.statistics.received += 1
        if message.is_error_frame:
            self.statistics.error_frames += 1
        elif not (message.is_remote_frame or message.is_extended_id):
            self._dispatch(message.arbitration_id, bytes(message.data), arrival)

    def _lost(self, attempted: str, error: Exception) -> LinkLost:
        return LinkLost(
            self._device,
            attempted,
            f"the bus {self._address} failed: {_words(error)}",
            "check the adapter, its cable and the bus (power, termination, bit rate)",
        )


def socketcand_address(channel: str) -> tuple[str, int, str]:
    """Host, port and bus of ``HOST:PORT/BUS``; ValueError if it is none."""
    place, slash, bus = channel.partition("/")
    host, colon, port = place.rpartition(":")
    if not (slash and colon and host and bus and port.isdecimal() and 0 < int(port) < 65536):
        raise ValueError(f"must be HOST:PORT/BUS, as 192.168.0.5:29536/can0, not {channel}")
    return host.removeprefix("[").removesuffix("]"), int(port), bus


def _options(address: BusAddress) -> dict[str, Any]:
    """What python-can is given; it takes any misspelt option without a word, so nothing else goes there."""
    if address.bitrate is not None and (elsewhere := _BITRATE_ELSEWHERE.get(address.interface)) is not None:
        raise ValueError(f"bitrate is no option of {address.interface}: {elsewhere}")
    options: dict[str, Any] = {"interface": address.interface, "channel": address.channel}
    if address.interface == "socketcand":
        host, port, bus = socketcand_address(address.channel)
        # Without tcp_tune each answer may wait 40 ms for an acknowledgement.
        options |= {"host": host, "port": port, "channel": bus, "tcp_tune": True}
    if address.bitrate is not None:
        options["bitrate"] = address.bitrate
    return options


def _open_bus(device: str, address: BusAddress, clock: Clock, deadline: float) -> can.BusABC:
    try:
        options = _options(address)
    except ValueError as error:
        raise CommandRefused(device, "open the bus", str(error), "correct the cell file") from error
    if address.interface not in can.VALID_INTERFACES:
        known = ", ".join(sorted(can.VALID_INTERFACES))
        raise CommandRefused(
            device, "open the bus", f"python-can has no interface {address.interface}", f"it has {known}"
        )
    if address.interface == "socketcand":
        _greet(device, options["host"], options["port"], deadline - clock.now())
    opening = _Opening(options)
    if not clock.wait(opening.done, deadline):
        opening.abandon()
        raise DeviceTimeout(device, "open the bus", f"{address} did not open in time", "check the adapter")
    if opening.bus is None:
        raise LinkLost(
            device, "open the bus", f"{address}: {_words(opening.error)}", _advice(address)
        ) from opening.error
    return opening.bus


class _Opening:
    """A bus that is being opened, on a thread of its own: libraries may take as long as they like."""

    def __init__(self, options: dict[str, Any]) -> None:
        self.bus: can.BusABC | None = None
        self.error: Exception | None = None
        self.done = threading.Event()
        self._abandoned = False
        self._lock = threading.Lock()
        threading.Thread(target=self._open, args=(options,), name="CAN bus opening", daemon=True).start()

    def _open(self, options: dict[str, Any]) -> None:
        try:
            # Else settings in the home folder and the environment would be mixed in.
            bus = can.Bus(ignore_config=True, **options)
        except Exception as error:  # noqa: BLE001 - a missing vendor library raises anything
            self.error = error
        else:
            with self._lock:
                if self._abandoned:
                    _shut_down(bus)
                else:
                    self.bus = bus
        self.done.set()

    def abandon(self) -> None:
        """Nobody waits for it any more."""
        with self._lock:
            self._abandoned = True
            if self.bus is not None:
                _shut_down(self.bus)


def _greet(device: str, host: str, port: int, timeout: float) -> None:
    """Is a socketcand there at all? python-can would try for ten seconds, and wait for its greeting for ever."""
    try:
        with socket.create_connection((host, port), timeout=max(timeout, 0.01)) as probe:
            greeting = probe.recv(16)
    except TimeoutError as error:
        raise DeviceTimeout(
            device, "open the bus", f"no socketcand answers at {host}:{port}", "is it running?"
        ) from error
    except OSError as error:
        raise LinkLost(
            device, "open the bus", f"no socketcand at {host}:{port}: {error.strerror or error}", "is it running?"
        ) from error
    if not greeting.startswith(b"< hi >"):
        raise LinkLost(device, "open the bus", f"what listens at {host}:{port} is no socketcand", "check the channel")


def _advice(address: BusAddress) -> str:
    if address.interface == "socketcan":
        return f"is the interface there and up? ip link show {address.channel}"
    return "is the adapter there, and its driver or library installed?"


def _shut_down(bus: can.BusABC) -> None:
    try:
        bus.shutdown()
    except Exception:  # noqa: BLE001 - it is given up; what a library says of that is of no use
        return


def _words(error: BaseException | None) -> str:
    return " ".join(str(error).split()) or type(error).__name__
