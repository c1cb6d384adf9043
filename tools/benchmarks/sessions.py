"""Whether errors of whole runs on the simulator are what the refined result says of them, and whether it tells if not.

python -m tools.benchmarks.sessions cells/paper-full.yaml --seeds 20 [--set PATH=VALUE]...
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from scipy import stats

from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import DegenerateCaptures, DeviceError, NoPlan
from dualcal_hal.transforms import Array, apply, inverse
from procedures.estimation.refined.motion import logarithm
from tools.benchmarks.accuracy import Ended, calibrated

NAMES = tuple(f"{what}{axis}" for what in ("t", "r") for axis in "xyz")

IMPROBABLE = float(stats.chi2.isf(1e-3, 12))
"""Normalised squares of an error that its covariance does not explain."""


@dataclass(frozen=True)
class Run:
    """errors (12,) in units of their sigmas, of T_P_A then T_H_E, translation then rotation; squares: normalised with
    the whole covariance; depth, m, and roll, rad: of the camera, off in its own frame; actual and predicted: 3D error
    at the worst point of the map, m, and its 95 % value there; scale: of squares over those of the stated noise.
    """

    seed: int
    errors: Array
    squares: float
    depth: float
    roll: float
    actual: float
    predicted: float
    scale: float
    probability: float
    verdict: str

    @property
    def silent(self) -> bool:
        """Whether the errors are not explained and nothing is said."""
        return self.squares > IMPROBABLE and self.verdict != "fail"


def attempt(path: Path, overrides: list[str], seed: int) -> Run | Ended:
    """A refusal to plan, a failed device and captures that determine too little are an outcome too."""
    try:
        return run(path, seed, overrides)
    except (NoPlan, DegenerateCaptures, DeviceError) as error:
        return Ended(seed, f"{type(error).__name__}: {' '.join(str(error).split())}")


def run(path: Path, seed: int, overrides: list[str]) -> Run:
    """Of a run with method refined and verification captures."""
    file, result = calibrated(path, seed, overrides)
    simulation, accuracy, verification = file.simulation, result.accuracy, result.verification
    if simulation is None or accuracy is None:
        raise ValueError(f"{path}: only a simulated cell with method refined says how far off it is")
    if verification is None:
        raise DegenerateCaptures("; ".join(result.reasons))
    truth = simulation.truth
    error = np.concatenate([logarithm(result.T_P_A, truth.T_P_A), logarithm(result.T_H_E, truth.T_H_E)])
    covariance = np.array(accuracy.covariance)
    points = np.array(accuracy.error_3d.map.points_mm) / 1000
    off = np.linalg.norm(apply(inverse(result.T_P_A), points) - apply(inverse(truth.T_P_A), points), axis=1)
    worst = int(np.argmax(off / np.array(accuracy.error_3d.map.p95_mm)))
    return Run(
        seed=seed,
        errors=error / np.sqrt(np.diag(covariance)),
        squares=float(error @ np.linalg.solve(covariance, error)),
        depth=float(error[8]),
        roll=float(error[11]),
        actual=float(off[worst]),
        predicted=accuracy.error_3d.map.p95_mm[worst] / 1000,
        scale=accuracy.fit.scale,
        probability=verification.probability,
        verdict=result.verdict,
    )


HEAD = "seed  squares (12)  largest/sigma  depth mm  roll deg  3D mm  predicted 95 %  scale  probability  verdict"


def row(one: Run | Ended) -> str:
    """One seed's line of the table."""
    if isinstance(one, Ended):
        return f"{one.seed:4d}  {one.why}"
    largest = int(np.argmax(np.abs(one.errors)))
    name = f"{'P_A' if largest < 6 else 'H_E'} {NAMES[largest % 6]}"
    return (
        f"{one.seed:4d}  {one.squares:12.1f}  {abs(one.errors[largest]):6.2f} {name}  {1e3 * one.depth:8.3f}"
        f"  {np.degrees(one.roll):8.4f}  {1e3 * one.actual:5.3f}  {1e3 * one.predicted:14.3f}  {one.scale:5.1f}"
        f"  {one.probability:11.2g}  {one.verdict}{'  SILENT' if one.silent else ''}"
    )


def summary(outcomes: Sequence[Run | Ended]) -> str:
    """Over the seeds that came to a result."""
    runs = [one for one in outcomes if isinstance(one, Run)]
    if not runs:
        return "no result"
    squares = np.array([one.squares for one in runs])
    errors = np.array([one.errors for one in runs])
    verdicts = ", ".join(f"{count} {verdict}" for verdict, count in Counter(one.verdict for one in runs).items())
    return "\n".join(
        [
            f"{len(runs)} of {len(outcomes)} with a result: {verdicts}",
            f"normalised squared error {squares.mean():.1f} (12), within the 95 % region"
            f" {np.mean(squares <= stats.chi2.ppf(0.95, 12)):.0%}",
            f"single parameters within 3 sigma {np.mean(np.abs(errors) <= 3):.1%},"
            f" all twelve {np.mean(np.all(np.abs(errors) <= 3, axis=1)):.0%}",
            f"3D error within its 95 % value at the worst point {np.mean([r.actual <= r.predicted for r in runs]):.0%}",
            f"errors that the covariance does not explain, and no fail: {sum(one.silent for one in runs)}",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cell", type=Path)
    parser.add_argument("--seeds", type=int, default=20, help="runs with seeds 1 to this number")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    overrides = ["simulation.stepper=kinematic", *options.set]
    load_cell(options.cell, overrides)  # what is wrong with these is no seed's outcome
    print(HEAD)
    outcomes = []
    with ProcessPoolExecutor(options.processes) as pool:
        for one in pool.map(partial(attempt, options.cell, overrides), range(1, options.seeds + 1)):
            outcomes.append(one)
            print(row(one), flush=True)
    print(summary(outcomes))


if __name__ == "__main__":
    main()
