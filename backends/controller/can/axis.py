"""One joint's drive, as the cycle and the bus's reader see it while they run."""

from __future__ import annotations

from collections import deque

from backends.controller.can.drive import Goal
from backends.controller.can.objects import (
    VOLTAGE,
    Control,
    Emergency,
    Feedback,
    NmtState,
    Scale,
    State,
    state_of,
    unpack_heartbeat,
)


class Axis:
    """A drive's last words, written by the reader, and what it is told next, written by the cycle."""

    def __init__(self, joint: int, node: int, scale: Scale) -> None:
        self.joint = joint
        self.node = node
        self.scale = scale
        self.name = f"joint {joint} (node {node})"
        # The reader's: each is replaced as a whole, so that the cycle never sees half of one.
        self.feedback: Feedback | None = None
        self.arrival = 0.0
        self.answers = 0
        self.heartbeats = 0
        self.nmt_state: int = NmtState.OPERATIONAL
        self.booted = False
        self.emergencies: deque[Emergency] = deque(maxlen=32)
        self.malformed = ""
        # The cycle's.
        self.goal = Goal.OFF
        self.controlword: int = Control.DISABLE_VOLTAGE
        self.bits = 0
        self.target = 0
        self.emergency: Emergency | None = None
        """The last one that the drive has not taken back."""
        self.last_error = ""
        """The error code that it kept when it was set up, in words."""

    @property
    def statusword(self) -> int:
        return self.feedback.statusword if self.feedback is not None else 0

    @property
    def state(self) -> State:
        return state_of(self.statusword)

    @property
    def condition(self) -> str:
        """Its state in words, and why it may be in it."""
        return str(self.state) if self.has_voltage else f"{self.state}, without voltage for the motor (emergency stop?)"

    @property
    def has_voltage(self) -> bool:
        """Whether the motor could get any current; a drive in operation has it, whatever it says."""
        return bool(self.statusword & VOLTAGE) or self.state is State.OPERATION_ENABLED

    @property
    def position(self) -> int:
        """Counts."""
        return self.feedback.position if self.feedback is not None else 0

    def take_feedback(self, data: bytes, arrival: float) -> None:
        try:
            self.feedback = Feedback.unpack(data)
        except ValueError as error:
            self.malformed = str(error)
            return
        self.arrival = arrival
        self.answers += 1

    def take_heartbeat(self, data: bytes) -> None:
        try:
            state = unpack_heartbeat(data)
        except ValueError as error:
            self.malformed = str(error)
            return
        if state == NmtState.BOOT_UP:
            self.booted = True
        self.nmt_state = state
        self.heartbeats += 1

    def take_emergency(self, data: bytes) -> None:
        try:
            self.emergencies.append(Emergency.unpack(data))
        except ValueError as error:
            self.malformed = str(error)
