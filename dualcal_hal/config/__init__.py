"""What a cell file says, as checked and frozen models, one section a file.

Fields are named as in the file, unit included; properties without suffix give SI and radians.
"""

from dualcal_hal.config.cell import CellConfig, CellDocument, reference_problems
from dualcal_hal.config.nominal import NominalConfig
from dualcal_hal.config.one_arm import (
    FIXED,
    STAND,
    OneArmCell,
    OneArmConfig,
    OneArmDocument,
    StandTruthConfig,
    is_of_one_arm,
    one_arm_problems,
)
from dualcal_hal.config.procedure import METHODS, ProcedureConfig
from dualcal_hal.config.references import Location
from dualcal_hal.config.robots import ArmConfig, RobotConfig
from dualcal_hal.config.simulation import SimulationConfig

__all__ = [
    "FIXED",
    "METHODS",
    "STAND",
    "ArmConfig",
    "CellConfig",
    "CellDocument",
    "Location",
    "NominalConfig",
    "OneArmCell",
    "OneArmConfig",
    "OneArmDocument",
    "ProcedureConfig",
    "RobotConfig",
    "SimulationConfig",
    "StandTruthConfig",
    "is_of_one_arm",
    "one_arm_problems",
    "reference_problems",
]
