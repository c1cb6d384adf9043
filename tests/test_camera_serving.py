"""``dualcal serve-camera``: any camera of a cell file is served from the PC that it hangs on."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import pytest

pytest.importorskip("zmq", reason="the zmq camera is an extra: pip install 'dualcal[zmq]'")

from backends.cameras.zmq_backend import ZmqBackend
from dualcal_hal.errors import LinkLost
from tests.camera_cells import CLOCK, camera_cell, picture
from tests.cells import TINY
from tests.command_line import dualcal

AMPLE = 30.0

Serve = Callable[..., tuple["subprocess.Popen[str]", str]]


@pytest.fixture
def album(tmp_path: Path) -> Path:
    for number in (1, 2, 3):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture(number))
    return tmp_path


@pytest.fixture
def serve(album: Path) -> Iterator[Serve]:
    """Begins to serve the album, as another process; gives that and its endpoint."""
    processes = []

    def begin(*options: str) -> tuple[subprocess.Popen[str], str]:
        program = "from tools.cli import main; main()"
        entry = f"backends.album={{type: opencv, folder: '{album}'}}"
        command = [sys.executable, "-c", program, "serve-camera", str(TINY), "--set", entry, "--backend", "album"]
        process = subprocess.Popen(
            [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=TINY.parents[1]
        )
        processes.append(process)
        assert process.stdout is not None
        served = re.fullmatch(r"serving '.+' at (tcp://127\.0\.0\.1:\d+)\n", process.stdout.readline())
        assert served is not None
        return process, served[1]

    yield begin
    for process in processes:
        process.kill()
        process.communicate()


def test_what_is_served_is_seen_and_a_signal_ends_it(serve: Serve) -> None:
    process, endpoint = serve("--name", "album")
    backend = ZmqBackend("lens", camera_cell(f"{{type: zmq, endpoint: '{endpoint}', camera: album}}"))
    backend.open(AMPLE)
    try:
        for _ in range(4):
            not_before = CLOCK.now()
            frame = backend.camera("camera").grab(not_before, AMPLE)
            assert not_before <= frame.time <= CLOCK.now()
            assert (frame.sequence - 1) % 3 + 1 == frame.image[0, 0]
        found = {finding.subject: finding.said for finding in backend.camera("camera").findings()}
        assert "this machine's own clock" in found["clock"]
    finally:
        backend.close()
    assert process.stdout is not None
    assert process.stdout.readline() == "somebody listens\n"
    while (line := process.stdout.readline()) != "nobody listens any more\n":
        assert re.fullmatch(r"\d+\.\d frames a second\n", line)
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=AMPLE)
    assert process.returncode == 130
    assert error == "dualcal: interrupted by SIGTERM\n"


def test_a_camera_that_makes_its_own_time_is_not_served() -> None:
    result = dualcal("serve-camera", TINY)
    assert result.exit_code == 2
    assert "makes its own time" in result.stderr


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--backend", "none"], "no backend 'none'"),
        (["--backend", "album", "--bind", "tcp://*:0"], "others than this machine's could listen"),
        (["--backend", "album", "--bind", "here"], "no endpoint"),
        (["--backend", "album", "--key", "x"], "--key and --allow belong together"),
        (["--backend", "album", "--key", "x", "--allow", "y"], "no key can be read"),
        (["--backend", "empty"], "holds no image"),
    ],
)
def test_what_cannot_be_served_is_refused_in_words(album: Path, tmp_path: Path, options: list[str], why: str) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    entries = [f"backends.{name}={{type: opencv, folder: '{at}'}}" for name, at in (("album", album), ("empty", empty))]
    sets = [word for entry in entries for word in ("--set", entry)]
    result = dualcal("serve-camera", TINY, *sets, *options)
    assert result.exit_code == 2, result.output
    assert why in " ".join(result.stderr.split())


def test_what_serving_needs_may_be_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tools.cli.serve_camera", None)
    result = dualcal("serve-camera", TINY)
    assert result.exit_code == 2
    assert "pip install 'dualcal[zmq]'" in result.stderr


@pytest.mark.slow
def test_a_sender_that_falls_silent_without_an_end_is_a_lost_link(serve: Serve) -> None:
    process, endpoint = serve()
    backend = ZmqBackend("lens", camera_cell(f"{{type: zmq, endpoint: '{endpoint}'}}"))
    backend.open(AMPLE)
    try:
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(LinkLost, match="connection was lost"):
            backend.camera("camera").grab(CLOCK.now() + 1.0, AMPLE)
    finally:
        backend.close()
