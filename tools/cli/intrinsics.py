"""``dualcal run --procedure intrinsics``, its replay, and ``dualcal intrinsics import``."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console

from dualcal_hal.camera import Intrinsics
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, load_cell, standing_alone
from dualcal_hal.clock import utc_now
from dualcal_hal.errors import FormatError, Problem, UsageError
from dualcal_hal.session.captures import CellShape
from dualcal_hal.session.conduct import INTRINSICS, Conduct, keep_conduct, read_conduct
from dualcal_hal.session.files import document_bytes
from dualcal_hal.session.folder import Session
from dualcal_hal.session.lock import SessionLock
from procedures.intrinsics import IntrinsicsProcedure, IntrinsicsResult, intrinsics_result, views_of
from procedures.intrinsics.camera_files import read_camera_file
from procedures.intrinsics.report import draw_intrinsics, intrinsics_tables
from procedures.intrinsics.result import INTRINSICS_FORMAT, findings, patch, set_options, write_patch
from procedures.planning.model import CellModel
from tools.cli.exits import FAULT, signals_deferred
from tools.cli.operator import Operator
from tools.cli.progress import progress
from tools.cli.run import (
    RunOptions,
    cell_at_pace,
    commissioned,
    devices,
    execute,
    file_of,
    go_on_from_journal,
    kept,
    load_asked,
    prepare_arms,
    recording_of,
    say_line,
    unused_folder,
)
from tools.cli.terminal import Screen, plain

RESULT_FILE = "intrinsics.json"
PATCH_FILE = "intrinsics.patch.yaml"
PICTURE_FILE = "intrinsics.png"

Say = Callable[[str], None]


@dataclass(frozen=True)
class _Run:
    """What stays the same from the call to the report."""

    console: Console
    options: RunOptions

    def say(self, line: str) -> None:
        say_line(self.console, line)


def run_intrinsics(options: RunOptions) -> int:
    """Prepare, run, estimate; returns the exit code: 0 if the camera is known, 1 if what it rests on is poor."""
    run = _Run(Screen(stderr=options.json), options)
    if options.dry_run:
        raise UsageError("--dry-run shows the plan of a calibration; --procedure intrinsics has none before its looks")
    if options.method is not None:
        raise UsageError("--method is the estimator of a calibration; --procedure intrinsics has one of its own")
    if options.resume is not None:
        return _resume(run, options.resume)
    if options.cell is None:
        raise UsageError("name a cell file, or with --resume a session to go on with")
    file = load_asked(options, options.cell)
    if file.one_arm is not None:
        raise UsageError("--procedure intrinsics needs two arms: one holds the target before the other's camera")
    IntrinsicsProcedure(file.cell, CellModel(file.cell))  # what it refuses is refused before there is a session
    cell = cell_at_pace(options, file, options.cell)
    commissioning = commissioned(cell, options, file, options.cell)
    started = utc_now()
    text, copies = standing_alone(file)
    folder = options.out or unused_folder(started, file.cell.name)
    session = Session.create(folder, text, started.isoformat(timespec="seconds"), copies)
    with kept(session, can_be_estimated=False), SessionLock(session.folder):
        keep_conduct(session, Conduct(cell.pace, options.emulate, INTRINSICS))
        if commissioning is not None:
            commissioning.copy_beside(session.cell_path)
        if text != file.text:
            file = load_cell(session.cell_path)
            cell = Cell(file, cell.pace)
        return _report(run, session, _finish(run, file, cell, session))


def _resume(run: _Run, folder: Path) -> int:
    """Go on with a session, or report it again."""
    options = run.options
    if options.out is not None:
        raise UsageError("--resume goes on in the session's own folder: it does not take --out")
    file = file_of(options, folder)
    session = Session(folder)
    if (folder / RESULT_FILE).exists():
        return _report(run, session, _result(file, session))
    with SessionLock(folder) as lock:
        if lock.left_by is not None:
            run.say(f"{folder}: taken over from {lock.left_by}, which has ended without giving it back")
        session = Session(folder)  # as it is now that nobody else writes it
        session.go_on(utc_now().isoformat(timespec="seconds"))
        with kept(session, can_be_estimated=False):
            run.say(f"going on with {folder}: {len(session.journal.results())} steps are finished")
            cell = cell_at_pace(options, file, session.cell_path)
            commissioned(cell, options, file, session.cell_path)
            keep_conduct(session, Conduct(cell.pace, options.emulate, INTRINSICS))
            return _report(run, session, _finish(run, file, cell, session))


def _finish(run: _Run, file: CellFile, cell: Cell, session: Session) -> IntrinsicsResult:
    """Run from where the session's journal ends, and estimate."""
    go_on_from_journal(cell, session)
    with recording_of(run.options, session, file, cell) as recording, devices(run.options, cell, session):
        cell.record(recording)
        with signals_deferred() as signals, progress(run.console) as watcher:
            operator = Operator(run.console, watcher, asked=not (cell.simulated or run.options.yes))
            execute(
                cell,
                IntrinsicsProcedure(file.cell, CellModel(file.cell)),
                session,
                watcher,
                lambda engine: signals.pass_on_to(engine.abort),
                operator.confirms,
                prepare=lambda opened, aborted: prepare_arms(run.console, run.options, opened, operator, aborted),
            )
        result = conclude(file, session)
        recording.document(RESULT_FILE, result.to_document())
    return result


def _result(file: CellFile, session: Session) -> IntrinsicsResult:
    views = views_of(session.journal, CellShape.of(file.cell))
    return intrinsics_result(views, file.cell.camera, file.cell.target.board, file.sha256, session.started)


def conclude(file: CellFile, session: Session) -> IntrinsicsResult:
    """Estimate from what the session has; write patch, picture and, as the last, the result.

    Raises DegenerateCaptures where the views determine no camera.
    """
    result = _result(file, session)
    if result.verdict == "ok":
        about = f"The camera of cell '{plain(file.cell.name)}', by dualcal run --procedure intrinsics"
        when = f", begun {session.started}." if session.started else "."
        intrinsics = result.estimate.intrinsics
        write_patch(session.folder / PATCH_FILE, intrinsics, [about + when, *findings(result)])
    else:
        (session.folder / PATCH_FILE).unlink(missing_ok=True)
    draw_intrinsics(session.folder / PICTURE_FILE, file.cell.name, result)
    session.write_document(RESULT_FILE, result.to_document())
    return result


def _report(run: _Run, session: Session, result: IntrinsicsResult) -> int:
    if run.options.json:
        typer.echo(plain(document_bytes(result.to_document()).decode()), nl=False)
    else:
        run.console.print(intrinsics_tables(result))
        if result.verdict == "ok":
            _tell_of_patch(run.say, session.folder / PATCH_FILE, result.estimate.intrinsics)
    run.say(f"session: {session.folder}")
    return 0 if result.verdict == "ok" else FAULT


def _tell_of_patch(say: Say, path: Path, intrinsics: Intrinsics) -> None:
    say(f"for the cell file: {path}, or for one run: {set_options(intrinsics)}")


# -- replay ------------------------------------------------------------------------------------------------------------


def replay_intrinsics(recorded: Session, file: CellFile, session: Session, *, as_json: bool) -> int:
    """Run the procedure again on what ``recorded`` has into ``session``, and compare; 0 if it came to the same.

    file: the cell with its devices played back. UsageError for a run that came to no result.
    """
    console = Screen(stderr=as_json)
    if not (recorded.folder / RESULT_FILE).exists():
        raise UsageError(f"{recorded.folder}: the run has no {RESULT_FILE} yet, with which a replay could be compared")
    expected = recorded.read_document(RESULT_FILE, INTRINSICS_FORMAT)
    cell, procedure = Cell(file, read_conduct(recorded).pace), IntrinsicsProcedure(file.cell, CellModel(file.cell))
    with signals_deferred() as signals:
        execute(cell, procedure, session, lambda event: None, lambda engine: signals.pass_on_to(engine.abort))
    # Read as the recorded one is: what is compared is what the files say.
    found = json.loads(document_bytes(conclude(file, session).to_document()))
    differences = sorted(name for name in expected.keys() | found.keys() if expected.get(name) != found.get(name))
    # A replay reaches its devices through another backend, and begins when it begins.
    differences = [name for name in differences if name not in ("cell_sha256", "started")]
    if as_json:
        typer.echo(json.dumps({"identical": not differences, "differences": differences, "result": found}, indent=1))
    elif differences:
        say_line(console, f"The replay came to something else than the recorded run: {', '.join(differences)}")
    else:
        say_line(console, "The result is the same to the last bit.")
    return FAULT if differences else 0


# -- import ------------------------------------------------------------------------------------------------------------


def import_intrinsics(camera_file: Path, cell: Path, out: Path | None, overrides: Sequence[str] = ()) -> None:
    """Print what another program's camera file is in a cell file, or write it to ``out``."""
    console = Screen()
    file = load_cell(cell, overrides, meshes=False, backends=False)
    if out is not None and out.exists() and any(out.samefile(source) for source in (cell, camera_file)):
        raise UsageError(f"{out}: the lines would take the place of what they come from or are for; name another file")
    read = read_camera_file(camera_file)
    try:
        intrinsics = read.intrinsics_for(file.cell.camera.size_px)
    except ValueError as error:
        raise FormatError([Problem(str(camera_file), str(error))]) from error
    comments = [f"The camera of {plain(camera_file.name)} ({read.kind}), for cell '{plain(file.cell.name)}'."]
    if read.size is None:
        comments.append("The file says nothing of the size of its images: see that it is camera.size_px.")
    if out is None:
        typer.echo(patch(intrinsics, comments), nl=False)
        say_line(console, f"# or for one run: {set_options(intrinsics)}")
    else:
        write_patch(out, intrinsics, comments)
        _tell_of_patch(lambda line: say_line(console, line), out, intrinsics)
