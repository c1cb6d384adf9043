"""What an operator is told of a bus and its drives."""

from __future__ import annotations

import math
from pathlib import Path

import canopen

from backends.controller.can.axis import Axis
from backends.controller.can.configuration import HEARTBEAT, HEARTBEAT_LOST, DriveRecord
from backends.controller.can.objects import IN_FAULT, NmtState
from backends.controller.can.statistics import CycleReport
from backends.controller.can.transport import BusAddress, BusStatistics
from dualcal_hal.errors import DeviceError
from dualcal_hal.findings import Finding

_FULLY_LATE = 0.0005  # of all cycles
_STOPPING_RUN = 3


def bus_finding(address: BusAddress, statistics: BusStatistics, loss: DeviceError | None) -> Finding:
    if loss is not None:
        return Finding("CAN bus", f"{address}: {loss}", "problem", "check the adapter, its cable and the bus")
    said = f"{address} is open; {statistics.received} frames received, {statistics.sent} sent"
    if statistics.error_frames:
        return Finding(
            "CAN bus", f"{said}, {statistics.error_frames} error frames", "note", "check termination and bit rate"
        )
    return Finding("CAN bus", said)


def drive_findings(axis: Axis, record: DriveRecord) -> list[Finding]:
    """Who it is, how it is, and what it did not take."""
    found = [Finding(axis.name, _identity(record)), _state(axis)]
    angle, counts = math.degrees(axis.scale.to_angle(axis.position)), axis.position
    position = f"{angle:.3f} deg, {counts} counts; {_limits(axis, record)}"
    outside = record.limits is not None and not record.limits[0] <= counts <= record.limits[1]
    found.append(
        Finding(f"{axis.name} position", position, "problem" if outside else "good", "drive it back" if outside else "")
    )
    window = "not told" if record.following_error_window is None else f"{record.following_error_window} counts"
    heartbeat = f"each {1000 * HEARTBEAT:.0f} ms; stops {1000 * HEARTBEAT_LOST:.0f} ms after this program's last one"
    operational = axis.nmt_state == NmtState.OPERATIONAL and axis.heartbeats > 0
    found.append(
        Finding(
            f"{axis.name} supervision",
            f"heartbeat {heartbeat if operational else 'not seen yet'}; following error window {window}",
            "good" if operational else "note",
        )
    )
    return found + [Finding(axis.name, note, "note", "set it up with the maker's tool") for note in record.notes]


def eds_findings(axis: Axis, record: DriveRecord, path: str) -> list[Finding]:
    """Whether the drive is the one of its data sheet."""
    subject = f"{axis.name} data sheet"
    if not Path(path).is_file():
        return [Finding(subject, f"{path}: no such file", "problem", "correct eds in the cell file")]
    try:
        sheet = canopen.import_od(path, axis.node).device_information
    except Exception as error:  # noqa: BLE001 - a file that is none may have the parser raise anything
        return [Finding(subject, f"{path}: cannot be read: {error}", "problem", "get it from the drive's maker")]
    different = [
        f"{what} 0x{found:X}, not 0x{meant:X}"
        for what, found, meant in (
            ("vendor", record.vendor, sheet.vendor_number),
            ("product", record.product, sheet.product_number),
        )
        if found is not None and meant is not None and found != meant
    ]
    name = f"{sheet.vendor_name or 'unnamed vendor'}, {sheet.product_name or 'unnamed product'}"
    if different:
        return [
            Finding(
                subject, f"{name}; the drive is another: {', '.join(different)}", "problem", "check eds and node id"
            )
        ]
    return [Finding(subject, name)]


def cycle_findings(report: CycleReport, period: float, prompt: bool) -> list[Finding]:
    """How well the cycle keeps its time."""
    share = report.late / report.cycles if report.cycles else 0.0
    said = (
        f"{1 / period:.0f} Hz, answered in {1000 * report.median:.1f} ms (median), {1000 * report.p99:.1f} ms (p99); "
        f"begins within {1000 * report.jitter:.1f} ms (p99); {report.late} of {report.cycles} late, "
        f"at most {report.longest_late_run} in a row"
    )
    bad = report.longest_late_run >= _STOPPING_RUN or share > _FULLY_LATE
    found = [Finding("cycle", said, "note" if bad else "good", "see what else runs on this machine" if bad else "")]
    if not prompt:
        found.append(
            Finding("priority", "the cycle has no real-time priority", "note", "permit it: ulimit -r, or CAP_SYS_NICE")
        )
    return found


def _identity(record: DriveRecord) -> str:
    name = record.name or "tells no name"
    versions = [
        f"{what} {value}" for what, value in (("hardware", record.hardware), ("software", record.software)) if value
    ]
    numbers = [
        f"{what} 0x{value:X}"
        for what, value in (
            ("vendor", record.vendor),
            ("product", record.product),
            ("revision", record.revision),
            ("serial", record.serial),
        )
        if value is not None
    ]
    return ", ".join([name, *versions, *numbers])


def _state(axis: Axis) -> Finding:
    subject = f"{axis.name} state"
    if axis.emergency is not None:
        return Finding(subject, f"{axis.state}, {axis.emergency}", "problem", "see to the drive, then dualcal reset")
    if axis.state in IN_FAULT:
        kept = f", {axis.last_error}" if axis.last_error else ""
        return Finding(subject, f"{axis.state}{kept}", "problem", "see to the drive, then dualcal reset")
    return Finding(subject, axis.condition)


def _limits(axis: Axis, record: DriveRecord) -> str:
    if record.limits is None:
        return "the drive has no limits of its own"
    low, high = sorted(math.degrees(axis.scale.to_angle(count)) for count in record.limits)
    return f"the drive's own limits {low:.1f} to {high:.1f} deg"
