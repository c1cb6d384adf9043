"""What a log costs: writing, reading, surveying and checking one of many frames.

python -m tools.benchmarks.log --frames 2000
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dualcal_hal.camera import Frame
from dualcal_hal.robot import Mode, RobotState
from dualcal_hal.session.log import Call, FrameRef, LogReader, LogWriter, Reply
from dualcal_hal.session.log.check import check_log
from dualcal_hal.session.log.info import log_info
from dualcal_hal.session.log.recover import recover_log

IMAGES = 8
READINGS = 4


def timed(what: str, function: Callable[[], object]) -> float:
    begun = time.perf_counter()
    function()
    took = time.perf_counter() - begun
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{what:24} {took:8.2f} s, peak {peak:.0f} MiB so far")
    return took


def write(path: Path, frames: int, size: tuple[int, int]) -> None:
    """As a run does: readings about each frame, and all of it synced every fourth."""
    rng = np.random.default_rng(1)
    width, height = size
    # Noise of a few grey levels on a flat scene, as a camera has it.
    images = [rng.normal(120, 2, (height, width)).round().astype(np.uint8) for _ in range(IMAGES)]
    waited = 0.0
    with LogWriter(path, datetime(2026, 1, 1, tzinfo=UTC), arms=("left", "right")) as log:
        for number in range(frames):
            when = 0.5 * number
            for reading in range(READINGS):
                arm = ("left", "right")[reading % 2]
                index = READINGS // 2 * number + reading // 2
                state = RobotState((0.1,) * 6, (0.0,) * 6, Mode.READY, (), when, index)
                log.record(Call(arm, index, "read", {"timeout_s": 1.0}, when))
                log.joint_states(arm, state)
                log.record(Reply(arm, index, state, when))
            log.record(Call("camera", number, "grab", {"not_before_s": when}, when))
            log.frame(Frame(images[number % IMAGES], when + 0.1, number))
            log.record(Reply("camera", number, FrameRef("camera", number, when + 0.1), when + 0.2))
            if number % 4 == 3:
                begun = time.perf_counter()
                log.sync()
                waited += time.perf_counter() - begun
        print(f"slowed by {log.slowed:.2f} s; in sync {waited:.2f} s")


def read(path: Path) -> None:
    with LogReader(path) as reader:
        for _ in reader.items():
            pass


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--size", type=int, nargs=2, default=(1024, 768), help="width and height, px")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log-0001.mcap"
        took = timed("write", lambda: write(path, arguments.frames, tuple(arguments.size)))
        size = path.stat().st_size
        print(f"{arguments.frames} frames, {size / 1e6:.0f} MB, {took / arguments.frames * 1e3:.1f} ms a frame")
        for _ in range(3):
            timed("info", lambda: log_info(path))
        timed("read", lambda: read(path))
        timed("check", lambda: check_log(path))
        timed("recover", lambda: recover_log(path, path.with_name("recovered.mcap")))


if __name__ == "__main__":
    main()
