"""How often the flange check names what is wrong: python -m tools.benchmarks.flange [--seeds N].

Each of the faults that a commissioning may meet is put into the joints or the readout of the paper's arms, in a few
random postures, with a controller whose own model differs from the calibrated kinematics and whose pendant rounds.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dualcal_hal.cellfile import load_cell
from dualcal_hal.config import RobotConfig
from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, rotation_from_vector, transform
from procedures.commissioning import check_flange
from procedures.commissioning.causes import Kind
from procedures.commissioning.readout import pose_of

CELL = Path(__file__).parents[2] / "cells" / "paper.yaml"

MODEL_MM, MODEL_DEG = 0.4, 0.04
"""Sigma of each length and angle by which the controller's model differs."""

SPREAD = 0.6
"""Part of the joints' ranges that an operator jogs through."""


@dataclass(frozen=True)
class Case:
    """A fault: the kind that should be named (None: that nothing is wrong) and the joints that should be."""

    name: str
    kind: Kind | None
    joints: tuple[int, ...]
    read: Callable[[Array], Array] = lambda q: q
    show: Callable[[Array], Array] = lambda T: T
    chain: Callable[[Chain], Chain] = lambda chain: chain


def cases(rng: np.random.Generator) -> list[Case]:
    """One of each kind, at random joints and by random amounts."""
    joint, other = (int(i) for i in rng.choice(6, 2, replace=False))
    middle = int(rng.choice([1, 2, 3, 4]))  # a zero of the first or last joint is a turned base or flange
    zero = float(np.deg2rad(rng.choice([-90.0, 90.0, 180.0, rng.uniform(1.0, 20.0), -rng.uniform(1.0, 20.0)])))
    pair = tuple(sorted((joint + 1, other + 1)))
    tool = transform(rotation_from_vector(rng.normal(size=3)), rng.uniform(-0.2, 0.2, 3))
    frame = transform(rotation_from_vector(rng.normal(size=3)), rng.uniform(-1.0, 1.0, 3))
    pure = transform(np.eye(3), [0.0, 0.0, float(rng.uniform(0.05, 0.3))])
    factor = float(rng.choice([-1.0, 1.0]))
    length = float(rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.05))
    return [
        Case("nothing", None, ()),
        Case("sign", Kind.SIGN, (joint + 1,), read=lambda q: _changed(q, joint, -q[:, joint])),
        Case("two signs", Kind.SIGN, pair, read=lambda q: _flipped(q, joint, other)),
        Case("zero", Kind.ZERO, (middle + 1,), read=lambda q: _changed(q, middle, q[:, middle] - zero)),
        Case("coupling", Kind.COUPLING, (3, 2), read=lambda q: _changed(q, 2, q[:, 2] + factor * q[:, 1])),
        Case("order", Kind.ORDER, pair, read=lambda q: _exchanged(q, joint, other)),
        Case("scale", Kind.SCALE, (middle + 1,), read=lambda q: _changed(q, middle, q[:, middle] * 1.25)),
        Case("tool", Kind.TOOL, (), show=lambda T: T @ tool),
        Case("tool along z", Kind.TOOL, (), show=lambda T: T @ pure),
        Case("work object", Kind.FRAME, (), show=lambda T: frame @ T),
        Case("kinematics", Kind.KINEMATICS, (2,), chain=lambda chain: _longer(chain, 1, length)),
    ]


def _changed(q: Array, joint: int, angles: Array) -> Array:
    q = q.copy()
    q[:, joint] = angles
    return q


def _flipped(q: Array, *joints: int) -> Array:
    q = q.copy()
    q[:, joints] *= -1.0
    return q


def _exchanged(q: Array, i: int, j: int) -> Array:
    q = q.copy()
    q[:, [i, j]] = q[:, [j, i]]
    return q


def _longer(chain: Chain, index: int, by: float) -> Chain:
    rows = list(chain.rows)
    rows[index] = replace(rows[index], a=rows[index].a + by)
    return Chain(tuple(rows))


def controllers_model(chain: Chain, rng: np.random.Generator) -> Chain:
    """Kinematics that differ from the calibrated ones as a maker's do."""

    def off(sigma: float) -> float:
        return float(rng.normal(0.0, sigma))

    length, angle = MODEL_MM / 1000, float(np.deg2rad(MODEL_DEG))
    return Chain(
        tuple(
            replace(
                row,
                theta=row.theta + off(angle),
                d=row.d + (off(length) if row.beta is None else 0.0),
                a=row.a + off(length),
                alpha=row.alpha + off(angle),
            )
            for row in chain.rows
        )
    )


def readout(T: Array, digits: int) -> Array:
    """(k, 4, 4) as typed from a pendant that shows X Y Z in mm and W P R in degrees with so many digits."""
    typed = []
    for pose in T:
        R = pose[:3, :3]
        pitch = np.arcsin(np.clip(-R[2, 0], -1.0, 1.0))
        wpr = np.degrees([np.arctan2(R[2, 1], R[2, 2]), pitch, np.arctan2(R[1, 0], R[0, 0])])
        typed.append(pose_of("fanuc", [round(float(x), digits) for x in (*(1e3 * pose[:3, 3]), *wpr)]))
    return np.stack(typed)


def posed(robot: RobotConfig, count: int, rng: np.random.Generator) -> Array:
    """(count, n) rad: postures that an operator jogs to."""
    middle, half = (robot.lower + robot.upper) / 2, SPREAD * (robot.upper - robot.lower) / 2
    return np.asarray(middle + half * rng.uniform(-1.0, 1.0, (count, len(middle))))


def named_rightly(case: Case, robot: RobotConfig, poses: int, digits: int, rng: np.random.Generator) -> str:
    """ "right", or what was said instead."""
    q = posed(robot, poses, rng)
    true = case.chain(controllers_model(robot.chain, rng)).forward(q)
    check = check_flange(robot.chain, case.read(q), readout(case.show(true), digits))
    if case.kind is None:
        return "right" if check.good else "unproven" if check.agrees else "wrongly bad"
    if check.agrees:
        return "not seen"
    if check.cause is None:
        return "none named"
    return "right" if (check.cause.kind, check.cause.joints) == (case.kind, case.joints) else str(check.cause.kind)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--poses", type=int, default=3)
    parser.add_argument("--digits", type=int, default=1, help="that the pendant shows of mm and degrees")
    options = parser.parse_args()
    cell = load_cell(CELL).cell
    said: dict[str, Counter[str]] = {}
    for seed in range(options.seeds):
        for robot in cell.robots.values():
            rng = np.random.default_rng([seed, options.poses])
            for case in cases(rng):
                what = named_rightly(case, robot, options.poses, options.digits, rng)
                said.setdefault(case.name, Counter())[what] += 1
    for name, counts in said.items():
        others = ", ".join(f"{what} {count}" for what, count in counts.most_common() if what != "right")
        print(f"{name:14} {counts['right']:4} of {counts.total():4}   {others}")


if __name__ == "__main__":
    main()
