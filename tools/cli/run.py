"""``dualcal run``."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import typer
from rich.console import Console

from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.clock import utc_now
from dualcal_hal.errors import UsageError
from dualcal_hal.session.captures import Captures, write_captures
from dualcal_hal.session.distances import read_distances
from dualcal_hal.session.folder import Session
from dualcal_hal.session.log import next_segment
from dualcal_hal.session.log.recording import LogRecording, Recording
from dualcal_hal.session.result import Result, with_truth_error, write_result
from procedures.alignment import largest_alignment_error, tolerance_px
from procedures.analysis import analyse
from procedures.calibrate import Calibration, captures_of
from procedures.engine import Engine
from procedures.observers import Observer, Observers
from procedures.planning.model import CellModel
from procedures.planning.plan import PLAN_FORMAT, Plan
from procedures.rehearsal import rehearse, require_reach
from procedures.report import draw_plan, draw_summary
from tools.cli.exits import FAULT, signals_deferred
from tools.cli.progress import progress
from tools.cli.show import show_rehearsal, show_result
from tools.cli.truth import simulated_truth


@dataclass(frozen=True)
class RunOptions:
    """What the command line says."""

    cell: Path
    out: Path | None = None
    seed: int | None = None
    method: str | None = None
    overrides: tuple[str, ...] = ()
    dry_run: bool = False
    yes: bool = False
    log: bool = True
    json: bool = False


def run_cell(options: RunOptions) -> int:
    """Prepare, run, analyse; returns the exit code."""
    file = _load(options)
    # With --json standard output is for the result alone.
    console = Console(stderr=options.json)
    model = CellModel(file.cell)
    calibration = Calibration(file.cell, model)
    cell = Cell(file)
    _warn_of_alignment_error(console, file, model)
    if options.dry_run:
        _rehearse(console, file, model, options)
        return 0
    require_reach(file.cell, model)
    _confirm(cell, options.yes)
    started = utc_now()
    session = Session.create(options.out or _unused_folder(started, file.cell.name), file.text)
    with _recording(options, session, file, cell) as recording:
        cell.record(recording)
        captures = _run(console, file, cell, calibration, session, started)
        result = conclude(file, session, captures)
        recording.document(session.result_path.name, result.to_document())
    show_result(console, file.cell, result, simulated_truth(file), as_json=options.json)
    if (distances := read_distances(session)) is not None:
        console.print(f"least distance between the arms {distances.least()}", highlight=False)
    console.print(f"session: {session.folder}", soft_wrap=True, highlight=False)
    return 0 if result.verdict == "ok" else FAULT


def _recording(options: RunOptions, session: Session, file: CellFile, cell: Cell) -> Recording:
    return LogRecording(next_segment(session.folder), file, cell.clock) if options.log else Recording()


def _run(
    console: Console, file: CellFile, cell: Cell, calibration: Calibration, session: Session, started: datetime
) -> Captures:
    """The run itself; its captures are written however it ends."""
    with signals_deferred() as signals:
        try:
            with progress(console) as watcher:
                execute(cell, calibration, session, watcher, lambda engine: signals.pass_on_to(engine.abort))
        except BaseException as error:
            try:
                write_session_captures(file, session, started)
            except OSError as second:
                error.add_note(f"captures.json could not be written ({second.strerror}); the journal has them")
            raise
        return write_session_captures(file, session, started)


def _rehearse(console: Console, file: CellFile, model: CellModel, options: RunOptions) -> None:
    """Show what a run would do; keep the plan and its picture where ``--out`` says."""
    rehearsal = rehearse(file.cell, model)
    show_rehearsal(console, file.cell, rehearsal, as_json=options.json)
    if options.out is None:
        console.print("With --out FOLDER the plan and a picture of it are written there.")
        return
    session = Session.create(options.out, file.text)
    if rehearsal.plan is not None:
        session.write_document("plan.json", rehearsal.plan.to_record())
    draw_plan(session.folder / "plan.png", file.cell, rehearsal.arms, rehearsal.plan)
    console.print(f"plan and picture: {session.folder}", soft_wrap=True, highlight=False)


def _load(options: RunOptions) -> CellFile:
    overrides = list(options.overrides)
    if options.method is not None:
        overrides.append(f"procedure.method={options.method}")
    if options.seed is not None:
        overrides.append(f"procedure.seed={options.seed}")
        if load_cell(options.cell, options.overrides).simulation is not None:
            overrides.append(f"simulation.seed={options.seed}")
    return load_cell(options.cell, overrides)


def _unused_folder(started: datetime, name: str) -> Path:
    folder = Path("sessions") / f"{started:%Y%m%d-%H%M%S}-{name}"
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(2))
    return folder if not folder.exists() else next(other for other in numbered if not other.exists())


def write_session_captures(file: CellFile, session: Session, started: datetime | None) -> Captures:
    """``captures.json`` from the journal."""
    begun = None if started is None else started.isoformat(timespec="seconds")
    captures = captures_of(session.journal, file.sha256, begun)
    write_captures(session.captures_path, captures)
    return captures


def execute(
    cell: Cell,
    calibration: Calibration,
    session: Session,
    watcher: Observer,
    begun: Callable[[Engine], None] = lambda engine: None,
) -> None:
    """Run the procedure on the cell's devices, which are closed again on any exit; ``begun`` gets the engine."""
    try:
        with Observers(watcher) as observers, cell as opened:
            engine = Engine(opened, session, observers)
            begun(engine)
            with _documents_kept(opened, session):
                engine.run(calibration.steps())
    except Exception as error:
        error.add_note(
            f"the session is kept in {session.folder}; what it has so far: dualcal estimate {session.folder}"
        )
        raise


@contextmanager
def _documents_kept(cell: Cell, session: Session) -> Iterator[None]:
    """Write what the backends measured over the run, also over one that failed."""
    try:
        yield
    except BaseException as error:
        try:
            _write_documents(cell, session)
        except OSError as second:
            error.add_note(f"what the backends measured could not be written ({second.strerror})")
        raise
    _write_documents(cell, session)


def _write_documents(cell: Cell, session: Session) -> None:
    for name, document in cell.documents().items():
        session.write_document(name, document)


def conclude(file: CellFile, session: Session, captures: Captures) -> Result:
    """Analyse, and only then compare with the truth where there is one; write both and the picture."""
    result = analyse_session(file, session, captures)
    shown = captures.captures[0]
    draw_summary(
        session.summary_path,
        cell=file.cell,
        plan=Plan.from_record(session.read_document("plan.json", PLAN_FORMAT)),
        captures=captures,
        result=result,
        image=session.read_image(shown.id),
        feature_px=shown.feature,
    )
    return result


def analyse_session(file: CellFile, session: Session, captures: Captures) -> Result:
    """The result, with its error where there is a truth, written to the session."""
    result = analyse(captures, file.cell, file.cell.procedure.method)
    truth = simulated_truth(file)
    if truth is not None:
        result = with_truth_error(result, truth)
    write_result(session.result_path, result)
    return result


def _confirm(cell: Cell, yes: bool) -> None:
    if cell.simulated or yes:
        return
    if not typer.confirm("This cell is not simulated: both arms will move. Go on?", default=False):
        raise UsageError("not confirmed; nothing was moved")


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
