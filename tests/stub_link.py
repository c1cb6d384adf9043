"""A controller without wires, for tests of what is above them: it follows courses exactly and reports all the time."""

from __future__ import annotations

import threading

import numpy as np

from backends.controller.link import ArmLink, ArmReport, Transfer
from dualcal_hal.errors import DeviceTimeout, MotionStopped
from dualcal_hal.robot import Mode

PERIOD = 0.005


class StubLink(ArmLink):
    """What a test may change while it runs: mode, faults, silent, tells_motion, obeys_stop, begins_late (s), moves."""

    def __init__(self, arm, at, clock):
        super().__init__(arm, len(at))
        self.clock = clock
        self.at = np.array(at, dtype=float)
        self.mode, self.faults = Mode.READY, ()
        self.silent = False
        self.tells_motion = self.tells_velocity = True
        self.obeys_stop = self.moves = self.takes_all = True
        self.begins_late = 0.0
        self.stops, self.courses = [], []
        self.transfer = None
        self._course = None
        self._newest = None
        self._sequence = 0
        self._arrived = threading.Condition()
        self._reports, self._failures = [], []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def open(self, deadline):
        """It is open from the beginning."""

    def close(self):
        self._closing.set()
        self._thread.join()

    def report_after(self, time, deadline):
        with self._arrived:
            while self._newest is None or self._newest.time <= time:
                if not self._arrived.wait(max(0.0, deadline - self.clock.now())) and self.clock.now() >= deadline:
                    raise DeviceTimeout(self.arm, "read", "no state")
            return self._newest

    def subscribe(self, function):
        self._reports.append(function)
        return lambda: self._reports.remove(function)

    def on_failure(self, function):
        self._failures.append(function)
        return lambda: self._failures.remove(function)

    def fail(self, error):
        for function in tuple(self._failures):
            function(error)

    def send(self, course):
        self.courses.append(course)
        self._course = course, self.clock.now() + self.begins_late
        self.transfer = Transfer()
        if self.takes_all:
            self.transfer.completed()
        return self.transfer

    def stop(self, reason):
        self.stops.append(reason)
        if self.transfer is not None:
            self.transfer.failed(MotionStopped(self.arm, "move", f"stopped: {reason}"))
        if self.obeys_stop:
            self._course = None

    def enable(self, timeout):
        self.mode = Mode.READY

    def disable(self, timeout):
        self.mode = Mode.DISABLED

    def reset_fault(self, timeout):
        self.faults = ()

    def findings(self):
        return []

    def _run(self):
        while not self._closing.wait(PERIOD):
            if not self.silent:
                self._report()

    def _report(self):
        course, now, moving = self._course, self.clock.now(), False
        velocity = np.zeros(self.joints)
        if course is not None and self.moves:
            t = now - course[1]
            moving = 0 <= t <= course[0].duration
            self.at, velocity = course[0].sample(max(0.0, t))
        self._sequence += 1
        report = ArmReport(
            tuple(self.at.tolist()),
            tuple(velocity.tolist()) if self.tells_velocity else None,
            self.mode,
            self.faults,
            moving if self.tells_motion else None,
            now,
            self._sequence,
        )
        with self._arrived:
            self._newest = report
            self._arrived.notify_all()
        for function in tuple(self._reports):
            function(report)
