"""How often verification captures are taken for wrong where nothing is, and for right where something is.

python -m tools.benchmarks.verification alarms|uncertain|power|suspects [--runs N]
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dualcal_hal.transforms import Array
from procedures.estimation import Degenerate
from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.estimate import refined
from procedures.estimation.refined.inexact import Inexact, joint_zeros, link_parameters, target_mount
from procedures.estimation.refined.model import Model
from procedures.estimation.refined.suspects import next_suspects
from procedures.estimation.refined.verification import Consistency, verify
from tools.benchmarks.refined import NOISES, Cell, boards, cell_of, random_cell, reference

FEATURE = 4
"""The middle corner of nine."""

_FIRST_MISS = 30.0  # px by which the feature point is off before the first correction


def aligned(cell: Cell, rng: np.random.Generator, noise: Noise, tolerance: float) -> CaptureArrays:
    """Noisy captures as the alignment takes them: after each picture the target is shifted by what the picture shows
    of the feature point, until that is within the tolerance, px per axis. Passive arm and corners miss anew each time,
    the active arm once an arrival.
    """
    data = cell.data
    model = Model(data, cell.knowns, noise)
    state = model.state(cell.T_P_A, cell.T_H_E)
    at, rows = model.linearised(state), slice(2 * FEATURE, 2 * FEATURE + 2)
    J = noise.pixel * model.jacobian(state)[:, rows]
    of_passive = J @ at.towards_passive
    active = rng.normal(size=(model.arrivals, data.active.shape[1]))[model.arrival]
    by_active = np.einsum("kin,kn->ki", J @ at.towards_active[model.arrival], active)
    left = np.tile([_FIRST_MISS, -_FIRST_MISS], (len(data), 1))
    passive: Array = np.zeros_like(data.passive)
    pixels: Array = np.zeros_like(data.pixels)
    waiting = np.arange(len(data))
    while len(waiting):
        passive[waiting] = rng.normal(size=(len(waiting), passive.shape[1]))
        pixels[waiting] = rng.normal(0, noise.pixel, (len(waiting), *pixels.shape[1:]))
        off = by_active[waiting] + np.einsum("kin,kn->ki", of_passive[waiting], passive[waiting])
        seen = left[waiting] + off + pixels[waiting, FEATURE]
        far = np.any(np.abs(seen) > tolerance, axis=1)
        left[waiting] -= np.where(far[:, None], seen, 0.0)
        waiting = waiting[far]
    return replace(
        data,
        active=data.active - noise.active * active,
        passive=data.passive - noise.passive * passive,
        pixels=data.pixels + pixels,
    )


def scatter(cell: Cell, noise: Noise) -> float:
    """Sigma, px, by which the feature point misses where the passive arm was sent, in an axis: rms over captures."""
    model = Model(cell.data, cell.knowns, noise)
    state = model.state(cell.T_P_A, cell.T_H_E)
    of_passive = (model.jacobian(state) @ model.linearised(state).towards_passive)[:, 2 * FEATURE : 2 * FEATURE + 2]
    return noise.pixel * float(np.sqrt(1 + np.mean(np.sum(of_passive**2, axis=2))))


@dataclass(frozen=True)
class Wrong:
    """What is wrong with a cell, and how to draw knowns that are in truth so."""

    words: str
    drawn: Callable[[np.random.Generator, Knowns], Knowns]


def _unit(rng: np.random.Generator, count: int) -> Array:
    way = rng.normal(size=count)
    return np.asarray(way / np.linalg.norm(way))


def mount_off(distance: float) -> Wrong:
    """By so many m in any direction."""
    inexact = target_mount(1.0, 1.0)

    def drawn(rng: np.random.Generator, knowns: Knowns) -> Knowns:
        return inexact.shifted(knowns, np.concatenate([distance * _unit(rng, 3), np.zeros(3)]))

    return Wrong(f"target mount off by {1e3 * distance:g} mm", drawn)


def zero_off(degrees: float) -> Wrong:
    """Of one joint of one arm that can be seen."""

    def drawn(rng: np.random.Generator, knowns: Knowns) -> Knowns:
        arm = ("active", "passive")[rng.integers(2)]
        joint = rng.integers(1, 5 if arm == "active" else 6)
        by = np.zeros(6)
        by[joint] = np.radians(degrees) * rng.choice([-1, 1])
        return joint_zeros(arm, [1.0] * 6).shifted(knowns, by)

    return Wrong(f"one joint zero off by {degrees:g} deg", drawn)


def links_off(degrees: float, length: float) -> Wrong:
    """All rows of both arms, by draws of these sigmas."""

    def drawn(rng: np.random.Generator, knowns: Knowns) -> Knowns:
        for arm in ("active", "passive"):
            links = link_parameters(arm, getattr(knowns, arm), length, float(np.radians(degrees)))
            knowns = links.shifted(knowns, rng.normal(0, links.sigmas))
        return knowns

    return Wrong(f"DH parameters off by {degrees:g} deg and {1e3 * length:g} mm (1 sigma)", drawn)


WRONG = (
    mount_off(2e-4),
    mount_off(5e-4),
    zero_off(0.02),
    zero_off(0.1),
    links_off(0.005, 2.5e-5),
    links_off(0.02, 1e-4),
)


def turned_out(cell: Cell, knowns: Knowns) -> Cell:
    """The same poses where the knowns are in truth these."""
    cell = replace(cell, knowns=knowns)
    return replace(cell, data=replace(cell.data, pixels=cell.seen()))


@dataclass(frozen=True)
class Check:
    """Captures of one calibration and of its verification, and what was found."""

    calibration: CaptureArrays
    verification: CaptureArrays
    found: Consistency
    suspects: tuple[str, ...] = ()


def check(
    rng: np.random.Generator,
    noise: Noise,
    verification: Cell,
    tolerance: float | None = None,
    wrong: Wrong | None = None,
    suspects: bool = False,
) -> Check:
    """The reference calibration, and other captures to verify with; tolerance in px: both as the alignment takes
    them.
    """
    calibration, given = reference(), reference().knowns
    if wrong is not None:
        true = wrong.drawn(rng, given)
        calibration, verification = turned_out(calibration, true), turned_out(verification, true)
    if tolerance is None:
        taken = [cell.noisy(rng, noise) for cell in (calibration, verification)]
    else:
        taken = [aligned(cell, rng, noise, tolerance) for cell in (calibration, verification)]
    result = refined(taken[0], given, noise)
    found = verify(result, taken[1])
    words: tuple[str, ...] = ()
    if suspects and not found.fits:
        kept = result.used
        words = tuple(suspect.words for suspect in next_suspects(result, taken[0].only(kept).followed_by(taken[1])))
    return Check(taken[0], taken[1], found, words)


def shares(checks: Sequence[Check]) -> tuple[float, float]:
    """With a probability below 5 %, and below that of the verdict."""
    probabilities = np.array([one.found.probability for one in checks])
    return float(np.mean(probabilities < 0.05)), float(np.mean([not one.found.fits for one in checks]))


def report_alarms(runs: int) -> None:
    other = reference("verification")
    for noise in NOISES:
        sigma = scatter(other, noise)
        print(f"{noise.pixel:g} px, joints {1e3 * noise.active:g} mrad, {runs} good sets, scatter {sigma:.3f} px")
        for times in (None, 2.8, 2.0, 1.0):
            tolerance = None if times is None else times * sigma
            rng = np.random.default_rng(1)
            found = [check(rng, noise, other, tolerance) for _ in range(runs)]
            five, verdict = shares(found)
            parts = [(one.found.poses, one.found.corners) for one in found]
            poses, corners = (np.mean([both[part].squares for both in parts]) for part in (0, 1))
            print(f"  tolerance {'none' if times is None else f'{times:g} sigma'}: 5 % level {five:.2%}", end=", ")
            print(f"fail {verdict:.2%}, poses {poses:.1f} of {parts[0][0].freedom}", end=", ")
            print(f"corners {corners:.1f} of {parts[0][1].freedom}")


SIZES = (0.0, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, np.inf)
"""Of predicted sigmas, mm."""


def uncertain(rng: np.random.Generator, arrivals: int = 3, positions: int = 3) -> tuple[Cell, Cell]:
    """A calibration of few constraints, between which the active flange turns little, and a verification of the same
    random cell elsewhere.
    """
    while True:
        other = random_cell(rng, 6, 2)
        spread = np.radians(np.exp(rng.uniform(np.log(1.5), np.log(30))))
        active = other.data.active[0] + rng.normal(0, spread, (4 * arrivals, 6))
        T_P_E = other.T_P_A @ other.knowns.active.forward(active) @ other.T_H_E
        passive, found = boards(rng, other.knowns, T_P_E, positions)
        whole = np.flatnonzero(found)[:arrivals]
        if len(whole) == arrivals:
            return cell_of(other.knowns, other.T_P_A, other.T_H_E, active[whole], passive[whole]), other


def check_uncertain(rng: np.random.Generator, mount: Inexact | None) -> tuple[float, Check] | None:
    """Predicted sigma, mm, the largest of a translation, of a good set; mount: what the target's mount is off by, which
    is only reckoned with. None where the captures do not determine the cell.
    """
    cells, noise = uncertain(rng), NOISES[0]
    given, inexact = cells[0].knowns, []
    if mount is not None:
        inexact = [mount]
        true = mount.shifted(given, rng.normal(0, mount.sigmas))
        cells = (turned_out(cells[0], true), turned_out(cells[1], true))
    calibration, verification = (cell.noisy(rng, noise) for cell in cells)
    try:
        result = refined(calibration, given, noise, inexact=inexact, estimate_inexact=False)
    except Degenerate:
        return None
    sigma = 1e3 * max(each.sigma for each in result.directions if each.name.startswith("translation"))
    return sigma, Check(calibration, verification, verify(result, verification))


def report_uncertain(runs: int) -> None:
    for words, mount, seed in (
        ("all knowns exact", None, 4),
        ("mount 0.3 mm, 0.1 deg (1 sigma), propagated", target_mount(3e-4, np.radians(0.1)), 5),
        ("mount 3 mm, 1 deg (1 sigma), propagated", target_mount(3e-3, np.radians(1.0)), 6),
    ):
        rng = np.random.default_rng(seed)
        found = [one for one in (check_uncertain(rng, mount) for _ in range(runs)) if one is not None]
        sigmas = np.array([sigma for sigma, _ in found])
        print(f"3 constraints x 3, {words}: {len(found)} good sets of {runs}")
        for low, high in pairwise(SIZES):
            inside = [one.found for sigma, one in found if low <= sigma < high]
            if inside:
                print(f"  sigma {low:g} to {high:g} mm: fail {sum(not one.fits for one in inside)} of {len(inside)}")
        print(
            f"  of all: fail {np.mean([not one.found.fits for _, one in found]):.2%}, sigma {np.median(sigmas):.2g} mm"
        )


def report_power(runs: int) -> None:
    noise, other = NOISES[0], reference("verification")
    for wrong in WRONG:
        for tolerance in (None, 2 * scatter(other, noise)):
            rng = np.random.default_rng(2)
            found = [check(rng, noise, other, tolerance, wrong) for _ in range(runs)]
            way = "as they come" if tolerance is None else "aligned within 2 sigma"
            print(f"{wrong.words}, {way}: fail {shares(found)[1]:.2%} of {runs}")


def report_suspects(runs: int) -> None:
    noise, other = NOISES[0], reference("verification")
    for wrong in WRONG:
        rng = np.random.default_rng(3)
        found = [check(rng, noise, other, None, wrong, suspects=True) for _ in range(runs)]
        told = Counter(one.suspects[0].split(":")[0] for one in found if one.suspects)
        print(f"{wrong.words}: {dict(told)}; the last: {next((o.suspects[0] for o in found[::-1] if o.suspects), '-')}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what", required=True)
    for name, help_, runs in (
        ("alarms", "of good sets", 2000),
        ("uncertain", "of good sets whose estimate is uncertain", 400),
        ("power", "of sets with something wrong", 200),
        ("suspects", "what is told to look at next", 30),
    ):
        commands.add_parser(name, help=help_).add_argument("--runs", type=int, default=runs)
    arguments = parser.parse_args()
    reports = {
        "alarms": report_alarms,
        "uncertain": report_uncertain,
        "power": report_power,
        "suspects": report_suspects,
    }
    reports[arguments.what](arguments.runs)


if __name__ == "__main__":
    main()
