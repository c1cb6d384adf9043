"""What stands in the frames of a CiA 402 drive: pure functions from bytes to meaning and back.

CiA 301 gives the frames' identifiers, heartbeats and emergencies, CiA 402 the words and states.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum, StrEnum

NMT = 0x000
SYNC = 0x080
EMERGENCY = 0x080
TPDO1 = 0x180
RPDO1 = 0x200
SDO_ANSWER = 0x580
SDO_REQUEST = 0x600
HEARTBEAT = 0x700

INT32 = range(-(2**31), 2**31)


class State(StrEnum):
    """Where a drive is in CiA 402's state machine."""

    NOT_READY = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch-on disabled"
    READY = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP = "quick stop active"
    FAULT_REACTION = "fault reaction active"
    FAULT = "fault"


_STATES = (
    (0x4F, 0x00, State.NOT_READY),
    (0x4F, 0x40, State.SWITCH_ON_DISABLED),
    (0x6F, 0x21, State.READY),
    (0x6F, 0x23, State.SWITCHED_ON),
    (0x6F, 0x27, State.OPERATION_ENABLED),
    (0x6F, 0x07, State.QUICK_STOP),
    (0x4F, 0x0F, State.FAULT_REACTION),
    (0x4F, 0x08, State.FAULT),
)

IN_FAULT = frozenset({State.FAULT, State.FAULT_REACTION})


def state_of(statusword: int) -> State:
    """The state a statusword tells; bits that no state has are those of a drive that is not ready."""
    for mask, value, state in _STATES:
        if statusword & mask == value:
            return state
    return State.NOT_READY


class Control(IntEnum):
    """Controlwords (6040)."""

    DISABLE_VOLTAGE = 0x00
    QUICK_STOP = 0x02
    SHUTDOWN = 0x06
    SWITCH_ON = 0x07
    ENABLE_OPERATION = 0x0F
    FAULT_RESET = 0x80


NEW_SET_POINT = 0x0010
"""Bit of the controlword in profile position mode: its rising edge hands a target over."""
AT_ONCE = 0x0020
"""Bit of the controlword in profile position mode: the target replaces the one under way."""
HALT = 0x0100
"""Bit of the controlword: slow down and stand, stay enabled."""
VOLTAGE = 0x0010
"""Bit of the statusword: there is voltage for the motor."""
TARGET_REACHED = 0x0400
"""Bit of the statusword: arrived; with HALT, standing."""
SET_POINT_TAKEN = 0x1000
"""Bit of the statusword in profile position mode: answers NEW_SET_POINT."""
FOLLOWING_ERROR = 0x2000
"""Bit of the statusword in the position modes."""


class Operation(IntEnum):
    """Modes of operation (6060, 6061)."""

    PROFILE_POSITION = 1
    CYCLIC_POSITION = 8


_COMMAND = struct.Struct("<Hbi")
_FEEDBACK = struct.Struct("<Hbi")


def pack_command(controlword: int, operation: int, target: int) -> bytes:
    """RPDO1: 6040:16, 6060:8, 607A:32; ``target`` in counts. ValueError where it is out of 32 bits."""
    if target not in INT32:
        raise ValueError(f"target of {target} counts is out of 32 bits")
    return _COMMAND.pack(controlword, operation, target)


def unpack_command(data: bytes) -> tuple[int, int, int]:
    """Controlword, operation and target of an RPDO1. ValueError for other than 7 bytes."""
    if len(data) != _COMMAND.size:
        raise ValueError(f"an RPDO1 has 7 bytes, not {len(data)}")
    controlword, operation, target = _COMMAND.unpack(data)
    return controlword, operation, target


@dataclass(frozen=True, slots=True)
class Feedback:
    """A TPDO1: 6041:16, 6061:8, 6064:32; position in counts."""

    statusword: int
    operation: int
    position: int

    @property
    def state(self) -> State:
        return state_of(self.statusword)

    @classmethod
    def unpack(cls, data: bytes) -> Feedback:
        """ValueError for other than 7 bytes."""
        if len(data) != _FEEDBACK.size:
            raise ValueError(f"a TPDO1 has 7 bytes, not {len(data)}: its mapping is not the one that was set up")
        return cls(*_FEEDBACK.unpack(data))

    def pack(self) -> bytes:
        return _FEEDBACK.pack(self.statusword, self.operation, self.position)


@dataclass(frozen=True, slots=True)
class Scale:
    """A drive's counts and its joint: angle = sign * counts / counts_per_rad + offset, rad."""

    counts_per_rad: float
    offset: float = 0.0
    sign: int = 1

    def to_counts(self, angle: float) -> int:
        """The nearest count."""
        return round(self.sign * (angle - self.offset) * self.counts_per_rad)

    def to_angle(self, counts: float) -> float:
        return self.sign * counts / self.counts_per_rad + self.offset


class NmtState(IntEnum):
    """What a heartbeat says of a node; 0 is said once, when it has booted."""

    BOOT_UP = 0x00
    STOPPED = 0x04
    OPERATIONAL = 0x05
    PRE_OPERATIONAL = 0x7F


class NmtCommand(IntEnum):
    """What a master tells nodes to be."""

    START = 0x01
    STOP = 0x02
    PRE_OPERATIONAL = 0x80
    RESET = 0x81
    RESET_COMMUNICATION = 0x82


def pack_nmt(command: NmtCommand, node: int) -> bytes:
    return bytes((command, node))


def unpack_heartbeat(data: bytes) -> int:
    """An NmtState as a number, as devices may say others; the toggle bit of node guarding is left out."""
    if len(data) != 1:
        raise ValueError(f"a heartbeat has one byte, not {len(data)}")
    return NmtState.PRE_OPERATIONAL if data[0] == NmtState.PRE_OPERATIONAL else data[0] & 0x7F


@dataclass(frozen=True, slots=True)
class Emergency:
    """An emergency frame: CiA 301's error code, the error register (1001), and five bytes of the maker's own."""

    code: int
    register: int
    maker: bytes

    @classmethod
    def unpack(cls, data: bytes) -> Emergency:
        """ValueError for other than 8 bytes."""
        if len(data) != 8:
            raise ValueError(f"an emergency has 8 bytes, not {len(data)}")
        code, register = struct.unpack_from("<HB", data)
        return cls(code, register, bytes(data[3:]))

    def pack(self) -> bytes:
        return struct.pack("<HB5s", self.code, self.register, self.maker)

    @property
    def is_over(self) -> bool:
        """Whether it takes back those before it."""
        return self.code >> 8 == 0

    def __str__(self) -> str:
        return words_of(self.code)


_WORDS = {
    0x2310: "continuous over current",
    0x2320: "short circuit or earth leakage",
    0x3110: "mains over voltage",
    0x3120: "mains under voltage",
    0x3210: "over voltage of the DC link",
    0x3220: "under voltage of the DC link",
    0x4110: "ambient temperature too high",
    0x4210: "device temperature too high",
    0x4310: "drive temperature too high",
    0x5441: "emergency stop or safe torque off",
    0x6320: "parameter error",
    0x7120: "motor fault",
    0x7121: "motor blocked",
    0x7300: "sensor fault",
    0x7305: "encoder fault",
    0x7320: "position sensor fault",
    0x8110: "CAN overrun, frames lost",
    0x8120: "CAN in error passive state",
    0x8130: "heartbeat of this program missed",
    0x8140: "recovered from bus off",
    0x8150: "identifier collision",
    0x8210: "PDO not processed: wrong length",
    0x8240: "unexpected length of SYNC",
    0x8250: "RPDO late",
    0x8400: "speed controller fault",
    0x8500: "position controller fault",
    0x8600: "positioning controller fault",
    0x8611: "following error",
    0x8612: "reference or software limit",
    0x8700: "SYNC controller fault",
    0xFF01: "a fault of the maker's own",
}
_CLASSES = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current in the device",
    0x23: "current at the output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage in the device",
    0x33: "voltage at the output",
    0x40: "temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "a fault of the maker's own",
}


def words_of(code: int) -> str:
    """An error code (603F, emergency) in words: ``code 0x8611 following error``."""
    high = code >> 8
    words = _WORDS.get(code) or _CLASSES.get(high) or _CLASSES.get(high & 0xF0, "unknown error")
    return f"code 0x{code:04X} {words}"
