"""Joint maximum likelihood of both transforms from all corners of all captures: :func:`refined`."""

from procedures.estimation.refined.data import CaptureArrays, Knowns, Noise
from procedures.estimation.refined.estimate import Alternative, Dropped, Refined, refined
from procedures.estimation.refined.noise import FoundNoise, Sigma
from procedures.estimation.refined.uncertainty import Direction, Limits, SpatialError

__all__ = [
    "Alternative",
    "CaptureArrays",
    "Direction",
    "Dropped",
    "FoundNoise",
    "Knowns",
    "Limits",
    "Noise",
    "Refined",
    "Sigma",
    "SpatialError",
    "refined",
]
