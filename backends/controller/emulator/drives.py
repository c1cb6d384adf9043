"""The drives of emulated arms, each arm's on a bus of its own."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from canopen import Network

from backends.controller.emulator.axis import Axis
from backends.controller.emulator.braking import Braking
from backends.controller.emulator.drive import Drive, Ill
from backends.controller.emulator.hub import TICK, Bus, Hub
from backends.controller.joint_map import JointMap
from backends.controller.options import CanArm, CanLink
from dualcal_hal.clock import Clock
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from backends.controller.emulator.arm import Reading

SYNC = 0x80
_NMT, _SDO, _HEARTBEAT = 0x000, 0x600, 0x700

TEMPERATURE, OVERCURRENT = 0x4210, 0x2310
"""What an emergency alone, and what a drive's fault tell."""

VICTIM = 2
"""The joint that faults befall where none is named."""

_FOLLOWING_TIME, _POSITION_WINDOW = 0.06, 1e-3
"""Where the master sets none: an axis that is behind by more than its way in so many seconds at full speed has a fault,
one that is nearer than so many radians has arrived."""

_SYNCS_GO_ON = 0.025  # s within which the next SYNC does what a tick would


class Motors(Protocol):
    """What drives need of an emulated arm, in the joints of its kinematics: rad, rad/s, rad/s^2."""

    @property
    def joints(self) -> int: ...
    @property
    def speed(self) -> Array: ...
    @property
    def acceleration(self) -> Array: ...
    def read(self) -> Reading: ...
    def command(self, q: Array, period: float) -> None: ...


class _Periodic:
    """A frame that canopen has sent again and again: a heartbeat."""

    def __init__(self, wires: _Wires, can_id: int, data: bytes, period: float) -> None:
        self._wires = wires
        self.can_id, self.data, self.period = can_id, data, period
        self.due = -math.inf

    def update(self, data: Any) -> None:
        self.data = bytes(data)

    def stop(self) -> None:
        self._wires.periodic.remove(self)


class _Wires(Network):
    """canopen's network on a bus of the hub: it sends; what it is to hear is handed to its nodes."""

    def __init__(self, bus: Bus) -> None:
        super().__init__()
        self._hub_bus = bus
        self.periodic: list[_Periodic] = []

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        self._hub_bus.send(can_id, bytes(data))

    def send_periodic(self, can_id: int, data: Any, period: float, remote: bool = False) -> Any:
        task = _Periodic(self, can_id, bytes(data), period)
        self.periodic.append(task)
        return task


class ArmDrives:
    """All drives of one arm. A SYNC is done for all of them at once: one reading, their frames, one command.

    on_target: called, on the hub's thread, when the arm is sent somewhere else than before. on_stop: when it is seen
    that it is being stopped, with the time since when.
    Used on the hub's thread only.
    """

    def __init__(self, arm: Motors, config: CanArm, bus: Bus, clock: Clock) -> None:
        self.bus = bus
        self._arm = arm
        self._clock = clock
        self._map = JointMap(config.joint_map, arm.joints)
        self._counts_per_rad = np.array([drive.sign * drive.counts_per_rad for drive in config.drives])
        self._offset = np.array([drive.offset_rad for drive in config.drives])
        self._wires = _Wires(bus)
        self.drives = [
            Drive(drive.node, self._wires, defaults)
            for drive, defaults in zip(config.drives, self._defaults(), strict=True)
        ]
        self._axes = [drive.axis for drive in self.drives]
        self._by_node = {drive.id: drive for drive in self.drives}
        self._synced = -math.inf
        self._read()
        for axis in self._axes:
            axis.hold()
        self._told = self._demands()
        self._braking = Braking()
        self.on_target: Callable[[], None] = lambda: None
        self.on_stop: Callable[[float], None] = lambda since: None
        bus.attach(self.on_frame)

    def on_frame(self, can_id: int, data: bytes) -> None:
        """What a master sends."""
        if can_id == SYNC:
            self._on_sync()
        elif can_id == _NMT:
            self._on_nmt(data)
        elif can_id > _HEARTBEAT:
            now = self._clock.now()
            for drive in self.drives:
                drive.on_heartbeat(can_id - _HEARTBEAT, now)
        elif can_id > _SDO:
            if (asked := self._by_node.get(can_id - _SDO)) is not None:
                self._read()
                asked.on_sdo(can_id, data, self._clock.now())
        else:
            for drive in self.drives:
                drive.on_pdo(can_id, data)

    def on_tick(self, now: float) -> None:
        """What drives do by themselves."""
        for beat in self._wires.periodic:
            if now >= beat.due:
                beat.due = max(beat.due + beat.period, now)
                if Ill.NO_HEARTBEAT not in self._by_node[beat.can_id - _HEARTBEAT].ills:
                    self.bus.send(beat.can_id, beat.data)
        for drive in self.drives:
            drive.watch(now)
        synchronous = now - self._synced < _SYNCS_GO_ON
        if any(axis.has_current and not (synchronous and axis.is_cyclic) for axis in self._axes):
            self._read()
            for axis in self._axes:
                axis.advance(now)
        self._command(TICK)

    def _on_sync(self) -> None:
        now = self._synced = self._clock.now()
        self._read()
        for drive in self.drives:
            if Ill.SILENT not in drive.ills:
                for pdo in drive.transmits:
                    if (data := pdo.data()) is not None:
                        self.bus.send(pdo.cob_id, data)
        for drive in self.drives:
            drive.on_sync(now)
        self._command(next((axis.period for axis in self._axes if axis.is_cyclic), TICK))
        if (since := self._braking.look(now, [drive.told for drive in self.drives])) is not None:
            self.on_stop(since)

    def _on_nmt(self, data: bytes) -> None:
        if len(data) >= 2:
            for drive in self.drives:
                if data[1] in (0, drive.id):
                    drive.on_nmt(data[0], self._clock.now())

    def _read(self) -> None:
        """Have all drives know where their motors are."""
        reading = self._arm.read()
        counts = (self._map.to_controller(reading.positions) - self._offset) * self._counts_per_rad
        velocities = self._map.velocity_to_controller(reading.velocities) * self._counts_per_rad
        for axis, actual, velocity in zip(self._axes, np.rint(counts).tolist(), velocities.tolist(), strict=True):
            axis.actual, axis.velocity = int(actual), velocity

    def _demands(self) -> list[float]:
        return [axis.demand for axis in self._axes]

    def _command(self, period: float) -> None:
        """Tell the arm where its drives want it, if that is anything new."""
        demands = self._demands()
        if demands != self._told:
            self._told = demands
            q = self._map.from_controller(np.array(demands) / self._counts_per_rad + self._offset)
            self._arm.command(q, period)
            self.on_target()

    def _defaults(self) -> list[dict[int, int]]:
        """Objects that depend on what the axis can do, and on its counts."""
        speed, acceleration = (
            np.abs(self._map.velocity_to_controller(np.diag(bound))).sum(axis=0)
            for bound in (self._arm.speed, self._arm.acceleration)
        )
        return [
            {
                0x6065: min(int(_FOLLOWING_TIME * v * counts), 0xFFFFFFFE),
                0x6067: int(_POSITION_WINDOW * counts) + 1,
                0x6081: min(int(v * counts) + 1, 0xFFFFFFFF),
                **dict.fromkeys((0x6083, 0x6084, 0x6085), min(int(a * counts) + 1, 0xFFFFFFFF)),
            }
            for counts, v, a in zip(np.abs(self._counts_per_rad), speed, acceleration, strict=True)
        ]


def _each_axis(drives: ArmDrives, do: Callable[[Axis], None]) -> None:
    for drive in drives.drives:
        do(drive.axis)


Strike = Callable[[ArmDrives, Drive], None]

FAULTS: dict[str, tuple[Strike, Strike | None]] = {
    "emergency": (lambda _, drive: drive.tell_emergency(TEMPERATURE), None),
    "drive-fault": (lambda _, drive: drive.axis.fail(OVERCURRENT), None),
    "node-reboot": (lambda _, drive: drive.reboot(), None),
    "following-error": (lambda _, drive: drive.axis.block(), lambda _, drive: drive.axis.free()),
    "heartbeat-loss": (
        lambda _, drive: drive.ills.add(Ill.NO_HEARTBEAT),
        lambda _, drive: drive.ills.discard(Ill.NO_HEARTBEAT),
    ),
    "sdo-abort": (lambda _, drive: drive.ills.add(Ill.REFUSES), lambda _, drive: drive.ills.discard(Ill.REFUSES)),
    "missing-pdo": (lambda _, drive: drive.ills.add(Ill.SILENT), lambda _, drive: drive.ills.discard(Ill.SILENT)),
    "estop": (lambda all_, _: _each_axis(all_, Axis.cut_power), lambda all_, _: _each_axis(all_, Axis.restore_power)),
    "lost-link": (lambda all_, _: all_.bus.lose(), lambda all_, _: all_.bus.mend()),
}
"""How each begins and, if it does, ends, by name."""


class DriveBuses:
    """The buses of emulated arms, served by TCP on this machine from now until they are closed.

    endpoints: how a controller's driver reaches them, as ``dualcal emulate`` tells.
    """

    def __init__(self, options: CanLink, arms: Mapping[str, Motors], clock: Clock, port: int = 0) -> None:
        """``arms`` by their names in ``options``; ``port`` 0 takes a free one. OSError if it cannot be listened to."""
        self._clock = clock
        self._hub = Hub(clock, options.arms, port)
        self.arms = {
            name: ArmDrives(arms[name], config, self._hub.buses[name], clock) for name, config in options.arms.items()
        }
        for drives in self.arms.values():
            self._hub.on_tick(drives.on_tick)
        self.endpoints: dict[str, Any] = {
            "interface": "socketcand",
            "arms": {name: {"channel": f"127.0.0.1:{self._hub.port}/{name}"} for name in options.arms},
        }
        self._hub.start()

    def strike(self, fault: str, arm: str, joint: int = VICTIM) -> Callable[[], None] | None:
        """Have one of :data:`FAULTS` begin, at the drive of a controller's ``joint``, counted from 1, where it befalls
        one; any thread. Returns what ends it, None if it does not last. KeyError, IndexError for what is not there."""
        drives, (begin, end) = self.arms[arm], FAULTS[fault]
        drive = drives.drives[joint - 1]
        self._hub.soon(lambda: begin(drives, drive))
        return None if end is None else lambda: self._hub.soon(lambda: end(drives, drive))

    def close(self) -> None:
        """Put all clients out; any number of times."""
        self._hub.close()
