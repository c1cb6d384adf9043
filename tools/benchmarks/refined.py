"""Accuracy of the refined estimate against what is possible at all, over many draws of the noise.

python -m tools.benchmarks.refined bound|cells|mount|outliers|noise|speed [--runs N]
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy import stats

from dualcal_hal.cellfile import load_cell
from dualcal_hal.clock import RealClock
from dualcal_hal.kinematics import Chain, random_joints
from dualcal_hal.session.captures import Use, read_captures
from dualcal_hal.transforms import Array, Mask, apply, inverse, rotation_from_vector, skew, transform
from procedures.estimation import Degenerate, mismatch
from procedures.estimation.projection import project
from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.estimate import refined
from procedures.estimation.refined.fit import minimise
from procedures.estimation.refined.inexact import fit_inexact, target_mount
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.motion import adjoint, logarithm, moved
from procedures.estimation.refined.noise import FoundNoise, find_noise

ROOT = Path(__file__).parents[2]
CELL = ROOT / "cells" / "paper.yaml"
CAPTURES = ROOT / "tests" / "data" / "reference-7x4.json"

NOISES = (Noise(0.1, 1e-4, 1e-4), Noise(0.03, 1e-4, 1e-4), Noise(0.1, 1e-6, 1e-6))
"""Those of the table of what is possible: px and rad."""


@dataclass(frozen=True)
class Cell:
    """Captures without noise, what is known of their cell, and its truth."""

    data: CaptureArrays
    knowns: Knowns
    T_P_A: Array
    T_H_E: Array

    def noisy(self, rng: np.random.Generator, noise: Noise) -> CaptureArrays:
        """Readings that miss where the arms stood, the active arm's once an arrival, and corners that miss theirs."""
        data = self.data
        labels, arrival = np.unique(data.arrivals, return_inverse=True)
        active = rng.normal(0, noise.active, (len(labels), data.active.shape[1]))
        return replace(
            data,
            active=data.active + active[arrival],
            passive=data.passive + rng.normal(0, noise.passive, data.passive.shape),
            pixels=data.pixels + rng.normal(0, noise.pixel, data.pixels.shape),
        )

    def seen(self) -> Array:
        """(k, n, 2) px: where the corners are."""
        knowns, data = self.knowns, self.data
        T_P_E = self.T_P_A @ knowns.active.forward(data.active) @ self.T_H_E
        T_E_T = inverse(T_P_E) @ knowns.passive.forward(data.passive) @ knowns.T_F_T
        return project(apply(T_E_T, knowns.corners), knowns.matrix, knowns.distortion)

    def error(self, T_P_A: Array, T_H_E: Array) -> Array:
        """(12,) of both transforms, what covariances are of."""
        return np.concatenate([logarithm(T_P_A, self.T_P_A), logarithm(T_H_E, self.T_H_E)])

    def mount_error(self, T_F_T: Array) -> Array:
        """(6,) of the target's mount."""
        return logarithm(T_F_T, self.knowns.T_F_T)

    def bound(self, noise: Noise) -> Array:
        """(12, 12): the Cramer-Rao bound of the error, with the errors of the arms as further unknowns."""
        model = Model(self.data, self.knowns, noise)
        return np.asarray(np.linalg.inv(model.linearised(model.state(self.T_P_A, self.T_H_E)).normal))


@cache
def reference(use: Use = "calibration") -> Cell:
    """The reference captures of the paper's cell."""
    file = load_cell(CELL)
    cell, simulation = file.cell, file.simulation
    assert simulation is not None
    board = cell.target.board
    captures = [capture for capture in read_captures(CAPTURES).captures if capture.use == use]
    intrinsics = cell.camera.intrinsics
    return Cell(
        data=CaptureArrays(
            active=np.array([capture.active_joints for capture in captures]),
            passive=np.array([capture.passive_joints for capture in captures]),
            arrivals=np.array([capture.active_arrival for capture in captures]),
            pixels=np.array([capture.corners for capture in captures]),
        ),
        knowns=Knowns(
            active=cell.active.chain,
            passive=cell.passive.chain,
            T_F_T=cell.passive.target_mount_transform,
            corners=board.corners,
            matrix=intrinsics.matrix,
            distortion=intrinsics.distortion,
        ),
        T_P_A=simulation.truth.T_P_A,
        T_H_E=simulation.truth.T_H_E,
    )


@dataclass(frozen=True)
class Verification:
    """Where the mismatch is looked at: flanges T_A_H (k, 4, 4) and the feature point in P (k, 3), exact."""

    T_A_H: Array
    p_P_T: Array

    @classmethod
    def of(cls, cell: Cell) -> Verification:
        knowns, data = cell.knowns, cell.data
        T_P_T = knowns.passive.forward(data.passive) @ knowns.T_F_T
        return cls(knowns.active.forward(data.active), T_P_T[:, :3, 3])

    def bound(self, cell: Cell, covariance: Array) -> float:
        """rms of the mismatch over these poses, m, for an error of the cell with this covariance (12, 12)."""
        T_P_E = cell.T_P_A @ self.T_A_H @ cell.T_H_E
        seen = np.einsum("kji,kj->ki", T_P_E[:, :3, :3], self.p_P_T - T_P_E[:, :3, 3])
        moves = np.concatenate([adjoint(inverse(self.T_A_H @ cell.T_H_E)), np.tile(np.eye(6), (len(seen), 1, 1))], 2)
        across = np.concatenate([np.tile(-np.eye(3), (len(seen), 1, 1)), skew(seen)], axis=2)[:, :2] @ moves
        return float(np.sqrt(np.mean(np.trace(across @ covariance @ np.swapaxes(across, 1, 2), axis1=1, axis2=2))))


@dataclass(frozen=True)
class Runs:
    """Of n draws: errors (n, 12) of the cell, normalised squares (n,) of them, of T_P_A's six alone (n,) and of each
    parameter (n, 12); mismatches (n, k) at the verification poses, m; costs (n,).
    """

    errors: Array
    squares: Array
    base_squares: Array
    single: Array
    mismatches: Array
    costs: Array


def draw(cell: Cell, verification: Verification, noise: Noise, runs: int, seed: int) -> Runs:
    """Estimates from the truth on, so that what is measured is the optimum and not the way to it."""
    rng = np.random.default_rng(seed)
    rows = []
    for _ in range(runs):
        model = Model(cell.noisy(rng, noise), cell.knowns, noise)
        fit = minimise(model, model.state(cell.T_P_A, cell.T_H_E))
        T_P_A, T_H_E = fit.state.T_P_A, fit.state.T_H_E
        error, covariance = cell.error(T_P_A, T_H_E), np.linalg.inv(fit.at.normal)
        rows.append(
            (
                error,
                error @ fit.at.normal @ error,
                error[:6] @ np.linalg.solve(covariance[:6, :6], error[:6]),
                error**2 / np.diag(covariance),
                mismatch(T_P_A, T_H_E, verification.T_A_H, verification.p_P_T),
                fit.at.cost,
            )
        )
    return Runs(*(np.array(column) for column in zip(*rows, strict=True)))


@dataclass(frozen=True)
class Ratio:
    """Root mean square of what was found over its bound, with its 95 % bootstrap interval."""

    value: float
    lower: float
    upper: float

    @classmethod
    def of(cls, squares: Array, bound: float, resamplings: int = 1000) -> Ratio:
        """squares (n,): of each run, in the square of the bound's unit."""
        rng = np.random.default_rng(0)
        again = squares[rng.integers(0, len(squares), (resamplings, len(squares)))].mean(axis=1)
        lower, upper = np.sqrt(np.percentile(again, [2.5, 97.5])) / bound
        return cls(float(np.sqrt(squares.mean()) / bound), float(lower), float(upper))


def ratios(cell: Cell, verification: Verification, noise: Noise, runs: Runs) -> dict[str, Ratio]:
    """Of the translation and rotation of T_P_A and of the mismatch."""
    covariance = cell.bound(noise)
    return {
        "translation": Ratio.of(np.sum(runs.errors[:, :3] ** 2, axis=1), float(np.sqrt(np.trace(covariance[:3, :3])))),
        "rotation": Ratio.of(np.sum(runs.errors[:, 3:6] ** 2, axis=1), float(np.sqrt(np.trace(covariance[3:6, 3:6])))),
        "mismatch": Ratio.of(np.mean(runs.mismatches**2, axis=1), verification.bound(cell, covariance)),
    }


def coverage(squares: Array, freedom: int) -> float:
    """Share of runs whose normalised squared error is within the 95 % region."""
    return float(np.mean(squares <= stats.chi2.ppf(0.95, freedom)))


LIMITS = np.radians([[-170, 170], [-110, 135], [-120, 160], [-185, 185], [-120, 120], [-350, 350]])
"""Of both arms' joints (6, 2), rad."""


def random_cell(rng: np.random.Generator, constraints: int, positions: int) -> Cell:
    """Another cell with the paper's arms, camera and board: bases 0.8 to 1.4 m apart, turned by any yaw and tilted by
    up to 30 degrees, the camera up to 60 degrees off the flange's axis with any roll; the feature point on the optical
    axis, 0.3 to 0.5 m away, the board tilted by up to 45 degrees and turned in any way.
    """
    knowns = reference().knowns
    while True:
        way, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.8, 1.4)
        tilt, yaw = _leaning(rng, 30), rotation_from_vector([0, 0, rng.uniform(-np.pi, np.pi)])
        T_P_A = transform(tilt @ yaw, [distance * np.cos(way), distance * np.sin(way), rng.uniform(-0.1, 0.1)])
        roll = rotation_from_vector([0, 0, rng.uniform(-np.pi, np.pi)])
        T_H_E = transform(_leaning(rng, 60) @ roll, rng.uniform(-0.1, 0.1, 3))
        found = _looks(rng, knowns, T_P_A, T_H_E, constraints, positions)
        if found is not None:
            return cell_of(knowns, T_P_A, T_H_E, *found)


def _leaning(rng: np.random.Generator, most_degrees: float) -> Array:
    way = rng.uniform(-np.pi, np.pi)
    return rotation_from_vector(np.radians(rng.uniform(0, most_degrees)) * np.array([np.cos(way), np.sin(way), 0]))


def _looks(
    rng: np.random.Generator, knowns: Knowns, T_P_A: Array, T_H_E: Array, constraints: int, positions: int
) -> tuple[Array, Array] | None:
    """Active joints (constraints, 6) and passive ones (constraints, positions, 6); None if too few were found."""
    active = random_joints(rng, 400, *LIMITS.T)
    T_P_E = T_P_A @ knowns.active.forward(active) @ T_H_E
    ends = T_P_E[:, None, :3, 3] + np.array([[0.3], [0.5]]) * T_P_E[:, None, :3, 2]
    reach = np.linalg.norm(ends - [0, 0, 0.3], axis=2)
    good = np.flatnonzero(np.all((reach > 0.25) & (reach < 0.6), axis=1))[: 8 * constraints]
    passive, found = boards(rng, knowns, T_P_E[good], positions)
    whole = np.flatnonzero(found)[:constraints]
    return (active[good[whole]], passive[whole]) if len(whole) == constraints else None


def boards(
    rng: np.random.Generator, knowns: Knowns, T_P_E: Array, positions: int, most_tilt: float = 45.0
) -> tuple[Array, Mask]:
    """Passive joints (c, positions, 6) that bring the board before cameras T_P_E (c, 4, 4), tilted by at most so many
    degrees, and for which they were found (c,).
    """
    lower, upper = LIMITS.T
    tries = 6
    goals = np.empty((len(T_P_E), positions, 4, 4))
    for i, j in np.ndindex(goals.shape[:2]):
        camera, depth = T_P_E[i], np.linspace(0.3, 0.5, positions)[j]
        turned = _leaning(rng, most_tilt) @ rotation_from_vector([0, 0, rng.uniform(-np.pi, np.pi)])
        facing = transform(camera[:3, :3] @ np.diag([1.0, -1, -1]) @ turned, camera[:3, 3] + depth * camera[:3, 2])
        goals[i, j] = facing @ inverse(knowns.T_F_T)
    goals = goals.reshape(-1, 4, 4).repeat(tries, axis=0)
    assert isinstance(knowns.passive, Chain)
    passive, reached = knowns.passive.inverse(goals, random_joints(rng, len(goals), lower, upper), lower, upper)
    passive, reached = passive.reshape(-1, positions, tries, 6), reached.reshape(-1, positions, tries)
    chosen = np.take_along_axis(passive, reached.argmax(axis=2)[..., None, None], axis=2)[:, :, 0]
    return chosen, np.asarray(np.all(reached.any(axis=2), axis=1))


def cell_of(knowns: Knowns, T_P_A: Array, T_H_E: Array, active: Array, passive: Array) -> Cell:
    """With the captures of arrivals at active joints (a, 6), boards at passive joints (a, positions, 6)."""
    positions = passive.shape[1]
    data = CaptureArrays(
        active=active.repeat(positions, axis=0),
        passive=passive.reshape(-1, passive.shape[-1]),
        arrivals=np.arange(len(active)).repeat(positions),
        pixels=np.zeros((len(active) * positions, len(knowns.corners), 2)),
    )
    cell = Cell(data, knowns, T_P_A, T_H_E)
    return replace(cell, data=replace(data, pixels=cell.seen()))


@dataclass(frozen=True)
class Found:
    """Whether the optimum that is reached from the truth was reached, or a better one, in s; whether an uncertainty
    above 5 mm was warned of, where there is one.
    """

    optimum: bool
    seconds: float
    warned: bool
    refused: bool


def find(cell: Cell, noise: Noise, rng: np.random.Generator) -> Found:
    """The nominal is no nominal: the identity, and one off by 60 degrees and 0.5 m."""
    data = cell.noisy(rng, noise)
    model = Model(data, cell.knowns, noise)
    best = minimise(model, model.state(cell.T_P_A, cell.T_H_E))
    clock = RealClock()
    begun = clock.now()
    try:
        found = refined(data, cell.knowns, noise)
    except Degenerate:
        return Found(False, clock.now() - begun, False, True)
    seconds = clock.now() - begun
    optimum = found.cost < best.at.cost + 1e-2 and bool(found.used.all())
    large = any(direction.sigma > 5e-3 for direction in found.directions if "translation" in direction.name)
    return Found(optimum, seconds, not large or any("uncertain" in words for words in found.warnings), False)


@dataclass(frozen=True)
class FoundMount:
    """Whether the optimum that is reached from the truth was reached with the mount free, in s; squares: of the error
    of all 18 numbers, normalised.
    """

    optimum: bool
    seconds: float
    squares: float


def find_with_free_mount(cell: Cell, noise: Noise, rng: np.random.Generator) -> FoundMount:
    """What is given of the mount is off by 60 degrees and 0.3 m."""
    data = cell.noisy(rng, noise)
    free = target_mount(np.inf, np.inf)
    model = Model(data, cell.knowns, noise)
    best = fit_inexact(data, cell.knowns, noise, model.state(cell.T_P_A, cell.T_H_E), [free], True)
    axes = rng.normal(size=(2, 3))
    shift, turn = (axes / np.linalg.norm(axes, axis=1, keepdims=True)) * [[0.3], [np.radians(60)]]
    wrong = replace(cell.knowns, T_F_T=moved(cell.knowns.T_F_T, np.concatenate([shift, turn])))
    clock = RealClock()
    begun = clock.now()
    try:
        found = refined(data, wrong, noise, inexact=[free])
    except Degenerate:
        return FoundMount(False, clock.now() - begun, np.inf)
    seconds = clock.now() - begun
    best_error = [cell.error(best.fit.state.T_P_A, best.fit.state.T_H_E), cell.mount_error(best.knowns.T_F_T)]
    error = np.concatenate([cell.error(found.T_P_A, found.T_H_E), cell.mount_error(found.knowns.T_F_T)])
    information = np.linalg.inv(best.covariance)
    apart = error - np.concatenate(best_error)
    optimum = bool(apart @ information @ apart < 1e-2 and found.used.all())
    return FoundMount(optimum, seconds, float(error @ information @ error))


def contaminated(rng: np.random.Generator, data: CaptureArrays, share: float = 0.2) -> tuple[CaptureArrays, Mask]:
    """With a share of captures, at random, that are wrong: corners shifted by 5 to 50 px, one joint of one arm misread
    by 1 to 10 degrees, or corners listed from the other end; and which (k,).
    """
    active, passive, pixels = data.active.copy(), data.passive.copy(), data.pixels.copy()
    wrong = rng.permutation(len(data))[: round(share * len(data))]
    for k in wrong:
        kind = rng.integers(4)
        if kind == 0:
            way = rng.uniform(-np.pi, np.pi)
            pixels[k] += rng.uniform(5, 50) * np.array([np.cos(way), np.sin(way)])
        elif kind == 1:
            pixels[k] = pixels[k, ::-1]
        else:
            joints = active if kind == 2 else passive
            joints[k, rng.integers(6)] += rng.choice([-1, 1]) * np.radians(rng.uniform(1, 10))
    return replace(data, active=active, passive=passive, pixels=pixels), np.isin(np.arange(len(data)), wrong)


def misread(rng: np.random.Generator, data: CaptureArrays) -> tuple[CaptureArrays, Mask]:
    """With one arrival at which a joint of the active arm was misread by 1 to 10 degrees, and its captures (k,)."""
    wrong = data.arrivals == rng.choice(np.unique(data.arrivals))
    active = data.active.copy()
    active[wrong, rng.integers(6)] += rng.choice([-1, 1]) * np.radians(rng.uniform(1, 10))
    return replace(data, active=active), wrong


@dataclass(frozen=True)
class Sorted:
    """Of one set with captures that are wrong: whether just these were dropped; error of T_P_A (m, rad) and that of
    the same set without them.
    """

    named: bool
    error: tuple[float, float]
    without: tuple[float, float]


def sort_out(cell: Cell, data: CaptureArrays, wrong: Mask, noise: Noise) -> Sorted:
    found = refined(data, cell.knowns, noise)
    good = refined(data.only(~wrong), cell.knowns, noise, keep_all=True)
    errors = [cell.error(each.T_P_A, each.T_H_E) for each in (found, good)]
    sizes = [(float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:6]))) for error in errors]
    return Sorted(bool(np.array_equal(~found.used, wrong)), sizes[0], sizes[1])


def report_bound(runs: int) -> None:
    cell, verification = reference(), Verification.of(reference("verification"))
    for noise in NOISES:
        found = draw(cell, verification, noise, runs, seed=1)
        print(f"{noise.pixel:g} px, joints {1e3 * noise.active:g} mrad, {runs} runs")
        for what, ratio in ratios(cell, verification, noise, found).items():
            print(f"  {what:12} {ratio.value:.3f} of the bound ({ratio.lower:.3f} to {ratio.upper:.3f})")
        print(f"  normalised squared error {found.squares.mean():.2f} (12), cost {found.costs.mean():.1f}")
        print(f"  95 % regions cover {coverage(found.squares, 12):.2%} (12), {coverage(found.base_squares, 6):.2%} (6)")
        print(f"  least share of a parameter within 3 sigma {np.mean(found.single <= 9, axis=0).min():.2%}")


def report_cells(runs: int) -> None:
    for positions in (3, 4):
        rng = np.random.default_rng(positions)
        found = [find(random_cell(rng, 3, positions), NOISES[0], rng) for _ in range(runs)]
        print(f"{runs} random cells, 3 constraints x {positions}")
        print(f"  {sum(one.optimum for one in found)} at the optimum, {sum(one.refused for one in found)} refused")
        print(f"  {sum(one.warned for one in found)} without an uncertainty that is not warned of")
        milliseconds = [1e3 * one.seconds for one in found]
        print(f"  {np.median(milliseconds):.0f} ms, 95 % {np.percentile(milliseconds, 95):.0f} ms")


def report_mount(runs: int) -> None:
    for positions in (4, 3):
        rng = np.random.default_rng(positions)
        found = [find_with_free_mount(random_cell(rng, 3, positions), NOISES[0], rng) for _ in range(runs)]
        print(f"{runs} random cells, 3 constraints x {positions}, the mount free", end=": ")
        print(f"{sum(one.optimum for one in found)} at the optimum", end=", ")
        print(f"normalised squared error {np.median([one.squares for one in found]):.1f} in the middle (18)", end=", ")
        print(f"{1e3 * np.median([one.seconds for one in found]):.0f} ms")


def report_outliers(runs: int) -> None:
    cell, noise = reference(), NOISES[0]
    for what, spoil in (("20 % wrong", contaminated), ("an arrival misread", misread)):
        rng = np.random.default_rng(1)
        found = [sort_out(cell, *spoil(rng, cell.noisy(rng, noise)), noise) for _ in range(runs)]
        alike = [max(e - 1.2 * w for e, w in zip(one.error, one.without, strict=True)) <= 1e-9 for one in found]
        print(f"{what}, {runs} runs: just these dropped {np.mean([one.named for one in found]):.2%}", end=", ")
        print(f"error within 1.2 of that without them {np.mean(alike):.2%}")
    rng = np.random.default_rng(2)
    clean = [bool(refined(cell.noisy(rng, noise), cell.knowns, noise).used.all()) for _ in range(runs)]
    print(f"clean, {runs} runs: none dropped {np.mean(clean):.2%}")


def noises_found(cell: Cell, noise: Noise, stated: Noise, runs: int, seed: int) -> list[FoundNoise]:
    """What draws of the noise say of it, where another was stated."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(runs):
        data = cell.noisy(rng, noise)
        model = Model(data, cell.knowns, stated)
        state = minimise(model, model.state(cell.T_P_A, cell.T_H_E)).state
        found.append(find_noise(data, cell.knowns, stated, state.T_P_A, state.T_H_E))
    return found


def report_noise(runs: int) -> None:
    for noise in NOISES:
        found = noises_found(reference(), noise, Noise(0.05, 3e-5, 3e-5), runs, seed=1)
        pixel = np.mean([abs(one.pixel.value / noise.pixel - 1) <= 0.15 for one in found])
        joint = np.mean([abs(one.joint.value / noise.passive - 1) <= 0.35 for one in found])
        known = np.mean([one.joint.identified for one in found])
        below = np.mean([noise.passive <= one.joint.upper for one in found])
        print(
            f"{noise.pixel:g} px, joints {1e3 * noise.active:g} mrad, {runs} runs: pixel within 15 % {pixel:.2%}",
            end=", ",
        )
        print(f"joint within 35 % {joint:.2%}, identified {known:.2%}, below its upper end {below:.2%}")


def repeated(cell: Cell, times: int) -> Cell:
    """The same captures again and again, each time with new arrivals."""
    data, count = cell.data, len(np.unique(cell.data.arrivals))
    arrivals = np.concatenate([data.arrivals + count * i for i in range(times)])
    active, passive = np.tile(data.active, (times, 1)), np.tile(data.passive, (times, 1))
    return replace(cell, data=CaptureArrays(active, passive, arrivals, np.tile(data.pixels, (times, 1, 1))))


def report_speed(runs: int) -> None:
    clock, noise = RealClock(), NOISES[0]
    for times in (1, 36, 72):
        cell = repeated(reference(), times)
        rng, seconds = np.random.default_rng(0), []
        for _ in range(runs):
            data = cell.noisy(rng, noise)
            begun = clock.now()
            refined(data, cell.knowns, noise)
            seconds.append(clock.now() - begun)
        print(f"{len(cell.data)} captures, start included: median {1e3 * np.median(seconds):.0f} ms", end=", ")
        print(f"longest {1e3 * max(seconds):.0f} ms of {runs}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    for name, help_, runs in (
        ("bound", "errors against the bound, at the three noises", 2000),
        ("cells", "random cells without a nominal", 1000),
        ("mount", "random cells without a nominal, nor one of the target's mount", 100),
        ("outliers", "captures that are wrong, and none", 500),
        ("noise", "sigmas found from the captures", 200),
        ("speed", "time for few and many captures", 20),
    ):
        commands.add_parser(name, help=help_).add_argument("--runs", type=int, default=runs)
    arguments = parser.parse_args()
    reports = {
        "bound": report_bound,
        "cells": report_cells,
        "mount": report_mount,
        "outliers": report_outliers,
        "noise": report_noise,
        "speed": report_speed,
    }
    reports[arguments.what](arguments.runs)


if __name__ == "__main__":
    main()
