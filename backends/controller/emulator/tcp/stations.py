"""The simple-message servers of a cell's arms, on a thread of their own."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from backends.controller.emulator.faults import FaultSchedule, Undo
from backends.controller.emulator.tcp.abb import ROOM, AbbServer
from backends.controller.emulator.tcp.controller import CONTACT, DRIVE_FAULT, Controller, ServedArm
from backends.controller.emulator.tcp.fanuc import FanucServer
from backends.controller.emulator.tcp.motoman import MotomanServer
from backends.controller.emulator.tcp.own_speed import OwnSpeed
from backends.controller.emulator.tcp.packets import Packing
from backends.controller.emulator.tcp.rep import RepServer
from backends.controller.emulator.tcp.server import Server
from backends.controller.emulator.tcp.wires import Line, Port
from backends.controller.promptness import prompt_interpreter, prompt_thread
from dualcal_hal.errors import UsageError

if TYPE_CHECKING:
    from backends.controller.emulator.arm import EmulatedArm
    from backends.controller.options import TcpLink
    from dualcal_hal.config import CellConfig
    from dualcal_hal.transforms import Array

LOOPBACK = "127.0.0.1"

BIG_ENDIAN = {"rep": False, "abb": False, "fanuc": True, "motoman": True}
"""Byte orders where the cell file does not say, as these controllers' have them."""


class Station:
    """A controller with its two ports. Arms that share ports share it."""

    def __init__(
        self, arms: Mapping[int, EmulatedArm], options: TcpLink, cell: CellConfig, schedule: FaultSchedule
    ) -> None:
        served = {group: ServedArm(arm, options.arms[arm.name]) for group, arm in arms.items()}
        self.names = [arm.name for arm in arms.values()]
        self.controller = Controller(served, tells_mode=not options.unknown_is_ready)
        self.line = Line()
        self._server = self._make(options, cell, schedule)

    def _make(self, options: TcpLink, cell: CellConfig, schedule: FaultSchedule) -> Server:
        big = BIG_ENDIAN[options.dialect] if options.byte_order is None else options.byte_order == "big"
        given = (self.controller, self.line, Packing(big, options.real == "f64"), schedule)
        match options.dialect:
            case "rep":
                return RepServer(*given)
            case "abb":
                return AbbServer(*given, self._own_speed(options, cell), options.max_points or ROOM)
            case "fanuc":
                return FanucServer(*given, self._own_speed(options, cell))
            case "motoman":
                return MotomanServer(*given)

    def _own_speed(self, options: TcpLink, cell: CellConfig) -> OwnSpeed:
        (name,) = self.names
        robot, confirmed = cell.robots[name], options.controller_speed_confirmed
        return OwnSpeed(
            robot.chain, _tool(cell, name), robot.speed, None if confirmed is None else confirmed.mm_s / 1000
        )

    def listen(self, motion: int, state: int) -> None:
        """At these ports, 0 for any. UsageError if that cannot be."""
        for number, serve, alone in (
            (motion, self._server.serve_motion, True),
            (state, self._server.serve_state, False),
        ):
            try:
                self.line.ports.append(Port(LOOPBACK, number, serve, alone))
            except OSError as error:
                raise UsageError(f"{LOOPBACK}:{number}: cannot be listened to: {error.strerror}") from error

    @property
    def endpoint(self) -> dict[str, Any]:
        """Where it listens."""
        motion, state = self.line.ports
        return {"host": LOOPBACK, "motion_port": motion.number, "state_port": state.number}

    def attach(self, schedule: FaultSchedule, on_wires: Callable[[Callable[[], None]], None]) -> None:
        """Have faults befall it; ``on_wires`` runs a function on the servers' thread."""
        line, controller = self.line, self.controller

        def flag(name: str) -> Callable[[], Undo]:
            def begin() -> Undo:
                on_wires(lambda: setattr(line, name, True))
                return lambda: on_wires(lambda: setattr(line, name, False))

            return begin

        def act(do: Callable[[], None], undo: Callable[[], None] | None = None) -> Callable[[], Undo | None]:
            def begin() -> Undo | None:
                on_wires(do)
                return None if undo is None else lambda: on_wires(undo)

            return begin

        befall: dict[str, Callable[[], Undo | None]] = {
            "drop": act(line.drop_one),
            "delay": act(line.delay, line.go_on),
            "split": flag("splitting"),
            "merge": flag("merging"),
            "corrupt": act(line.corrupt_one),
            "half-open": act(line.deaden),
            "stale": flag("stale"),
            "lost-link": act(line.down, line.up),
            "estop": act(controller.press_e_stop, controller.release_e_stop),
            "mode": act(lambda: controller.turn_key(False), lambda: controller.turn_key(True)),
            "drive-fault": act(lambda: controller.fail(DRIVE_FAULT)),
        }
        for name in self.names:
            for fault, begin in befall.items():
                schedule.attach(fault, name, begin)


class SimpleMessageServers:
    """All controllers of a cell that are reached by TCP."""

    def __init__(
        self,
        options: TcpLink,
        cell: CellConfig,
        arms: Mapping[str, EmulatedArm],
        schedule: FaultSchedule,
        free_ports: bool,
    ) -> None:
        """Listens from now on, on this machine only; UsageError where that cannot be."""
        self._schedule = schedule
        by_ports: dict[tuple[int, int], dict[int, EmulatedArm]] = {}
        for name, config in sorted(options.arms.items()):
            if not free_ports and config.host not in (LOOPBACK, "localhost"):
                raise UsageError(
                    f"{name}: an emulator serves this machine only, and the cell file has its controller at "
                    f"{config.host}; use --free-ports, or --set its host to {LOOPBACK}"
                )
            by_ports.setdefault((config.motion_port, config.state_port), {})[config.group or 0] = arms[name]
        self._stations: list[Station] = []
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="emulated controllers", daemon=True)
        try:
            for (motion, state), grouped in by_ports.items():
                station = Station(grouped, options, cell, schedule)
                self._stations.append(station)
                station.listen(*((0, 0) if free_ports else (motion, state)))
        except UsageError:
            self._close_ports()
            self._loop.close()
            raise
        for station in self._stations:
            station.attach(schedule, self.soon)
        self._thread.start()

    @property
    def endpoints(self) -> dict[str, Any]:
        """By arm, as ``dualcal emulate`` tells."""
        return {name: station.endpoint for station in self._stations for name in station.names}

    def touched(self, contact: str) -> None:
        """Parts touch: all controllers have an error."""
        for station in self._stations:
            self.soon(partial(station.controller.fail, CONTACT))

    def soon(self, function: Callable[[], None]) -> None:
        """Run ``function`` on the servers' thread, at once if this is it."""
        if threading.current_thread() is self._thread:
            function()
        else:
            self._loop.call_soon_threadsafe(function)

    def close(self) -> None:
        """Put all clients out; once."""
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()
        self._loop.close()

    def _run(self) -> None:
        with prompt_interpreter(), prompt_thread():
            self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        for station in self._stations:
            station.line.up()
        await self._ended.wait()
        for station in self._stations:
            station.line.down()
        for station in self._stations:
            for port in station.line.ports:
                await port.closed()

    def _close_ports(self) -> None:
        for station in self._stations:
            for port in station.line.ports:
                port.give_up()


def _tool(cell: CellConfig, name: str) -> Array:
    """(4, 4): what the arm carries, in its flange."""
    if name == cell.passive_name:
        return cell.passive.target_mount_transform
    return np.asarray(cell.nominal.T_H_E)
