"""``dualcal replay``."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import typer
from rich.console import Console

from dualcal_hal.camera import Image
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import (
    DualcalError,
    FrameMissing,
    Interrupted,
    LogDamaged,
    LogEnded,
    MotionStopped,
    ReplayMismatch,
    UsageError,
)
from dualcal_hal.session.comparison import Comparison, compare_captures, compare_results
from dualcal_hal.session.conduct import INTRINSICS, read_conduct
from dualcal_hal.session.folder import Session
from dualcal_hal.session.journal import Journal, StepKey
from dualcal_hal.session.log import LogReader
from dualcal_hal.session.log.attempts import FinishedAttempts, begun_segments
from dualcal_hal.session.log.records import RecordedError
from procedures.calibrate import captures_of
from tools.cli.exits import FAULT, signals_deferred
from tools.cli.intrinsics import replay_intrinsics
from tools.cli.results import AnyResult, read_any
from tools.cli.run import analyse_session, calibration_of, execute, write_session_captures
from tools.cli.terminal import Screen
from tools.cli.truth import told_truth

_NO_END_OF_A_RUN = (ReplayMismatch, FrameMissing, LogDamaged, Interrupted)
"""Errors that say that the replay failed, and not that the recorded run ended so."""


@dataclass(frozen=True)
class ReplayOptions:
    """What the command line says."""

    session: Path
    out: Path | None
    json: bool


@dataclass(frozen=True)
class Replayed:
    """result: None if the recorded run has none; ended: how that run ended then, and ``otherwise`` if the replay ended
    in another way; times in s.

    served: whether detections were not worked out anew, because images were recorded with loss.
    """

    result: AnyResult | None
    ended: str
    otherwise: str
    recorded_time: float
    time: float
    served: bool
    captures: Comparison
    results: Comparison | None

    @property
    def identical(self) -> bool:
        same_result = self.results is None or self.results.identical
        return self.captures.identical and same_result and not self.otherwise

    @property
    def differences(self) -> tuple[str, ...]:
        ends = (self.otherwise,) if self.otherwise else ()
        return (*self.captures.differences, *(self.results.differences if self.results else ()), *ends)


def replay_session(options: ReplayOptions) -> int:
    """Play a session back and compare; 0 if it came to the same."""
    file = _load(options.session)
    console = Screen(stderr=options.json)
    recorded = Session(options.session)
    with _session(options.out, file.text) as session:
        if read_conduct(recorded).procedure == INTRINSICS:
            return replay_intrinsics(recorded, file, session, as_json=options.json)
        replayed = _replay(options.session, file, session)
    if options.json:
        typer.echo(json.dumps(_document(replayed), indent=1, allow_nan=False))
    else:
        _show(console, replayed)
    return FAULT if replayed.differences else 0


def _load(session: Path) -> CellFile:
    """The session's cell with all its devices played back from its log."""
    path = session / "cell.yaml"
    if not path.is_file():
        raise UsageError(f"{session}: is no session: there is no cell.yaml in it")
    begun_segments(session)  # refused now, before anything is begun
    # Before anything is checked: what the devices were reached through need not be installed here.
    return load_cell(path, instead={"type": "replay", "session": str(session.absolute())})


class _PassingSession(Session):
    """A session whose folder is thrown away: nobody will look at its images."""

    def write_image(self, name: str, image: Image) -> None:
        pass


@contextmanager
def _session(out: Path | None, cell_text: str) -> Iterator[Session]:
    if out is not None:
        yield Session.create(out, cell_text)
        return
    with tempfile.TemporaryDirectory(prefix="dualcal-replay-") as folder:
        yield _PassingSession.create(Path(folder), cell_text)


def _replay(recorded: Path, file: CellFile, session: Session) -> Replayed:
    expected = read_any(recorded / "result.json", file.cell) if (recorded / "result.json").exists() else None
    segments = begun_segments(recorded)
    log, journal = FinishedAttempts(segments), Journal(recorded / "journal.jsonl")
    _require_all_steps(recorded, log, journal)
    conduct = read_conduct(Session(recorded))
    cell, calibration = Cell(file, conduct.pace), calibration_of(file.cell)
    begun = perf_counter()
    result, error = None, None
    try:
        with signals_deferred() as signals:
            execute(cell, calibration, session, lambda event: None, lambda engine: signals.pass_on_to(engine.abort))
        captures = write_session_captures(file, session)
        compared = expected is not None and expected.truth_error is not None
        analyse_session(file, session, captures, told_truth(file) if compared else None)
        # Read as the recorded one is: what is compared is what the files say.
        result = read_any(session.result_path, file.cell)
    except _NO_END_OF_A_RUN:
        raise
    except DualcalError as raised:
        if expected is not None:
            raise
        error = raised
    taken = captures_of(session.journal, file.sha256, None).captures
    there = captures_of(journal, file.sha256, None).captures
    ended, otherwise = ("", "") if expected is not None else _compare_ends(log, error)
    return Replayed(
        result,
        ended,
        otherwise,
        cell.clock.now(),
        perf_counter() - begun,
        not all(map(_is_exact, segments)),
        compare_captures(there, taken),
        None if expected is None or result is None else compare_results(expected, result),
    )


def _require_all_steps(recorded: Path, log: FinishedAttempts, journal: Journal) -> None:
    """LogDamaged for steps that no log has, whether it was cut off or never kept."""
    missing = [_name(key) for key, _ in journal.results() if key not in log.finished]
    if missing:
        steps = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        why = f"it ends before {steps}: it was cut off, or that part ran with --no-log; dualcal estimate still works"
        raise LogDamaged(f"the log of {recorded}", None, why)


def _name(step: StepKey) -> str:
    place = step.constraint or step.phase
    return place if step.position is None else f"{place} position {step.position}"


def _compare_ends(log: FinishedAttempts, error: DualcalError | None) -> tuple[str, str]:
    """How a run without a result ended, and in words if its replay ended in another way."""
    if log.ended is None:
        ended, same = "it was cut off", isinstance(error, LogEnded)
    elif log.ended.error is None:
        ended, same = "well, before it was analysed", error is None
    else:
        recorded = log.ended.error.error()
        ended = str(recorded)
        if isinstance(recorded, Interrupted):  # from outside, in the middle of whatever was done
            same = isinstance(error, MotionStopped | LogEnded)
        else:
            same = error is not None and RecordedError.of(error) == log.ended.error
    return ended, "" if same else f"the recorded run ended so: {ended}; the replay so: {error or 'well'}"


def _is_exact(segment: Path) -> bool:
    with LogReader(segment) as reader:
        return reader.about().get("frames") == "png"


def _document(replayed: Replayed) -> dict[str, object]:
    return {
        "identical": replayed.identical,
        "differences": list(replayed.differences),
        "recorded_run_ended": replayed.ended or None,
        "recorded_s": replayed.recorded_time,
        "replay_s": replayed.time,
        "recorded_detections": replayed.served,
        "result": None if replayed.result is None else replayed.result.to_document(),
    }


def _show(console: Console, replayed: Replayed) -> None:
    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    faster = replayed.recorded_time / replayed.time
    say(f"{replayed.recorded_time:.0f} s of recorded time in {replayed.time:.1f} s, {faster:.0f} times as fast")
    if replayed.results is None:
        say(f"The recorded run has no result. It ended so: {replayed.ended}")
    if replayed.served:
        say("The images were recorded with loss: the recorded detections were taken in place of new ones.")
    what = "captures" if replayed.results is None else "result"
    if replayed.identical:
        say(
            f"The {what} is the same to the last bit."
            if replayed.results
            else "Its captures are the same to the last bit."
        )
    elif not replayed.differences:
        say(f"The same {what}, within 1e-6 mm and 1e-9 rad.")
    else:
        say("The replay came to something else than the recorded run:")
        for line in replayed.differences:
            say(f"  {line}")
