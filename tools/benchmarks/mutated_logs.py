"""Logs with random damage: whatever was done to a log, reading it gives records or one of the typed errors.

python -m tools.benchmarks.mutated_logs --count 100000
"""

from __future__ import annotations

import argparse
import random
import resource
import tempfile
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from dualcal_hal.camera import Frame, Intrinsics
from dualcal_hal.errors import LogDamaged, LogMissing, LogTooNew
from dualcal_hal.robot import JointPath, Mode, MotionState, RobotState
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.log import (
    Call,
    FrameRef,
    LogReader,
    LogWriter,
    MotionEnded,
    Note,
    Picture,
    Reply,
    StepBegun,
    StepFinished,
    Worked,
)
from dualcal_hal.session.log.check import check_log
from dualcal_hal.session.log.info import log_info
from dualcal_hal.session.log.recover import recover_log

STARTED = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
TYPED = (LogDamaged, LogMissing, LogTooNew)


def write_sample(path: Path, points: int = 6, size: tuple[int, int] = (24, 16)) -> None:
    """A small log of the kind that a run writes: for each point a motion, a frame of (width, height) px and work."""
    rng = np.random.default_rng(7)
    width, height = size
    with LogWriter(path, STARTED, arms=("left", "right"), metadata={"cell": "sample"}) as log:
        log.attach("cell.yaml", "application/yaml", b"name: sample\n", 0.0)
        log.calibration(Intrinsics(np.diag([30.0, 30.0, 1.0]), np.zeros(5), size), 0.0)
        log.record(Note("info", "begun", 0.0))
        for point in range(points):
            begun = 10.0 * point + 1 / 3
            key = StepKey("calibration", "calibration/00", point, "point")
            log.record(StepBegun(key, begun))
            path_sent = JointPath(((0.1 * point, 1 / 7),), (1.0, 1.0), (2.0, 2.0))
            log.record(Call("left", point, "start", {"path": path_sent}, begun))
            log.record(Reply("left", point, None, begun + 0.01))
            state = RobotState((0.1 * point, 1 / 7), (0.0, -0.0), Mode.READY, (), begun + 2, point)
            log.joint_states("left", state)
            log.record(MotionEnded("left", point, MotionState.SETTLED, state, begun + 2))
            log.record(Call("camera", point, "grab", {"not_before_s": begun + 2, "timeout_s": 2.0}, begun + 2))
            image = rng.integers(0, 256, (height, width), dtype=np.uint8)
            frame = Frame(image, begun + 2.1, point)
            log.frame(frame)
            log.record(Reply("camera", point, FrameRef("camera", point, frame.time), begun + 2.2))
            log.annotations((12.0, 8.0), (12.5, 8.25), frame.time)
            log.transforms([("left", "camera", np.eye(4))], begun + 2.2)
            log.record(Worked(point, "detection", {"frame": point}, {"corners_px": [[1 / 3, 2.0]]}, begun + 2.3))
            log.record(StepFinished(key, begun + 2.4))
            log.sync()
        log.attach("result.json", "application/json", b"{}", 100.0)


def mutate(content: bytes, chance: random.Random) -> bytes:
    """One to three damages: bytes flipped, cut out, put in, overwritten by others of the file, or its end cut off."""
    data = bytearray(content)
    for _ in range(chance.randint(1, 3)):
        if not data:
            break
        place, other = chance.randrange(len(data)), chance.randrange(len(data))
        length = chance.choice((1, 2, 8, chance.randint(1, 400)))
        match chance.randrange(6):
            case 0:
                data[place] ^= 1 << chance.randrange(8)
            case 1:
                del data[place : place + length]
            case 2:
                data[place:place] = chance.randbytes(length)
            case 3:
                data[place : place + length] = data[other : other + length]
            case 4:
                data[place : place + 8] = chance.choice(
                    (b"\xff" * 8, b"\0" * 8, (1 << chance.randrange(64)).to_bytes(8, "little"))
                )
            case 5:
                del data[place:]
    return bytes(data)


def read_all(path: Path, recovered: Path) -> str:
    """Read a log in every way there is; the name of the typed error that it ends with, or what it is. All else
    goes through.
    """
    outcome = "read"
    for way in (_items, log_info, check_log, lambda path: _recover(path, recovered)):
        try:
            way(path)
        except TYPED as error:
            outcome = type(error).__name__
    return outcome


def _items(path: Path) -> None:
    with LogReader(path) as reader:
        reader.layout()
        reader.metadata()
        for _ in reader.attachments():
            pass
        for item in reader.items():
            if isinstance(item, Picture):
                item.decode()
            elif isinstance(item, Reply | MotionEnded) and item.error is not None:
                item.error.error()


def _recover(path: Path, recovered: Path) -> None:
    recovered.unlink(missing_ok=True)
    recover_log(path, recovered)
    assert not [finding for finding in check_log(recovered).findings if "checksum" in finding.what]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        sample, mutated, recovered = (Path(folder) / name for name in ("log-0001.mcap", "mutated.mcap", "new.mcap"))
        write_sample(sample, points=4)
        content = sample.read_bytes()
        for number in range(arguments.count):
            mutated.write_bytes(mutate(content, chance))
            try:
                outcomes[read_all(mutated, recovered)] += 1
            except BaseException:
                kept = Path(tempfile.gettempdir()) / f"mutated-{arguments.seed}-{number}.mcap"
                mutated.replace(kept)
                print(f"number {number} is kept as {kept}")
                raise
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{arguments.count} mutated logs of {len(content)} bytes: {dict(outcomes)}; peak {peak:.0f} MiB")


if __name__ == "__main__":
    main()
