"""What a cell file says, as checked and frozen models, one section a file.

Fields are named as in the file, unit included; properties without suffix give SI and radians.
"""

from dualcal_hal.config.cell import CellConfig, CellDocument, Location, reference_problems
from dualcal_hal.config.nominal import NominalConfig
from dualcal_hal.config.procedure import METHODS, ProcedureConfig
from dualcal_hal.config.robots import RobotConfig
from dualcal_hal.config.simulation import SimulationConfig

__all__ = [
    "METHODS",
    "CellConfig",
    "CellDocument",
    "Location",
    "NominalConfig",
    "ProcedureConfig",
    "RobotConfig",
    "SimulationConfig",
    "reference_problems",
]
