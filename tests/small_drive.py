"""Drives for tests: a few CiA 402 nodes on a virtual bus, by frames alone, with what can go wrong by switches.

They share no code with the driver: what bytes mean is written down here once more.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from time import monotonic

import can

COUNTS = 10_000.0  # per radian
PERIOD = 0.05  # s between two SYNCs; so that a busy machine is not late by three of them

SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x08


@dataclass
class SmallDrive:
    """One node. Profile position goes at the set velocity without a ramp; cyclic targets are followed at once."""

    node: int
    position: int = 0
    # What can go wrong.
    silent: bool = False
    heartless: bool = False
    dead: bool = False
    aborts: set[int] = field(default_factory=set)
    window: int = 2000
    voltage: bool = True
    stiff: bool = False
    shows_operation: int | None = None
    # What it is.
    state: int = SWITCH_ON_DISABLED
    nmt: int = 0x7F
    objects: dict[tuple[int, int], bytes] = field(default_factory=dict)
    controlwords: list[int] = field(default_factory=list)
    targets: list[int] = field(default_factory=list)
    sdo_writes: list[tuple[int, int, int]] = field(default_factory=list)
    rpdo: tuple[int, int, int] | None = None
    operation: int = 0
    set_point: int | None = None
    set_points: list[int] = field(default_factory=list)
    taken: bool = False
    heard: float | None = None
    next_beat: float = 0.0
    text: bytes = b""

    def __post_init__(self) -> None:
        numbers = {
            (0x1000, 0): (0x00020192, 4),
            (0x1018, 1): (0x1234, 4),
            (0x1018, 2): (0x42, 4),
            (0x6502, 0): (0x81, 4),
            (0x6065, 0): (self.window, 4),
            (0x607D, 1): (-100_000, 4),
            (0x607D, 2): (100_000, 4),
            (0x605A, 0): (2, 2),
            (0x605B, 0): (0, 2),
            (0x6007, 0): (0, 2),
            (0x603F, 0): (0, 2),
        }
        for key, (value, size) in numbers.items():
            self.objects[key] = value.to_bytes(size, "little", signed=value < 0)
        self.objects[0x1008, 0] = b"a small drive"

    def number(self, index: int, subindex: int = 0) -> int:
        return int.from_bytes(self.objects.get((index, subindex), b"\0"), "little")

    def statusword(self) -> int:
        arrived = self.set_point is None or self.position == self.set_point
        return self.state | 0x10 * self.voltage | (0x400 if arrived else 0) | (0x1000 if self.taken else 0)

    def control(self, word: int) -> None:
        before = self.controlwords[-1] if self.controlwords else 0
        self.controlwords.append(word)
        kind = word & 0x8F
        if self.state == FAULT:
            if word & 0x80 and not before & 0x80:
                self.state = SWITCH_ON_DISABLED
        elif not word & 0x02:
            self.state = SWITCH_ON_DISABLED
        elif not word & 0x04:
            self.state = QUICK_STOP if self.state in (ENABLED, QUICK_STOP) else SWITCH_ON_DISABLED
        elif kind == 0x06 and self.state in (SWITCH_ON_DISABLED, SWITCHED_ON, ENABLED):
            self.state = READY
        elif kind == 0x07 and self.state in (READY, ENABLED):
            self.state = SWITCHED_ON
        elif kind == 0x0F and self.state in (SWITCHED_ON, QUICK_STOP):
            self.state = ENABLED


class SmallBus:
    """The drives of one arm on a virtual bus of that name."""

    def __init__(self, channel: str, nodes: Iterable[int] = (1, 2, 3)) -> None:
        self.drives = {node: SmallDrive(node) for node in nodes}
        self.nmt: list[tuple[int, int]] = []
        self.master_beats = 0
        self.syncs = 0
        self.lock = threading.RLock()
        self._bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self._ending = False
        self._last_sync = 0.0
        self._thread = threading.Thread(target=self._run, name="small drives")
        self._thread.start()

    def close(self) -> None:
        self._ending = True
        self._thread.join()
        self._bus.shutdown()

    def __enter__(self) -> SmallBus:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def emergency(self, node: int, code: int) -> None:
        self.send(0x80 + node, struct.pack("<HB5x", code, 1))

    def fail(self, node: int, code: int) -> None:
        with self.lock:
            self.drives[node].state = FAULT
        self.emergency(node, code)

    def reboot(self, node: int) -> None:
        with self.lock:
            old = self.drives[node]
            self.drives[node] = SmallDrive(node, position=old.position)
        self.send(0x700 + node, b"\0")

    def _run(self) -> None:
        while not self._ending:
            message = self._bus.recv(0.005)
            with self.lock:
                if message is not None and not message.is_extended_id:
                    self._hear(message.arbitration_id, bytes(message.data))
                for drive in self.drives.values():
                    self._live(drive, monotonic())

    def _live(self, drive: SmallDrive, now: float) -> None:
        period = drive.number(0x1017) / 1000
        if period and not drive.heartless and not drive.dead and now >= drive.next_beat:
            drive.next_beat = now + period
            self.send(0x700 + drive.node, bytes((drive.nmt,)))
        watched = (drive.number(0x1016, 1) & 0xFFFF) / 1000
        if watched and drive.heard is not None and now - drive.heard > watched:
            drive.heard = None
            drive.state = QUICK_STOP if drive.state == ENABLED else drive.state

    def _hear(self, identifier: int, data: bytes) -> None:
        if identifier == 0x000:
            command, node = data
            self.nmt.append((command, node))
            if node in self.drives:
                self.drives[node].nmt = {1: 0x05, 0x80: 0x7F}[command]
        elif identifier == 0x080:
            self.syncs += 1
            for drive in self.drives.values():
                if not drive.dead and drive.nmt == 0x05:
                    self._sync(drive)
        for drive in self.drives.values():
            if not drive.dead:
                self._hear_of(drive, identifier, data)

    def _hear_of(self, drive: SmallDrive, identifier: int, data: bytes) -> None:
        watched = drive.number(0x1016, 1)
        if identifier == 0x200 + drive.node:
            drive.rpdo = struct.unpack("<Hbi", data)
        elif identifier == 0x600 + drive.node:
            self._request(drive, data)
        elif watched and identifier == 0x700 + (watched >> 16 & 0x7F):
            drive.heard = monotonic()
            self.master_beats += 1

    def _sync(self, drive: SmallDrive) -> None:
        if drive.rpdo is not None:
            word, drive.operation, target = drive.rpdo
            drive.control(word)
            self._move(drive, word, target)
        if not drive.silent:
            shown = drive.operation if drive.shows_operation is None else drive.shows_operation
            self.send(0x180 + drive.node, struct.pack("<Hbi", drive.statusword(), shown, drive.position))

    def _move(self, drive: SmallDrive, word: int, target: int) -> None:
        if drive.state != ENABLED:
            drive.set_point = None
            return
        drive.targets.append(target)
        if drive.operation == 8:
            if abs(target - drive.position) > drive.window:
                self.fail(drive.node, 0x8611)
            elif not drive.stiff:
                drive.position = target
        elif drive.operation == 1:
            if word & 0x10 and not drive.taken:
                drive.set_point = target
                drive.set_points.append(target)
            drive.taken = bool(word & 0x10)
            if drive.set_point is not None and not word & 0x100:
                step = max(1, round(drive.number(0x6081) * PERIOD))
                way = drive.set_point - drive.position
                drive.position += max(-step, min(step, way))

    def _request(self, drive: SmallDrive, data: bytes) -> None:
        command, index, subindex = struct.unpack_from("<BHB", data)
        key = (index, subindex)
        answer = 0x580 + drive.node
        head = data[1:4]
        if command == 0x80:
            return
        if index in drive.aborts and command != 0x60:
            self.send(answer, b"\x80" + head + struct.pack("<I", 0x06020000))
        elif command & 0xE0 == 0x20:
            size = 4 - (command >> 2 & 3)
            drive.objects[key] = data[4 : 4 + size]
            drive.sdo_writes.append((index, subindex, drive.number(*key)))
            if index == 0x6040:
                drive.control(drive.number(index))
            self.send(answer, b"\x60" + head + bytes(4))
        elif command & 0xE0 == 0x40:
            value = struct.pack("<H", drive.statusword()) if index == 0x6041 else drive.objects.get(key)
            if value is None:
                self.send(answer, b"\x80" + head + struct.pack("<I", 0x06020000))
            elif len(value) <= 4:
                self.send(answer, bytes((0x43 | (4 - len(value)) << 2,)) + head + value.ljust(4, b"\0"))
            else:
                drive.text = value
                self.send(answer, b"\x41" + head + struct.pack("<I", len(value)))
        elif command & 0xE0 == 0x60:
            part, drive.text = drive.text[:7], drive.text[7:]
            last = not drive.text
            self.send(answer, bytes((command & 0x10 | (7 - len(part)) << 1 | last,)) + part.ljust(7, b"\0"))
