"""The objects that an emulated drive has: CiA 301's of communication, CiA 402's of motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from canopen import ObjectDictionary
from canopen.objectdictionary import ODRecord, ODVariable, datatypes

PDOS = 4
"""How many PDOs a drive has each way."""

RPDO, TPDO = 0x1400, 0x1800
"""Index of the first communication parameters; the mapping is 0x200 further on."""

NOT_VALID = 1 << 31
"""Set in the identifier of a PDO that is switched off."""

Kind = Literal["u8", "i8", "u16", "i16", "u32", "i32"]

_TYPES = {
    "u8": datatypes.UNSIGNED8,
    "i8": datatypes.INTEGER8,
    "u16": datatypes.UNSIGNED16,
    "i16": datatypes.INTEGER16,
    "u32": datatypes.UNSIGNED32,
    "i32": datatypes.INTEGER32,
}

TEXTS = {0x1008: "Device name", 0x1009: "Hardware version", 0x100A: "Software version"}
TEXT_VALUES = {0x1008: "dualcal emulated drive", 0x1009: "1.0", 0x100A: "1.0"}
"""What a drive says of itself in words."""


@dataclass(frozen=True, slots=True)
class Entry:
    """A number that a drive has. mapped: r if a PDO that it receives may carry it, t one that it sends."""

    index: int
    subindex: int
    name: str
    kind: Kind
    access: Literal["ro", "rw", "wo", "const"]
    default: int = 0
    mapped: Literal["", "r", "t", "rt"] = ""

    @property
    def bits(self) -> int:
        return int(self.kind[1:])


def entries(node: int) -> dict[tuple[int, int], Entry]:
    """All numbers of the drive with this node id, by index and subindex."""
    numbers = [*_COMMUNICATION, *_MOTION]
    numbers.append(Entry(0x1014, 0, "COB-ID emergency", "u32", "ro", 0x80 + node))
    numbers.append(Entry(0x1018, 4, "Serial number", "u32", "ro", node))
    for number in range(PDOS):
        numbers += _pdo(RPDO, number, f"RPDO{number + 1}", 0x200 + node, (0x60400010, 0x60600008, 0x607A0020))
        numbers += _pdo(TPDO, number, f"TPDO{number + 1}", 0x180 + node, (0x60410010, 0x60610008, 0x60640020))
    return {(entry.index, entry.subindex): entry for entry in numbers}


def object_dictionary(node: int, numbers: dict[tuple[int, int], Entry]) -> ObjectDictionary:
    """The same for canopen, and the texts."""
    dictionary = ObjectDictionary()
    dictionary.node_id = node
    records = {index: ODRecord(f"{index:04X}", index) for index, subindex in numbers if subindex}
    for record in records.values():
        dictionary.add_object(record)
    for (index, subindex), entry in sorted(numbers.items()):
        variable = ODVariable(entry.name, index, subindex)
        variable.data_type, variable.access_type, variable.default = _TYPES[entry.kind], entry.access, entry.default
        (records[index].add_member if index in records else dictionary.add_object)(variable)
    for index, name in TEXTS.items():
        text = ODVariable(name, index)
        text.data_type, text.access_type = datatypes.VISIBLE_STRING, "const"
        dictionary.add_object(text)
    return dictionary


def _pdo(first: int, number: int, name: str, cob_id: int, mapped: tuple[int, ...]) -> list[Entry]:
    """Communication and mapping; the first PDO is on, the others are off and empty."""
    index, cob_id = first + number, cob_id + 0x100 * number
    if number:
        cob_id, mapped = cob_id | NOT_VALID, ()
    return [
        Entry(index, 0, f"{name} highest subindex", "u8", "const", 2),
        Entry(index, 1, f"{name} COB-ID", "u32", "rw", cob_id),
        Entry(index, 2, f"{name} transmission type", "u8", "rw", 1),
        Entry(index + 0x200, 0, f"{name} number of objects", "u8", "rw", len(mapped)),
        *(
            Entry(index + 0x200, k, f"{name} object {k}", "u32", "rw", mapped[k - 1] if k <= len(mapped) else 0)
            for k in range(1, 9)
        ),
    ]


_COMMUNICATION = (
    Entry(0x1000, 0, "Device type", "u32", "ro", 0x00020192),  # a servo drive of CiA 402
    Entry(0x1001, 0, "Error register", "u8", "ro", mapped="t"),
    Entry(0x1003, 0, "Number of errors", "u8", "rw"),
    *(Entry(0x1003, k, f"Error {k}", "u32", "ro") for k in range(1, 5)),
    Entry(0x1005, 0, "COB-ID SYNC", "u32", "ro", 0x80),
    Entry(0x1016, 0, "Number of heartbeat consumers", "u8", "const", 2),
    Entry(0x1016, 1, "Consumer heartbeat time 1", "u32", "rw"),
    Entry(0x1016, 2, "Consumer heartbeat time 2", "u32", "rw"),
    Entry(0x1017, 0, "Producer heartbeat time", "u16", "rw"),
    Entry(0x1018, 0, "Identity highest subindex", "u8", "const", 4),
    Entry(0x1018, 1, "Vendor", "u32", "ro", 0),  # that of nobody
    Entry(0x1018, 2, "Product code", "u32", "ro", 402),
    Entry(0x1018, 3, "Revision", "u32", "ro", 0x00010000),
    Entry(0x1029, 0, "Number of error classes", "u8", "const", 1),
    Entry(0x1029, 1, "Behaviour on communication error", "u8", "rw", 0),
)

_MOTION = (
    Entry(0x6007, 0, "Abort connection option code", "i16", "rw", 1),
    Entry(0x603F, 0, "Error code", "u16", "ro", mapped="t"),
    Entry(0x6040, 0, "Controlword", "u16", "rw", mapped="r"),
    Entry(0x6041, 0, "Statusword", "u16", "ro", mapped="t"),
    Entry(0x605A, 0, "Quick stop option code", "i16", "rw", 2),
    Entry(0x6060, 0, "Mode of operation", "i8", "rw", mapped="r"),
    Entry(0x6061, 0, "Mode of operation display", "i8", "ro", mapped="t"),
    Entry(0x6062, 0, "Position demand value", "i32", "ro", mapped="t"),
    Entry(0x6064, 0, "Position actual value", "i32", "ro", mapped="t"),
    Entry(0x6065, 0, "Following error window", "u32", "rw"),
    Entry(0x6066, 0, "Following error time out", "u16", "rw", 100),
    Entry(0x6067, 0, "Position window", "u32", "rw"),
    Entry(0x606C, 0, "Velocity actual value", "i32", "ro", mapped="t"),
    Entry(0x607A, 0, "Target position", "i32", "rw", mapped="r"),
    Entry(0x607D, 0, "Software position limits highest subindex", "u8", "const", 2),
    Entry(0x607D, 1, "Minimal position limit", "i32", "rw", -(1 << 31)),
    Entry(0x607D, 2, "Maximal position limit", "i32", "rw", (1 << 31) - 1),
    Entry(0x6081, 0, "Profile velocity", "u32", "rw", mapped="r"),
    Entry(0x6083, 0, "Profile acceleration", "u32", "rw"),
    Entry(0x6084, 0, "Profile deceleration", "u32", "rw"),
    Entry(0x6085, 0, "Quick stop deceleration", "u32", "rw"),
    Entry(0x60C2, 0, "Interpolation time period highest subindex", "u8", "const", 2),
    Entry(0x60C2, 1, "Interpolation time period value", "u8", "rw", 10),
    Entry(0x60C2, 2, "Interpolation time index", "i8", "rw", -3),
    Entry(0x60F4, 0, "Following error actual value", "i32", "ro", mapped="t"),
    Entry(0x6502, 0, "Supported drive modes", "u32", "ro", 0x81),  # profile and cyclic synchronous position
)
