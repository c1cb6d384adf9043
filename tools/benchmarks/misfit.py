"""What becomes of captures whose knowns or noise are other than stated, all of them alike, so that none is an outlier.

python -m tools.benchmarks.misfit [--runs N]
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.transforms import Array
from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.estimate import refined
from procedures.estimation.refined.inexact import joint_zeros
from tools.benchmarks.refined import NOISES, Cell, reference
from tools.benchmarks.verification import links_off, mount_off, turned_out

NOISE = NOISES[0]


@dataclass(frozen=True)
class Misfit:
    """drawn: captures of a cell in which something is other than stated."""

    words: str
    drawn: Callable[[np.random.Generator, Cell], CaptureArrays]


def wrong_knowns(words: str, true: Callable[[np.random.Generator, Knowns], Knowns]) -> Misfit:
    return Misfit(words, lambda rng, cell: turned_out(cell, true(rng, cell.knowns)).noisy(rng, NOISE))


def louder(words: str, noise: Noise) -> Misfit:
    return Misfit(words, lambda rng, cell: cell.noisy(rng, noise))


def zeros_off(degrees: float) -> Misfit:
    """Of all joints of both arms, each by a draw of this sigma."""
    sigmas = [float(np.radians(degrees))] * 6

    def true(rng: np.random.Generator, knowns: Knowns) -> Knowns:
        for arm in ("active", "passive"):
            knowns = joint_zeros(arm, sigmas).shifted(knowns, rng.normal(0, sigmas))
        return knowns

    return wrong_knowns(f"joint zeros off by {degrees:g} deg (1 sigma)", true)


def loose(angle: float) -> Misfit:
    """Joints stand off by as much as they can, rad, this way or that."""

    def drawn(rng: np.random.Generator, cell: Cell) -> CaptureArrays:
        data = cell.noisy(rng, NOISE)
        of_active: Array = rng.choice([-angle, angle], (int(data.arrivals.max()) + 1, data.active.shape[1]))
        of_passive: Array = rng.choice([-angle, angle], data.passive.shape)
        return replace(data, active=data.active + of_active[data.arrivals], passive=data.passive + of_passive)

    return Misfit(f"joints loose by {1e3 * angle:g} mrad", drawn)


MISFITS = (
    wrong_knowns("target mount off by 0.5 mm", mount_off(5e-4).drawn),
    zeros_off(0.05),
    wrong_knowns("links off by 0.3 mm and 0.02 deg (1 sigma)", links_off(0.02, 3e-4).drawn),
    loose(6e-4),
    louder("pixel noise 3 times the stated", replace(NOISE, pixel=3 * NOISE.pixel)),
    louder("joint noise 5 times the stated", replace(NOISE, active=5 * NOISE.active, passive=5 * NOISE.passive)),
    louder("nothing", NOISE),
)


def report(runs: int) -> None:
    cell = reference()
    for misfit in MISFITS:
        dropped, squares, warned = [], [], []
        for seed in range(runs):
            found = refined(misfit.drawn(np.random.default_rng(seed), cell), cell.knowns, NOISE)
            dropped.append(int(np.sum(~found.used)))
            error = cell.error(found.T_P_A, found.T_H_E)[:6]
            squares.append(float(error @ np.linalg.solve(found.covariance[:6, :6], error)))
            warned.append(any("times what the stated noise explains" in words for words in found.warnings))
        counts = np.array(dropped)
        print(f"{misfit.words}: of {len(cell.data)} captures {counts.mean():.2f} dropped", end=", ")
        print(f"at most {counts.max()}, more than 2 in {np.mean(counts > 2):.1%} of {runs} sets", end="; ")
        print(f"warned {np.mean(warned):.0%}, normalised squared error of T_P_A {np.median(squares):.0f} (6)")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100)
    report(parser.parse_args().runs)


if __name__ == "__main__":
    main()
