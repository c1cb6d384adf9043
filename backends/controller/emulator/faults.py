"""What goes wrong in an emulated controller, by name and moment."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from dualcal_hal.errors import UsageError

if TYPE_CHECKING:
    from backends.controller.emulator.arm import EmulatedArm
    from dualcal_hal.clock import Clock, Handle

FAULTS = {
    "drop": "a reply is not sent (TCP)",
    "delay": "replies wait until this ends (TCP)",
    "split": "messages come in two pieces (TCP)",
    "merge": "two messages come in one piece (TCP)",
    "corrupt": "bytes of a state are overwritten (TCP)",
    "half-open": "the connections are dead, and nobody is told (TCP)",
    "stale": "no more states come (TCP)",
    "estop": "the emergency stop is pressed",
    "mode": "the key switch is turned to manual (TCP)",
    "drive-fault": "a drive fails",
    "lost-link": "the arm's connections break, and it cannot be reached for a while",
    "following-error": "a drive's axis is blocked (CAN)",
    "emergency": "a drive sends an emergency frame (CAN)",
    "node-reboot": "a drive reboots (CAN)",
    "heartbeat-loss": "a drive's heartbeat ceases (CAN)",
    "sdo-abort": "a drive aborts the next SDO transfers (CAN)",
    "missing-pdo": "a drive's positions do not come (CAN)",
}
"""Names and what they do."""

LASTING = {"lost-link": 3.0, "delay": 1.2}
"""Seconds that a fault lasts where nothing else is asked for; others last, or strike once."""

GRAMMAR = "NAME[:ARM]@WHEN[~SECONDS]"

_INTO_MOTION = 0.1  # s after an arm began to move that a fault within the motion comes

Undo = Callable[[], None]


@dataclass(frozen=True)
class Moment:
    """When a fault comes: ``after`` so many seconds, or at the N-th ``motion`` or trajectory ``point`` of the arm."""

    kind: Literal["after", "motion", "point"]
    value: float

    def __str__(self) -> str:
        return f"{self.value:g} s" if self.kind == "after" else f"{self.kind} {self.value:g}"


@dataclass(frozen=True)
class Fault:
    """arm: which one it befalls, or None for both, or whichever it is that moves; seconds: how long it lasts, None for
    a fault that stays or strikes once."""

    name: str
    arm: str | None
    when: Moment
    seconds: float | None

    def __str__(self) -> str:
        return self.name if self.arm is None else f"{self.name} of {self.arm}"


def parse_fault(text: str, arms: Iterable[str]) -> Fault:
    """A fault as the command line has it; UsageError.

    WHEN is seconds after the begin (``12.5``), or ``motion:3`` (0.1 s into the third motion of that arm, or of any if
    none is named), or ``point:7`` (as its seventh trajectory point comes, by TCP).
    """
    what, at, rest = text.partition("@")
    name, colon, arm = what.partition(":")
    when, tilde, lasting = rest.partition("~")
    if name not in FAULTS:
        raise UsageError(f"--fault {text}: there is no fault '{name}'; there are: {', '.join(FAULTS)}")
    known = sorted(arms)
    if colon and arm not in known:
        raise UsageError(f"--fault {text}: there is no arm '{arm}', only {', '.join(known)}")
    if not at:
        raise UsageError(f"--fault {text}: say when, as {GRAMMAR}: {name}@12.5, {name}@motion:3 or {name}@point:7")
    seconds = _positive(text, lasting) if tilde else LASTING.get(name)
    return Fault(name, arm or None, _moment(text, when), seconds)


def _moment(text: str, when: str) -> Moment:
    kind, colon, number = when.partition(":")
    if not colon:
        return Moment("after", _positive(text, when))
    if kind in ("motion", "point") and number.isdecimal() and int(number) > 0:
        return Moment("motion" if kind == "motion" else "point", int(number))
    raise UsageError(f"--fault {text}: '{when}' is no moment; give seconds, motion:N or point:N")


def _positive(text: str, number: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise UsageError(f"--fault {text}: '{number}' is no time in seconds")
    return value


class FaultSchedule:
    """Has faults come at their moments. Whoever is hit has told how before :meth:`start`; any thread may call."""

    def __init__(self, faults: Iterable[Fault], clock: Clock, say: Callable[[str], None]) -> None:
        """``say`` gets a line for each fault that comes or ends, with the clock's time."""
        self._faults = list(faults)
        self._clock = clock
        self._say = say
        self._lock = threading.Lock()
        self._hit: dict[tuple[str, str], list[Callable[[], Undo | None]]] = {}
        self._counts: dict[tuple[str, str | None], int] = {}
        self._handles: list[Handle] = []
        self._came = math.inf
        self._told: set[str] = set()
        self._closed = False

    def attach(self, name: str, arm: str, begin: Callable[[], Undo | None]) -> None:
        """``begin`` has that fault befall the arm, must not wait, and returns what ends it, or None if nothing does."""
        if name not in FAULTS:
            raise ValueError(f"there is no fault {name}")
        self._hit.setdefault((name, arm), []).append(begin)

    def start(self) -> None:
        """Time begins; UsageError for a fault that nothing of this cell can have."""
        for fault in self._faults:
            if not self._of(fault):
                have = sorted({name for name, _ in self._hit})
                raise UsageError(f"--fault {fault}: this cell's controller cannot have it; it has: {', '.join(have)}")
        for fault in self._faults:
            if fault.when.kind == "after":
                self._at(self._clock.now() + fault.when.value, fault, None)

    def moved(self, arm: EmulatedArm) -> None:
        """That arm began to move."""
        for fault in self._counted("motion", arm.name):
            self._at(self._clock.now() + _INTO_MOTION, fault, arm.name)

    def pointed(self, arm: str) -> None:
        """A trajectory point of that arm has come."""
        for fault in self._counted("point", arm):
            self._come(fault, arm)

    def stopped(self, arm: str, when: float | None = None) -> None:
        """That arm was told to stop, at ``when`` by the clock if not now; the first time after a fault it is said."""
        with self._lock:
            when = self._clock.now() if when is None else when
            if when < self._came or arm in self._told:
                return
            self._told.add(arm)
        self._say(f"stop: {arm} is told to, {when:.6f} s of the clock")

    def close(self) -> None:
        """No more comes."""
        with self._lock:
            self._closed = True
            handles, self._handles = self._handles, []
        for handle in handles:
            handle.cancel()

    def _counted(self, kind: str, arm: str) -> list[Fault]:
        with self._lock:
            for of in (arm, None):
                self._counts[kind, of] = self._counts.get((kind, of), 0) + 1
            return [
                fault
                for fault in self._faults
                if fault.when.kind == kind
                and fault.arm in (arm, None)
                and self._counts[kind, fault.arm] == int(fault.when.value)
            ]

    def _at(self, when: float, fault: Fault, mover: str | None) -> None:
        with self._lock:
            if not self._closed:
                self._handles.append(self._clock.call_at(when, lambda: self._come(fault, mover)))

    def _of(self, fault: Fault, mover: str | None = None) -> list[Callable[[], Undo | None]]:
        arm = fault.arm or mover
        return [
            begin for (name, of), hit in self._hit.items() if name == fault.name and arm in (of, None) for begin in hit
        ]

    def _come(self, fault: Fault, mover: str | None) -> None:
        with self._lock:
            if self._closed:
                return
            now = self._came = self._clock.now()
            self._told = set()
        undo = [back for begin in self._of(fault, mover) if (back := begin()) is not None]
        self._say(f"fault: {fault}, at {fault.when}, {now:.6f} s of the clock")
        if fault.seconds is None or not undo:
            return

        def end() -> None:
            for each in undo:
                each()
            self._say(f"fault: {fault} has ended, {self._clock.now():.6f} s of the clock")

        with self._lock:
            if not self._closed:
                self._handles.append(self._clock.call_at(now + fault.seconds, end))
