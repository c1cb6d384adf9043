"""``dualcal run``."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Protocol

import typer
from rich.console import Console

from dualcal_hal.camera import Image
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, differences, load_cell, standing_alone
from dualcal_hal.clock import utc_now
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.config import CellConfig, OneArmCell
from dualcal_hal.errors import FormatError, NotConfirmed, Problem, UsageError
from dualcal_hal.pace import REDUCED_SPEED, Pace
from dualcal_hal.session.captures import CaptureRecord, Captures, CellShape, write_captures
from dualcal_hal.session.conduct import CALIBRATION, INTRINSICS, Conduct, keep_conduct, read_conduct
from dualcal_hal.session.distances import DISTANCES, Distances, read_distances
from dualcal_hal.session.folder import CELL_FILE, Session
from dualcal_hal.session.lock import SessionLock
from dualcal_hal.session.log import next_segment
from dualcal_hal.session.log.recording import LogRecording, Recording
from dualcal_hal.session.one_arm_result import OneArmResult
from dualcal_hal.transforms import Array
from procedures.alignment import largest_alignment_error, tolerance_px
from procedures.calibrate import Calibration, captures_of, is_complete
from procedures.engine import Confirmation, Engine
from procedures.observers import Observer, Observers
from procedures.one_arm.procedure import OneArmCalibration
from procedures.one_arm.rehearsal import rehearse_views
from procedures.planning.model import CellModel, Posture
from procedures.planning.plan import PLAN_FORMAT, Plan
from procedures.rehearsal import rehearse, require_reach
from procedures.report import draw_one_arm, draw_plan, draw_summary
from procedures.steps import Procedure
from tools.cli.emulator import emulator
from tools.cli.exits import FAULT, signals_deferred
from tools.cli.operator import Operator
from tools.cli.progress import progress
from tools.cli.results import AnyResult, analysed, compared, read_any, write_any
from tools.cli.show import show_rehearsal, show_rehearsed_views, show_result
from tools.cli.terminal import Screen, plain
from tools.cli.truth import simulated_truth

PLAN_FILE = "plan.json"


class Stepping(Protocol):
    """What the engine is given the steps of."""

    def steps(self) -> Procedure[None]:
        """All of the run."""
        ...


@dataclass(frozen=True)
class RunOptions:
    """What the command line says."""

    cell: Path | None
    out: Path | None = None
    seed: int | None = None
    method: str | None = None
    overrides: tuple[str, ...] = ()
    dry_run: bool = False
    yes: bool = False
    log: bool = True
    json: bool = False
    resume: Path | None = None
    speed: float | None = None
    emulate: bool = False
    enable: bool = False
    faults: tuple[str, ...] = ()
    procedure: str | None = None


def run_cell(options: RunOptions) -> int:
    """Prepare, run, analyse; returns the exit code."""
    if _procedure(options) == INTRINSICS:
        from tools.cli.intrinsics import run_intrinsics

        return run_intrinsics(options)
    # With --json standard output is for the result alone.
    console = Screen(stderr=options.json)
    if options.resume is not None:
        return _resume(console, options, options.resume)
    if options.cell is None:
        raise UsageError("name a cell file, or with --resume a session to go on with")
    file = load_asked(options, options.cell)
    calibration = calibration_of(file.cell)
    cell = cell_at_pace(options, file, options.cell)
    if isinstance(file.cell, OneArmCell):
        if options.dry_run:
            _rehearse_views(console, file, file.cell, options)
            return 0
    else:
        model = CellModel(file.cell)
        _warn_of_alignment_error(console, file, model)
        if options.dry_run:
            _rehearse(console, file, model, options)
            return 0
        require_reach(file.cell, model)
    commissioning = commissioned(cell, options, file, options.cell)
    started = utc_now()
    text, copies = standing_alone(file)
    folder = options.out or unused_folder(started, file.cell.name)
    session = Session.create(folder, text, started.isoformat(timespec="seconds"), copies)
    with kept(session), SessionLock(session.folder):
        keep_conduct(session, Conduct(cell.pace, options.emulate))
        if commissioning is not None:
            commissioning.copy_beside(session.cell_path)
        if text != file.text:
            file = load_cell(session.cell_path)
            calibration = calibration_of(file.cell)
            cell = Cell(file, cell.pace)
        result = _finish(console, options, file, cell, calibration, session)
        return _report(console, options, file, session, result, commissioning)


def calibration_of(cell: CellConfig) -> Stepping:
    """The procedure of a cell with two arms, or with one."""
    return OneArmCalibration(cell) if isinstance(cell, OneArmCell) else Calibration(cell, CellModel(cell))


def _procedure(options: RunOptions) -> str:
    """The one that is asked for, which a session has decided on already."""
    if options.resume is None:
        return options.procedure or CALIBRATION
    begun = read_conduct(Session(options.resume)).procedure
    if options.procedure not in (None, begun):
        raise UsageError(f"{options.resume}: the session is one of --procedure {begun}, not {options.procedure}")
    return begun


def _resume(console: Console, options: RunOptions, folder: Path) -> int:
    """Go on with a session, or report it again."""
    if options.out is not None or options.dry_run:
        raise UsageError("--resume goes on in the session's own folder: it takes neither --out nor --dry-run")
    file = file_of(options, folder)
    if (session := Session(folder)).result_path.exists() and _is_finished(file, session):
        return _report(console, options, file, session, read_any(session.result_path, file.cell))
    with SessionLock(folder) as lock:
        if lock.left_by is not None:
            say_line(console, f"{folder}: taken over from {lock.left_by}, which has ended without giving it back")
        session = Session(folder)  # as it is now that nobody else writes it
        session.go_on(utc_now().isoformat(timespec="seconds"))
        with kept(session):
            steps = session.journal.results()
            say_line(console, f"going on with {folder}: {len(steps)} steps are finished")
            if is_complete(captures := _captures(file, session), file.cell.procedure):
                say_line(console, "all is captured already: only the analysis is left, and no arm is moved")
                write_captures(session.captures_path, captures)
                result = conclude(file, session, captures, lambda line: say_line(console, line))
                commissioning = None
            else:
                calibration, cell = calibration_of(file.cell), cell_at_pace(options, file, session.cell_path)
                commissioning = commissioned(cell, options, file, session.cell_path)
                keep_conduct(session, Conduct(cell.pace, options.emulate))
                result = _finish(console, options, file, cell, calibration, session)
            return _report(console, options, file, session, result, commissioning)


def file_of(options: RunOptions, folder: Path) -> CellFile:
    """The cell file of a session; UsageError with a diff if the command line asks for another."""
    session_file = folder / CELL_FILE
    if not folder.is_dir():
        raise UsageError(f"{folder}: there is no such session")
    if not session_file.exists():
        raise UsageError(f"{folder}: there is no {CELL_FILE} in it, so it is no session that could go on")
    file = load_cell(session_file)
    given, _ = standing_alone(load_asked(options, options.cell or session_file))
    if diff := differences(file.text, given):
        raise UsageError(f"{folder}: the session was begun with another cell file than is asked for now:\n{diff}")
    return file


def _is_finished(file: CellFile, session: Session) -> bool:
    # The picture is the last that is written.
    return session.summary_path.exists() and is_complete(_captures(file, session), file.cell.procedure)


def _finish(
    console: Console, options: RunOptions, file: CellFile, cell: Cell, calibration: Stepping, session: Session
) -> AnyResult:
    """Run from where the session's journal ends, and analyse."""
    go_on_from_journal(cell, session)
    with recording_of(options, session, file, cell) as recording, devices(options, cell, session):
        cell.record(recording)
        captures = _run(console, options, file, cell, calibration, session)
        result = conclude(file, session, captures, lambda line: say_line(console, line))
        recording.document(session.result_path.name, result.to_document())
    return result


@contextmanager
def devices(options: RunOptions, cell: Cell, session: Session) -> Iterator[None]:
    """The cell's devices are those of an emulator beside it while this lasts, if that is asked for."""
    if not options.emulate:
        yield
        return
    with emulator(session.cell_path, options.faults) as endpoints:
        cell.use_emulator(endpoints)
        yield


def go_on_from_journal(cell: Cell, session: Session) -> None:
    """Have the backends be as the last finished step left them, before they are opened."""
    try:
        cell.go_on_from(session.journal.left.backends)
    except FormatError as error:
        where = session.journal.newest_line
        raise FormatError([Problem(f"{where}: {each.where}", each.what) for each in error.problems]) from error


def _report(
    console: Console,
    options: RunOptions,
    file: CellFile,
    session: Session,
    result: AnyResult,
    commissioning: Commissioning | None = None,
) -> int:
    """Show what came of it; a calibration that was verified is kept in the cell's commissioning."""
    if options.json:
        typer.echo(plain(session.result_path.read_text()), nl=False)
    else:
        show_result(console, file.cell, result, simulated_truth(file, session.folder), as_json=False)
    if commissioning is not None and result.verdict == "ok":
        commissioning.record_verified(f"verdict {result.verdict} of session {session.folder.name}")
    if (distances := read_distances(session)) is not None:
        between = "between the arms" if file.one_arm is None else "between arm and stand"
        say_line(console, f"least distance {between} {distances.least()}")
    say_line(console, f"session: {session.folder}")
    return 0 if result.verdict == "ok" else FAULT


def say_line(console: Console, line: str) -> None:
    """A line for the operator, as long as it is."""
    console.print(line, soft_wrap=True, highlight=False)


@contextmanager
def kept(session: Session, *, can_be_estimated: bool = True) -> Iterator[None]:
    """Whatever ends the run, say how to go on."""
    try:
        yield
    except BaseException as error:
        folder = shlex.quote(str(session.folder))
        again = f"{folder} --emulate" if read_conduct(session).emulated else folder
        error.add_note(f"the session is kept; to go on with it: dualcal run --resume {again}")
        if can_be_estimated:
            error.add_note(f"what it has so far: dualcal estimate {folder}")
        raise


def recording_of(options: RunOptions, session: Session, file: CellFile, cell: Cell) -> Recording:
    """Where all that passes is told to: the session's next log, or nowhere."""
    return LogRecording(next_segment(session.folder), file, cell.clock) if options.log else Recording()


def _run(
    console: Console, options: RunOptions, file: CellFile, cell: Cell, calibration: Stepping, session: Session
) -> Captures:
    """The run itself; its captures are written however it ends."""
    with signals_deferred() as signals:
        try:
            with progress(console) as watcher:
                operator = Operator(console, watcher, asked=not (cell.simulated or options.yes))
                execute(
                    cell,
                    calibration,
                    session,
                    watcher,
                    lambda engine: signals.pass_on_to(engine.abort),
                    operator.confirms,
                    prepare=lambda opened, aborted: prepare_arms(console, options, opened, operator, aborted),
                )
        except BaseException as error:
            try:
                write_session_captures(file, session)
            except OSError as second:
                error.add_note(f"captures.json could not be written ({second.strerror}); the journal has them")
            except FormatError:
                pass  # a damaged journal is what the run has ended by
            raise
        return write_session_captures(file, session)


def _rehearse(console: Console, file: CellFile, model: CellModel, options: RunOptions) -> None:
    """Show what a run would do; keep the plan and its picture where ``--out`` says."""
    rehearsal = rehearse(file.cell, model)
    show_rehearsal(console, file.cell, rehearsal, as_json=options.json)
    if options.out is None:
        console.print(_WITH_OUT)
        return
    _keep_rehearsed(console, file, options.out, rehearsal.arms, rehearsal.plan)


def _rehearse_views(console: Console, file: CellFile, cell: OneArmCell, options: RunOptions) -> None:
    """The same of a cell with one arm."""
    rehearsed = rehearse_views(cell)
    show_rehearsed_views(console, cell, rehearsed, as_json=options.json)
    if options.out is None:
        console.print(_WITH_OUT)
        return
    _keep_rehearsed(console, file, options.out, rehearsed.home, rehearsed.plan)


_WITH_OUT = "With --out FOLDER the plan and a picture of it are written there."


def _keep_rehearsed(console: Console, file: CellFile, folder: Path, arms: Posture, plan: Plan | None) -> None:
    """The plan, if there is one, and its picture with the arms where they begin."""
    session = Session.create(folder, file.text)
    if plan is not None:
        session.write_document(PLAN_FILE, plan.to_record())
    draw_plan(session.folder / "plan.png", file.cell, arms, plan)
    say_line(console, f"plan and picture: {session.folder}")


def load_asked(options: RunOptions, path: Path) -> CellFile:
    """The cell file with what the command line sets in it."""
    overrides = list(options.overrides)
    if options.method is not None:
        if load_cell(path, overrides).one_arm is None:
            overrides.append(f"procedure.method={options.method}")
        elif options.method != "refined":
            raise UsageError(f"--method {options.method} needs two arms; a cell with one is for method refined")
    if options.seed is not None:
        overrides.append(f"procedure.seed={options.seed}")
        if load_cell(path, options.overrides).simulation is not None:
            overrides.append(f"simulation.seed={options.seed}")
    return load_cell(path, overrides)


def unused_folder(started: datetime, name: str) -> Path:
    """For a session that is begun now."""
    folder = Path("sessions") / f"{started:%Y%m%d-%H%M%S}-{name}"
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(2))
    return folder if not folder.exists() else next(other for other in numbered if not other.exists())


def write_session_captures(file: CellFile, session: Session) -> Captures:
    """``captures.json`` from the journal."""
    captures = _captures(file, session)
    write_captures(session.captures_path, captures)
    return captures


def _captures(file: CellFile, session: Session) -> Captures:
    return captures_of(session.journal, file.sha256, session.started, CellShape.of(file.cell))


def execute(
    cell: Cell,
    calibration: Stepping,
    session: Session,
    watcher: Observer,
    begun: Callable[[Engine], None] = lambda engine: None,
    confirm: Confirmation = lambda shown, aborted: True,
    prepare: Callable[[Cell, Callable[[], bool]], None] = lambda cell, aborted: None,
) -> None:
    """Run the procedure on the cell's devices, which are closed again on any exit.

    ``begun`` gets the engine; ``confirm`` asks the operator; ``prepare`` is done once the devices are open, and told
    what says whether the run was aborted.
    """
    with Observers(watcher) as observers, cell as opened:
        engine = Engine(opened, session, observers, confirm)
        begun(engine)
        prepare(opened, lambda: engine.aborted)
        with _documents_kept(opened, session):
            engine.run(calibration.steps())


@contextmanager
def _documents_kept(cell: Cell, session: Session) -> Iterator[None]:
    """Write what the backends measured over the run, also over one that failed, behind what they did before."""
    earlier = read_distances(session)
    try:
        yield
    except BaseException as error:
        try:
            _write_documents(cell, session, earlier)
        except OSError as second:
            error.add_note(f"what the backends measured could not be written ({second.strerror})")
        raise
    _write_documents(cell, session, earlier)


def _write_documents(cell: Cell, session: Session, earlier: Distances | None) -> None:
    for name, document in cell.documents().items():
        if name == DISTANCES and earlier is not None:
            session.write_document(name, Distances.from_document(document).after(earlier).to_document())
        else:
            session.write_document(name, document)


def conclude(
    file: CellFile, session: Session, captures: Captures, say: Callable[[str], None] = lambda line: None
) -> AnyResult:
    """Analyse, and only then compare with the truth where there is one; write both and the picture.

    ``say`` gets a line for each part of the picture that cannot be drawn, as a file of the session is missing.
    """
    result = analyse_session(file, session, captures, simulated_truth(file, session.folder))
    shown = captures.captures[0]
    image, plan = _image_of(session, shown, say), None
    if isinstance(result, OneArmResult):
        assert isinstance(file.cell, OneArmCell)
        draw_one_arm(session.summary_path, file.cell.one_arm, captures.captures, result, image)
        return result
    if (session.folder / PLAN_FILE).exists():
        plan = _read_plan(session, file.cell)
    else:
        say(f"{session.folder / PLAN_FILE}: is missing; the picture does without the plan")
    draw_summary(
        session.summary_path,
        cell=file.cell,
        plan=plan,
        captures=captures,
        result=result,
        image=image,
        feature_px=shown.feature,
    )
    return result


def _image_of(session: Session, shown: CaptureRecord, say: Callable[[str], None]) -> Image | None:
    try:
        return session.read_image(shown.id)
    except UsageError as error:
        say(f"{error}; the picture does without what the camera saw")
        return None


def _read_plan(session: Session, cell: CellConfig) -> Plan:
    """``plan.json``; FormatError if it is none of this cell's."""
    record = session.read_document(PLAN_FILE, PLAN_FORMAT)
    try:
        plan = Plan.from_record(record)
        plan.require_joints(cell.active.chain.joints, cell.passive.chain.joints)
    except ValueError as error:
        raise FormatError([Problem(str(session.folder / PLAN_FILE), str(error))]) from error
    return plan


def analyse_session(
    file: CellFile, session: Session, captures: Captures, truth: Mapping[str, Array] | None
) -> AnyResult:
    """The result, with its error where there is a truth, written to the session."""
    result = analysed(captures, file.cell, file.cell.procedure.method)
    if truth is not None:
        result = compared(result, truth)
    write_any(session.result_path, result)
    return result


def cell_at_pace(options: RunOptions, file: CellFile, path: Path) -> Cell:
    """The cell of ``path``, its devices not open yet, at the pace that its commissioning and ``--speed`` allow."""
    cell = Cell(file)
    if options.emulate and cell.time != "real":
        raise UsageError("--emulate puts an emulator behind real wires; this cell has its own simulator: go without")
    if options.faults and not options.emulate:
        raise UsageError("--fault is for the emulator: it goes with --emulate")
    begun = Conduct() if options.resume is None else read_conduct(Session(options.resume))
    if options.resume is not None and begun.emulated != options.emulate:
        said = "an emulator's: go on with --emulate" if begun.emulated else "no emulator's: go on without --emulate"
        raise UsageError(f"{options.resume}: the session's devices were {said}")
    free = cell.simulated or options.emulate or Commissioning.of(path, file).verified
    share = begun.pace.share if options.speed is None else options.speed
    return Cell(file, Pace(share, None if free else REDUCED_SPEED))


def commissioned(cell: Cell, options: RunOptions, file: CellFile, path: Path) -> Commissioning | None:
    """The record of a cell that is not simulated; UsageError if its arms must not be moved yet."""
    if cell.simulated or options.emulate:
        return None
    commissioning = Commissioning.of(path, file)
    if missing := commissioning.missing():
        raise UsageError("\n".join(["this cell is not simulated, and its arms must not be moved yet:", *missing]))
    return commissioning


def prepare_arms(
    console: Console, options: RunOptions, cell: Cell, operator: Operator, aborted: Callable[[], bool]
) -> None:
    """What the operator wants done before the procedure begins, once the devices are open."""
    if not (options.enable or options.emulate):
        return
    if not operator.agrees("Switch the drives of both arms on?", aborted):
        raise NotConfirmed("not confirmed by the operator: the drives were left as they are")
    for name in cell.enable_arms():
        say_line(console, f"{name}: its drives are on")


def _warn_of_alignment_error(console: Console, file: CellFile, model: CellModel) -> None:
    """Paper, section 4.2: the alignment's error should be below the arms' repeatability."""
    tolerance = tolerance_px(model, file.cell.procedure.tolerance_px)
    error = largest_alignment_error(model, tolerance)
    repeatability = min(file.cell.active.repeatability, file.cell.passive.repeatability)
    comparison = f"e_c_max {error * 1e3:.3f} mm at {tolerance:.3g} px and {model.distance[1] * 1e3:.0f} mm"
    if error > repeatability:
        console.print(
            f"warning: {comparison} exceeds the arms' repeatability of {repeatability * 1e3:.3g} mm: "
            "lower procedure.tolerance_px or distance_mm",
            style="yellow",
        )
    else:
        console.print(f"{comparison}, below the arms' repeatability of {repeatability * 1e3:.3g} mm")
