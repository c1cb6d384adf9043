"""What is wrong with simulated arms and with what is mounted on them; all are off by default.

What is drawn, is drawn from the simulation's seed; directions and axes evenly over the sphere.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from dualcal_hal.config.values import NotNegative, Number, PartsPerMillion, Positive, Section
from dualcal_hal.transforms import Array


class KinematicErrorsConfig(Section):
    """The known Denavit-Hartenberg parameters are wrong: a normal error on each of both arms."""

    angle_deg: NotNegative = 0.0
    """Standard deviation of the error of each theta, alpha and beta, degrees."""
    length_mm: NotNegative = 0.0
    """Standard deviation of the error of each a and d, mm."""

    @property
    def angle(self) -> float:
        """Radians."""
        return float(np.radians(self.angle_deg))

    @property
    def length(self) -> float:
        """Metres."""
        return self.length_mm / 1000


class JointZeroConfig(Section):
    """Encoders whose zero is off: a link stands at what is read plus the offset."""

    offset_deg: dict[str, tuple[Number, ...]] = Field(default={})
    """Of each joint of an arm, by its name, degrees."""

    def offset(self, arm: str) -> Array | float:
        """(n,) rad; 0 for an arm that is not named."""
        return np.radians(self.offset_deg.get(arm, 0.0))


class EncoderEccentricityConfig(Section):
    """Encoder discs that sit off their axis: a link stands off what is read by a sine of one period a turn."""

    amplitude_mrad: NotNegative = 0.0
    """Largest error, mrad; the phase is drawn for each joint."""

    @property
    def amplitude(self) -> float:
        """Radians."""
        return self.amplitude_mrad / 1000


class BacklashConfig(Section):
    """Play in the gears: a link follows half a gap behind its motor, and after a reversal once the gap is crossed."""

    gap_mrad: NotNegative = 0.0
    """Between both ends of the play, mrad."""

    @property
    def gap(self) -> float:
        """Radians."""
        return self.gap_mrad / 1000


class ComplianceConfig(Section):
    """Joints that give way to the weight of the links, in proportion to its torque; encoders do not see it."""

    sag_mrad: NotNegative = 0.0
    """Of the shoulder (joint 2) if all links lay behind each other in one level line, mrad; arms with offsets do not
    quite get there. All joints are equally stiff, links weigh what their capsules' volumes say, the tool nothing."""

    @property
    def sag(self) -> float:
        """Radians."""
        return self.sag_mrad / 1000


class ArmScaleConfig(Section):
    """Both arms are larger than known, in all lengths of their Denavit-Hartenberg rows."""

    ppm: PartsPerMillion = 0.0
    """Parts per million; within 100 000."""

    @property
    def factor(self) -> float:
        return 1.0 + 1e-6 * self.ppm


class BaseDriftConfig(Section):
    """The active base wanders steadily in a drawn direction and turns about its origin on a drawn axis."""

    translation_mm_per_hour: NotNegative = 0.0
    """Speed, mm per hour of simulated time."""
    rotation_deg_per_hour: NotNegative = 0.0
    """Speed, degrees per hour of simulated time."""

    @property
    def translation(self) -> float:
        """Metres per second."""
        return self.translation_mm_per_hour / 1000 / 3600

    @property
    def rotation(self) -> float:
        """Radians per second."""
        return float(np.radians(self.rotation_deg_per_hour)) / 3600


class ThermalConfig(Section):
    """Both arms grow from the start of the simulation on as they warm up: 1 - exp(-t / time constant) of the end."""

    growth_ppm: PartsPerMillion = 0.0
    """Of all lengths in the end, parts per million; within 100 000."""
    time_constant_min: Positive = 60.0
    """Minutes of simulated time."""

    def factor(self, when: float) -> float:
        """By which the lengths have grown at time ``when`` in s."""
        return 1.0 - 1e-6 * self.growth_ppm * float(np.expm1(-when / (60 * self.time_constant_min)))


class MountFlexConfig(Section):
    """A camera mount that bends: about the flange's origin, so that the optical axis leans towards the ground."""

    mrad_per_g: NotNegative = 0.0
    """With the optical axis level, mrad; it follows the sine of the axis's angle to the vertical."""

    @property
    def bend(self) -> float:
        """Radians at 1 g."""
        return self.mrad_per_g / 1000


class TargetMountConfig(Section):
    """The target sits elsewhere on its flange than known: shifted in a drawn direction, turned about a drawn axis."""

    translation_mm: NotNegative = 0.0
    """Length of the shift, mm."""
    rotation_deg: NotNegative = 0.0
    """Angle of the turn, degrees."""

    @property
    def translation(self) -> float:
        """Metres."""
        return self.translation_mm / 1000

    @property
    def rotation(self) -> float:
        """Radians."""
        return float(np.radians(self.rotation_deg))


class TargetSlipConfig(TargetMountConfig):
    """The target slips on its flange: from then on it is shifted and turned, in drawn directions."""

    at_s: NotNegative = 0.0
    """When, seconds of simulated time."""


class SettleTimeConfig(Section):
    """An arm's links go on swinging along its last move once its set points rest; encoders do not see it.

    Motors with weight to move (the stepper bullet) settle some 0.06 s later: that much has faded by the first frame.
    """

    amplitude_mrad: NotNegative = 0.0
    """Of the joint that moved farthest, as the swing begins, mrad; of the others in proportion to their way."""
    frequency_hz: Positive = 15.0
    """Of the swing, Hz."""
    decay_s: Positive = 0.1
    """Time in which it fades to 1/e, seconds."""

    def swing(self, since: float) -> float:
        """Rad of the joint that moved farthest, ``since`` s after its set points came to rest."""
        if since <= 0.0:
            return 0.0
        turn, fading = 2 * np.pi * self.frequency_hz * since, np.exp(-since / self.decay_s)
        return float(self.amplitude_mrad / 1000 * fading * np.sin(turn))


class TimeSkewConfig(Section):
    """The joints of a state were sampled earlier than its time stamp says."""

    delay_s: Annotated[Number, Field(ge=0, le=1)] = 0.0
    """By how much, seconds; at most 1."""


class MechanicalErrorsConfig(Section):
    """What is wrong with the simulated arms and with what is mounted on them."""

    kinematics: KinematicErrorsConfig = KinematicErrorsConfig()
    joint_zero: JointZeroConfig = JointZeroConfig()
    encoder_eccentricity: EncoderEccentricityConfig = EncoderEccentricityConfig()
    backlash: BacklashConfig = BacklashConfig()
    compliance: ComplianceConfig = ComplianceConfig()
    arm_scale: ArmScaleConfig = ArmScaleConfig()
    base_drift: BaseDriftConfig = BaseDriftConfig()
    thermal: ThermalConfig = ThermalConfig()
    mount_flex: MountFlexConfig = MountFlexConfig()
    target_mount: TargetMountConfig = TargetMountConfig()
    target_slip: TargetSlipConfig = TargetSlipConfig()
    settle_time: SettleTimeConfig = SettleTimeConfig()
    time_skew: TimeSkewConfig = TimeSkewConfig()
