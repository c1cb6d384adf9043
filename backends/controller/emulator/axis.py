"""What CiA 402 makes of one axis: its state machine, its modes of operation, its ways to stop. All is in counts."""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum

from backends.controller.emulator.generator import TrajectoryGenerator

PROFILE_POSITION, CYCLIC_SYNCHRONOUS_POSITION = 1, 8

FOLLOWING_ERROR = 0x8611
"""Error code of an axis that does not follow its set points."""

_LONGEST_STEP = 0.02
"""Seconds that set points go on by at once, however late the process is."""

Values = dict[tuple[int, int], int]
"""The drive's objects, by index and subindex."""


class State(Enum):
    """CiA 402's states, by what the statusword shows of them."""

    NOT_READY = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY = 0x21
    SWITCHED_ON = 0x23
    ENABLED = 0x27
    QUICK_STOP = 0x07
    FAULT_REACTION = 0x0F
    FAULT = 0x08


class Command(Enum):
    """What a controlword asks for: the bits that count, and how they stand."""

    DISABLE_VOLTAGE = 0x02, 0x00
    QUICK_STOP = 0x06, 0x02
    SHUTDOWN = 0x07, 0x06
    SWITCH_ON = 0x0F, 0x07
    ENABLE = 0x0F, 0x0F

    @classmethod
    def of(cls, word: int) -> Command:
        return next(command for command in cls if word & command.value[0] == command.value[1])


_MOVING = (State.ENABLED, State.QUICK_STOP, State.FAULT_REACTION)

_TRANSITIONS = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY,  # 2
    (State.READY, Command.SWITCH_ON): State.SWITCHED_ON,  # 3
    (State.READY, Command.ENABLE): State.ENABLED,  # 3 and 4 at once
    (State.READY, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,  # 7
    (State.READY, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.ENABLE): State.ENABLED,  # 4
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY,  # 6
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,  # 10
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.ENABLED, Command.SWITCH_ON): State.SWITCHED_ON,  # 5
    (State.ENABLED, Command.SHUTDOWN): State.READY,  # 8
    (State.ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 9
    (State.ENABLED, Command.QUICK_STOP): State.QUICK_STOP,  # 11
    (State.QUICK_STOP, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,  # 12
    (State.QUICK_STOP, Command.ENABLE): State.ENABLED,  # 16, where the option code has it stay
}


class Axis:
    """One motor with its brake, which holds it whenever it has no current.

    state: CiA 402's. mode: of operation. actual, velocity: where the motor is, counts, and how fast, counts/s; to be
    kept up to date. powered: whether there is voltage for the motor.
    """

    def __init__(self, values: Values, on_fault: Callable[[int], None]) -> None:
        """``values`` are the drive's; ``on_fault`` is told the code of a fault before the axis stops for it."""
        self._values = values
        self._on_fault = on_fault
        self._generator = TrajectoryGenerator()
        self._now = self._synced = -math.inf
        self._blocked_at: float | None = None
        self.actual = 0
        self.velocity = 0.0
        self.powered = True
        self.state = State.NOT_READY
        self.reset()

    def reset(self) -> None:
        """Lose current and all that was asked for, as by a loss of the drive's own supply."""
        self._switch_off(State.NOT_READY)
        self.mode = 0
        self._controlword = 0
        self._begin_mode()

    def boot(self) -> None:
        """The drive has booted."""
        self.state = State.SWITCH_ON_DISABLED

    @property
    def demand(self) -> float:
        """Where the motor is to be: by set points, or where the brake holds it."""
        return self._generator.position if self._blocked_at is None else self._blocked_at

    @property
    def has_current(self) -> bool:
        """Whether the motor does anything."""
        return self.state in _MOVING

    @property
    def is_cyclic(self) -> bool:
        """Whether its set points come by SYNC and nothing else moves it."""
        return self.state is State.ENABLED and self.mode == CYCLIC_SYNCHRONOUS_POSITION

    @property
    def period(self) -> float:
        """Seconds from one set point of a cyclic mode to the next, as it was told."""
        return float(self._values[0x60C2, 1] * 10.0 ** self._values[0x60C2, 2])

    @property
    def told(self) -> tuple[int, int]:
        """The controlword and the target that came last."""
        return self._controlword, self._values[0x607A, 0]

    # What a master reads

    def statusword(self) -> int:
        """6041, as far as it is the axis's."""
        word = self.state.value | 0x0010 * self.powered | 0x0800 * self._limited
        if self.state is State.QUICK_STOP:
            word |= 0x0400 * (self._generator.velocity == 0.0)
        elif self.state is State.ENABLED:
            word |= 0x2000 * (self._off_since is not None)
            if self.mode == PROFILE_POSITION:
                word |= 0x0400 * self._reached | 0x1000 * self._acknowledged
            elif self.mode == CYCLIC_SYNCHRONOUS_POSITION:
                word |= 0x1000
        return word

    def set_point(self) -> int:
        """6062, where it is to be now."""
        return round(self._generator.position)

    def following_error(self) -> int:
        """60F4, by how much it is not there."""
        return round(self._generator.position) - self.actual

    # What a master asks for

    def obey(self, word: int) -> None:
        """A controlword, 6040."""
        before, self._controlword = self._controlword, word
        if self.state is State.FAULT and word & ~before & 0x80:
            self._switch_off(State.SWITCH_ON_DISABLED)
            self._on_fault(0)
            return
        command = Command.of(word)
        state = _TRANSITIONS.get((self.state, command))
        if self.state is State.QUICK_STOP and command is Command.ENABLE and self._values[0x605A, 0] not in (5, 6):
            state = None
        if self.state is State.SWITCH_ON_DISABLED and not self.powered:
            state = None
        if state is State.ENABLED:
            self._enable()
        elif state is State.QUICK_STOP:
            self.quick_stop()
        elif state is not None:
            self._switch_off(state)
        elif self.state is State.ENABLED and self.mode == PROFILE_POSITION:
            self._hear_set_point(word, before)

    def operate(self, mode: int) -> None:
        """A mode of operation that it has, 6060."""
        if mode != self.mode:
            self.mode = mode
            self._begin_mode()

    def quick_stop(self) -> None:
        """Stop as 605A has it, if it is enabled."""
        if self.state is State.ENABLED:
            if self._values[0x605A, 0] == 0:
                self._switch_off(State.SWITCH_ON_DISABLED)
            else:
                self.state = State.QUICK_STOP

    def disable(self) -> None:
        """Take the current off; the brake holds."""
        if self.has_current:
            self._switch_off(State.SWITCH_ON_DISABLED)

    # What happens with time

    def on_sync(self, now: float) -> None:
        """Take the set point of a cyclic mode."""
        if self.is_cyclic:
            self._generator.follow(self._within_limits(self._values[0x607A, 0]), now - self._synced)
        self._synced = now

    def advance(self, now: float) -> None:
        """Go on with a profile or with braking, and look after the following error."""
        dt, self._now = min(now - self._now, _LONGEST_STEP), now
        if self.state is State.ENABLED:
            if self.mode == PROFILE_POSITION:
                self._go_on_with_profile(dt)
            elif now - self._synced > 2 * self.period:  # it has come to rest at its last set point
                self._generator.rest(self._generator.position)
        elif self.state is State.FAULT_REACTION:
            if self._brake(0x6085, dt):
                self._switch_off(State.FAULT)
        elif self.state is State.QUICK_STOP:
            option = self._values[0x605A, 0]
            if self._brake(0x6085 if option in (2, 6) else 0x6084, dt) and option in (1, 2):
                self._switch_off(State.SWITCH_ON_DISABLED)
        self._watch_following_error(now)

    # What is done to it

    def fail(self, code: int) -> None:
        """Have a fault: stop, and be off until it is acknowledged. Only the first one counts."""
        if self.state in (State.FAULT, State.FAULT_REACTION, State.NOT_READY):
            return
        self._on_fault(code)
        if self.has_current:
            self.state = State.FAULT_REACTION
        else:
            self._switch_off(State.FAULT)

    def block(self) -> None:
        """Have the motor not turn any more, however much current it gets."""
        self._blocked_at = float(self.actual)

    def free(self) -> None:
        """Have it turn again."""
        self._blocked_at = None

    def cut_power(self) -> None:
        """The emergency stop takes the motor's voltage: the brake holds it."""
        self.powered = False
        if self.state is State.FAULT_REACTION:
            self._switch_off(State.FAULT)
        elif self.state not in (State.NOT_READY, State.FAULT):
            self._switch_off(State.SWITCH_ON_DISABLED)

    def restore_power(self) -> None:
        """There is voltage again; the axis stays off."""
        self.powered = True

    def hold(self) -> None:
        """Have the brake hold the motor where it is."""
        self._generator.rest(self.actual)

    # How it does it

    def _enable(self) -> None:
        if self.state is not State.QUICK_STOP:
            self._rest_here()
        self.state = State.ENABLED
        self._begin_mode()

    def _switch_off(self, state: State) -> None:
        if self.has_current:
            self._rest_here()
        self.state = state
        self._off_since: float | None = None
        self._limited = False

    def _rest_here(self) -> None:
        """Where the motor is; the noise of an encoder is no reason to move."""
        near = abs(self._generator.position - self.actual) <= self._values[0x6067, 0]
        self._generator.rest(self._generator.position if near else self.actual)

    def _brake(self, deceleration: int, dt: float) -> bool:
        """Slow down by an object's deceleration; whether the motor stands, which comes after its set points."""
        stands = self._generator.brake(self._values[deceleration, 0], dt)
        return stands and abs(self.velocity) <= 10 * self._values[0x6067, 0]

    def _begin_mode(self) -> None:
        self._target: float | None = None
        self._pending: float | None = None
        self._acknowledged = self._reached = False

    def _hear_set_point(self, word: int, before: int) -> None:
        """Profile position: a new set point is a rising edge; it is acknowledged until that is taken back."""
        if word & ~before & 0x10 and not self._acknowledged:
            goal = self._values[0x607A, 0]
            if word & 0x40:
                goal += round(self._generator.position if self._target is None else self._target)
            target = self._within_limits(goal)
            if self._target is None or self._reached or word & 0x20:
                self._target, self._pending = target, None
            else:
                self._pending = target
            self._acknowledged, self._reached = True, False
        elif not word & 0x10:
            self._acknowledged = self._pending is not None

    def _go_on_with_profile(self, dt: float) -> None:
        speed, acceleration, deceleration = (self._values[index, 0] for index in (0x6081, 0x6083, 0x6084))
        if self._target is None or self._controlword & 0x100:  # halt
            stands = self._generator.brake(deceleration, dt)
            self._reached = stands and self._target is not None
            return
        arrived = self._generator.approach(self._target, speed, acceleration, deceleration, dt)
        if arrived and self._pending is not None:
            self._target, self._pending = self._pending, None
            self._acknowledged = bool(self._controlword & 0x10)
            return
        self._reached = arrived and abs(self.actual - self._target) <= self._values[0x6067, 0]

    def _within_limits(self, target: int) -> float:
        """Software limits hold a target back, and the statusword says so."""
        lowest, highest = self._values[0x607D, 1], self._values[0x607D, 2]
        self._limited = not lowest <= target <= highest
        return max(lowest, min(highest, target))

    def _watch_following_error(self, now: float) -> None:
        # One that cannot turn at all need not be far off: its current is at the limit.
        window = self._values[0x6065 if self._blocked_at is None else 0x6067, 0]
        off = abs(self._generator.position - self.actual) > window and window != 0xFFFFFFFF
        if self.state not in (State.ENABLED, State.QUICK_STOP) or not off:
            self._off_since = None
        elif self._off_since is None:
            self._off_since = now
        elif now - self._off_since > self._values[0x6066, 0] / 1000:
            self.fail(FOLLOWING_ERROR)
