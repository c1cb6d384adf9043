"""Cells for tests: the paper's, and the paper's with a small plan."""

from __future__ import annotations

from pathlib import Path

from dualcal_hal.cellfile import CellFile, load_cell

PAPER = Path(__file__).parent.parent / "cells" / "paper.yaml"
TINY = PAPER.with_name("tiny.yaml")
KINEMATIC = "simulation.stepper=kinematic"
"""Without physics, where a test is about something else: it takes a third of the time."""
FOUND_STAND_OFF = "procedure.stand_off=null"
"""Where a test is about the search for one."""
SMALL = (
    KINEMATIC,
    # The one that is found, to the degree: to search for it takes a fifth of a small run.
    "procedure.stand_off={active_deg: [24, 38, -14, -44, 57, 40], passive_deg: [-27, 44, -16, 51, 53, -132]}",
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
    return load_cell(PAPER, (KINEMATIC, *overrides))


def small_cell(*overrides: str) -> CellFile:
    return load_cell(PAPER, (*SMALL, *overrides))
