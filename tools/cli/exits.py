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

from dualcal_hal.errors import DeviceError, DualcalError, Interrupted, LogDamaged, LogNotWritten

FAULT, USAGE, INTERRUPTED = 1, 2, 130

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class _Break(BaseException):
    """A signal outside a run: no ``except Exception`` on the way may take it for its own."""


class DeferredSignals:
    """Signals while devices are open: they ask the run to end and break into nothing, however many come."""

    def __init__(self) -> None:
        self._requests: SimpleQueue[str | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._reason: str | None = None
        self._abort: Callable[[str], None] | None = None
        self._thread = threading.Thread(target=self._serve, name="signals", daemon=True)
        self._thread.start()

    def request(self, reason: str) -> None:
        """Called by the handler: of all ways to tell another thread, this queue alone may be used there."""
        self._requests.put(reason)

    def pass_on_to(self, abort: Callable[[str], None]) -> None:
        """Hand requests to ``abort``, one that has come already at once."""
        with self._lock:
            self._abort = abort
            if self._reason is not None:
                abort(self._reason)

    def close(self) -> None:
        """Hand out nothing any more."""
        self._requests.put(None)
        self._thread.join()

    def _serve(self) -> None:
        while (reason := self._requests.get()) is not None:
            with self._lock:
                self._reason = self._reason or reason
                if self._abort is not None:
                    self._abort(self._reason)


_deferred: DeferredSignals | None = None
_received: str | None = None


def handle_signals() -> None:
    """Let signals end the program in order, also where a script's background has them ignored."""
    for number in _SIGNALS:
        signal.signal(number, _on_signal)


def ignore_signals() -> None:
    """From here on nothing but its own end ends the program; it has none of the defaults while it shuts down."""
    for number in _SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _on_signal(number: int, frame: FrameType | None) -> None:
    global _received  # noqa: PLW0603 - signals are the process's own
    _received = _received or f"interrupted by {signal.Signals(number).name}"
    if _deferred is not None:
        _deferred.request(_received)
    else:
        raise _Break


@contextmanager
def signals_deferred() -> Iterator[DeferredSignals]:
    """While this lasts signals break in nowhere; at its end Interrupted is raised if one came, and nothing else was."""
    global _deferred  # noqa: PLW0603 - signals are the process's own
    signals = DeferredSignals()
    _deferred = signals
    try:
        _raise_if_received()
        yield signals
        _raise_if_received()
    finally:
        if _received is not None:
            # The end has begun: another signal must not break into the message that says what was stopped.
            ignore_signals()
        _deferred = None
        signals.close()


def _raise_if_received() -> None:
    if _received is not None:
        raise Interrupted(_received)


@contextmanager
def ended_in_order() -> Iterator[None]:
    """Turn what ends a command into a message on standard error and an exit code, never a traceback."""
    try:
        yield
        # A signal may have fallen where Python lets no exception out, such as a weak reference's callback.
        _raise_if_received()
        sys.stdout.flush()
    except _Break as error:
        _end(error, _received or "", INTERRUPTED)
    except (DeviceError, LogDamaged, LogNotWritten) as error:
        _end(error, str(error), FAULT)
    except DualcalError as error:
        _end(error, str(error), USAGE)
    except BrokenPipeError as error:
        # Whoever read our output has gone; nothing is left to say to it.
        _silence_output()
        raise SystemExit(FAULT if _received is None else INTERRUPTED) from error
    except OSError as error:
        _silence_output()
        what = error.strerror or str(error)
        _end(error, f"{error.filename}: {what}" if error.filename else what, FAULT)


def _silence_output() -> None:
    """What is still buffered cannot be written; the interpreter must not try again at its end."""
    with suppress(io.UnsupportedOperation):  # not a file: there is nothing to be tried
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _end(error: BaseException, message: str, code: int) -> None:
    from tools.cli.terminal import plain

    with suppress(OSError, ValueError):  # where nobody reads it the exit code still tells
        for line in "\n".join((message, *getattr(error, "__notes__", ()))).split("\n"):
            print(f"dualcal: {plain(line)}", file=sys.stderr)
    raise SystemExit(code if _received is None else INTERRUPTED) from error
