"""Whether an arm's joints are what its kinematics take them for, before it moves by itself."""

from procedures.commissioning.flange import FlangeCheck, Tolerance, check_flange

__all__ = ["FlangeCheck", "Tolerance", "check_flange"]
