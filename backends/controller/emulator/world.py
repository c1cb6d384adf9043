"""The simulated world of a cell in real time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from backends.controller.emulator.arm import EmulatedArm
from backends.controller.emulator.servo import TICK
from backends.simulator.stepper import stepper_class
from backends.simulator.truth import Truth
from dualcal_hal.clock import RealClock
from dualcal_hal.session.distances import DISTANCES, Distances

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig, SimulationConfig

_ASLEEP = 0.25  # s from one look to the next while nothing moves


class EmulatedWorld:
    """A cell as it truly is, on the machine's clock; a thread of its own moves it, and both arms begin at home.

    begin: the clock's time at which its own time, :meth:`now`, is 0. lock: what everything in it happens under.
    """

    def __init__(self, cell: CellConfig, simulation: SimulationConfig) -> None:
        self.clock = RealClock()
        self.lock = threading.RLock()
        self.seed, self.noise = simulation.seed, simulation.noise
        self.time_skew, self.backlash = simulation.errors.time_skew.delay_s, simulation.errors.backlash.gap
        self.truth = Truth(cell, simulation)
        self.stepper = stepper_class(simulation.stepper)(cell, self.truth)
        self.begin = self.clock.now()
        self.arms = {name: EmulatedArm(name, robot, self) for name, robot in sorted(cell.robots.items())}
        self._contact_listeners: list[Callable[[str], None]] = []
        self._told_of_contact = False
        self._closed = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name="emulated world", daemon=True)
        self._thread.start()

    def now(self) -> float:
        """Seconds since it began."""
        return self.clock.now() - self.begin

    def wake(self) -> None:
        """There is something to move."""
        self._wake.set()

    def on_contact(self, listener: Callable[[str], None]) -> None:
        """Tell ``listener`` once when parts touch, and which; on the world's thread, or at once."""
        self._contact_listeners.append(listener)
        self._wake.set()

    def distances(self) -> Distances:
        """How near the arms came to each other while they moved; empty without physics."""
        with self.lock:
            document = self.stepper.documents(self.now()).get(DISTANCES)
        return Distances([], [], [], []) if document is None else Distances.from_document(document)

    def close(self) -> None:
        """End its time; any number of times."""
        with self.lock:
            if self._closed:
                return
            self._closed = True
        self._wake.set()
        self._thread.join()
        self.stepper.close()

    def _run(self) -> None:
        while True:
            self._wake.clear()
            with self.lock:
                if self._closed:
                    return
                now = self.now()
                moving = [arm.advance(now) for arm in self.arms.values()]
                contact = self.stepper.fault
            if contact is not None and not self._told_of_contact:
                self._told_of_contact = bool(self._contact_listeners)
                for listener in self._contact_listeners:
                    listener(contact)
            self.clock.wait(self._wake, self.clock.now() + (TICK if any(moving) else _ASLEEP))
