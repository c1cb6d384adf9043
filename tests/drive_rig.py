"""Emulated drives on a bus without wires, in virtual time, and a master that knows no more than CiA 301's frames."""

from __future__ import annotations

import struct
import threading
from dataclasses import dataclass

import numpy as np

from backends.controller.emulator.arm import Reading
from backends.controller.emulator.drives import ArmDrives
from backends.controller.emulator.hub import Bus
from backends.controller.options import CanArm
from dualcal_hal.clock import VirtualClock
from dualcal_hal.transforms import Array

NEVER = threading.Event()
SYNC = 0x80


class IdealMotors:
    """Motors that are at once where they are told to be."""

    def __init__(self, joints: int, home: float = 0.0) -> None:
        self.joints = joints
        self.speed, self.acceleration = np.full(joints, 2.0), np.full(joints, 8.0)
        self.q: Array = np.full(joints, home)
        self.commands: list[Array] = []
        self.noise = np.zeros(joints)

    def read(self) -> Reading:
        return Reading(self.q + self.noise, np.zeros(self.joints), 0.0)

    def command(self, q: Array, period: float) -> None:
        self.commands.append(q)
        self.q = q


class RecordingBus(Bus):
    """``heard``: what was sent on it, by whoever is attached."""

    def __init__(self, clock: VirtualClock) -> None:
        super().__init__("arm", clock)
        self.heard: list[tuple[int, bytes]] = []

    def send(self, can_id: int, data: bytes) -> None:
        self.heard.append((can_id, data))


@dataclass(frozen=True)
class Shown:
    """What a drive sends at each SYNC, as TPDO1 is mapped by itself."""

    status: int
    mode: int
    position: int

    @property
    def state(self) -> str:
        """CiA 402's masks, as the standard's table has them."""
        for name, mask, value in (
            ("switch-on disabled", 0x4F, 0x40),
            ("ready", 0x6F, 0x21),
            ("switched on", 0x6F, 0x23),
            ("enabled", 0x6F, 0x27),
            ("quick stop", 0x6F, 0x07),
            ("fault reaction", 0x4F, 0x0F),
            ("fault", 0x4F, 0x08),
        ):
            if self.status & mask == value:
                return name
        return "not ready"


class Aborted(Exception):
    """An SDO transfer was aborted; args: the code."""


class Rig:
    """One arm's drives and their master."""

    def __init__(self, joints: int = 1, *, home: float = 0.0, **arm: object) -> None:
        """Drives have node ids from 1 on, and 1000 counts a radian, unless ``arm`` has other drives."""
        drives = [{"node": k + 1, "counts_per_rad": 1000.0} for k in range(joints)]
        config = CanArm.model_validate({"channel": "arm", "drives": drives} | arm)
        self.clock = VirtualClock(100.0)
        self.bus = RecordingBus(self.clock)
        self.motors = IdealMotors(joints, home)
        self.drives = ArmDrives(self.motors, config, self.bus, self.clock)
        self.boot_messages = self.taken()

    def taken(self) -> list[tuple[int, bytes]]:
        """What was sent since this was asked last."""
        heard, self.bus.heard = self.bus.heard, []
        return heard

    def send(self, can_id: int, data: bytes = b"") -> None:
        self.drives.on_frame(can_id, data)

    def pass_time(self, seconds: float) -> None:
        """In ticks of 5 ms."""
        for _ in range(round(seconds / 0.005)):
            self.clock.wait(NEVER, self.clock.now() + 0.005)
            self.drives.on_tick(self.clock.now())

    def nmt(self, command: int, node: int = 0) -> None:
        self.send(0, bytes((command, node)))

    def sync(self) -> dict[int, Shown]:
        """What each drive sends at a SYNC, by node."""
        self.taken()
        self.send(SYNC)
        frames = self.taken()
        return {can_id - 0x180: Shown(*struct.unpack("<Hbi", data)) for can_id, data in frames if can_id < 0x200}

    def cycle(self, word: int, target: int = 0, mode: int = 8, node: int = 1) -> Shown:
        """A cycle of 10 ms with a target for one drive, and what that is like at the end of it."""
        self.send(0x200 + node, struct.pack("<Hbi", word, mode, target))
        self.send(SYNC)
        self.pass_time(0.01)
        return self.shown(node)

    def shown(self, node: int = 1) -> Shown:
        """What a drive says by SDO."""
        heard = self.bus.heard
        data = self.read(0x6041, 0, node) + self.read(0x6061, 0, node) + self.read(0x6064, 0, node)
        self.bus.heard = heard
        return Shown(*struct.unpack("<Hbi", data))

    def enable(self, mode: int = 8, node: int = 1, target: int = 0) -> None:
        for word in (0x06, 0x07, 0x0F):
            shown = self.cycle(word, target, mode, node)
        assert shown.state == "enabled"

    def read(self, index: int, subindex: int = 0, node: int = 1) -> bytes:
        """An SDO upload, expedited or in segments."""
        reply = self._ask(node, struct.pack("<BHB4x", 0x40, index, subindex))
        if reply[0] & 0x02:
            return reply[4 : 8 - (reply[0] >> 2 & 0x03)]
        data, toggle = b"", 0
        while True:
            segment = self._ask(node, bytes((0x60 | toggle,)) + bytes(7))
            data += segment[1 : 8 - (segment[0] >> 1 & 0x07)]
            if segment[0] & 0x01:
                return data
            toggle ^= 0x10

    def number(self, index: int, subindex: int = 0, node: int = 1) -> int:
        return int.from_bytes(self.read(index, subindex, node), "little")

    def write(self, index: int, subindex: int, data: bytes, node: int = 1) -> None:
        """An expedited SDO download."""
        command = 0x23 | (4 - len(data)) << 2
        self._ask(node, struct.pack("<BHB", command, index, subindex) + data.ljust(4, b"\0"))

    def _ask(self, node: int, request: bytes) -> bytes:
        self.taken()
        self.send(0x600 + node, request)
        replies = [data for can_id, data in self.taken() if can_id == 0x580 + node]
        if not replies:
            raise TimeoutError
        if replies[0][0] == 0x80:
            raise Aborted(struct.unpack("<I", replies[0][4:])[0])
        return replies[0]


def u8(value: int) -> bytes:
    return struct.pack("<B", value)


def u16(value: int) -> bytes:
    return struct.pack("<H", value)


def u32(value: int) -> bytes:
    return struct.pack("<I", value)


def i16(value: int) -> bytes:
    return struct.pack("<h", value)


def i32(value: int) -> bytes:
    return struct.pack("<i", value)
