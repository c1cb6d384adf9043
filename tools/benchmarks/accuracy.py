"""Accuracy and alignment over seeds: whole runs on the simulator. A seed without a result is told with its reason.

python -m tools.benchmarks.accuracy cells/paper.yaml --seeds 20 [--set PATH=VALUE]...
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.errors import DegenerateCaptures, DeviceError, NoPlan, UsageError
from dualcal_hal.session.folder import Session
from dualcal_hal.session.result import Result
from procedures.calibrate import Calibration, captures_of
from procedures.events import PointDone
from procedures.planning.model import CellModel
from tools.cli.run import conclude, execute


@dataclass(frozen=True)
class Run:
    """One run's figures: mismatch and translation in mm, rotation in deg, frames for each point, points given up.

    ``later_frames``: those of the points from the fourth constraint on.
    """

    seed: int
    mismatch: float
    translation: float
    rotation: float
    frames: tuple[int, ...]
    later_frames: tuple[int, ...]
    given_up: int
    verdict: str


@dataclass(frozen=True)
class Ended:
    """A seed that came to no result, and why."""

    seed: int
    why: str


def attempt(path: Path, seed: int, overrides: list[str]) -> Run | Ended:
    """As :func:`run`; a refusal to plan, a failed device and captures that determine too little are an outcome too."""
    try:
        return run(path, seed, overrides)
    except (NoPlan, DegenerateCaptures, DeviceError) as error:
        return Ended(seed, f"{type(error).__name__}: {' '.join(str(error).split())}")


def calibrated(
    path: Path, seed: int, overrides: list[str], observe: Callable[[object], None] = lambda event: None
) -> tuple[CellFile, Result]:
    """The result of a whole run with both seeds set, in a folder that is thrown away."""
    file = load_cell(path, [*overrides, f"procedure.seed={seed}", f"simulation.seed={seed}"])
    with tempfile.TemporaryDirectory() as folder:
        session = Session.create(Path(folder) / "session", file.text)
        execute(Cell(file), Calibration(file.cell, CellModel(file.cell)), session, observe)
        result = conclude(file, session, captures_of(session.journal, file.sha256, None))
    if not isinstance(result, Result):
        raise UsageError(f"{path}: one arm alone has no base of another to be found")
    return file, result


def run(path: Path, seed: int, overrides: list[str]) -> Run:
    """The figures of a whole run; DegenerateCaptures if nothing verifies it."""
    points: list[PointDone] = []

    def collect(event: object) -> None:
        if isinstance(event, PointDone):
            points.append(event)

    _, result = calibrated(path, seed, overrides, collect)
    constraints = list(dict.fromkeys(point.constraint for point in points))
    if result.mismatch_after is None:
        raise DegenerateCaptures("; ".join(result.reasons))
    assert result.truth_error is not None  # the cell is simulated
    return Run(
        seed,
        result.mismatch_after.mean * 1e3,
        result.truth_error.base_translation * 1e3,
        float(np.rad2deg(result.truth_error.base_rotation)),
        tuple(point.frames for point in points),
        tuple(point.frames for point in points if constraints.index(point.constraint) >= 3),
        sum(not point.captured for point in points),
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
    seeds = range(1, options.seeds + 1)
    print("seed  mismatch mean mm  T_P_A deg  T_P_A mm  frames mean  p95  given up  verdict")
    outcomes = []
    with ProcessPoolExecutor(options.processes) as pool:
        for one in pool.map(attempt, [options.cell] * len(seeds), seeds, [options.set] * len(seeds)):
            outcomes.append(one)
            print(row(one), flush=True)
    print(summary(outcomes))


def row(one: Run | Ended) -> str:
    """One seed's line of the table."""
    if isinstance(one, Ended):
        return f"{one.seed:4d}  {one.why}"
    return (
        f"{one.seed:4d}  {one.mismatch:16.4f}  {one.rotation:9.4f}  {one.translation:8.3f}"
        f"  {np.mean(one.frames):11.2f}  {np.percentile(one.frames, 95):3.0f}"
        f"  {one.given_up:8d}  {one.verdict}"
    )


def summary(outcomes: Sequence[Run | Ended]) -> str:
    """The figures over the seeds that came to a result, and how many did not."""
    runs = [one for one in outcomes if isinstance(one, Run)]
    without = f"without a result {len(outcomes) - len(runs)} of {len(outcomes)} seeds"
    if not runs:
        return without
    frames = np.concatenate([one.frames for one in runs])
    later = np.concatenate([one.later_frames for one in runs])
    mismatch, rotation, translation = np.array([(one.mismatch, one.rotation, one.translation) for one in runs]).T
    return (
        f"mismatch: mean {mismatch.mean():.4f}, max {mismatch.max():.4f} mm; T_P_A: rms {_rms(rotation):.4f}, max "
        f"{rotation.max():.4f} deg, rms {_rms(translation):.3f}, max {translation.max():.3f} mm; frames a point: mean "
        f"{frames.mean():.2f}, p95 {np.percentile(frames, 95):.0f}, max {frames.max()}, "
        f"from the fourth constraint on {later.mean():.2f}; "
        f"given up {sum(one.given_up for one in runs)} of {len(frames)} points; {without}"
    )


def _rms(values: np.ndarray[tuple[int], np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(values**2)))


if __name__ == "__main__":
    main()
