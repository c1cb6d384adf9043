"""Cells with one arm for tests: those of the examples, and small ones that run in a second or two."""

from __future__ import annotations

from pathlib import Path

CELLS = Path(__file__).parent.parent / "cells"
EYE_IN_HAND, EYE_TO_HAND = (CELLS / f"{name}.yaml" for name in ("eye-in-hand", "eye-to-hand"))
BOTH = (EYE_IN_HAND, EYE_TO_HAND)
KINEMATIC = "simulation.stepper=kinematic"
SMALL = (
    KINEMATIC,
    # A quarter of the pixels.
    "camera.matrix=[[406, 0, 255.5], [0, 406, 191.5], [0, 0, 1]]",
    "camera.size_px=[512, 384]",
    "camera.sigma_px=0.015",
    "procedure.views=6",
    "procedure.first_looks=3",
    "procedure.verification.views=3",
)
