"""Intrinsics over seeds: whole runs on the simulator, begun with a cell file whose camera is wrong.

The simulator has the camera of the cell file; the procedure is told another one, with focal lengths wrong by up to
``--focal`` %, a principal point wrong by up to ``--centre`` px, drawn for each seed, and no distortion. Prints for each
parameter what was found less the truth, in px and as it is and in its sigmas.

python -m tools.benchmarks.intrinsics cells/paper.yaml cells/paper-full.yaml --seeds 10
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from time import perf_counter

import numpy as np

from dualcal_hal.camera import Intrinsics
from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import DegenerateCaptures, DeviceError, NoPlan
from dualcal_hal.session.captures import CellShape
from dualcal_hal.session.folder import Session
from dualcal_hal.transforms import Array
from procedures.intrinsics import IntrinsicsProcedure, intrinsics_result, views_of
from procedures.intrinsics.estimate import NAMES, parameters
from procedures.intrinsics.result import settings
from procedures.planning.model import CellModel
from tools.cli.run import execute


@dataclass(frozen=True, eq=False)
class Run:
    """One run's figures: errors and sigma (9,), rms in px, views used, share of the cells, seconds of computing."""

    seed: int
    errors: Array
    sigma: Array
    rms: float
    views: int
    share: float
    verdict: str
    seconds: float


@dataclass(frozen=True)
class Ended:
    """A seed that came to no result, and why."""

    seed: int
    why: str


@dataclass(frozen=True)
class Wrong:
    """How wrong the cell file may be: parts of the focal lengths, px of the principal point."""

    focal: float
    centre: float


def attempt(path: Path, seed: int, wrong: Wrong, overrides: Sequence[str]) -> Run | Ended:
    """As :func:`run`; a refusal to plan, a failed device and views that determine too little are an outcome too."""
    try:
        return run(path, seed, wrong, overrides)
    except (NoPlan, DegenerateCaptures, DeviceError) as error:
        return Ended(seed, f"{type(error).__name__}: {' '.join(str(error).split())}")


def run(path: Path, seed: int, wrong: Wrong, overrides: Sequence[str]) -> Run:
    """A run of the cell with this seed for poses, noise and what is wrong in the cell file."""
    overrides = ["simulation.stepper=kinematic", *overrides, f"procedure.seed={seed}", f"simulation.seed={seed}"]
    true = load_cell(path, overrides)
    camera = true.cell.camera.intrinsics
    told = load_cell(path, [*overrides, *settings(_disturbed(camera, seed, wrong))])
    begun = perf_counter()
    with tempfile.TemporaryDirectory(prefix="dualcal-intrinsics-") as folder:
        session = Session.create(Path(folder) / "session", told.text)
        execute(Cell(true), IntrinsicsProcedure(told.cell, CellModel(told.cell)), session, lambda event: None)
        views = views_of(session.journal, CellShape.of(told.cell))
    result = intrinsics_result(views, told.cell.camera, told.cell.target.board, told.sha256, None)
    found = result.estimate
    return Run(
        seed,
        parameters(found.intrinsics) - parameters(camera),
        found.sigma,
        found.rms,
        int(found.used.sum()),
        result.coverage.share,
        result.verdict,
        perf_counter() - begun,
    )


def _disturbed(camera: Intrinsics, seed: int, wrong: Wrong) -> Intrinsics:
    rng = np.random.default_rng([seed, 5])
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1 + rng.choice([-1, 1], 2) * wrong.focal * rng.uniform(0.5, 1.0, 2)
    matrix[:2, 2] += rng.choice([-1, 1], 2) * wrong.centre * rng.uniform(0.5, 1.0, 2)
    return Intrinsics(matrix, np.zeros(5), camera.size)


def _print(path: Path, outcomes: Sequence[Run | Ended]) -> None:
    runs = [outcome for outcome in outcomes if isinstance(outcome, Run)]
    print(f"\n{path}: {len(runs)} of {len(outcomes)} runs came to a result")
    for outcome in outcomes:
        if isinstance(outcome, Ended):
            print(f"  seed {outcome.seed}: {outcome.why}")
        elif outcome.verdict != "ok":
            print(f"  seed {outcome.seed}: {outcome.verdict}")
    if not runs:
        return
    errors, sigma = np.array([one.errors for one in runs]), np.array([one.sigma for one in runs])
    normalised = errors / sigma
    print("| parameter | rms error | median sigma | rms of error / sigma | largest | above 3 sigma |")
    print("|---|---|---|---|---|---|")
    for i, name in enumerate(NAMES):
        rms, largest = np.sqrt(np.mean(normalised[:, i] ** 2)), np.abs(normalised[:, i]).max()
        print(
            f"| {name} | {np.sqrt(np.mean(errors[:, i] ** 2)):.2g} | {np.median(sigma[:, i]):.2g} | {rms:.2f} "
            f"| {largest:.2f} | {np.sum(np.abs(normalised[:, i]) > 3)} |"
        )
    for words, values in (
        ("rms px", [one.rms for one in runs]),
        ("views used", [one.views for one in runs]),
        ("share of cells", [one.share for one in runs]),
        ("seconds of computing", [one.seconds for one in runs]),
    ):
        print(f"{words}: median {np.median(values):.3g}, {min(values):.3g} to {max(values):.3g}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cells", type=Path, nargs="+")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--focal", type=float, default=3.0, help="largest error of fx and fy, percent")
    parser.add_argument("--centre", type=float, default=15.0, help="largest error of cx and cy, px")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE", dest="overrides")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    seeds, wrong = range(1, options.seeds + 1), Wrong(options.focal / 100, options.centre)
    with ProcessPoolExecutor(options.processes) as pool:
        for path in options.cells:
            _print(path, list(pool.map(attempt, repeat(path), seeds, repeat(wrong), repeat(options.overrides))))


if __name__ == "__main__":
    main()
