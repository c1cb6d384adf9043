"""Joint maximum likelihood of both transforms from all corners of all captures: :func:`refined`."""

from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.estimate import Alternative, Dropped, Refined, refined
from procedures.estimation.refined.guidance import would_help
from procedures.estimation.refined.hidden import Hidden, hidden
from procedures.estimation.refined.inexact import (
    Inexact,
    Known,
    common_scale,
    free_intrinsics,
    intrinsics,
    joint_zeros,
    link_parameters,
    square_size,
    target_mount,
)
from procedures.estimation.refined.noise import FoundNoise, Sigma
from procedures.estimation.refined.suspects import Suspect, next_suspects
from procedures.estimation.refined.uncertainty import Direction, Limits, SpatialError
from procedures.estimation.refined.verification import Consistency, verify

__all__ = [
    "Alternative",
    "CaptureArrays",
    "Consistency",
    "Direction",
    "Dropped",
    "FoundNoise",
    "Hidden",
    "Inexact",
    "Known",
    "Knowns",
    "Limits",
    "Noise",
    "Refined",
    "Sigma",
    "SpatialError",
    "Suspect",
    "common_scale",
    "free_intrinsics",
    "hidden",
    "intrinsics",
    "joint_zeros",
    "link_parameters",
    "next_suspects",
    "refined",
    "square_size",
    "target_mount",
    "verify",
    "would_help",
]
