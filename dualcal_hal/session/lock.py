"""Two processes never write one session."""

from __future__ import annotations

import errno
import fcntl
import getpass
import json
import os
import socket
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from dualcal_hal.clock import utc_now
from dualcal_hal.errors import UsageError

LOCK = "session.lock"


@dataclass(frozen=True)
class Owner:
    """Who holds a session's lock, or held it."""

    pid: int
    host: str
    user: str
    since: str

    def __str__(self) -> str:
        return f"process {self.pid} of {self.user} on {self.host}, since {self.since}"


class SessionLock:
    """Held by the process that writes a session, for as long as it does; a context manager.

    The lock is the system's on the open file, which ends with the process that holds it; what the file says is for
    people. The file stays: if it were removed, another process could still wait for the old one while a third locks a
    new one of the same name.

    left_by: the owner that has ended without giving the lock back, None without one.
    """

    def __init__(self, folder: Path) -> None:
        """Takes nothing yet."""
        self._folder = folder
        self._descriptor: int | None = None
        self.left_by: Owner | None = None

    def __enter__(self) -> Self:
        """UsageError if another process holds it, or if the folder cannot be written to."""
        path = self._folder / LOCK
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise UsageError(f"{self._folder}: cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self.left_by = _owner(descriptor)
            _write(descriptor, json.dumps(asdict(_this_process())).encode() + b"\n")
        except OSError as error:
            owner = _owner(descriptor)
            os.close(descriptor)
            if error.errno in (errno.EWOULDBLOCK, errno.EACCES):
                who = owner or "another process"
                raise UsageError(f"{self._folder}: is being written by {who}; wait for its end, or end it") from error
            raise UsageError(f"{path}: cannot be locked: {error.strerror}") from error
        self._descriptor = descriptor
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            with suppress(OSError):  # then the next one is told of an owner that has ended, which is true
                os.ftruncate(descriptor, 0)
            os.close(descriptor)


def _this_process() -> Owner:
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return Owner(os.getpid(), socket.gethostname(), user, utc_now().isoformat(timespec="seconds"))


def _owner(descriptor: int) -> Owner | None:
    """What the file says, None if nothing; an owner that is about to be written counts as unknown."""
    try:
        return Owner(**json.loads(os.pread(descriptor, 10_000, 0)))
    except (OSError, TypeError, ValueError, RecursionError):
        return None


def _write(descriptor: int, content: bytes) -> None:
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, content, 0)
