"""Refined results on the reference captures: the paper's cell with the noise that its file states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from dualcal_hal.session.captures import Captures, read_captures
from dualcal_hal.session.result import Result, with_truth_error
from procedures.analysis import Choices, analyse
from tests.reference_cell import REFERENCE
from tests.reference_run import TRUTH, cell

JOINT = 3e-5  # rad
PIXEL = 0.02


@cache
def noisy_captures(bent: float = 0.0) -> Captures:
    """Corners that miss by PIXEL, joints by JOINT, the active arm's once an arrival; bent: by how much the passive
    arm's fifth joint zero is off, rad, besides what a fit can take up.
    """
    rng = np.random.default_rng(1)
    exact = read_captures(REFERENCE)
    arrivals = sorted({capture.active_arrival for capture in exact.captures})
    active = {arrival: rng.normal(0, JOINT, 6) for arrival in arrivals}
    captures = []
    for capture in exact.captures:
        corners = np.array(capture.corners) + rng.normal(0, PIXEL, np.shape(capture.corners))
        passive = capture.passive_joints + rng.normal(0, JOINT, 6)
        passive += bent * np.array([0, 0, np.sin(passive[1]), 0, 1, 0])
        captures.append(
            replace(
                capture,
                active_joints=tuple((capture.active_joints + active[capture.active_arrival]).tolist()),
                passive_joints=tuple(passive.tolist()),
                feature=tuple(corners[len(corners) // 2].tolist()),
                corners=tuple(map(tuple, corners.tolist())),
            )
        )
    return replace(exact, captures=tuple(captures))


@cache
def refined_result(bent: float = 0.0, choices: Choices | None = None) -> Result:
    return with_truth_error(analyse(noisy_captures(bent), cell(), "refined", choices), TRUTH)


@cache
def with_some_off() -> tuple[Captures, Result]:
    """One arrival read wrong by the active arm, one capture by the passive arm, one listed from the other end."""
    captures = list(noisy_captures().captures)
    for index, capture in enumerate(captures):
        if capture.constraint == "calibration/02":
            off = np.array(capture.active_joints) + [0, 0.02, 0, 0, 0, 0]
            captures[index] = replace(capture, active_joints=tuple(off.tolist()))
    off = np.array(captures[1].passive_joints) + [0, 0.02, 0, 0, 0, 0]
    captures[1] = replace(captures[1], passive_joints=tuple(off.tolist()))
    captures[20] = replace(captures[20], corners=captures[20].corners[::-1], order_known=False)
    changed = replace(noisy_captures(), captures=tuple(captures))
    return changed, with_truth_error(analyse(changed, cell(), "refined"), TRUTH)
