"""PDOs as a drive's parameters have them: who may change what when (CiA 301), and how a frame is read and made."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping

from canopen import SdoAbortedError

from backends.controller.emulator.dictionary import NOT_VALID, PDOS, RPDO, TPDO, Entry

NOT_NOW = 0x08000022  # the present state of the device
NO_SUCH_OBJECT = 0x06020000
NOT_MAPPABLE = 0x06040041
TOO_LONG = 0x06040042
VALUE_RANGE = 0x06090030

_CODES = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "i32": "i"}

Key = tuple[int, int]


class ReceivePdo:
    """What comes for a drive; ``take`` gets the objects of the last frame, by index."""

    def __init__(self, entries: list[Entry], synchronous: bool, take: Callable[[int, int], None]) -> None:
        self._layout = struct.Struct("<" + "".join(_CODES[entry.kind] for entry in entries))
        self._indices = [entry.index for entry in entries]
        self._take = take
        self._latest: bytes | None = None
        self._synchronous = synchronous

    def hear(self, data: bytes) -> None:
        """A frame: it counts at the next SYNC, or at once. One that is too short is no PDO of this mapping."""
        if len(data) >= self._layout.size:
            self._latest = data
            if not self._synchronous:
                self.latch()

    def latch(self) -> None:
        """Hand over the last frame, once."""
        if self._latest is not None:
            values = self._layout.unpack_from(self._latest)
            self._latest = None
            for index, value in zip(self._indices, values, strict=True):
                self._take(index, value)


class TransmitPdo:
    """What goes from a drive at each ``every``-th SYNC."""

    def __init__(self, cob_id: int, entries: list[Entry], every: int, show: Callable[[int], Callable[[], int]]) -> None:
        self.cob_id = cob_id
        self._layout = struct.Struct("<" + "".join(_CODES[entry.kind] for entry in entries))
        self._sources = [show(entry.index) for entry in entries]
        self._every = every
        self._syncs = 0

    def data(self) -> bytes | None:
        """Its frame at a SYNC, None if it does not go at this one."""
        self._syncs += 1
        if self._syncs < self._every:
            return None
        self._syncs = 0
        return self._layout.pack(*[source() for source in self._sources])


class PdoParameters:
    """The rules by which a master maps a drive's PDOs: switch off, clear, write, count, switch on."""

    def __init__(self, numbers: Mapping[Key, Entry], values: Mapping[Key, int]) -> None:
        self._numbers = numbers
        self._values = values

    @staticmethod
    def has(index: int) -> bool:
        """Whether an object belongs to a PDO."""
        return RPDO <= index < 0x1C00

    def check(self, index: int, subindex: int, value: int) -> None:
        """SdoAbortedError if ``value`` must not be written now."""
        communication, mapping = index & ~0x200, index | 0x200
        on = not self._values[communication, 1] & NOT_VALID
        if index == mapping:
            if on or (subindex and self._values[mapping, 0]):
                raise SdoAbortedError(NOT_NOW)
            if subindex:
                self._entry(mapping, value)
            else:
                self._check_length(mapping, value)
        elif subindex == 1:
            if on and not value & NOT_VALID and value != self._values[index, 1]:
                raise SdoAbortedError(VALUE_RANGE)
        elif subindex == 2 and not (1 <= value <= 240 or (index < TPDO and value in (0, 254, 255))):
            raise SdoAbortedError(VALUE_RANGE)

    def receive(self, take: Callable[[int, int], None]) -> dict[int, ReceivePdo]:
        """Those that are on, by identifier."""
        return {
            self._values[index, 1] & 0x7FF: ReceivePdo(self._mapped(index), self._values[index, 2] <= 240, take)
            for index in self._on(RPDO)
        }

    def transmit(self, show: Callable[[int], Callable[[], int]]) -> list[TransmitPdo]:
        """Those that are on."""
        return [
            TransmitPdo(self._values[index, 1] & 0x7FF, self._mapped(index), self._values[index, 2], show)
            for index in self._on(TPDO)
        ]

    def _on(self, first: int) -> list[int]:
        numbers = range(first, first + PDOS)
        return [n for n in numbers if not self._values[n, 1] & NOT_VALID and self._values[n + 0x200, 0]]

    def _mapped(self, communication: int) -> list[Entry]:
        mapping = communication + 0x200
        return [self._entry(mapping, self._values[mapping, k + 1]) for k in range(self._values[mapping, 0])]

    def _check_length(self, mapping: int, count: int) -> None:
        if count > 8:
            raise SdoAbortedError(VALUE_RANGE)
        mapped = [self._entry(mapping, self._values[mapping, k + 1]) for k in range(count)]
        if sum(entry.bits for entry in mapped) > 64:
            raise SdoAbortedError(TOO_LONG)

    def _entry(self, mapping: int, value: int) -> Entry:
        """What a mapping's number (index, subindex, bits) stands for."""
        entry = self._numbers.get((value >> 16, value >> 8 & 0xFF))
        if entry is None:
            raise SdoAbortedError(NO_SUCH_OBJECT)
        if ("r" if mapping < TPDO else "t") not in entry.mapped or entry.bits != value & 0xFF:
            raise SdoAbortedError(NOT_MAPPABLE)
        return entry
