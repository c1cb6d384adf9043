"""The ``backends`` entry of an industrial controller."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from backends.controller.joint_map import JointMapConfig
from dualcal_hal.config.files import BesideTheCellFile
from dualcal_hal.config.values import AtLeast1, NotNegative, Number, Positive, Section

Port = Annotated[AtLeast1, Field(le=65535)]
NodeId = Annotated[AtLeast1, Field(le=127)]
Dialect = Literal["rep", "abb", "fanuc", "motoman"]

CORRIDOR_MM = {"abb": 10.0, "fanuc": 10.0}
"""What dialects that blend cut off corners by where the cell file does not say, mm."""

BITRATE_ELSEWHERE = {
    "socketcan": "set it by: ip link set CHANNEL type can bitrate N",
    "socketcand": "it is set where socketcand runs",
    "virtual": "a virtual bus has none",
    "udp_multicast": "a bus in a network has none",
}
"""Interfaces that do not set the bit rate, and who does."""

CAN_NEEDS = ("can", "canopen")
"""Modules of the extra that drives on CAN need."""


class TcpArm(Section):
    """Where one arm's controller listens."""

    host: str
    """Name or address of the controller."""
    motion_port: Port
    """TCP port that takes motion messages: 11000, on Motoman's 50240."""
    state_port: Port
    """TCP port that sends states: 11002, on Motoman's 50241."""
    group: Annotated[int, Field(strict=True, ge=0, le=3)] | None = None
    """The controller's group of axes, where its messages carry one (motoman)."""
    joint_map: JointMapConfig | None = None
    """Where the controller's joints are not those of the kinematics."""


class SpeedConfirmed(Section):
    """What an operator has set at the controller."""

    mm_s: Positive
    """The highest speed of the tool, mm/s."""


class TcpLink(Section):
    """ROS-Industrial's simple message over TCP."""

    dialect: Dialect
    """Whose server it is; they differ."""
    byte_order: Literal["big", "little"] | None = None
    """The server's; judged from its first message where left out, and held against it where given."""
    real: Literal["f32", "f64"] | None = None
    """Size of the server's floating-point numbers; as byte_order."""
    max_points: Annotated[AtLeast1, Field(ge=2)] | None = None
    """How many points a download may have (abb): 200 where left out, 100 on older servers."""
    corridor_mm: NotNegative | None = None
    """How far from the path the controller may cut a corner, mm; added to clearance (abb, fanuc). 10 where left out."""
    controller_speed_confirmed: SpeedConfirmed | None = None
    """The speed set at a controller that ignores the speed it is sent (abb, fanuc)."""
    unknown_is_ready: bool = False
    """Whether what a controller cannot tell is taken to be as it has to be: mode, drives, emergency stop, error, motion
    possible."""
    arms: dict[str, TcpArm]
    """Both arms, by their names under robots."""

    @property
    def ignores_velocity(self) -> bool:
        """Whether the controller moves at a speed of its own."""
        return self.dialect in ("abb", "fanuc")

    @property
    def corridor(self) -> float:
        """Metres."""
        given = CORRIDOR_MM.get(self.dialect, 0.0) if self.corridor_mm is None else self.corridor_mm
        return given / 1000

    @model_validator(mode="after")
    def _fits_the_dialect(self) -> Self:
        problems = []
        if self.max_points is not None and self.dialect != "abb":
            problems.append(f"max_points is abb's, not {self.dialect}'s")
        if not self.ignores_velocity:
            for key in ("corridor_mm", "controller_speed_confirmed"):
                if getattr(self, key) is not None:
                    problems.append(f"{key} is for dialects that ignore velocity, abb and fanuc, not {self.dialect}")
        grouped = self.dialect == "motoman"
        for name, arm in self.arms.items():
            if arm.group is not None and not grouped:
                problems.append(f"arms.{name}.group: only motoman's messages carry a group")
            if arm.motion_port == arm.state_port:
                problems.append(f"arms.{name}: motion_port and state_port must differ")
        problems += _shared(self.arms, grouped)
        if problems:
            raise ValueError("; ".join(problems))
        return self


def _shared(arms: dict[str, TcpArm], grouped: bool) -> list[str]:
    """What is wrong with arms that name the same ports."""
    problems = []
    names = sorted(arms)
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            a, b = arms[first], arms[second]
            if a.host != b.host or not {a.motion_port, a.state_port} & {b.motion_port, b.state_port}:
                continue
            if not grouped:
                problems.append(
                    f"arms {first} and {second} name the same port: only motoman's messages tell arms apart"
                )
            elif (a.motion_port, a.state_port) != (b.motion_port, b.state_port):
                problems.append(f"arms {first} and {second} must share both ports or none")
            elif (a.group or 0) == (b.group or 0):
                problems.append(f"arms {first} and {second} share ports: each needs a group of its own")
    return problems


class Drive(Section):
    """One joint's drive on the bus."""

    node: NodeId
    """CANopen node id, 1 to 127."""
    counts_per_rad: Positive
    """Position counts of the drive for one radian of the joint."""
    offset_rad: Number = 0.0
    """What the joint stands at where the drive shows 0 counts, rad."""
    sign: Literal[-1, 1] = 1
    """-1 where the drive counts against the joint."""
    eds: BesideTheCellFile | None = None
    """The drive's electronic data sheet (EDS), for its names and versions; found without it."""


class CanArm(Section):
    """One arm's bus and drives."""

    channel: str
    """The bus: can0, a serial device, or host:port of a socketcand."""
    drives: Annotated[tuple[Drive, ...], Field(min_length=1)]
    """One for each of the controller's joints."""
    joint_map: JointMapConfig | None = None
    """Order and coupling; sign and offset belong to each drive."""


class CanLink(Section):
    """Joint drives by CiA 402 over CANopen, one bus an arm."""

    interface: str
    """python-can's name: socketcan, socketcand, slcan, ..."""
    bitrate: AtLeast1 | None = None
    """Bits per second, where the interface sets it."""
    sync_period_ms: Annotated[Number, Field(ge=2, le=100)] = 10.0
    """Period of the cycle: targets, SYNC, positions; ms."""
    mode: Literal["cyclic", "profile"] = "cyclic"
    """cyclic sends a position each cycle (mode 8); profile has each drive make its own way (mode 1)."""
    arms: dict[str, CanArm]
    """Both arms, by their names under robots."""

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        problems = []
        if self.bitrate is not None and self.interface in BITRATE_ELSEWHERE:
            elsewhere = BITRATE_ELSEWHERE[self.interface]
            problems.append(f"bitrate is no option of {self.interface}: {elsewhere}")
        channels: dict[str, str] = {}
        for name, arm in self.arms.items():
            if arm.channel in channels:
                problems.append(f"arms {channels[arm.channel]} and {name} share channel {arm.channel}: one bus per arm")
            channels[arm.channel] = name
            nodes = [drive.node for drive in arm.drives]
            if len(set(nodes)) != len(nodes):
                problems.append(f"arms.{name}.drives: a node id stands there twice: {nodes}")
            if arm.joint_map is not None and (arm.joint_map.sign is not None or arm.joint_map.offset_deg is not None):
                problems.append(f"arms.{name}.joint_map: sign and offset_rad belong to each drive on CAN")
        if problems:
            raise ValueError("; ".join(problems))
        return self


class Link(Section):
    """What the controller is reached by: one of them."""

    tcp: TcpLink | None = None
    """ROS-Industrial's simple message."""
    can: CanLink | None = None
    """CANopen drives."""

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if (self.tcp is None) == (self.can is None):
            raise ValueError("must be one of tcp and can")
        return self


class ControllerOptions(Section):
    """An industrial controller, by TCP or CAN."""

    link: Link

    @property
    def corridor(self) -> float:
        """How far from a path it may cut corners, m."""
        return 0.0 if self.link.tcp is None else self.link.tcp.corridor
