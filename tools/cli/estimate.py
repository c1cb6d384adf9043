"""``dualcal estimate``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.config import CellConfig
from dualcal_hal.errors import FormatError, UsageError
from dualcal_hal.session.captures import Captures, CellShape, read_captures
from dualcal_hal.session.folder import Session
from dualcal_hal.session.result import Rejected, read_truth
from dualcal_hal.transforms import Array
from procedures.analysis import Choices
from procedures.analysis.board_poses import with_corners
from procedures.calibrate import captures_of, finished
from procedures.redetection import detect_anew
from tools.cli.results import analysed, compared, without, write_any
from tools.cli.show import show_result
from tools.cli.terminal import Screen
from tools.cli.triples import TriplesOptions, estimate_from_triples, holds_triples
from tools.cli.truth import simulated_truth
from tools.cli.views import ViewsOptions, estimate_from_views, holds_views

SOURCES = ("captures.json", "cell.yaml", "journal.jsonl", "plan.json")
"""Files of a session that no result may replace."""


@dataclass(frozen=True)
class EstimateOptions:
    """What the command line says."""

    captures: Path
    cell: Path | None
    method: str | None
    truth: Path | None
    out: Path | None
    redetect: bool
    noise: str | None
    keep_all: bool
    free: tuple[str, ...]
    json: bool
    sigmas: Mapping[str, str | None]  # of pose triples alone, by A, B, C
    sigma_flange: str | None  # of views alone
    sigma_pixel: float | None


def estimate_captures(options: EstimateOptions) -> None:
    """Analyse captures, pose triples or views from anywhere; print the result and write it where asked."""
    if not options.captures.exists():
        raise UsageError(f"{options.captures}: does not exist")
    _check_out(options)
    if _estimated_without_cell(options):
        return
    file = load_cell(_cell_path(options), meshes=False, backends=False)
    captures, unfinished = _captures(options.captures, file)
    console = Screen(stderr=options.json)
    if options.redetect:
        captures, unseen = _detected_anew(console, options.captures, captures, file.cell)
        unfinished = (*unfinished, *unseen)
    ours = captures.cell_sha256 == file.sha256
    if captures.cell_sha256 is not None and not ours:
        console.print(
            f"warning: the captures were taken with another cell file than {_cell_path(options)}", style="yellow"
        )
    result = analysed(captures, file.cell, options.method or file.cell.procedure.method, _choices(options))
    if unfinished:
        said = f"{len(unfinished)} captures left out, the first {unfinished[0].id}: {unfinished[0].reason}"
        result = without(result, unfinished, said)
    folder = options.captures if options.captures.is_dir() else options.captures.parent
    truth = _truth(options.truth, file, folder, ours=ours)
    if truth is not None:
        result = compared(result, truth)
    if options.out is not None:
        try:
            write_any(options.out, result)
        except OSError as error:
            raise UsageError(f"{options.out}: cannot be written: {error.strerror}") from error
    show_result(console, file.cell, result, truth, as_json=options.json)
    if options.out is None:
        console.print("Not written to a file; --out FILE does that.")


def _estimated_without_cell(options: EstimateOptions) -> bool:
    """Whether there were pose triples or views."""
    if holds_triples(options.captures):
        _refuse_unfit(options, "pose triples")
        estimate_from_triples(TriplesOptions(options.captures, options.sigmas, options.out, options.json))
        return True
    if holds_views(options.captures):
        _refuse_unfit(options, "views")
        estimate_from_views(_of_views(options))
        return True
    _refuse_unfit(options, "captures")
    return False


def _refuse_unfit(options: EstimateOptions, here: str) -> None:
    """Options that say something of what the file does not have; here: what it has."""
    captures, triples, views, either = ("captures",), ("pose triples",), ("views",), ("captures", "views")
    given = {
        "--cell": (options.cell is not None, captures),
        "--method": (options.method is not None, captures),
        "--truth": (options.truth is not None, captures),
        "--redetect": (options.redetect, captures),
        "--noise": (options.noise is not None, either),
        "--keep-all": (options.keep_all, either),
        "--free": (bool(options.free), either),
        **{f"--sigma-{name.lower()}": (sigma is not None, triples) for name, sigma in options.sigmas.items()},
        "--sigma-flange": (options.sigma_flange is not None, views),
        "--sigma-pixel": (options.sigma_pixel is not None, views),
    }
    unfit = {name: of for name, (is_given, of) in given.items() if is_given and here not in of}
    if unfit:
        there = " and ".join(dict.fromkeys(kind for of in unfit.values() for kind in of))
        raise UsageError(f"{options.captures}: has {here}; leave out what is for {there}: {', '.join(unfit)}")


def _of_views(options: EstimateOptions) -> ViewsOptions:
    return ViewsOptions(
        options.captures,
        options.noise,
        options.sigma_flange,
        options.sigma_pixel,
        options.keep_all,
        options.free,
        options.out,
        options.json,
    )


def _choices(options: EstimateOptions) -> Choices | None:
    """Of the refined method; None where none was made."""
    if options.noise is None and not options.keep_all and not options.free:
        return None
    return Choices(options.noise == "estimate", options.keep_all, options.free)


def _cell_path(options: EstimateOptions) -> Path:
    if options.cell is not None:
        return options.cell
    folder = options.captures if options.captures.is_dir() else options.captures.parent
    if (folder / "cell.yaml").exists():
        return folder / "cell.yaml"
    raise UsageError(f"{options.captures}: there is no cell.yaml beside it; name the cell file with --cell")


def _check_out(options: EstimateOptions) -> None:
    """Results replace results, never the data they come from, and no device."""
    out = options.out
    if out is None or not out.exists():
        return
    if not out.is_file():
        raise UsageError(f"{out}: is no regular file")
    folder = options.captures if options.captures.is_dir() else options.captures.parent
    sources = (options.captures, *(folder / name for name in SOURCES), options.cell, options.truth)
    if any(source is not None and source.exists() and out.samefile(source) for source in sources):
        raise UsageError(f"{out}: is what the estimate is made from; name another file with --out")


def _captures(path: Path, file: CellFile) -> tuple[Captures, tuple[Rejected, ...]]:
    """The captures, and those of a session's unfinished constraint, which are left out."""
    cell = file.cell
    folder = path if path.is_dir() else path.parent
    source = path / "captures.json" if path.is_dir() else path
    if not (folder / "journal.jsonl").exists():
        return _read(source, cell), ()
    written = _read(source, cell) if source.exists() else None
    if path.is_dir():
        # A run that was killed had no time to write its captures, or left those of an earlier part.
        journalled = _journalled(folder, file, required=written is None)
        if written is None or (journalled is not None and len(journalled.captures) > len(written.captures)):
            written = journalled
    assert written is not None  # what is named exists
    return finished(written, cell.procedure)


def _journalled(folder: Path, file: CellFile, *, required: bool) -> Captures | None:
    """The captures that the session's journal has; None for a damaged one that is not required."""
    try:
        journal = Session(folder).journal
        return captures_of(journal, file.sha256, None, CellShape.of(file.cell))
    except FormatError:
        if required:
            raise
        return None


def _read(path: Path, cell: CellConfig) -> Captures:
    joints = (cell.active.chain.joints, cell.passive.chain.joints)
    board, size = cell.target.board, cell.camera.intrinsics.size
    read = read_captures(path, joints=joints, corners=len(board.corners), feature=board.feature, image_size=size)
    return with_corners(read, cell)


def _detected_anew(
    console: Console, folder: Path, captures: Captures, cell: CellConfig
) -> tuple[Captures, tuple[Rejected, ...]]:
    """The captures with the corners that their recorded images show now, and those that show none."""
    if not folder.is_dir():
        raise UsageError(f"{folder}: --redetect needs the session's folder, which has the images")
    anew = detect_anew(Session(folder), captures, cell)
    console.print(f"detected anew in {len(anew.captures.captures)} images; {anew.moved}", highlight=False)
    return anew.captures, anew.missed


def _truth(path: Path | None, file: CellFile, folder: Path, *, ours: bool) -> Mapping[str, Array] | None:
    if path is not None:
        return read_truth(path) if file.one_arm is None else read_truth(path, file.one_arm.names)
    return simulated_truth(file, folder) if ours else None
