"""Are plans found, and do they touch? Whole runs on random cells at the edge of the stated error.

python -m tools.benchmarks.safety --cells 1000 [--first 1] [--arms paper] [--stepper bullet]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import Contact, DualcalError, NoPlan
from dualcal_hal.session.folder import Session
from procedures.calibrate import Calibration
from procedures.planning.model import CellModel
from procedures.planning.plan import Plan
from procedures.planning.poses import PosePlanner
from tools.benchmarks.edge_cells import edge_cell
from tools.cli.run import execute


@dataclass(frozen=True)
class Outcome:
    """What came of one cell: "run", "refused", "contact" or "failed", and why; seconds each plan took."""

    number: int
    kind: str
    why: str
    plans: tuple[float, ...]


class _TimedPlans:
    """While entered, how long each plan takes in this process."""

    def __enter__(self) -> list[float]:
        self._plan = PosePlanner.plan
        times: list[float] = []

        def timed(planner: PosePlanner, *arguments: object, **options: object) -> Plan:
            begin = time.perf_counter()
            try:
                return self._plan(planner, *arguments, **options)  # type: ignore[arg-type]
            finally:
                times.append(time.perf_counter() - begin)

        PosePlanner.plan = timed  # type: ignore[method-assign, assignment]
        return times

    def __exit__(self, *exception: object) -> None:
        PosePlanner.plan = self._plan  # type: ignore[method-assign]


def run(number: int, stepper: str, arms: str | None) -> Outcome:
    """A whole run on one cell, in a folder that is thrown away."""
    with tempfile.TemporaryDirectory() as folder, _TimedPlans() as plans:
        path = Path(folder) / "cell.yaml"
        path.write_text(edge_cell(number, stepper=stepper, arms=arms))
        kind, why = "run", ""
        try:
            file = load_cell(path)
            session = Session.create(Path(folder) / "session", file.text)
            execute(Cell(file), Calibration(file.cell, CellModel(file.cell)), session, lambda event: None)
        except NoPlan as refusal:
            kind, why = "refused", str(refusal)
        except Contact as contact:
            kind, why = "contact", str(contact)
        except DualcalError as error:
            kind, why = "failed", str(error)
    return Outcome(number, kind, why, tuple(plans))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=int, default=1000)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--arms", choices=["paper", "public"], default="public")
    parser.add_argument("--stepper", choices=["bullet", "kinematic"], default="bullet")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    numbers = range(options.first, options.first + options.cells)
    arms = "paper" if options.arms == "paper" else None
    outcomes = []
    with ProcessPoolExecutor(options.processes) as pool:
        for one in pool.map(run, numbers, [options.stepper] * len(numbers), [arms] * len(numbers)):
            outcomes.append(one)
            first = one.plans[0] if one.plans else np.nan
            plans = f"first plan {first:5.2f} s of {len(one.plans)}"
            print(f"{one.number:5d}  {one.kind:8s}  {plans}  {one.why}", flush=True)
    kinds = Counter(one.kind for one in outcomes)
    times = [one.plans[0] for one in outcomes if one.plans]
    print(f"{len(outcomes)} cells: {', '.join(f'{kind} {count}' for kind, count in kinds.most_common())}")
    if times:
        p95 = np.percentile(times, 95)
        print(f"first plan median {np.median(times):.2f}, p95 {p95:.2f}, max {np.max(times):.2f} s")


if __name__ == "__main__":
    main()
