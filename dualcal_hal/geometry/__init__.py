"""Shapes of the arms and of what stands about them, and how far they stay clear of each other. Metres and radians."""

from dualcal_hal.geometry.body import BETWEEN_SAMPLES, LARGEST_MOTION, ArmBody
from dualcal_hal.geometry.capsules import (
    Capsules,
    camera_box,
    camera_capsule,
    link_capsules,
    plate_box,
    plate_capsules,
)
from dualcal_hal.geometry.cell import CellGeometry
from dualcal_hal.geometry.distance import segment_distance
from dualcal_hal.geometry.mesh import Mesh, read_mesh
from dualcal_hal.geometry.placement import Placement
from dualcal_hal.geometry.solids import Block, Cylinder, Fixture, HalfSpace, Solid

__all__ = [
    "BETWEEN_SAMPLES",
    "LARGEST_MOTION",
    "ArmBody",
    "Block",
    "Capsules",
    "CellGeometry",
    "Cylinder",
    "Fixture",
    "HalfSpace",
    "Mesh",
    "Placement",
    "Solid",
    "camera_box",
    "camera_capsule",
    "link_capsules",
    "plate_box",
    "plate_capsules",
    "read_mesh",
    "segment_distance",
]
