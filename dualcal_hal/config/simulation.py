"""The simulated world: the truth, its noise and its errors. Neither plan nor estimate may see it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from dualcal_hal.config.errors import ErrorsConfig
from dualcal_hal.config.nominal import TransformsConfig
from dualcal_hal.config.robots import KinematicsConfig
from dualcal_hal.config.values import Natural, NotNegative, Section
from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from dualcal_hal.config.cell import CellConfig


class TruthConfig(TransformsConfig):
    """The simulated cell as it is."""

    kinematics: dict[str, KinematicsConfig] = Field(default={})
    """The true kinematics of an arm, by its name; the cell's own where left out."""

    def chains(self, cell: CellConfig) -> dict[str, Chain]:
        """The true chain of each arm of the cell."""
        return {name: self.kinematics.get(name, arm.kinematics).chain for name, arm in cell.robots.items()}

    def target_mount(self, cell: CellConfig) -> Array:
        """T_F_T (4, 4) as it is without the error ``target_mount``: what is known of it."""
        return cell.passive.target_mount_transform


class NoiseConfig(Section):
    """Standard deviations of the simulated errors."""

    joint_mrad: NotNegative = 0.03
    """Error of a joint for each commanded target, which its encoder does not show, mrad."""
    encoder_mrad: NotNegative = 0.005
    """Error of a reading of a joint, mrad."""
    image_grey: NotNegative = 2.0
    """Noise of a pixel, grey levels of 255."""
    blur_px: NotNegative = 0.6
    """Sigma of the lens's blur, px."""

    @property
    def joint(self) -> float:
        """Radians."""
        return self.joint_mrad / 1000

    @property
    def encoder(self) -> float:
        """Radians."""
        return self.encoder_mrad / 1000


class SimulatedConfig(Section):
    """What a simulated world has besides the truth."""

    seed: Natural
    """Of the noise and of the errors that are drawn."""
    stepper: Literal["kinematic", "bullet"]
    """What moves the simulated arms: kinematic moves them exactly, bullet by motors, with weight and contact."""
    noise: NoiseConfig = NoiseConfig()
    """What disturbs it anew each time."""
    errors: ErrorsConfig = ErrorsConfig()
    """What is wrong with it for good."""


class SimulationConfig(SimulatedConfig):
    """The simulated world; neither plan nor estimate may see it."""

    truth: TruthConfig
    """The cell as it is."""
