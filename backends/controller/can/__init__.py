"""Arms whose joints are CiA 402 drives on CAN: one bus an arm."""

from __future__ import annotations

from backends.controller.can.session import CanArmLink
from backends.controller.link import ArmLink
from backends.controller.options import CanLink
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused

__all__ = ["links"]


def links(options: CanLink, joints: dict[str, int], clock: Clock) -> dict[str, ArmLink]:
    """The link of each arm of ``options``; ``joints``: how many each has. Nothing is opened.

    CommandRefused where an arm has not one drive for each of its joints.
    """
    for arm, number in joints.items():
        drives = len(options.arms[arm].drives)
        if drives != number:
            why = f"{number} joints, but {drives} drives"
            raise CommandRefused(arm, "set up", why, "name one drive for each joint in the cell file")
    return {arm: CanArmLink(arm, options, clock) for arm in joints}
