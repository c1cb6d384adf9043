"""AXB = YCZ on the published benchmark: two UR10 arms at random joints, A, B and C each off by 0.5 deg and 0.5 mm in a
random direction.

The set-up is that of Wu, Wang, Qi, Wang and Ren, "Simultaneous Hand-Eye, Tool-Flange, and Robot-Robot Calibration for
Comanipulation by Solving the AXB = YCZ Problem", IEEE Transactions on Robotics 32(2), 2016; the DH parameters are those
that Universal Robots publishes. Prints errors of Y in closed form and refined, whether they are as their covariance
has them, and times, and fails where a limit is not kept.

python -m tools.benchmarks.triples --runs 1000
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass

import numpy as np

from dualcal_hal.kinematics import Chain, Row, random_joints
from dualcal_hal.transforms import Array, inverse, rotation_angle, rotation_from_vector, transform, vector_from_rotation
from procedures.estimation.triples import Solution, TripleNoise, estimate_triples, solve_in_closed_form

_RIGHT = np.pi / 2
UR10 = Chain(
    (
        Row(0.0, 0.1273, 0.0, _RIGHT),
        Row(0.0, 0.0, -0.612, 0.0),
        Row(0.0, 0.0, -0.5723, 0.0),
        Row(0.0, 0.163941, 0.0, _RIGHT),
        Row(0.0, 0.1157, 0.0, -_RIGHT),
        Row(0.0, 0.0922, 0.0, 0.0),
    )
)

ROTATION_ERROR = np.deg2rad(0.5)
TRANSLATION_ERROR = 0.5e-3

LIMITS = {30: (1.0, 0.8), 270: (0.3, 0.25)}
"""By the number of triples: mean error of Y, mrad and mm."""

CLOSED_FORM_LIMIT = (300, 3.0)
"""Triples, ms."""


def turn(axis: str, angle: float) -> Array:
    """(3, 3): about x, y or z, by rad."""
    return rotation_from_vector(angle * np.eye(3)["xyz".index(axis)])


TRUTH = Solution(
    X=transform(turn("x", np.pi / 3) @ turn("y", np.pi / 6), [0.0, 0.0, 0.270]),
    Y=transform(turn("z", np.pi) @ turn("y", -np.pi / 6) @ turn("x", np.pi / 12), [1.700, 0.0, 0.200]),
    Z=transform(turn("x", np.pi) @ turn("y", 0.1), [0.0, 0.0, 0.100]),
)


def random_triples(rng: np.random.Generator, count: int) -> tuple[Array, Array, Array]:
    """Exact A, B, C (n, 4, 4) at joint angles anywhere in a turn."""
    limits = np.full(6, -np.pi), np.full(6, np.pi)
    A = UR10.forward(random_joints(rng, count, *limits))
    C = UR10.forward(random_joints(rng, count, *limits))
    return A, inverse(A @ TRUTH.X) @ TRUTH.Y @ C @ TRUTH.Z, C


def with_errors(rng: np.random.Generator, poses: Array) -> Array:
    """Turned and shifted by just the benchmark's magnitudes, each in a direction of its own."""
    directions = rng.normal(size=(2, len(poses), 3))
    w, v = directions / np.linalg.norm(directions, axis=2)[:, :, None]
    return np.asarray(poses @ transform(rotation_from_vector(ROTATION_ERROR * w), TRANSLATION_ERROR * v))


def noise() -> TripleNoise:
    """The same magnitudes as sigmas of each axis."""
    sigmas = TRANSLATION_ERROR / np.sqrt(3), ROTATION_ERROR / np.sqrt(3)
    return TripleNoise.of_sigmas(sigmas, sigmas, sigmas)


@dataclass(frozen=True)
class Figures:
    """Means over the runs. Error of Y in closed form and refined: mrad, mm; squared error of all 18 in units of their
    covariance; times in ms are medians.
    """

    closed_form: tuple[float, float]
    refined: tuple[float, float]
    squared: float
    closed_form_ms: float
    refined_ms: float


def figures(count: int, runs: int, seed: int) -> Figures:
    """Of ``runs`` sets of ``count`` triples."""
    rng = np.random.default_rng([seed, count])
    rows = [_run(rng, count) for _ in range(runs)]
    means, medians = np.mean(rows, axis=0), np.median(rows, axis=0)
    return Figures(
        closed_form=(means[0], means[1]),
        refined=(means[2], means[3]),
        squared=means[4],
        closed_form_ms=medians[5],
        refined_ms=medians[6],
    )


def _run(rng: np.random.Generator, count: int) -> list[float]:
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, count))
    began = time.perf_counter()
    first = solve_in_closed_form(A, B, C)
    solved = time.perf_counter()
    found = estimate_triples(A, B, C, noise())
    refined = time.perf_counter()
    error = np.concatenate(
        [_motion(getattr(found, name), getattr(TRUTH, name)) for name in ("X", "Y", "Z")],
    )
    squared = float(error @ np.linalg.solve(found.covariance, error))
    return [*_error(first.Y), *_error(found.Y), squared, 1e3 * (solved - began), 1e3 * (refined - solved)]


def _motion(T: Array, goal: Array) -> Array:
    between = inverse(T) @ goal
    return np.concatenate([between[:3, 3], vector_from_rotation(between[:3, :3])])


def _error(Y: Array) -> tuple[float, float]:
    """mrad, mm."""
    rotation = 1e3 * float(rotation_angle(Y[:3, :3], TRUTH.Y[:3, :3]))
    return rotation, 1e3 * float(np.linalg.norm(Y[:3, 3] - TRUTH.Y[:3, 3]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    kept = True
    print("| triples | closed form of Y, mrad, mm | refined, mrad, mm | limit | NEES of 18 | ms closed form, whole |")
    print("|---|---|---|---|---|---|")
    for count in sorted({*LIMITS, CLOSED_FORM_LIMIT[0]}):
        found = figures(count, options.runs, options.seed)
        limit = LIMITS.get(count, (np.inf, np.inf))
        kept &= found.refined[0] <= limit[0] and found.refined[1] <= limit[1]
        kept &= count != CLOSED_FORM_LIMIT[0] or found.closed_form_ms <= CLOSED_FORM_LIMIT[1]
        pairs = (f"{one:.3g}, {other:.3g}" for one, other in (found.closed_form, found.refined, limit))
        times = f"{found.closed_form_ms:.2f}, {found.refined_ms:.0f}"
        print(f"| {count} | {' | '.join(pairs)} | {found.squared:.2f} | {times} |", flush=True)
    if not kept:
        sys.exit("a limit is not kept")


if __name__ == "__main__":
    main()
