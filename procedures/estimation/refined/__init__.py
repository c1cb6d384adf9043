"""Joint maximum likelihood of both transforms from all corners of all captures: :func:`refined`."""

from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.estimate import Alternative, Dropped, Refined, refined
from procedures.estimation.refined.inexact import (
    Inexact,
    Known,
    intrinsics,
    joint_zeros,
    link_parameters,
    square_size,
    target_mount,
)
from procedures.estimation.refined.noise import FoundNoise, Sigma
from procedures.estimation.refined.uncertainty import Direction, Limits, SpatialError

__all__ = [
    "Alternative",
    "CaptureArrays",
    "Direction",
    "Dropped",
    "FoundNoise",
    "Inexact",
    "Known",
    "Knowns",
    "Limits",
    "Noise",
    "Refined",
    "Sigma",
    "SpatialError",
    "intrinsics",
    "joint_zeros",
    "link_parameters",
    "refined",
    "square_size",
    "target_mount",
]
