"""Whole runs of a cell with one arm over seeds: whether their errors are what the result says of them.

python -m tools.benchmarks.one_arm cells/eye-in-hand.yaml --seeds 20 [--set PATH=VALUE]...
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.config import OneArmCell
from dualcal_hal.errors import DegenerateCaptures, DeviceError, NoPlan, UsageError
from dualcal_hal.session.folder import Session
from dualcal_hal.session.one_arm_result import OneArmResult
from dualcal_hal.transforms import Array
from procedures.calibrate import captures_of
from procedures.estimation.refined.motion import logarithm
from procedures.one_arm.procedure import OneArmCalibration
from tools.benchmarks.accuracy import Ended
from tools.cli.run import conclude, execute
from tools.cli.truth import told_truth

IMPROBABLE = float(stats.chi2.isf(1e-3, 12))
"""Normalised squares of an error that its covariance does not explain."""


@dataclass(frozen=True)
class Run:
    """errors (12,) in units of their sigmas, of camera then target, translation then rotation; squares: normalised with
    the whole covariance; camera, target: off by, mm; left_out, verified: px rms.
    """

    seed: int
    errors: Array
    squares: float
    camera: float
    target: float
    left_out: float
    verified: float
    probability: float
    verdict: str


def attempt(path: Path, overrides: list[str], seed: int) -> Run | Ended:
    """A refusal to plan, a failed device and captures that determine too little are an outcome too."""
    try:
        return run(path, seed, overrides)
    except (NoPlan, DegenerateCaptures, DeviceError) as error:
        return Ended(seed, f"{type(error).__name__}: {' '.join(str(error).split())}")


def run(path: Path, seed: int, overrides: list[str]) -> Run:
    """A whole run with both seeds set, in a folder that is thrown away."""
    file = load_cell(path, [*overrides, f"procedure.seed={seed}", f"simulation.seed={seed}"])
    if not isinstance(file.cell, OneArmCell):
        raise UsageError(f"{path}: is no cell of one arm")
    with tempfile.TemporaryDirectory() as folder:
        session = Session.create(Path(folder) / "session", file.text)
        execute(Cell(file), OneArmCalibration(file.cell), session, lambda event: None)
        result = conclude(file, session, captures_of(session.journal, file.sha256, None))
    assert isinstance(result, OneArmResult)
    return _figures(file, seed, result)


def _figures(file: CellFile, seed: int, result: OneArmResult) -> Run:
    truth, errors = told_truth(file), []
    assert truth is not None  # the cell is simulated
    for name, found in result.transforms.items():
        errors.append(logarithm(found.T, truth[name]))
    error, covariance = np.concatenate(errors), np.array(result.covariance.matrix)
    proof = result.verification
    return Run(
        seed,
        error / np.sqrt(np.diag(covariance)),
        float(error @ np.linalg.solve(covariance, error)),
        1e3 * float(np.linalg.norm(error[:3])),
        1e3 * float(np.linalg.norm(error[6:9])),
        result.left_out.rms_px,
        np.nan if proof is None else proof.found.rms_px,
        np.nan if proof is None else proof.probability,
        result.verdict,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cell", type=Path)
    parser.add_argument("--seeds", type=int, default=20, help="runs with seeds 1 to this number")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    load_cell(options.cell, options.set)  # what is wrong with these is no seed's outcome
    print("seed  squares  largest sigma  camera mm  target mm  left out px  verified px  probability  verdict")
    outcomes = []
    with ProcessPoolExecutor(options.processes) as pool:
        for one in pool.map(partial(attempt, options.cell, options.set), range(1, options.seeds + 1)):
            outcomes.append(one)
            print(row(one), flush=True)
    print(summary(outcomes))


def row(one: Run | Ended) -> str:
    """One seed's line of the table."""
    if isinstance(one, Ended):
        return f"{one.seed:4d}  {one.why}"
    return (
        f"{one.seed:4d}  {one.squares:7.1f}  {np.max(np.abs(one.errors)):13.2f}  {one.camera:9.4f}  {one.target:9.4f}"
        f"  {one.left_out:11.3f}  {one.verified:11.3f}  {one.probability:11.2g}  {one.verdict}"
    )


def summary(outcomes: Sequence[Run | Ended]) -> str:
    """Over the seeds that came to a result, and how many did not."""
    runs = [one for one in outcomes if isinstance(one, Run)]
    without = f"without a result {len(outcomes) - len(runs)} of {len(outcomes)} seeds"
    if not runs:
        return without
    squares, errors = np.array([one.squares for one in runs]), np.array([one.errors for one in runs])
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(one.verdict for one in runs).items())
    silent = sum(one.squares > IMPROBABLE and one.verdict != "fail" for one in runs)
    return (
        f"normalised squares: mean {squares.mean():.2f} of 12; 95 % region holds "
        f"{100 * np.mean(squares <= stats.chi2.isf(0.05, 12)):.0f} %; within 3 sigma "
        f"{100 * np.mean(np.abs(errors) <= 3):.1f} % of the numbers; camera rms "
        f"{np.sqrt(np.mean([one.camera**2 for one in runs])):.4f} mm, target rms "
        f"{np.sqrt(np.mean([one.target**2 for one in runs])):.4f} mm; {verdicts}; wrong and silent {silent}; {without}"
    )


if __name__ == "__main__":
    main()
