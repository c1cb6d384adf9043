"""``dualcal emulate`` as a process: it says where it listens, serves, and leaves nothing behind."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from backends.cameras.zmq_backend import ZmqBackend
from dualcal_hal.cellfile import load_cell
from dualcal_hal.clock import RealClock
from tests.cells import TINY
from tests.command_line import dualcal
from tests.simple_message_client import ARMS, PATIENCE, Client, tcp_overrides


@contextmanager
def emulator(*arguments: str, free_ports: bool = True) -> Iterator[tuple[subprocess.Popen[str], dict[str, Any]]]:
    overrides = [part for override in tcp_overrides() for part in ("--set", override)]
    command = [sys.executable, "-m", "tools.cli", "emulate", str(TINY), *overrides, "--until-stdin-closes", *arguments]
    process = subprocess.Popen(
        [*command, *(["--free-ports"] if free_ports else [])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.stdin.close()
        process.wait(PATIENCE)
        process.stdout.close()
        process.stderr.close()


def group_is_empty(process: subprocess.Popen[str]) -> bool:
    """Whether no process of its session is left."""
    try:
        os.killpg(process.pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_it_serves_arms_and_camera_and_ends_with_its_input() -> None:
    with emulator("--fault", "estop:right@0") as (process, document):
        assert document["format"] == "dualcal.emulator/1"
        assert document["pid"] == process.pid
        assert set(document["backends"]) == {"cell", "eye"}
        left = document["backends"]["cell"]["tcp"]["left"]
        with (
            socket.create_connection((left["host"], left["motion_port"]), PATIENCE) as motion,
            socket.create_connection((left["host"], left["state_port"]), PATIENCE) as state,
        ):
            client = Client(motion, state)
            assert client.ask(1, bytes(40))[:3] == (1, 3, 1)
            assert client.next_status() == (1, 0, 0, 0, 0, 2, 1)
        eye = ZmqBackend("eye", load_cell(TINY, tcp_overrides()))
        eye.use_emulator(document["backends"]["eye"])
        eye.open(PATIENCE)
        try:
            asked = eye.clock.now()
            frames = [eye.camera("camera").grab(asked, PATIENCE) for _ in range(2)]
        finally:
            eye.close()
        assert all(asked <= frame.time <= eye.clock.now() for frame in frames)
        assert frames[0].image.shape == (384, 512)
        assert np.std(frames[0].image) > 1.0
        assert process.stdin is not None
        process.stdin.close()
        assert process.wait(PATIENCE) == 0
        assert process.stderr is not None
        assert "fault: estop of right" in process.stderr.read()
        assert group_is_empty(process)


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_it_in_order(number: int) -> None:
    with emulator() as (process, _):
        os.kill(process.pid, number)
        assert process.wait(PATIENCE) == 0
        assert group_is_empty(process)


def test_its_camera_ends_even_if_it_is_killed() -> None:
    with emulator() as (process, _):
        process.kill()
        process.wait(PATIENCE)
        clock, never = RealClock(), threading.Event()
        end = clock.now() + PATIENCE
        while not group_is_empty(process):
            assert clock.now() < end, "the camera's process is left behind"
            clock.wait(never, clock.now() + 0.05)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--fault", "explode@1"], "there is no fault 'explode'"),
        (["--fault", "sdo-abort@1"], "cannot have it"),
        (["--set", f"backends.cell.link.tcp.arms={ARMS.replace('127.0.0.1', '192.168.1.5')}"], "this machine only"),
        (["--set", "simulation=null"], "the emulator needs to know how the cell truly is"),
    ],
)
def test_what_cannot_be_emulated_is_refused(arguments: list[str], said: str) -> None:
    overrides = [part for override in tcp_overrides() for part in ("--set", override)]
    result = dualcal("emulate", TINY, *overrides, *arguments)
    assert result.exit_code == 2
    assert said in result.output


def test_a_cell_with_a_simulator_has_no_wires_to_emulate() -> None:
    result = dualcal("emulate", Path(TINY))
    assert result.exit_code == 2
    assert "which has no emulator" in result.output


def test_a_port_that_is_taken_is_said() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        arms = ARMS.replace("motion_port: 1,", f"motion_port: {port},")
        overrides = [part for override in tcp_overrides(arms=arms) for part in ("--set", override)]
        result = dualcal("emulate", TINY, *overrides)
    assert result.exit_code == 2
    assert f"127.0.0.1:{port}: cannot be listened to" in result.output
