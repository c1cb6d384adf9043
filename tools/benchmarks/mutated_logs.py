"""Logs with random damage: whatever was done to a log, reading it gives records or one of the typed errors.

By bytes, which checksums find, and by records with the checksums made right again, which only their readers find. Each
is read, counted, checked, recovered and exported, and of some sessions the replay is run.

python -m tools.benchmarks.mutated_logs --count 100000
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from copy import deepcopy
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.camera import Frame, Intrinsics
from dualcal_hal.errors import DualcalError, LogDamaged, LogMissing, LogTooNew
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
from dualcal_hal.session.log.export import export_log
from dualcal_hal.session.log.info import log_info
from dualcal_hal.session.log.layout import METADATA_NAME, RECORD_KINDS, camera_of
from dualcal_hal.session.log.recover import recover_log
from dualcal_hal.session.log.writer import FileWriter
from tools.golden import GOLDEN

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


class Rewriter:
    """A log that is written again with some of its records changed: what checksums vouch for may still be anything."""

    def __init__(self, source: Path, wanted: Callable[[str], bool] = lambda topic: True) -> None:
        """Keeps the messages of the wanted topics in memory."""
        with LogReader(source) as reader:
            self._layout, self._about = reader.layout(), dict(reader.about())
            self._messages = [(topic, message) for topic, message in reader.messages() if wanted(topic)]

    def write(self, target: Path, chance: random.Random) -> None:
        """With one to three records changed, and all checksums right."""
        changed = set(chance.sample(range(len(self._messages)), chance.randint(1, 3)))
        about = self._about if chance.random() < 0.9 else {**self._about, "devices": chance.choice(_DEVICES)}
        with target.open("wb") as file:
            writer = FileWriter(file, self._layout)
            writer.write_metadata(METADATA_NAME, about)
            for number, (topic, message) in enumerate(self._messages):
                data, when, sequence = message.data, message.publish_time, message.sequence
                if number in changed:
                    data = mutate_record(data, chance) if topic in RECORD_KINDS else mutate(data, chance)
                    if chance.random() < 0.1:
                        when, sequence = chance.choice((0, 1 << 62, (1 << 64) - 1)), chance.randrange(1 << 32)
                writer.write(topic, when, data, sequence)
            writer.finish()


def mutate_record(data: bytes, chance: random.Random) -> bytes:
    """A record's JSON with one of its values another, missing, or of another kind; now and then with bytes damaged."""
    if chance.random() < 0.15:
        return mutate(data, chance)
    record = json.loads(data)
    path = chance.choice(list(_places(record, ())))
    value = deepcopy(chance.choice(_ODD))
    if not path:
        return json.dumps(value).encode()
    holder = record
    for key in path[:-1]:
        holder = holder[key]
    match chance.randrange(8):
        case 0:
            del holder[path[-1]]
        case 1 if isinstance(holder, list):
            holder[path[-1] : path[-1] + 1] = holder[path[-1] : path[-1] + 1] * chance.choice((2, 1000))
        case _:
            holder[path[-1]] = value
    return json.dumps(record).encode()


def _places(value: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, below in entries:
        yield from _places(below, (*path, key))


_DEEP: Any = 0
for _ in range(100):
    _DEEP = [_DEEP]

_ODD: tuple[Any, ...] = (
    *(None, True, -1, 0, 1.5, 2**63, 10**30, 10**400, 1e308, -1e308, float("nan"), float("inf")),
    *("", "nan", "inf", "\ud800", "\x00", "\x1b[31m", "a" * 300, "../../x", "left", "start", "DeviceError"),
    *([], {}, [[]], [0.0], _DEEP, {"number": "nan"}, {"state": {}}, {"path": {}}, {"stop": {"confirmed": 1}}),
    {"frame": {"camera": "camera", "sequence": 10**30, "time_s": "inf"}},
    {"class": "DeviceError", "device": "left", "attempted": "x", "why": "\ud800", "advice": ""},
)
_DEVICES = (
    *("", "[]", '{"arms": [], "camera": ""}', '{"arms": ["left"], "camera": "camera"}'),
    *('{"arms": ["\\ud800"], "camera": "c"}', json.dumps({"arms": ["x" * 5000], "camera": "c"})),
    '{"arms": ["left", "left"], "camera": "../../x"}',
)


def read_all(path: Path, folder: Path) -> str:
    """Read a log in every way there is; the name of the typed error that it ends with, or what it is. All else
    goes through. ``folder`` takes what is recovered and exported, and is emptied for that.
    """
    outcome = "read"
    for way in (_items, log_info, check_log, lambda path: _recover(path, folder), lambda path: _export(path, folder)):
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


def _recover(path: Path, folder: Path) -> None:
    recovered = folder / "recovered.mcap"
    recovered.unlink(missing_ok=True)
    recover_log(path, recovered)
    findings = (found.what for found in check_log(recovered).findings)
    assert not [what for what in findings if "checksum" in what and "PNG" not in what]


def _export(path: Path, folder: Path) -> None:
    shutil.rmtree(folder / "export", ignore_errors=True)
    export_log(path, folder / "export")


def replay(session: Path) -> str:
    """Play a session back in this process; its exit code, or the name of the typed error that it ends with."""
    from tools.cli.replay import ReplayOptions, replay_session

    try:
        with redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            return f"replay {replay_session(ReplayOptions(session, None, json=False))}"
    except DualcalError as error:
        return f"replay {type(error).__name__}"


def is_replayed(topic: str) -> bool:
    """Whether a replay needs the topic's messages."""
    return topic in RECORD_KINDS or camera_of(topic) is not None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--session", type=Path, default=GOLDEN, help="the session that is replayed with records changed"
    )
    parser.add_argument("--replays", type=int, default=100, help="one log of so many is a replayed session's")
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        sample, mutated = folder / "log-0001.mcap", folder / "mutated.mcap"
        write_sample(sample, points=4)
        content, records = sample.read_bytes(), Rewriter(sample)
        session = shutil.copytree(arguments.session, folder / "session")
        played = Rewriter(arguments.session / sample.name, is_replayed)
        for number in range(arguments.count):
            spoilt = mutated
            try:
                if number % arguments.replays == 0:
                    spoilt = session / sample.name
                    played.write(spoilt, chance)
                    outcomes[replay(session)] += 1
                    continue
                if number % 2:
                    mutated.write_bytes(mutate(content, chance))
                else:
                    records.write(mutated, chance)
                outcomes[read_all(mutated, folder)] += 1
            except BaseException:
                kept = Path(tempfile.gettempdir()) / f"mutated-{arguments.seed}-{number}.mcap"
                shutil.copyfile(spoilt, kept)
                print(f"number {number} is kept as {kept}")
                raise
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"{arguments.count} mutated logs, half by bytes, half by records: {dict(outcomes)}; peak {peak:.0f} MiB")


if __name__ == "__main__":
    main()
