"""What a STATUS message says of an arm: whether it would move, and why not, in words."""

from __future__ import annotations

from typing import Literal

from backends.controller.tcp.codec import STATUS_UNKNOWN, Status
from dualcal_hal.findings import Finding
from dualcal_hal.robot import Mode

_MANUAL, _AUTOMATIC = 1, 2


def known(value: int) -> bool | None:
    """What one of its fields says; None where that is unknown, as is all that is not 0 or 1."""
    return bool(value) if value in (0, 1) else None


def mode(status: Status | None, unknown_is_ready: bool) -> Mode:
    """Ready only if powered, automatic, without emergency stop and error, and motion is possible.

    unknown_is_ready: whether what the controller does not tell is taken to be as it has to be.
    """
    if status is None:
        return Mode.READY if unknown_is_ready else Mode.UNKNOWN
    if known(status.e_stopped):
        return Mode.EMERGENCY_STOP
    if known(status.in_error):
        return Mode.FAULT
    if status.mode == _MANUAL:
        return Mode.MANUAL
    if known(status.drives_powered) is False or known(status.motion_possible) is False:
        return Mode.DISABLED
    told = status.mode == _AUTOMATIC and None not in map(
        known, (status.e_stopped, status.in_error, status.drives_powered, status.motion_possible)
    )
    return Mode.READY if told or unknown_is_ready else Mode.UNKNOWN


def is_enabled(status: Status) -> bool:
    """Whether the drives are on, and motion is possible where the controller says so."""
    return known(status.drives_powered) is True and known(status.motion_possible) is not False


def faults(status: Status | None) -> tuple[str, ...]:
    """The controller's error, with its code."""
    if status is None or not known(status.in_error):
        return ()
    if status.error_code == STATUS_UNKNOWN:
        return ("an error of the controller, which tells no code",)
    return (f"error {status.error_code} of the controller",)


def why_not(status: Status | None, as_mode: Mode) -> tuple[str, str]:
    """Why an arm in that mode does not move, and what to do."""
    told = ", ".join(faults(status))
    match as_mode:
        case Mode.EMERGENCY_STOP:
            return ", ".join(filter(None, ("an emergency stop is active", told))), "release it at the controller"
        case Mode.FAULT:
            return told, "clear it at the controller"
        case Mode.MANUAL:
            return "the controller is in manual mode", "switch it to automatic at the controller"
        case Mode.DISABLED if status is not None and known(status.drives_powered) is False:
            return "the drives are off", "switch them on"
        case Mode.DISABLED:
            return "motion is not possible", "see at the controller whether a hold is on and its motion program runs"
        case Mode.READY:
            return "", ""
    if status is None:
        return "the controller sends no STATUS", "see whether its state program runs"
    unknown = [name for name, value in _told(status) if value == "unknown"]
    return f"the controller does not tell: {', '.join(unknown)}", "set unknown_is_ready if it cannot"


def findings(status: Status | None, as_mode: Mode) -> list[Finding]:
    """What an operator is told of it."""
    why, advice = why_not(status, as_mode)
    found = [Finding("mode", str(as_mode) if not why else f"{as_mode}: {why}", "problem" if why else "good", advice)]
    if status is None:
        return found
    found += [Finding(name, value, _verdict(name, value)) for name, value in _told(status)]
    errors = faults(status)
    found.append(Finding("faults", ", ".join(errors) or "none", "problem" if errors else "good"))
    return found


def _told(status: Status) -> list[tuple[str, str]]:
    operating = {_MANUAL: "manual", _AUTOMATIC: "automatic"}.get(status.mode, "unknown")
    return [
        ("drives", _word(status.drives_powered, "on", "off")),
        ("emergency stop", _word(status.e_stopped, "active", "released")),
        ("error", _word(status.in_error, "yes", "no")),
        ("operating mode", operating),
        ("motion", _word(status.motion_possible, "possible", "not possible")),
    ]


def _word(value: int, yes: str, no: str) -> str:
    return {True: yes, False: no, None: "unknown"}[known(value)]


_BAD = {("drives", "off"), ("emergency stop", "active"), ("operating mode", "manual"), ("motion", "not possible")}


def _verdict(name: str, value: str) -> Literal["good", "note", "problem"]:
    if (name, value) in _BAD or (name, value) == ("error", "yes"):
        return "problem"
    return "note" if value == "unknown" else "good"
