"""One node's objects, read and written by SDO: one request at a time a node, and errors of ours alone."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import canopen
from canopen.sdo.client import SdoClient
from canopen.sdo.exceptions import SdoAbortedError

from backends.controller.can.objects import SDO_ANSWER, SDO_REQUEST
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout

_ANSWER = 0.5  # s


class _Network(canopen.Network):
    """What canopen's client sends through: our transport in place of a bus and a notifier of its own."""

    def __init__(self, send: Callable[[int, bytes], None]) -> None:
        super().__init__()
        self._send = send

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self._send(can_id, bytes(data))


class SdoNode:
    """The objects of the node of one joint. Calls from any thread but the bus's reader, which brings the answers."""

    def __init__(self, device: str, joint: int, node: int, send: Callable[[int, bytes], None]) -> None:
        self._device = device
        self.name = f"joint {joint} (node {node})"
        objects = canopen.ObjectDictionary()
        self._client = SdoClient(SDO_REQUEST + node, SDO_ANSWER + node, objects)
        self._client.network = _Network(send)
        self._client.RESPONSE_TIMEOUT = _ANSWER
        # Two requests at once of one client take each other's answers.
        self._lock = threading.Lock()

    def answered(self, data: bytes) -> None:
        """Its answer has arrived (called by the bus's reader); frames of other than 8 bytes are none."""
        if len(data) == 8:
            self._client.on_response(0, data, 0.0)

    def read(self, index: int, subindex: int = 0) -> bytes:
        """CommandRefused where the node aborts it (there is no such object), DeviceTimeout where it does not answer."""
        return bytes(self._ask(f"read {_object(index, subindex)}", lambda: self._client.upload(index, subindex)))

    def read_number(self, index: int, subindex: int = 0, signed: bool = False) -> int:
        return int.from_bytes(self.read(index, subindex), "little", signed=signed)

    def read_text(self, index: int, subindex: int = 0) -> str:
        return self.read(index, subindex).decode("ascii", "replace").rstrip("\0 ")

    def write(self, index: int, subindex: int, value: int, size: int, signed: bool = False) -> None:
        """Write a number of ``size`` bytes. Errors as of :meth:`read`."""
        data = value.to_bytes(size, "little", signed=signed)
        attempted = f"write {value} to {_object(index, subindex)}"
        self._ask(attempted, lambda: self._client.download(index, subindex, data))

    def _ask(self, attempted: str, request: Callable[[], Any]) -> Any:
        with self._lock:
            try:
                return request()
            except DeviceError:
                raise
            except SdoAbortedError as abort:
                raise CommandRefused(self._device, attempted, f"{self.name} aborts it: {abort}") from abort
            except Exception as error:  # an answer that is none may have the client raise anything
                raise DeviceTimeout(
                    self._device, attempted, f"{self.name}: {error}", "is the drive powered, and its node id right?"
                ) from error


def _object(index: int, subindex: int) -> str:
    return f"object {index:04X}:{subindex:02X}"
