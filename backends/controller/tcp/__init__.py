"""Arms at controllers that speak ROS-Industrial's simple message over TCP.

In the order of reading: transport (bytes), codec (messages), dialects (what differs between servers), port (a
connection that is kept), state and motion (a controller's two ports), condition and feedback (what a controller
tells), handover (a course on its way), session (one arm).
"""

from __future__ import annotations

from collections.abc import Mapping

from backends.controller.link import ArmLink
from backends.controller.options import TcpArm, TcpLink
from backends.controller.tcp.controller import Controller
from backends.controller.tcp.dialects import dialect
from backends.controller.tcp.feedback import Feedback
from backends.controller.tcp.motion import MotionPort
from backends.controller.tcp.session import SimpleMessageArm
from backends.controller.tcp.state import StatePort
from backends.controller.tcp.transport import Address
from dualcal_hal.clock import Clock
from dualcal_hal.robot import Joints

__all__ = ["links"]


def links(
    options: TcpLink, joints: Mapping[str, int], clock: Clock, top_speeds: Mapping[str, Joints]
) -> dict[str, ArmLink]:
    """The arms by name, none of them open. Arms that share ports share connections.

    joints: how many each arm has; top_speeds: rad/s of each of its controller's joints, the most that it can.
    """
    by_ports: dict[tuple[Address, Address], list[str]] = {}
    for arm in sorted(joints):
        by_ports.setdefault(_ports(options.arms[arm]), []).append(arm)
    made: dict[str, ArmLink] = {}
    for arms in by_ports.values():
        controller = _controller(options, arms, top_speeds[arms[0]], clock)
        for arm in arms:
            group = options.arms[arm].group or 0
            told_by = group if options.dialect == "motoman" else None
            port = controller.state.address
            feedback = Feedback(arm, joints[arm], told_by, port, options.unknown_is_ready, clock)
            made[arm] = SimpleMessageArm(arm, joints[arm], group, controller, feedback, clock)
    return made


def _controller(options: TcpLink, arms: list[str], top_speed: Joints, clock: Clock) -> Controller:
    """One that arms share. Only arms whose messages have no use for a top speed do."""
    name, (state_at, motion_at), spoken = ", ".join(arms), _ports(options.arms[arms[0]]), dialect(options, top_speed)
    state = StatePort(name, state_at, (options.byte_order, options.real), clock)
    motion = MotionPort(name, motion_at, spoken, lambda: state.wire, clock)
    return Controller(state, motion, spoken)


def _ports(arm: TcpArm) -> tuple[Address, Address]:
    return Address(arm.host, arm.state_port), Address(arm.host, arm.motion_port)
