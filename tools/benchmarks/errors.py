"""What each error of a real cell does to the result, alone and without noise: the mean mismatch and the error of T_P_A.

On the reference captures of the paper's cell, without images. Prints the rows of a Markdown table.

python -m tools.benchmarks.errors --seeds 10
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.cellfile import CellFile, load_cell
from dualcal_hal.config import CellConfig, SimulationConfig
from dualcal_hal.config.errors import ErrorsConfig
from dualcal_hal.session.captures import Captures, read_captures
from dualcal_hal.transforms import Array, rotation_angle
from procedures.analysis import analyse
from procedures.estimation import CornerFit, Prior, fit_corners, mismatch
from tools.benchmarks.captures import simulated_captures

CELL = Path("cells/paper.yaml")
POSES = Path("tests/data/reference-7x4.json")

Errors = Mapping[str, Mapping[str, Any]]
"""As a cell file has them under ``simulation.errors``."""

_PRIOR_SIGMAS = (0.2, 0.2, 0.02, 0.2)  # m and rad of T_P_A, then of T_H_E: nothing is held back
_PIXEL_SIGMA = 0.02


@dataclass(frozen=True)
class Figures:
    """Mean mismatch on the verification captures in mm, by the method of the paper and by a fit to all corners; of
    the fit the errors of T_P_A in mm and deg, and the rms of its residuals in px."""

    paper: float
    corners: float
    translation: float
    rotation: float
    residual: float


def figures(errors: Errors, seed: int = 1) -> Figures:
    """Of the paper's cell without noise but with ``errors``, drawn from a seed."""
    cell, simulation = paper_cell(errors, seed)
    captures = simulated_captures(cell, simulation, read_captures(POSES))
    after = analyse(captures, cell, "paper").mismatch_after
    assert after is not None
    fit, truth = fit_to_all_corners(cell, captures), simulation.truth
    T_A_H, T_P_T, _ = _views(cell, captures, "verification")
    return Figures(
        paper=1e3 * after.mean,
        corners=1e3 * float(mismatch(fit.T_P_A, fit.T_H_E, T_A_H, T_P_T[:, :3, 3]).mean()),
        translation=1e3 * float(np.linalg.norm(fit.T_P_A[:3, 3] - truth.T_P_A[:3, 3])),
        rotation=float(np.rad2deg(rotation_angle(fit.T_P_A[:3, :3], truth.T_P_A[:3, :3]))),
        residual=fit.rms,
    )


def paper_cell(errors: Errors, seed: int = 1) -> tuple[CellConfig, SimulationConfig]:
    """The paper's cell and its simulation with ``errors``."""
    file = _paper()
    assert file.simulation is not None
    update = {"errors": ErrorsConfig.model_validate(errors), "seed": seed}
    return file.cell, file.simulation.model_copy(update=update)


@cache
def _paper() -> CellFile:
    return load_cell(CELL)


def fit_to_all_corners(cell: CellConfig, captures: Captures) -> CornerFit:
    """From the captures to calibrate with."""
    camera = cell.camera.intrinsics
    prior = Prior(cell.nominal.T_P_A, cell.nominal.T_H_E, _PRIOR_SIGMAS)
    T_A_H, T_P_T, seen = _views(cell, captures, "calibration")
    return fit_corners(
        T_A_H, T_P_T, cell.target.board.corners, seen, camera.matrix, camera.distortion, prior, _PIXEL_SIGMA
    )


def _views(cell: CellConfig, captures: Captures, use: str) -> tuple[Array, Array, Array]:
    """T_A_H and T_P_T (k, 4, 4) as known, and what was seen (k, n, 2) px."""
    chosen = [capture for capture in captures.captures if capture.use == use]
    T_A_H = cell.active.chain.forward([capture.active_joints for capture in chosen])
    T_P_F = cell.passive.chain.forward([capture.passive_joints for capture in chosen])
    return T_A_H, T_P_F @ cell.passive.target_mount_transform, np.array([capture.corners for capture in chosen])


@dataclass(frozen=True)
class Row:
    """An error, and the mean mismatch in mm that METHOD.md gives for it."""

    what: str
    errors: Errors
    method: str = ""


def joint_zero(arm: str, joint: int, offset_deg: float) -> Errors:
    """Of one joint, counted from 1."""
    return {"joint_zero": {"offset_deg": {arm: [offset_deg if i == joint else 0.0 for i in range(1, 7)]}}}


_INVISIBLE = {("left", 1), ("left", 6), ("right", 1)}

ROWS = (
    Row("none", {}),
    Row("kinematics 0.02 deg, 0.1 mm", {"kinematics": {"angle_deg": 0.02, "length_mm": 0.1}}, "0.8"),
    Row("kinematics 0.1 deg, 0.5 mm", {"kinematics": {"angle_deg": 0.1, "length_mm": 0.5}}, "3.5"),
    *(
        Row(
            f"zero of joint {joint}, {role} arm, 0.1 deg",
            joint_zero(arm, joint, 0.1),
            "0" if (arm, joint) in _INVISIBLE else "0.36",
        )
        for role, arm in (("active", "left"), ("passive", "right"))
        for joint in range(1, 7)
    ),
    Row("encoder eccentricity 0.5 mrad", {"encoder_eccentricity": {"amplitude_mrad": 0.5}}),
    Row("backlash, gap 0.15 mrad", {"backlash": {"gap_mrad": 0.15}}),
    Row("backlash, gap 0.3 mrad", {"backlash": {"gap_mrad": 0.3}}, "0.25"),
    Row("sag 1 mrad", {"compliance": {"sag_mrad": 1}}, "0.27"),
    Row("scale of both arms 1000 ppm", {"arm_scale": {"ppm": 1000}}, "0.004"),
    Row("base drifts 5 mm/h, 0.2 deg/h", {"base_drift": {"translation_mm_per_hour": 5, "rotation_deg_per_hour": 0.2}}),
    Row("thermal growth 100 ppm, 10 min", {"thermal": {"growth_ppm": 100, "time_constant_min": 10}}),
    Row("flex of the camera's mount 0.5 mrad/g", {"mount_flex": {"mrad_per_g": 0.5}}, "0.11"),
    Row("target mount 0.5 mm", {"target_mount": {"translation_mm": 0.5}}, "0.66"),
    Row("target mount 5 mm", {"target_mount": {"translation_mm": 5}}, "7.4"),
    Row("target slips 0.5 mm half-way", {"target_slip": {"translation_mm": 0.5, "at_s": 145}}),
    Row("squares 1000 ppm too wide", {"square_scale": {"x_ppm": 1000}}),
    Row("plate bowed by 0.2 mm at its corners", {"flatness": {"bow_mm": 0.2}}),
    Row("plate bowed by 0.2 mm at the corners seen", {"flatness": {"bow_mm": 0.8}}, "0.11"),
    Row("focal lengths 1000 ppm too long", {"focal": {"x_ppm": 1000, "y_ppm": 1000}}),
    Row("principal point 2 px to the right", {"principal_point": {"right_px": 2}}),
    Row("distortion 1 px in the image's corner", {"distortion_residual": {"corner_px": 1}}),
    Row("corners 0.1 px to the right", {"corner_bias": {"right_px": 0.1}}),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="draws of each error")
    parser.add_argument("--processes", type=int, default=2)
    options = parser.parse_args()
    seeds = range(1, options.seeds + 1)
    print("| error | mismatch, paper's method | all corners | METHOD | T_P_A mm | T_P_A deg | residual px |")
    print("|---|---|---|---|---|---|---|")
    with ProcessPoolExecutor(options.processes) as pool:
        for row in ROWS:
            found = pool.map(figures, [row.errors] * len(seeds), seeds)
            paper, corners, translation, rotation, residual = np.median([astuple(one) for one in found], axis=0)
            print(
                f"| {row.what} | {paper:.3f} | {corners:.3f} | {row.method} "
                f"| {translation:.2f} | {rotation:.4f} | {residual:.2f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
