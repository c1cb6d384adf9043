"""Estimators on plain arrays: no file, no device, no image.

The two-step method of the paper (:func:`estimate`), its verification, a pinhole camera with distortion, and
the joint fit to all corners that serves planning.
"""

from procedures.estimation.corner_fit import CornerFit, Prior, fit_corners
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.line import Line, fit_line
from procedures.estimation.paper import Estimate, Unobservable, estimate
from procedures.estimation.rotation import Iteration
from procedures.estimation.verification import Statistics, judge, mismatch, statistics

__all__ = [
    "CornerFit",
    "Degenerate",
    "Estimate",
    "Iteration",
    "Line",
    "Prior",
    "Statistics",
    "Unobservable",
    "estimate",
    "fit_corners",
    "fit_line",
    "judge",
    "mismatch",
    "statistics",
]
