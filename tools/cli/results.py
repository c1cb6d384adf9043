"""Results of cells with two arms and with one, for commands that do the same with either."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import RenderableType

from dualcal_hal.config import CellConfig, OneArmCell
from dualcal_hal.errors import UsageError
from dualcal_hal.session.captures import Captures
from dualcal_hal.session.one_arm_result import (
    OneArmResult,
    read_one_arm_result,
    with_errors_against,
    write_one_arm_result,
)
from dualcal_hal.session.result import Rejected, Result, read_result, with_truth_error, write_result
from dualcal_hal.transforms import Array
from procedures.analysis import Choices, analyse
from procedures.one_arm.analysis import analyse_one_arm
from procedures.report import one_arm_tables, result_tables

AnyResult = Result | OneArmResult


def analysed(captures: Captures, cell: CellConfig, method: str, choices: Choices | None = None) -> AnyResult:
    """The result of captures of this cell."""
    if not isinstance(cell, OneArmCell):
        return analyse(captures, cell, method, choices)
    if method != "refined":
        raise UsageError(f"method '{method}' needs two arms; a cell with one is for method refined")
    return analyse_one_arm(captures, cell, choices)


def compared(result: AnyResult, truth: Mapping[str, Array]) -> AnyResult:
    """The same with its errors against the truth."""
    if isinstance(result, OneArmResult):
        return with_errors_against(result, truth)
    return with_truth_error(result, truth)


def without(result: AnyResult, rejected: Sequence[Rejected], reason: str) -> AnyResult:
    """The same, telling of more captures that were left out."""
    every, reasons = (*result.captures_rejected, *rejected), (*result.reasons, reason)
    if isinstance(result, OneArmResult):
        return result.model_copy(update={"captures_rejected": every, "reasons": reasons})
    return replace(result, captures_rejected=every, reasons=reasons)


def write_any(path: Path, result: AnyResult) -> None:
    """The public file."""
    if isinstance(result, OneArmResult):
        write_one_arm_result(path, result)
    else:
        write_result(path, result)


def read_any(path: Path, cell: CellConfig) -> AnyResult:
    """The public file of a session of this cell."""
    return read_one_arm_result(path) if isinstance(cell, OneArmCell) else read_result(path)


def tables_of(cell: CellConfig, result: AnyResult, truth: Mapping[str, Array] | None) -> RenderableType:
    """For a person."""
    if isinstance(result, OneArmResult):
        assert isinstance(cell, OneArmCell)
        return one_arm_tables(cell.one_arm, result, truth)
    return result_tables(cell, result, truth)
