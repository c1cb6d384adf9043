"""What both methods do with verification captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from dualcal_hal.config import CellConfig
from dualcal_hal.session.captures import CaptureRecord
from dualcal_hal.session.result import Mismatch, Rejected
from dualcal_hal.transforms import Array
from procedures.estimation import Statistics, mismatch, statistics


@dataclass(frozen=True)
class CalibratedPlaces:
    """Constraints and arrivals that were calibrated with: nothing is proven on them."""

    constraints: frozenset[str]
    arrivals: frozenset[int]

    @classmethod
    def of(cls, captures: Sequence[CaptureRecord]) -> CalibratedPlaces:
        """Of all captures of a run."""
        calibrated = [capture for capture in captures if capture.use == "calibration"]
        return cls(
            frozenset(capture.constraint for capture in calibrated),
            frozenset(capture.active_arrival for capture in calibrated),
        )

    def has(self, capture: CaptureRecord) -> bool:
        return capture.constraint in self.constraints or capture.active_arrival in self.arrivals

    def reason(self, capture: CaptureRecord) -> str:
        """Why a verification capture there is rejected."""
        return f"verification on constraint {capture.constraint}, which was calibrated with"


def mismatch_of(captures: Sequence[CaptureRecord], cell: CellConfig, T_P_A: Array, T_H_E: Array) -> Statistics | None:
    """Distances of the feature point from the predicted optical axis; None without captures."""
    if not captures:
        return None
    T_A_H, T_P_T = poses(captures, cell)
    return statistics(mismatch(T_P_A, T_H_E, T_A_H, T_P_T[:, :3, 3]))


def poses(captures: Sequence[CaptureRecord], cell: CellConfig) -> tuple[Array, Array]:
    """T_A_H and T_P_T (k, 4, 4)."""
    active, passive = joints(captures, cell)
    T_P_F = cell.passive.chain.forward(passive)
    return cell.active.chain.forward(active), T_P_F @ cell.passive.target_mount_transform


def joints(captures: Sequence[CaptureRecord], cell: CellConfig) -> tuple[Array, Array]:
    """Of the active and the passive arm, (k, n) rad."""
    active = np.array([capture.active_joints for capture in captures]).reshape(len(captures), cell.active.chain.joints)
    passive = np.array([capture.passive_joints for capture in captures]).reshape(
        len(captures), cell.passive.chain.joints
    )
    return active, passive


def mismatch_record(statistics: Statistics | None) -> Mismatch | None:
    return None if statistics is None else Mismatch(**asdict(statistics))


def words_for(rejected: Sequence[Rejected]) -> list[str]:
    """A line, where there is something to say."""
    return [f"{len(rejected)} captures rejected, the first {rejected[0].id}: {rejected[0].reason}"] if rejected else []
