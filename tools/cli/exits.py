"""How a command ends: errors become one clear message and an exit code, signals end a run in order."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from types import FrameType

from dualcal_hal.errors import DeviceError, DualcalError, Interrupted

FAULT, USAGE, INTERRUPTED = 1, 2, 130

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)

_requests: SimpleQueue[str | None] | None = None
_ending = False


def handle_signals() -> None:
    """Let the first signal end the program in order, also where a script's background has it ignored.

    Later signals find the end under way and change nothing: arms are being stopped and data written.
    """
    for number in _SIGNALS:
        signal.signal(number, _on_signal)


def ignore_signals() -> None:
    """From here on nothing but its own end ends the program; it has none of the defaults while it shuts down."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _on_signal(number: int, frame: FrameType | None) -> None:
    global _ending  # noqa: PLW0603 - signals are the process's own
    if _ending:
        return
    _ending = True
    ignore_signals()
    reason = f"interrupted by {signal.Signals(number).name}"
    if _requests is not None:
        # Of all ways to tell another thread, this one alone may be used where a handler may have interrupted itself.
        _requests.put(reason)
    else:
        raise Interrupted(reason)


@contextmanager
def aborting_with(abort: Callable[[str], None]) -> Iterator[None]:
    """While a run is on, a signal asks it to end, instead of breaking in wherever the program is."""
    global _requests  # noqa: PLW0603 - signals are the process's own
    requests: SimpleQueue[str | None] = SimpleQueue()

    def pass_on() -> None:
        while (reason := requests.get()) is not None:
            abort(reason)

    thread = threading.Thread(target=pass_on, name="signals", daemon=True)
    thread.start()
    _requests = requests
    try:
        yield
    finally:
        _requests = None
        requests.put(None)
        thread.join()


@contextmanager
def ended_in_order() -> Iterator[None]:
    """Turn what ends a command into a message on standard error and an exit code, never a traceback."""
    try:
        yield
        sys.stdout.flush()
    except Interrupted as error:
        _end(error, str(error), INTERRUPTED)
    except DeviceError as error:
        _end(error, str(error), FAULT)
    except DualcalError as error:
        _end(error, str(error), USAGE)
    except BrokenPipeError as error:
        # Whoever read our output has gone; nothing is left to say to it.
        _silence_output()
        raise SystemExit(FAULT) from error
    except OSError as error:
        _silence_output()
        what = error.strerror or str(error)
        _end(error, f"{error.filename}: {what}" if error.filename else what, FAULT)


def _silence_output() -> None:
    """What is still buffered cannot be written; the interpreter must not try again at its end."""
    with suppress(io.UnsupportedOperation):  # not a file: there is nothing to be tried
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _end(error: Exception, message: str, code: int) -> None:
    for line in (*message.splitlines(), *getattr(error, "__notes__", ())):
        print(f"dualcal: {line}", file=sys.stderr)
    raise SystemExit(code) from error
