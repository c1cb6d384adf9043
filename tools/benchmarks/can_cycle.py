"""Does the cycle keep its time? Two arms of six drives each, at two buses by socketcand, in another process.

python -m tools.benchmarks.can_cycle --minutes 10 [--period-ms 10] [--busy 1]

--busy: threads that compute beside the cycles, in the same interpreter.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np

from backends.controller import can
from backends.controller.can.session import CanArmLink
from backends.controller.can.statistics import CycleReport
from backends.controller.course import Course
from backends.controller.emulator.arm import Reading
from backends.controller.emulator.drives import DriveBuses
from backends.controller.joint_map import JointMap
from backends.controller.options import CanLink
from dualcal_hal.clock import Clock, RealClock
from dualcal_hal.errors import DeviceError
from dualcal_hal.robot import JointPath
from dualcal_hal.transforms import Array

ARMS = ("left", "right")
JOINTS = 6
COUNTS_PER_RAD = 1e5
LATE_SHARE, LATE_RUN = 0.0005, 3
"""Late cycles: at most this share of them, and never so many in a row."""

_SPEED, _ACCELERATION, _SWING = 0.5, 2.0, 0.4  # rad/s, rad/s^2, rad


class _Motors:
    """Motors that are at once where they are told to be."""

    joints = JOINTS

    def __init__(self) -> None:
        self.speed, self.acceleration = np.full(JOINTS, 2.0), np.full(JOINTS, 8.0)
        self._q = np.zeros(JOINTS)

    def read(self) -> Reading:
        return Reading(self._q, np.zeros(JOINTS), 0.0)

    def command(self, q: Array, period: float) -> None:
        self._q = q


def options(period_ms: float, endpoints: dict[str, Any] | None = None) -> CanLink:
    drives = [{"node": node, "counts_per_rad": COUNTS_PER_RAD} for node in range(1, JOINTS + 1)]
    arms = {} if endpoints is None else endpoints["arms"]
    return CanLink.model_validate(
        {
            "interface": "socketcand",
            "sync_period_ms": period_ms,
            "arms": {
                arm: {**arms.get(arm, {"channel": f"127.0.0.1:1/{arm}"}), "drives": tuple(drives)} for arm in ARMS
            },
        }
    )


def serve(period_ms: float) -> None:
    """Emulated drives, until standard input is closed."""
    # Real ones are hardware, which waits for nobody; the threads begun from here on have it, too.
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    buses = DriveBuses(options(period_ms), {arm: _Motors() for arm in ARMS}, RealClock())
    print(json.dumps(buses.endpoints), flush=True)
    sys.stdin.read()
    buses.close()


@contextmanager
def drives_elsewhere(period_ms: float) -> Iterator[dict[str, Any]]:
    """Their endpoints."""
    command = [sys.executable, "-m", "tools.benchmarks.can_cycle", "--serve", "--period-ms", str(period_ms)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdin is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.stdin.close()
            try:
                process.wait(5.0)
            except subprocess.TimeoutExpired:
                process.send_signal(signal.SIGKILL)


def swing(link: CanArmLink, clock: Clock, ending: threading.Event) -> list[str]:
    """Move to and fro until it is ended; what went wrong meanwhile."""
    wrong: list[str] = []
    sign = 1.0
    while not ending.is_set():
        now = clock.now()
        try:
            report = link.report_after(now, now + 1.0)
            if report.in_motion:
                continue
            there = tuple(sign * _SWING * (joint + 1) / JOINTS for joint in range(JOINTS))
            path = JointPath((there,), (_SPEED,) * JOINTS, (_ACCELERATION,) * JOINTS)
            transfer = link.send(Course(np.array(report.positions), path, JointMap(None, JOINTS)))
        except DeviceError as error:
            wrong.append(str(error))
            clock.wait(ending, clock.now() + 1.0)
            continue
        told = threading.Event()
        transfer.on_end(told.set)
        clock.wait(told, clock.now() + 10.0)
        if transfer.error is not None:
            wrong.append(str(transfer.error))
        sign = -sign
    return wrong


def compute(ending: threading.Event) -> None:
    """What an interpreter may be busy with: small steps, and now and then a long one that nobody can interrupt."""
    numbers = np.random.default_rng(1).random(2_000)
    while not ending.is_set():
        for _ in range(2_000):
            sum(i * i for i in range(200))
        sorted(numbers.tolist())


def show(arm: str, report: CycleReport, period_ms: float) -> bool:
    share = report.late / max(1, report.cycles)
    print(
        f"{arm:6s} {report.cycles} cycles of {period_ms:g} ms: late {report.late} ({100 * share:.3f} %), "
        f"longest run {report.longest_late_run} ({report.longest_late_run_in_motion} in motion); "
        f"answered after {1000 * report.median:.2f} ms median, {1000 * report.p99:.2f} ms p99; "
        f"begins {1000 * report.jitter:.2f} ms late (p99); largest step {report.largest_step:.4f} of v_max * dt"
    )
    return share <= LATE_SHARE and report.longest_late_run < LATE_RUN and report.largest_step <= 1.0 + 1e-6


def run(minutes: float, period_ms: float, busy: int) -> bool:
    clock, ending = RealClock(), threading.Event()
    with ExitStack() as stack:
        endpoints = stack.enter_context(drives_elsewhere(period_ms))
        links = can.links(options(period_ms, endpoints), dict.fromkeys(ARMS, JOINTS), clock)
        for link in links.values():
            link.open(clock.now() + 20.0)
            stack.callback(link.close)
            link.enable(5.0)
        threads = [threading.Thread(target=compute, args=(ending,)) for _ in range(busy)]
        wrong: list[str] = []
        threads += [
            threading.Thread(target=lambda link=link: wrong.extend(swing(link, clock, ending)))
            for link in links.values()
        ]
        wall, processor = time.perf_counter(), time.process_time()
        for thread in threads:
            thread.start()
        clock.wait(threading.Event(), clock.now() + 60 * minutes)
        ending.set()
        share = (time.process_time() - processor) / (time.perf_counter() - wall)
        for thread in threads:
            thread.join()
        assert all(isinstance(link, CanArmLink) for link in links.values())
        good = [show(arm, link.cycle_report(), period_ms) for arm, link in links.items()]  # type: ignore[attr-defined]
    children = os.times()
    print(
        f"processor: {100 * share:.0f} % of one core here, {100 * children.children_user / (60 * minutes):.0f} % + "
        f"{100 * children.children_system / (60 * minutes):.0f} % (system) in the drives' process"
    )
    for text in wrong:
        print("wrong:", text)
    return all(good) and not wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--period-ms", type=float, default=10.0)
    parser.add_argument("--busy", type=int, default=0)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        serve(arguments.period_ms)
    else:
        sys.exit(0 if run(arguments.minutes, arguments.period_ms, arguments.busy) else 1)


if __name__ == "__main__":
    main()
