"""What keeps a thread on time in a busy interpreter, and on a busy machine."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

_SWITCH = 1e-4
"""s for which a computing thread keeps the interpreter while another one waits for it; 5 ms by default, and a cycle
waits for it once with each system call that it makes."""


_BEFORE_OTHERS = -10
"""Niceness of what stands for a machine of its own."""


class _SwitchInterval:
    """The interpreter's, as short as above while somebody needs it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._before = 0.0

    def shorten(self) -> None:
        with self._lock:
            self._users += 1
            if self._users == 1:
                self._before = sys.getswitchinterval()
                sys.setswitchinterval(min(self._before, _SWITCH))

    def restore(self) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                sys.setswitchinterval(self._before)


_interval = _SwitchInterval()


@contextmanager
def prompt_interpreter() -> Iterator[None]:
    """While one or more have entered, threads that compute hand the interpreter over sooner."""
    _interval.shorten()
    try:
        yield
    finally:
        _interval.restore()


@contextmanager
def prompt_thread() -> Iterator[bool]:
    """While entered, the calling thread goes before all that have no real-time priority, where that is permitted."""
    priority = getattr(os, "SCHED_FIFO", None)
    granted = False
    if priority is not None:
        with suppress(OSError):
            # Its children, processes that a library may start, are not to have it.
            os.sched_setscheduler(0, priority | os.SCHED_RESET_ON_FORK, os.sched_param(1))
            granted = True
    try:
        yield granted
    finally:
        if granted:
            with suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def go_before_others() -> None:
    """Have the calling thread, and those it starts from here on, go before the machine's other work where permitted."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _BEFORE_OTHERS)


@contextmanager
def before_others() -> Iterator[None]:
    """The same, until it is left: the interpreter's other threads wait for this one, however prompt they are."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    go_before_others()
    try:
        yield
    finally:
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, before)


def spare_the_heap() -> None:
    """Have the collector leave alone what is there by now: a search of all of it holds every thread up for 0.1 s."""
    gc.collect()
    gc.freeze()
