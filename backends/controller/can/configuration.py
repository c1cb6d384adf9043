"""What a drive is set up to by SDO, in pre-operational, and what is read of it meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial

from backends.controller.can.objects import (
    RPDO1,
    TPDO1,
    Control,
    Operation,
    State,
    state_of,
    words_of,
)
from backends.controller.can.sdo import SdoNode
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout

HEARTBEAT = 0.1
"""s; how often this program and each drive say that they live."""
HEARTBEAT_LOST = 0.5
"""s without this program's heartbeat after which a drive stops by itself: what a busy interpreter does not come to."""

_CIA_402 = 402
_QUICK_STOP_AND_STAY = 6  # slow down on the quick stop ramp and hold the position
_ON_LOSS_QUICK_STOP = 3
_SLOW_DOWN_FIRST = 1
_PDO_OFF = 1 << 31
_PDO_NOT_ON_REQUEST = 1 << 30
_EVERY_SYNC = 1
_RPDO_OBJECTS = (0x60400010, 0x60600008, 0x607A0020)
_TPDO_OBJECTS = (0x60410010, 0x60610008, 0x60640020)
_SUPPORTED = {Operation.PROFILE_POSITION: (1 << 0, "profile position"), Operation.CYCLIC_POSITION: (1 << 7, "cyclic")}


@dataclass(frozen=True)
class DriveRecord:
    """What a drive told of itself at set-up; None where it has no such object. Positions in counts.

    notes: in words, what it did not take.
    """

    device_type: int
    name: str | None
    hardware: str | None
    software: str | None
    vendor: int | None
    product: int | None
    revision: int | None
    serial: int | None
    statusword: int
    error_code: int | None
    following_error_window: int | None
    following_error_time_ms: int | None
    limits: tuple[int, int] | None
    quick_stop_option: int | None
    abort_option: int | None
    notes: tuple[str, ...] = field(default=())

    @property
    def last_error(self) -> str:
        """The error code it keeps, in words; empty if it keeps none."""
        return words_of(self.error_code) if self.error_code else ""


def switch_off(sdo: SdoNode) -> None:
    """Switch a drive off that is enabled, as a program that is gone may have left it; no word if it does not answer."""
    with suppress(DeviceTimeout, CommandRefused):
        state = state_of(sdo.read_number(0x6041))
        if state is State.OPERATION_ENABLED:
            sdo.write(0x6040, 0, Control.SHUTDOWN, 2)
        elif state is State.QUICK_STOP:
            sdo.write(0x6040, 0, Control.DISABLE_VOLTAGE, 2)


def is_there(sdo: SdoNode) -> bool:
    """Whether the node answers."""
    try:
        sdo.read_number(0x1000)
    except DeviceTimeout:
        return False
    except CommandRefused:
        return True
    return True


def device_type(sdo: SdoNode) -> int:
    """The type (1000) of a node that is there and is a drive. DeviceTimeout, CommandRefused, DeviceError."""
    kind = sdo.read_number(0x1000)
    if kind & 0xFFFF != _CIA_402:
        raise DeviceError(
            sdo.name,
            "set up",
            f"is no drive by CiA 402: device type 0x{kind:08X}",
            "check the node ids of the cell file",
        )
    return kind


def configure(sdo: SdoNode, node: int, operation: Operation, period: float) -> DriveRecord:
    """Set a drive up that is in pre-operational. It is not enabled then, and not supervised yet.

    period: of SYNC, s. DeviceTimeout, CommandRefused (an abort of what cannot be done without), DeviceError.
    """
    kind = device_type(sdo)
    # Until the cycle begins no heartbeat is sent, and one that was missed before must be no fault again.
    _optional(lambda: sdo.write(0x1016, 1, 0, 4))
    _check_supported(sdo, operation)
    notes = []
    for number in range(1, 4):
        # A drive's other PDOs, sent on events, would only load the bus.
        if (identifier := _number(sdo, 0x1800 + number, 1)) is not None and not identifier & _PDO_OFF:
            _optional(partial(sdo.write, 0x1800 + number, 1, identifier | _PDO_OFF, 4))
    _map_pdo(sdo, 0x1400, 0x1600, RPDO1 + node, _RPDO_OBJECTS)
    _map_pdo(sdo, 0x1800, 0x1A00, TPDO1 + node, _TPDO_OBJECTS)
    sdo.write(0x6060, 0, operation, 1, signed=True)
    if operation is Operation.CYCLIC_POSITION and not _interpolate(sdo, period):
        notes.append("takes no interpolation time (60C2); check that it is the SYNC period")
    sdo.write(0x1017, 0, round(1000 * HEARTBEAT), 2)
    if not _optional(lambda: sdo.write(0x605A, 0, _QUICK_STOP_AND_STAY, 2, signed=True)):
        notes.append("its quick stop option (605A) cannot be set to 6")
    if _number(sdo, 0x605B, signed=True) == 0:
        # Where it reads 0, a drive that is switched off while it moves coasts.
        _optional(lambda: sdo.write(0x605B, 0, _SLOW_DOWN_FIRST, 2, signed=True))
    # Where it reads 0, the loss of the heartbeat is nothing to the drive.
    unmoved = _number(sdo, 0x6007, signed=True) == 0
    if unmoved and not _optional(lambda: sdo.write(0x6007, 0, _ON_LOSS_QUICK_STOP, 2, signed=True)):
        notes.append("does nothing when this program dies: its abort connection option (6007) cannot be set to 3")
    return _record(sdo, kind, tuple(notes))


def supervise(sdo: SdoNode, master: int) -> None:
    """Have the drive stop by itself HEARTBEAT_LOST s after the last heartbeat of node id ``master``, this program's."""
    sdo.write(0x1016, 1, master << 16 | round(1000 * HEARTBEAT_LOST), 4)


def leave(sdo: SdoNode) -> None:
    """Before this program ends as it should: its heartbeat is missed no more."""
    sdo.write(0x1016, 1, 0, 4)


def _map_pdo(sdo: SdoNode, parameters: int, mapping: int, identifier: int, objects: tuple[int, ...]) -> None:
    # Drives that send no PDO when they are asked to by a remote frame refuse to have that bit cleared.
    identifier |= (_number(sdo, parameters, 1) or 0) & _PDO_NOT_ON_REQUEST
    # CiA 301's order: off, emptied, filled, on.
    sdo.write(parameters, 1, identifier | _PDO_OFF, 4)
    sdo.write(mapping, 0, 0, 1)
    for number, mapped in enumerate(objects, start=1):
        sdo.write(mapping, number, mapped, 4)
    sdo.write(mapping, 0, len(objects), 1)
    sdo.write(parameters, 2, _EVERY_SYNC, 1)
    sdo.write(parameters, 1, identifier, 4)


def _check_supported(sdo: SdoNode, operation: Operation) -> None:
    supported = _number(sdo, 0x6502)
    bit, words = _SUPPORTED[operation]
    if supported is not None and not supported & bit:
        raise DeviceError(
            sdo.name, "set up", f"has no {words} mode: 6502 is 0x{supported:X}", "set the other mode under link.can"
        )


def _interpolate(sdo: SdoNode, period: float) -> bool:
    """Have targets come in each ``period`` s, told in ms or, where that is not whole, in units of 0.1 ms."""
    exponent = -3 if round(1e4 * period) % 10 == 0 else -4
    value = round(period * 10**-exponent)
    if value > 255:
        return False
    return _optional(lambda: sdo.write(0x60C2, 1, value, 1)) and _optional(
        lambda: sdo.write(0x60C2, 2, exponent, 1, signed=True)
    )


def _record(sdo: SdoNode, kind: int, notes: tuple[str, ...]) -> DriveRecord:
    lower, upper = (_number(sdo, 0x607D, number, signed=True) for number in (1, 2))
    limits = (lower, upper) if lower is not None and upper is not None and lower < upper else None
    return DriveRecord(
        device_type=kind,
        name=_text(sdo, 0x1008),
        hardware=_text(sdo, 0x1009),
        software=_text(sdo, 0x100A),
        vendor=_number(sdo, 0x1018, 1),
        product=_number(sdo, 0x1018, 2),
        revision=_number(sdo, 0x1018, 3),
        serial=_number(sdo, 0x1018, 4),
        statusword=sdo.read_number(0x6041),
        error_code=_number(sdo, 0x603F),
        following_error_window=_number(sdo, 0x6065),
        following_error_time_ms=_number(sdo, 0x6066),
        limits=limits,
        quick_stop_option=_number(sdo, 0x605A, signed=True),
        abort_option=_number(sdo, 0x6007, signed=True),
        notes=notes,
    )


def _optional(request: Callable[[], None]) -> bool:
    """Whether the drive took it; most objects of CiA 402 are optional."""
    try:
        request()
    except CommandRefused:
        return False
    return True


def _number(sdo: SdoNode, index: int, subindex: int = 0, signed: bool = False) -> int | None:
    try:
        return sdo.read_number(index, subindex, signed)
    except CommandRefused:
        return None


def _text(sdo: SdoNode, index: int) -> str | None:
    try:
        return sdo.read_text(index)
    except CommandRefused:
        return None
