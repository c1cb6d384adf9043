"""How a command ends: errors become one clear message and an exit code, signals end a run in order."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import typer

from dualcal_hal.errors import DeviceError, DualcalError, Interrupted

FAULT, USAGE, INTERRUPTED = 1, 2, 130

_abort: Callable[[str], None] | None = None


@contextmanager
def signals_handled() -> Iterator[None]:
    """Handle SIGINT and SIGTERM, also where a script's background has them ignored."""
    before = {number: signal.signal(number, _on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def aborting_with(abort: Callable[[str], None]) -> Iterator[None]:
    """While a run is on, a signal asks it to end, instead of breaking in wherever the program is."""
    global _abort  # noqa: PLW0603 - signals are the process's own
    _abort = abort
    try:
        yield
    finally:
        _abort = None


def _on_signal(number: int, frame: FrameType | None) -> None:
    reason = f"interrupted by {signal.Signals(number).name}"
    if _abort is not None:
        _abort(reason)
    else:
        raise Interrupted(reason)


@contextmanager
def reported() -> Iterator[None]:
    """Turn what this program has to say into a message on standard error and an exit code."""
    try:
        yield
    except Interrupted as error:
        _end(error, INTERRUPTED)
    except DeviceError as error:
        _end(error, FAULT)
    except DualcalError as error:
        _end(error, USAGE)
    except BrokenPipeError:
        # Whoever read our output has gone; nothing is left to say to it.
        sys.stderr.close()
        raise typer.Exit(FAULT) from None


def _end(error: DualcalError, code: int) -> None:
    for line in str(error).splitlines():
        typer.echo(f"dualcal: {line}", err=True)
    for note in getattr(error, "__notes__", ()):
        typer.echo(f"dualcal: {note}", err=True)
    raise typer.Exit(code) from error
