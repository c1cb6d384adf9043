"""``dualcal run --emulate`` in a process of its own, with a motion to come across."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from dualcal_hal.clock import RealClock
from tests.cells import PAPER, SMALL
from tests.guarded_cell import UNHURRIED_MS

AMPLE = 90.0
"""Seconds within which a small run has ended, also on a machine that has much else to do."""

MARKS = {"can": "sdo-abort@motion:3~0.01"}
"""A fault that does a run nothing: the emulator tells that it is in the middle of its third motion."""


def arguments(link: str, *overrides: str) -> list[str]:
    """Of a small run of the fast cell over a link."""
    kind = "can" if link == "can" else "tcp"
    chosen = f"can.sync_period_ms={UNHURRIED_MS}" if link == "can" else f"tcp.dialect={link}"
    settings = (*SMALL, f"backends.cell.link.{chosen}", *overrides)
    set_them = [part for setting in settings for part in ("--set", setting)]
    return [str(PAPER.with_name(f"paper-{kind}-fast.yaml")), "--emulate", *set_them]


class Running:
    """A run. said: what it and its emulator have said on standard error so far."""

    def __init__(self, folder: Path, link: str, *overrides: str, speed: float = 1.0) -> None:
        self.session = folder / "session"
        command = [sys.executable, "-m", "tools.cli", "run", *arguments(link, *overrides), "--out", str(self.session)]
        command += ["--speed", str(speed)]
        mark = MARKS.get(link, "merge@motion:3")
        self.process = subprocess.Popen(
            [*command, "--fault", mark], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
        )
        self.said = ""

    def moves(self) -> float:
        """Wait until its third motion is under way; when that is, s of the clock."""
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said += line.decode()
            if told := re.search(r"fault: .* (\d+\.\d+) s of the clock", self.said):
                return float(told[1])
        raise AssertionError(self.said)

    def ends(self) -> int:
        """Its exit code, once nobody is left who could say anything: it, its emulator, the camera's process."""
        assert self.process.stderr is not None
        with contextlib.closing(self.process.stderr):
            self.said += self.process.stderr.read().decode()
        return self.process.wait(AMPLE)

    @property
    def stops(self) -> list[str]:
        """The arms that were told to stop."""
        return re.findall(r"stop: (\w+) is told to", self.said)

    @property
    def rests(self) -> dict[str, float]:
        """Since when arms rest, s of the clock."""
        return {arm: float(since) for arm, since in re.findall(r"(\w+): rests since (\d+\.\d+) s", self.said)}

    @property
    def emulator(self) -> int:
        """The process id of its emulator."""
        asked = ["emulate", str(self.session / "cell.yaml")]
        return next(pid for pid, command in processes() if command.split("\0")[3:5] == asked)


@contextmanager
def running(folder: Path, link: str, *overrides: str, speed: float = 1.0) -> Iterator[Running]:
    run = Running(folder, link, *overrides, speed=speed)
    try:
        yield run
        assert not [command for _, command in processes() if str(run.session) in command]
    finally:
        if run.process.poll() is None:
            run.process.kill()
            run.process.wait()
        assert run.process.stderr is not None
        run.process.stderr.close()


def gone_on_with(session: Path) -> dict[str, Any]:
    """The result that a session comes to."""
    command = [sys.executable, "-m", "tools.cli", "run", "--resume", str(session), "--emulate", "--json"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=AMPLE)
    assert ended.returncode == 0, ended.stderr
    result: dict[str, Any] = json.loads(ended.stdout)
    return result


def processes() -> list[tuple[int, str]]:
    """Process ids and command lines of all that run."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdecimal():
            with contextlib.suppress(OSError):
                found.append((int(folder.name), (folder / "cmdline").read_text()))
    return found


def kill(pid: int) -> float:
    """End a process as nothing can be kept from; when, s of the clock."""
    os.kill(pid, signal.SIGKILL)
    return RealClock().now()
