"""Runs of a cell with one arm over seeds: whether their errors are what the result says of them, and the verdict too.

python -m tools.benchmarks.one_arm cells/eye-in-hand.yaml --seeds 20 [--set PATH=VALUE]...
python -m tools.benchmarks.one_arm cells/eye-in-hand.yaml --seeds 2000 --drawn

Drawn captures are those of the provisional plan with corners off by camera.sigma_px and an arm off by simulation.noise:
no simulator, no images, nothing but the estimate.
"""

from __future__ import annotations

import argparse
import tempfile
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np
from scipy import stats

from dualcal_hal.cell import Cell
from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.config import OneArmCell
from dualcal_hal.errors import DegenerateCaptures, DeviceError, NoPlan, UsageError
from dualcal_hal.session.captures import CaptureRecord, Captures
from dualcal_hal.session.folder import Session
from dualcal_hal.session.one_arm_result import OffRecord, OneArmResult
from dualcal_hal.transforms import Array, apply, inverse
from procedures.calibrate import captures_of
from procedures.estimation.projection import project
from procedures.estimation.refined.motion import logarithm
from procedures.one_arm.analysis import analyse_one_arm
from procedures.one_arm.procedure import OneArmCalibration
from procedures.one_arm.rehearsal import rehearse_views
from procedures.planning.plan import Plan
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
    scale: float
    dropped: int


def attempt(path: Path, overrides: list[str], is_drawn: bool, seed: int) -> Run | Ended:
    """A refusal to plan, a failed device and captures that determine too little are an outcome too."""
    try:
        return drawn(path, seed, overrides) if is_drawn else run(path, seed, overrides)
    except (NoPlan, DegenerateCaptures, DeviceError) as error:
        return Ended(seed, f"{type(error).__name__}: {' '.join(str(error).split())}")


def run(path: Path, seed: int, overrides: list[str]) -> Run:
    """A whole run with both seeds set, in a folder that is thrown away."""
    file = load_cell(path, [*overrides, f"procedure.seed={seed}", f"simulation.seed={seed}"])
    cell = _cell_of(file)
    with tempfile.TemporaryDirectory() as folder:
        session = Session.create(Path(folder) / "session", file.text)
        execute(Cell(file), OneArmCalibration(cell), session, lambda event: None)
        result = conclude(file, session, captures_of(session.journal, file.sha256, None))
    assert isinstance(result, OneArmResult)
    return _figures(file, seed, result)


def drawn(path: Path, seed: int, overrides: list[str]) -> Run:
    """The estimate alone, from captures whose noise is drawn."""
    file, plan = _planned(path, tuple(overrides))
    return _figures(file, seed, analyse_one_arm(draw_captures(file, plan, seed), _cell_of(file)))


@cache
def _planned(path: Path, overrides: tuple[str, ...]) -> tuple[CellFile, Plan]:
    file = load_cell(path, overrides)
    plan = rehearse_views(_cell_of(file)).plan
    if plan is None:
        raise UsageError(f"{path}: has no provisional plan")
    return file, plan


def _cell_of(file: CellFile) -> OneArmCell:
    if not isinstance(file.cell, OneArmCell):
        raise UsageError("is no cell of one arm")
    return file.cell


def draw_captures(file: CellFile, plan: Plan, seed: int) -> Captures:
    """Of the views planned, the arm read ``encoder`` and its arrival's error beside where it stood."""
    cell, truth, rng = _cell_of(file), told_truth(file), np.random.default_rng(seed)
    assert truth is not None  # the cell is simulated
    assert file.simulation is not None
    config, noise, camera = cell.one_arm, file.simulation.noise, cell.camera
    T_camera, T_target = (truth[name] for name in config.names)
    captures = []
    for number, view in enumerate(plan.constraints):
        commanded = np.array(view.active or view.positions[0].passive)
        stood = commanded + 1e-3 * noise.joint_mrad * rng.standard_normal(commanded.shape)
        read = commanded + 1e-3 * noise.encoder_mrad * np.sqrt(0.5) * rng.standard_normal(commanded.shape)
        flange = config.arm.chain.forward(stood)
        T_B_E, T_B_T = (flange @ T_camera, T_target) if config.camera_on_arm else (T_camera, flange @ T_target)
        board = cell.target.board
        seen = project(
            apply(inverse(T_B_E) @ T_B_T, board.corners), camera.intrinsics.matrix, camera.intrinsics.distortion
        )
        corners = tuple(map(tuple, (seen + camera.sigma_px * rng.standard_normal(seen.shape)).tolist()))
        angles: tuple[float, ...] = tuple(read.tolist())
        captures.append(
            CaptureRecord(
                id=f"{view.name}/0",
                use=view.use,
                constraint=view.name,
                position=0,
                active_arrival=number if config.camera_on_arm else 0,
                active_joints=angles if config.camera_on_arm else (),
                passive_joints=() if config.camera_on_arm else angles,
                feature=corners[board.feature],
                corners=corners,
                image_size=camera.intrinsics.size,
                aligned=False,
            )
        )
    return Captures(file.sha256, None, tuple(captures))


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
        _pixels(result.left_out),
        np.nan if proof is None else _pixels(proof.found),
        np.nan if proof is None else proof.probability,
        result.verdict,
        result.fit.scale,
        len(result.captures_rejected),
    )


def _pixels(off: OffRecord | None) -> float:
    """px rms; NaN where the target should be behind the camera."""
    return np.nan if off is None else off.rms_px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cell", type=Path)
    parser.add_argument("--seeds", type=int, default=20, help="runs with seeds 1 to this number")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--drawn", action="store_true", help="captures with drawn noise in place of whole runs")
    options = parser.parse_args()
    load_cell(options.cell, options.set)  # what is wrong with these is no seed's outcome
    if not options.drawn:
        print("seed  squares  largest sigma  camera mm  target mm  left out px  verified px  probability  verdict")
    outcomes: list[Run | Ended] = []
    seeds, chunk = range(1, options.seeds + 1), 20 if options.drawn else 1
    with ProcessPoolExecutor(options.processes) as pool:
        for one in pool.map(partial(attempt, options.cell, options.set, options.drawn), seeds, chunksize=chunk):
            outcomes.append(one)
            if not options.drawn:
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
    misfit, left_out = (sum(told) for told in ([one.scale > 1 for one in runs], [one.dropped > 0 for one in runs]))
    return (
        f"normalised squares: mean {squares.mean():.2f} of 12; 95 % region holds "
        f"{100 * np.mean(squares <= stats.chi2.isf(0.05, 12)):.0f} %; within 3 sigma "
        f"{100 * np.mean(np.abs(errors) <= 3):.1f} % of the numbers; camera rms "
        f"{np.sqrt(np.mean([one.camera**2 for one in runs])):.4f} mm, target rms "
        f"{np.sqrt(np.mean([one.target**2 for one in runs])):.4f} mm; {verdicts}; with misfit {misfit}, "
        f"with views left out {left_out}; wrong and silent {silent}; {without}"
    )


if __name__ == "__main__":
    main()
