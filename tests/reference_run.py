"""A run on the reference captures: the paper's cell, captures with noise, their result and a plan."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from dualcal_hal.cellfile import load_cell
from dualcal_hal.config import CellConfig
from dualcal_hal.session.captures import Captures, read_captures
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME, Result, with_truth_error
from procedures.analysis import analyse
from procedures.planning.plan import Plan, PlannedConstraint, PlannedPosition
from tests.reference_cell import REFERENCE, T_H_E, T_P_A

TRUTH = {T_P_A_NAME: T_P_A, T_H_E_NAME: T_H_E}


@cache
def cell() -> CellConfig:
    return load_cell(Path(__file__).parents[1] / "cells" / "paper.yaml").cell


@cache
def captures() -> Captures:
    """The reference captures with the passive arm's readings off by 0.1 mrad and the features by up to 0.1 px."""
    rng = np.random.default_rng(1)
    exact = read_captures(REFERENCE)
    noisy = [
        replace(
            capture,
            passive_joints=tuple((capture.passive_joints + rng.normal(0, 1e-4, 6)).tolist()),
            feature=tuple((capture.feature + rng.uniform(-0.1, 0.1, 2)).tolist()),
        )
        for capture in exact.captures
    ]
    return replace(exact, captures=tuple(noisy))


@cache
def result() -> Result:
    return with_truth_error(analyse(captures(), cell(), "paper"), TRUTH)


@cache
def plan() -> Plan:
    """What might have been planned: the passive arm's first joint 5 mrad from where it came to stand."""
    constraints = []
    for name in dict.fromkeys(capture.constraint for capture in captures().captures):
        members = [capture for capture in captures().captures if capture.constraint == name]
        positions = tuple(
            PlannedPosition((q[0] + 0.005, *q[1:]), distance=0.5 - 0.02 * i, tilt=0.1 * i, clearance=0.1 - 0.01 * i)
            for i, q in enumerate(member.passive_joints for member in members)
        )
        use, active = members[0].use, members[0].active_joints
        constraints.append(PlannedConstraint(name, use, active, positions, 0.0123, 0.35, 6.5))
    return Plan(tuple(constraints), 0.123, {}, False, "5 first looks")
