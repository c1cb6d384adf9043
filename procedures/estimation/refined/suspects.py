"""What may be wrong where captures are not as predicted: what, left to all captures, would explain them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.data import CaptureArrays
from procedures.estimation.refined.estimate import Refined
from procedures.estimation.refined.inexact import (
    Inexact,
    Known,
    fit_inexact,
    joint_zeros,
    link_parameters,
    target_mount,
)
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.verification import LEAST_PROBABILITY, corner_squares

# Far more than any of them is off in a cell that somebody calibrated: what is found is what the captures say.
_MOUNT = (0.02, float(np.radians(5.0)))  # m, rad
_ZERO = float(np.radians(1.0))
_LINK = (0.002, float(np.radians(0.3)))  # m, rad


@dataclass(frozen=True)
class Suspect:
    """words: what to look at, and by how much it would have to be off; explains: whether that is enough."""

    words: str
    explains: bool


def next_suspects(result: Refined, captures: CaptureArrays) -> tuple[Suspect, ...]:
    """In the order in which to look at them: those that explain the captures first, and in each group what is most
    often wrong in real cells first: the target's mount, the zeros of the joints, the calibration of the arms, and
    what no calibration mends.

    captures: all of them, in any order; those of which the order of corners is not known are taken as they are listed.
    """
    joints = {"active": result.knowns.active.joints, "passive": result.knowns.passive.joints}
    tried: list[tuple[str, list[Inexact]]] = [
        ("the target's mount on its flange", [target_mount(*_MOUNT)]),
        ("the zeros of the joints", [joint_zeros(arm, [_ZERO] * n) for arm, n in joints.items()]),
        ("the calibration of the arms", [link_parameters(arm, n, *_LINK) for arm, n in joints.items()]),
    ]
    found = [_suspect(what, inexact, result, captures) for what, inexact in tried]
    loose = "looseness: backlash, sag, a camera or target that is not tight"
    if not any(suspect.explains for suspect in found):
        loose += "; none of what can be calibrated explains the captures"
    found.append(Suspect(loose, False))
    return tuple(sorted(found, key=lambda suspect: not suspect.explains))


def _suspect(what: str, inexact: list[Inexact], result: Refined, captures: CaptureArrays) -> Suspect:
    start = Model(captures, result.knowns, result.noise).state(result.T_P_A, result.T_H_E)
    try:
        fit = fit_inexact(captures, result.knowns, result.noise, start, inexact, True)
    except (Degenerate, np.linalg.LinAlgError):
        return Suspect(what, False)
    corners, ranks = corner_squares(fit.fit.at)
    numbers = sum(len(one.names) for one in inexact)
    freedom = int(ranks.sum()) - CELL - numbers
    left = fit.fit.at.cost - float(corners.sum())
    if freedom <= 0 or stats.chi2.sf(left, freedom) < LEAST_PROBABILITY:
        return Suspect(what, False)
    return Suspect(f"{what}: {_largest(fit.known)} would explain the captures", True)


def _largest(known: tuple[Known, ...]) -> str:
    """What stands out most, in sigmas, of what is seen."""
    seen = [one for one in known if one.seen] or list(known)
    most = max(seen, key=lambda one: abs(one.value) / one.sigma)
    size = abs(most.value)
    amount = f"{np.degrees(size):.2g} deg" if most.unit == "rad" else f"{1e3 * size:.2g} mm"
    return f"{most.name} off by {amount}"
