"""An emulator started beside a run and ended with it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from dualcal_hal.errors import DeviceError

FORMAT = "dualcal.emulator/1"

STARTS_WITHIN = 60.0
"""Seconds that an emulator may take until it listens: it builds the cell's world first."""

ENDS_WITHIN = 10.0
"""Seconds that it may take to end once it is told to."""


@contextmanager
def emulator(cell_file: Path, faults: tuple[str, ...] = ()) -> Iterator[Mapping[str, Any]]:
    """Where the emulator of a cell serves each of its backends, by name; it listens on free ports while this lasts.

    DeviceError if it does not come to listen. What it has to say goes to standard error.
    """
    command = [sys.executable, "-m", "tools.cli", "emulate", str(cell_file), "--free-ports", "--until-stdin-closes"]
    command += [part for fault in faults for part in ("--fault", fault)]
    # In a session of its own: Ctrl-C is for the run alone, which stops the arms before it ends the emulator.
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True, env=_environment()
    )
    try:
        yield _endpoints(process)
    finally:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.close()
        try:
            process.wait(ENDS_WITHIN)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


def _environment() -> dict[str, str]:
    """The same, and this program's own packages wherever it was started."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    return {**os.environ, "PYTHONPATH": path}


def _endpoints(process: subprocess.Popen[bytes]) -> Mapping[str, Any]:
    """What its first line says."""
    lines: SimpleQueue[bytes] = SimpleQueue()
    assert process.stdout is not None
    threading.Thread(target=lambda out=process.stdout: lines.put(out.readline()), daemon=True).start()
    try:
        line = lines.get(timeout=STARTS_WITHIN)
    except Empty:
        process.kill()
        raise _not_started(f"it does not listen after {STARTS_WITHIN:g} s") from None
    try:
        document = json.loads(line)
        if document["format"] != FORMAT:
            raise ValueError(f"its format is {document['format']}")
        backends: Mapping[str, Any] = document["backends"]
        return backends
    except (ValueError, LookupError, TypeError) as error:
        raise _not_started(f"it ended or did not say where it listens ({error})") from error


def _not_started(why: str) -> DeviceError:
    return DeviceError("emulator", "start", why, "see what it says above")
