"""A drive on a CANopen node of its own: what CiA 301 makes of it. Used on its bus's thread only."""

from __future__ import annotations

import contextlib
import math
import struct
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any

from canopen import LocalNode, Network, SdoAbortedError

from backends.controller.emulator.axis import CYCLIC_SYNCHRONOUS_POSITION, FOLLOWING_ERROR, PROFILE_POSITION, Axis
from backends.controller.emulator.dictionary import TEXT_VALUES, entries, object_dictionary
from backends.controller.emulator.pdo import VALUE_RANGE, PdoParameters, ReceivePdo, TransmitPdo

HEARTBEAT_LOST = 0x8130
CONNECTION_ABORTED = 0x8100

BOOT = 0.1
"""Seconds from a reset to the boot-up message."""

_HARDWARE_ERROR = 0x06060000
_OPERATIONAL, _STOPPED, _INITIALISING = 5, 4, 0
_RESETS = (129, 130)

_MODES = (0, PROFILE_POSITION, CYCLIC_SYNCHRONOUS_POSITION)
_ALLOWED: dict[tuple[int, int], tuple[int, ...]] = {
    (0x1003, 0): (0,),
    (0x1029, 1): (0, 1, 2),
    (0x6007, 0): (0, 1, 2, 3),
    (0x605A, 0): (0, 1, 2, 5, 6),
    (0x6060, 0): _MODES,
}


class Ill(Enum):
    """What can be wrong with a drive and goes on being so."""

    SILENT = "its PDOs do not come"
    NO_HEARTBEAT = "its heartbeats do not come"
    REFUSES = "it aborts all requests"


class Drive:
    """A drive that has just got its supply.

    axis: what it moves. transmits: its PDOs that are on, none unless the node is operational. ills: what is wrong.
    """

    def __init__(self, node: int, network: Network, defaults: Mapping[int, int]) -> None:
        """``defaults`` of objects that depend on the axis, by index."""
        self.id = node
        self.ills: set[Ill] = set()
        self._receives: dict[int, ReceivePdo] = {}
        self.transmits: list[TransmitPdo] = []
        self._numbers = entries(node)
        self._defaults = {(index, 0): value for index, value in defaults.items()}
        self._values = self._at_power_on()
        self._pdos = PdoParameters(self._numbers, self._values)
        self._heard: dict[int, float] = {}
        self._boots_at: float | None = None  # None once it has
        self._refuses = False
        self._word: int | None = None
        self.axis = Axis(self._values, self._on_fault)
        self._live: dict[int, Callable[[], int]] = {
            0x6041: self._statusword,
            0x6061: lambda: self.axis.mode,
            0x6062: self.axis.set_point,
            0x6064: lambda: self.axis.actual,
            0x606C: lambda: round(self.axis.velocity),
            0x60F4: self.axis.following_error,
        }
        self.node = LocalNode(node, object_dictionary(node, self._numbers))
        self.node.add_read_callback(self._on_read)
        self.node.add_write_callback(self._on_write)
        network.add_node(self.node)
        self._boot()

    # What comes by the bus

    def on_nmt(self, command: int, now: float) -> None:
        """A network management command to this node."""
        if self._boots_at is not None:
            return
        if command in _RESETS:
            self.reboot()
            return
        was_operational = self._is(_OPERATIONAL)
        self.node.nmt.on_command(0, bytes((command, self.id)), now)
        if self._is(_OPERATIONAL) and not was_operational:
            self._map()
        elif was_operational and not self._is(_OPERATIONAL):
            self._unmap()
            if self.axis.has_current:
                self._abort_connection(CONNECTION_ABORTED)

    def on_sdo(self, can_id: int, data: bytes, now: float) -> None:
        """A request to its SDO server."""
        if len(data) == 8 and self._boots_at is None and not self._is(_STOPPED):
            self._refuses = Ill.REFUSES in self.ills
            # It is canopen's way not to go on with a transfer that was never begun.
            with contextlib.suppress(struct.error):
                self.node.sdo.on_request(can_id, bytearray(data), now)
            self._refuses = False

    def on_heartbeat(self, producer: int, now: float) -> None:
        """Another node's heartbeat, which it may have been told to watch; it does so from the first one on."""
        if producer in self._watched():
            self._heard[producer] = now

    def on_pdo(self, can_id: int, data: bytes) -> None:
        """A PDO, which may be for it."""
        if (pdo := self._receives.get(can_id)) is not None:
            pdo.hear(data)
            self._obey()

    def on_sync(self, now: float) -> None:
        """Do what came by PDO since the last one, and go on with what it is about."""
        for pdo in self._receives.values():
            pdo.latch()
        self._obey()
        self.axis.on_sync(now)
        self.axis.advance(now)

    @property
    def told(self) -> tuple[int, int] | None:
        """The controlword and the target that came last, None while it hears none."""
        return self.axis.told if self._is(_OPERATIONAL) else None

    # What happens by itself

    def watch(self, now: float) -> None:
        """Boot when it is time, and miss the heartbeats that do not come."""
        if self._boots_at is not None:
            self._boots_at = min(self._boots_at, now + BOOT)
            if now >= self._boots_at:
                self._boot()
        elif self._heard:
            for producer, longest in self._watched().items():
                if producer in self._heard and now - self._heard[producer] > longest:
                    del self._heard[producer]
                    self._lose_heartbeat()

    def tell_emergency(self, code: int) -> None:
        """Send an emergency, and keep it in mind; go on."""
        values = self._values
        values[0x1001, 0] |= _error_register(code)
        errors = [code, *(values[0x1003, k] for k in range(1, 4))]
        values.update({(0x1003, k): error for k, error in enumerate(errors, 1)})
        values[0x1003, 0] = sum(error != 0 for error in errors)
        self._send_emergency(code)

    def reboot(self) -> None:
        """Lose all, be away for a while, and begin anew."""
        self.node.nmt.stop_heartbeat()
        self.node.nmt.on_command(0, bytes((_RESETS[0], self.id)), 0.0)
        self._unmap()
        self.axis.reset()
        self._values.update(self._at_power_on())
        self._heard = {}
        self._boots_at = math.inf  # it begins to count at the next tick

    def _boot(self) -> None:
        self._boots_at = None
        self.node.nmt.state = "INITIALISING"  # sends the boot-up message
        self.node.nmt.state = "PRE-OPERATIONAL"
        self.axis.boot()

    def _at_power_on(self) -> dict[tuple[int, int], int]:
        return {key: entry.default for key, entry in self._numbers.items()} | self._defaults

    # Communication

    def _is(self, nmt_state: int) -> bool:
        return self.node.nmt._state == nmt_state

    def _map(self) -> None:
        self._receives = self._pdos.receive(self._take)
        self.transmits = self._pdos.transmit(self._source)

    def _unmap(self) -> None:
        self._receives, self.transmits = {}, []

    def _watched(self) -> dict[int, float]:
        """Nodes whose heartbeat it is to watch, each with the longest time between two, s."""
        told = [self._values[0x1016, k] for k in (1, 2)]
        return {entry >> 16 & 0x7F: (entry & 0xFFFF) / 1000 for entry in told if entry >> 16 & 0x7F and entry & 0xFFFF}

    def _lose_heartbeat(self) -> None:
        self._abort_connection(HEARTBEAT_LOST)
        behaviour = self._values[0x1029, 1]
        if behaviour == 2 or (behaviour == 0 and self._is(_OPERATIONAL)):
            self.node.nmt.state = "STOPPED" if behaviour == 2 else "PRE-OPERATIONAL"
            self._unmap()

    def _abort_connection(self, code: int) -> None:
        """The master is not there, or does not mean to be: 6007 says what to do."""
        option = self._values[0x6007, 0]
        if option == 1:
            self.axis.fail(code)
            return
        self.tell_emergency(code)
        if option == 2:
            self.axis.disable()
        elif option == 3:
            self.axis.quick_stop()

    def _on_fault(self, code: int) -> None:
        """The axis has a fault, or has none any more: 0."""
        self._values[0x603F, 0] = code
        if code:
            self.tell_emergency(code)
        else:
            self._values[0x1001, 0] = 0
            self._send_emergency(0)

    def _send_emergency(self, code: int) -> None:
        if not self._is(_STOPPED) and not self._is(_INITIALISING):
            self.node.emcy.send(code, self._values[0x1001, 0])

    # Objects

    def _statusword(self) -> int:
        return self.axis.statusword() | 0x0200 * self._is(_OPERATIONAL)

    def _source(self, index: int) -> Callable[[], int]:
        return self._live.get(index) or (lambda: self._values[index, 0])

    def _on_read(self, index: int, subindex: int, od: object) -> int | str | None:
        if self._refuses:
            raise SdoAbortedError(_HARDWARE_ERROR)
        if index in TEXT_VALUES:
            return TEXT_VALUES[index]
        live = self._live.get(index)
        return self._values.get((index, subindex)) if live is None else live()

    def _on_write(self, index: int, subindex: int, od: Any, data: bytes) -> None:
        if self._refuses:
            raise SdoAbortedError(_HARDWARE_ERROR)
        key, value = (index, subindex), od.decode_raw(bytes(data))
        if value not in _ALLOWED.get(key, (value,)) or (0x6081 <= index <= 0x6085 and value == 0):
            raise SdoAbortedError(VALUE_RANGE)
        if self._pdos.has(index):
            self._pdos.check(index, subindex, value)
            self._values[key] = value
            if self._is(_OPERATIONAL):
                self._map()
        elif subindex:
            self._values[key] = value
            self._heard = {} if index == 0x1016 else self._heard
        elif index == 0x1003:
            self._values.update({(0x1003, k): 0 for k in range(5)})
        else:
            self._take(index, value)
            self._obey()

    def _take(self, index: int, value: int) -> None:
        """An object without subindex was written, by SDO or PDO."""
        if index == 0x6060 and value not in _MODES:
            return
        self._values[index, 0] = value
        if index == 0x6040:
            self._word = value
        elif index == 0x6060:
            self.axis.operate(value)

    def _obey(self) -> None:
        """Do what a controlword says that has come: after all that came with it, whichever way it is mapped."""
        if self._word is not None:
            word, self._word = self._word, None
            self.axis.obey(word)


def _error_register(code: int) -> int:
    """CiA 301's bit for a class of emergencies, and the one for any."""
    classes = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08, 0x8: 0x10}
    return 0x01 | (0x20 if code == FOLLOWING_ERROR else classes.get(code >> 12, 0))
