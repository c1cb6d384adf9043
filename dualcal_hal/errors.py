"""The one tree of errors.

    DualcalError
    ├── CellFileError (ValueError)          the cell file, or a value given with --set
    ├── FormatError (ValueError)            a public file (captures, result, session) that cannot be read
    ├── UsageError (ValueError)             a call that cannot be carried out as asked
    │   └── NotConfirmed                    the operator does not want what was shown
    ├── DegenerateCaptures (ValueError)     captures that do not determine what is sought
    ├── NoPlan (RuntimeError)               no poses or no way that keep all conditions
    ├── LogMissing (LookupError)            a folder or file that holds no log
    ├── LogDamaged (ValueError)             a log whose bytes are not what was written
    ├── LogTooNew (ValueError)              a log of a later version
    ├── LogNotWritten (OSError)             a log that the disk does not take
    ├── Interrupted                         SIGINT, SIGTERM or an abort by the operator
    └── DeviceError                         names the device, what was attempted and what to do
        ├── NotOpen (RuntimeError)
        ├── UnknownDevice (LookupError)
        ├── DeviceTimeout (TimeoutError)
        ├── LinkLost (ConnectionError)
        ├── CommandRefused (ValueError)     by the guard or the device, before anything moved
        ├── MotionStopped (RuntimeError)
        ├── MotionFailed (RuntimeError)
        │   └── Contact                     parts touch that should not
        ├── ArmMoved (RuntimeError)
        ├── StopFailed (RuntimeError)
        ├── FrameRefused (ValueError)       an image that came and must not be used
        ├── ReplayMismatch (ValueError)     a command that is not the recorded one
        ├── FrameMissing (LookupError)      an image that the recording should have
        └── LogEnded (EOFError)             a command after the end of the recording

Leaves also inherit the fitting builtin. No third party's exception crosses a backend's border.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self


class DualcalError(Exception):
    """Anything this program has to say about why it does not go on."""


@dataclass(frozen=True)
class Problem:
    """One thing wrong in a file: where (``cell.yaml:6:5``, ``--set a.b``, a capture's id) and what."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}" if self.where else self.what


class _WithProblems(DualcalError):
    def __init__(self, problems: Sequence[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("\n".join(str(problem) for problem in self.problems))


class CellFileError(_WithProblems, ValueError):
    """The cell file is not usable; ``problems`` holds all that was found, in the file's order."""


class FormatError(_WithProblems, ValueError):
    """A captures, result or session file is not usable; ``problems`` holds all that was found."""


class UsageError(DualcalError, ValueError):
    """The call cannot be carried out as it was asked."""


class NotConfirmed(UsageError):
    """The operator was asked, and did not agree."""


class DegenerateCaptures(DualcalError, ValueError):
    """The captures do not determine what is sought; the message says which condition failed."""


class NoPlan(DualcalError, RuntimeError):
    """No poses or no way found; the message says which condition failed how often."""


class LogMissing(DualcalError, LookupError):
    """There is no log where one was looked for."""


class LogDamaged(DualcalError, ValueError):
    """A log is not as it was written; ``file`` says which, ``offset`` at which byte, None where that is not known."""

    def __init__(self, file: str, offset: int | None, why: str) -> None:
        self.file = file
        self.offset = offset
        self.why = why
        super().__init__(f"{file}: {why}" if offset is None else f"{file}: at byte {offset}: {why}")


class LogTooNew(DualcalError, ValueError):
    """The log was written by a later version."""


class LogNotWritten(DualcalError, OSError):
    """The log cannot be written, so the run must not go on as if it were."""


class Interrupted(DualcalError):
    """The operator, SIGINT or SIGTERM asked for an end."""


class DeviceError(DualcalError):
    """A device did not do what it was asked."""

    def __init__(self, device: str, attempted: str, why: str, advice: str = "") -> None:
        self.device = device
        self.attempted = attempted
        self.why = why
        self.advice = advice
        super().__init__(f"{device}: {attempted}: {why}" + (f"; {advice}" if advice else ""))


class NotOpen(DeviceError, RuntimeError):
    """The device was used before it was opened or after it was closed."""


class UnknownDevice(DeviceError, LookupError):
    """The backend has no device of that name."""


class DeviceTimeout(DeviceError, TimeoutError):
    """The device did not answer or finish in time."""


class LinkLost(DeviceError, ConnectionError):
    """The connection to the device is gone."""


class CommandRefused(DeviceError, ValueError):
    """A command that must not be sent was not sent."""


class MotionStopped(DeviceError, RuntimeError):
    """The motion was ended by a stop before it arrived."""


class MotionFailed(DeviceError, RuntimeError):
    """The motion was ended by a fault before it arrived."""


class Contact(MotionFailed):
    """Parts touch that should not; the message names both."""


class ArmMoved(DeviceError, RuntimeError):
    """An arm moved while a picture was taken; the capture is refused."""


class StopFailed(DeviceError, RuntimeError):
    """An arm was told to stop and did not confirm that it stands."""


class FrameRefused(DeviceError, ValueError):
    """An image that came is damaged, another camera's or of another size, and must not be used."""


class ReplayMismatch(DeviceError, ValueError):
    """What is asked is not what was asked in the recorded run, at this place."""

    index: int | None = None
    """Of the device's calls, or of the pieces of work; None in an error that comes from a recording itself."""
    expected: object = None
    got: object = None

    @classmethod
    def at(cls, device: str, index: int, expected: object, got: object, what: str) -> Self:
        """``what`` differs, in a few words; ``expected`` was recorded."""
        where = f"the recorded run differs at its {index + 1}. call" if device != WORK else f"at its {index + 1}. work"
        mismatch = cls(
            device,
            "replay",
            f"{where}: {what}; recorded: {expected}; now: {got}",
            "the procedure, its settings or the cell file are not those of the recorded run",
        )
        mismatch.index, mismatch.expected, mismatch.got = index, expected, got
        return mismatch


class FrameMissing(DeviceError, LookupError):
    """The recording has a reply of the camera, but not the image that it speaks of."""


class LogEnded(DeviceError, EOFError):
    """The recording has nothing more for this device."""


WORK = "procedure"
"""Stands for a device where something is worked out without one."""
