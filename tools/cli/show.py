"""What a command puts on the screen."""

from __future__ import annotations

import json
from collections.abc import Mapping

import typer
from rich.console import Console

from dualcal_hal.config import CellConfig
from dualcal_hal.transforms import Array
from procedures.one_arm.rehearsal import RehearsedViews
from procedures.rehearsal import Rehearsal
from procedures.report import plan_table, views_table, way_table
from tools.cli.results import AnyResult, tables_of


def show_result(
    console: Console, cell: CellConfig, result: AnyResult, truth: Mapping[str, Array] | None, *, as_json: bool
) -> None:
    """Tables for a person, or the document alone for a program."""
    if as_json:
        typer.echo(json.dumps(result.to_document(), indent=1, allow_nan=False))
    else:
        console.print(tables_of(cell, result, truth))


def show_rehearsal(console: Console, cell: CellConfig, rehearsal: Rehearsal, *, as_json: bool) -> None:
    """The way to the stand-off, the looks and the provisional plan; the plan alone (or null) for a program."""
    if as_json:
        typer.echo(json.dumps(None if rehearsal.plan is None else rehearsal.plan.to_record(), indent=1))
        return
    console.print(f"Dry run of cell '{cell.name}': no device is opened.")
    if rehearsal.stand_off is not None:
        stand_off = rehearsal.stand_off
        console.print(
            f"\nFrom home to the stand-off: camera and target {stand_off.distance * 1e3:.0f} mm apart, "
            f"the arms {stand_off.clearance * 1e3:.0f} mm clear of each other whatever the bases' error"
        )
        if stand_off.way:
            console.print(way_table(stand_off.way))
        for number, taken in enumerate(rehearsal.looks, start=1):
            look = f"Look {number} of {len(rehearsal.looks)}"
            if taken.way is None:
                console.print(f"{look} is missed: {taken.missed}")
            elif not taken.way:
                console.print(f"{look}, from where the arms stand")
            else:
                console.print(look)
                console.print(way_table(taken.way))
    if rehearsal.plan is None:
        console.print(f"There is no provisional plan from the nominal transforms ({rehearsal.no_plan}).")
        console.print("The run plans after its looks, with better transforms.")
        return
    console.print("Provisional: the run plans anew after its looks." if rehearsal.stand_off else "From the nominal:")
    console.print(plan_table(rehearsal.plan))


def show_rehearsed_views(console: Console, cell: CellConfig, rehearsed: RehearsedViews, *, as_json: bool) -> None:
    """The looks and the provisional plan of a cell with one arm; the plan alone (or null) for a program."""
    if as_json:
        typer.echo(json.dumps(None if rehearsed.plan is None else rehearsed.plan.to_record(), indent=1))
        return
    console.print(f"Dry run of cell '{cell.name}': no device is opened.")
    if rehearsed.looks is not None:
        looks = f"{cell.procedure.first_looks} first looks, from as many of these as it takes:"
        console.print(looks)
        console.print(views_table(rehearsed.looks))
    if rehearsed.plan is None:
        console.print(f"There is no provisional plan from the nominal transforms ({rehearsed.no_plan}).")
        console.print("The run plans after its looks, with better transforms.")
        return
    console.print("Provisional: the run plans anew after its looks." if rehearsed.looks else "From the nominal:")
    console.print(views_table(rehearsed.plan))
