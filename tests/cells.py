"""Cells for tests: the paper's, and the paper's with a small plan."""

from __future__ import annotations

from pathlib import Path

from dualcal_hal.cellfile import CellFile, load_cell

PAPER = Path(__file__).parent.parent / "cells" / "paper.yaml"
SMALL = (
    "procedure.constraints=3",
    "procedure.positions=3",
    "procedure.first_looks=3",
    "procedure.verification.constraints=1",
    "procedure.verification.positions=2",
)
NOISELESS = (
    "simulation.noise={joint_mrad: 0, encoder_mrad: 0, image_grey: 0, blur_px: 0}",
    "robots.left.joint_sigma_mrad=0",
    "robots.right.joint_sigma_mrad=0",
    "robots.left.encoder_sigma_mrad=0",
    "robots.right.encoder_sigma_mrad=0",
)


def paper_cell(*overrides: str) -> CellFile:
    return load_cell(PAPER, overrides)


def small_cell(*overrides: str) -> CellFile:
    return load_cell(PAPER, (*SMALL, *overrides))
