"""``dualcal estimate``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import UsageError
from dualcal_hal.session.captures import Captures, read_captures
from dualcal_hal.session.folder import Session
from dualcal_hal.session.result import read_truth, with_truth_error, write_result
from dualcal_hal.transforms import Array
from procedures.analysis import analyse
from procedures.calibrate import captures_of
from tools.cli.show import show_result
from tools.cli.truth import simulated_truth


@dataclass(frozen=True)
class EstimateOptions:
    """What the command line says."""

    captures: Path
    cell: Path | None
    method: str | None
    truth: Path | None
    out: Path | None
    json: bool


def estimate_captures(options: EstimateOptions) -> None:
    """Analyse captures from anywhere; print the result and write it where asked."""
    file = load_cell(_cell_path(options))
    captures = _captures(options.captures, file)
    console = Console(stderr=options.json)
    ours = captures.cell_sha256 == file.sha256
    if captures.cell_sha256 is not None and not ours:
        console.print(
            f"warning: the captures were taken with another cell file than {_cell_path(options)}", style="yellow"
        )
    result = analyse(captures, file.cell, options.method or file.cell.procedure.method)
    truth = _truth(options.truth, file if ours else None)
    if truth is not None:
        result = with_truth_error(result, truth)
    if options.out is not None:
        try:
            write_result(options.out, result)
        except OSError as error:
            raise UsageError(f"{options.out}: cannot be written: {error.strerror}") from error
    show_result(console, file.cell, result, truth, as_json=options.json)


def _cell_path(options: EstimateOptions) -> Path:
    if options.cell is not None:
        return options.cell
    folder = options.captures if options.captures.is_dir() else options.captures.parent
    if (folder / "cell.yaml").exists():
        return folder / "cell.yaml"
    raise UsageError(f"{options.captures}: there is no cell.yaml beside it; name the cell file with --cell")


def _captures(path: Path, file: CellFile) -> Captures:
    cell = file.cell
    joints = (cell.active.chain.joints, cell.passive.chain.joints)
    source = path / "captures.json" if path.is_dir() else path
    if path.is_dir() and not source.exists() and (path / "journal.jsonl").exists():
        # A run that was killed had no time to write its captures; its journal has them.
        return captures_of(Session(path).journal, file.sha256, None)
    return read_captures(source, joints=joints, corners=len(cell.target.board.corners))


def _truth(path: Path | None, file: CellFile | None) -> Mapping[str, Array] | None:
    if path is not None:
        return read_truth(path)
    return None if file is None else simulated_truth(file)
