"""What holds for every test: it leaves no thread and no socket behind. And what many look at: a recorded run."""

from __future__ import annotations

import gc
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Matrices are small here: a second thread of OpenBLAS only spins, and takes its time from the other worker's tests.
# It is read when numpy is first imported, also by the processes that tests start.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# How long an example takes is the machine's business.
settings.register_profile("any machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("any machine")

_GRACE = 1.0  # s in which a thread that was told to end may do so


KEEP_TIME = (
    "contract/",
    "test_camera_",
    "test_can_",
    "test_controlled_robot",
    "test_emulat",
    "test_faulty_runs",
    "test_first_motion",
    "test_over_wires",
    "test_socketcand_hub",
    "test_tcp_",
    "test_watch",
)
"""Tests on real clocks and wires, which wait more than they compute: beside those that compute they would be late."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    folder = Path(__file__).parent
    for item in items:
        if item.path.relative_to(folder).as_posix().startswith(KEEP_TIME):
            item.add_marker(pytest.mark.keeps_time)


def pytest_collection_finish() -> None:
    """All that was imported and collected stays: to search it now and then would hold up tests that keep time."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def _nothing_left_behind() -> Iterator[None]:
    threads, sockets = set(threading.enumerate()), _sockets()
    yield
    started = set(threading.enumerate()) - threads
    for thread in started:
        thread.join(_GRACE)
    left = [thread.name for thread in started if thread.is_alive()]
    assert not left, f"threads left behind: {left}"
    assert not _sockets() - sockets, "sockets left behind"


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session of a finished run of the tiny cell; not to be changed."""
    from tests.cells import TINY
    from tests.command_line import dualcal

    folder = tmp_path_factory.mktemp("recorded") / "session"
    result = dualcal("run", TINY, "--out", folder)
    assert result.exit_code == 0, result.output
    return folder


def _sockets() -> set[str]:
    links = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            links.add(os.readlink(descriptor))
        except FileNotFoundError:  # the descriptor of this very listing
            continue
    return {link for link in links if link.startswith("socket:")}


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs leave no picture, where a test is about something else: it takes a third of a small one."""
    monkeypatch.setattr("tools.cli.run.draw_summary", lambda *_, **__: None)
