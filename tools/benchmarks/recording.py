"""What recording costs a run, and how fast a recording is replayed; both in alternation, as the machine's speed varies.

python -m tools.benchmarks.recording [--cell cells/paper.yaml] [--rounds 5]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

_COMMAND = [sys.executable, "-c", "from tools.cli import main; main()"]


def timed(*arguments: object) -> tuple[float, float, str, int]:
    """Wall time and processor time in s of a whole command, its output and its peak memory in MiB."""
    start = time.perf_counter()
    with subprocess.Popen([*_COMMAND, *map(str, arguments)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        output = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"dualcal {' '.join(map(str, arguments))} ended with {process.returncode}")
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, output, usage.ru_maxrss // 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cell", type=Path, default=Path("cells/paper.yaml"))
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    walls: dict[str, list[float]] = {"--no-log": [], "--log": []}
    processor: dict[str, list[float]] = {"--no-log": [], "--log": []}
    replays: list[float] = []
    factors: list[float] = []
    peak = 0
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.rounds):
            for log in ("--no-log", "--log"):
                wall, used, _, _ = timed("run", options.cell, log, "--out", Path(folder) / f"{number}{log}")
                walls[log].append(wall)
                processor[log].append(used)
            wall, _, output, peak = timed("replay", Path(folder) / f"{number}--log", "--json")
            replays.append(wall)
            document = json.loads(output)
            factors.append(document["recorded_s"] / wall)
            if not document["identical"]:
                print("the replay was not the same to the last bit")
        size = (Path(folder) / "0--log" / "log-0001.mcap").stat().st_size
    for name, times in (("wall", walls), ("processor", processor)):
        without, with_ = (statistics.median(times[log]) for log in ("--no-log", "--log"))
        cost = statistics.median(b / a for a, b in zip(times["--no-log"], times["--log"], strict=True)) - 1
        print(f"{name:9} without log {without:6.2f} s, with {with_:6.2f} s: {100 * cost:+.1f} % (median of pairs)")
    print(
        f"replay    {statistics.median(replays):6.2f} s, {statistics.median(factors):.1f} times as fast as recorded, "
        f"{peak} MiB; log {size / 1e6:.1f} MB"
    )


if __name__ == "__main__":
    main()
