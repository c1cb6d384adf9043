"""``dualcal emulate``: a cell's devices behind their real wire protocols."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from types import FrameType

import typer

from backends.controller.emulator.process import FORMAT, Emulator
from backends.controller.promptness import go_before_others, spare_the_heap
from dualcal_hal.errors import DeviceError
from tools.cli.terminal import plain


@dataclass(frozen=True)
class EmulateOptions:
    """What the command line says."""

    cell: Path
    overrides: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    free_ports: bool = False
    until_stdin_closes: bool = False


def emulate(options: EmulateOptions) -> None:
    """Serve until a signal comes, or until standard input closes if that was asked for."""
    go_before_others()  # a controller has a machine of its own
    # Of all ways to tell another thread, this queue alone may be used in a signal's handler.
    ended: SimpleQueue[str | None] = SimpleQueue()

    def on_signal(number: int, frame: FrameType | None) -> None:
        ended.put(None)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, on_signal)
    if options.until_stdin_closes:
        threading.Thread(target=_await_end_of_input, args=(ended,), name="standard input", daemon=True).start()
    emulator = Emulator(
        options.cell,
        options.overrides,
        options.faults,
        free_ports=options.free_ports,
        say=_say,
        failed=ended.put,
    )
    with emulator:
        spare_the_heap()
        document = {"format": FORMAT, "pid": os.getpid(), "backends": emulator.endpoints}
        typer.echo(json.dumps(document))
        sys.stdout.flush()
        failure = ended.get()
    if failure is not None:
        raise DeviceError("emulator", "go on", failure, "see what it says above")


def _await_end_of_input(ended: SimpleQueue[str | None]) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    ended.put(None)


def _say(line: str) -> None:
    print(f"dualcal emulate: {plain(line)}", file=sys.stderr, flush=True)
