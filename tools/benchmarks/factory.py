"""The calibration over real wires: each dialect over TCP, and CAN, against the emulator in another process.

    python -m tools.benchmarks.factory [--fast] [--only rep --only can] [--set ...]

Prints for each what the run came to beside the truth, how long it took, and how close the arms came to each other.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

CELLS = Path(__file__).parents[2] / "cells"
LINKS = ("rep", "abb", "fanuc", "motoman", "can")


@dataclass(frozen=True)
class Outcome:
    """mean, largest: mm of mismatch; rotation, translation: T_P_A's error, deg and mm; least: as the emulator says."""

    code: int
    seconds: float
    mean: float
    largest: float
    rotation: float
    translation: float
    least: str


def main() -> int:
    """Run all that is asked for; 1 if any run did not end with verdict ok."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=LINKS, help="one of them; may be repeated")
    parser.add_argument("--fast", action="store_true", help="arms five times faster")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", action="append", default=[], metavar="PATH=VALUE")
    options = parser.parse_args()
    failed = 0
    print(f"{'link':8} {'exit':>4} {'s':>7} {'mean mm':>8} {'max mm':>7} {'T_P_A deg':>9} {'mm':>6}  least distance")
    for link in options.only or LINKS:
        outcome = run(link, options.fast, options.seed, options.set)
        failed += outcome.code != 0
        print(
            f"{link:8} {outcome.code:4} {outcome.seconds:7.1f} {outcome.mean:8.3f} {outcome.largest:7.3f} "
            f"{outcome.rotation:9.4f} {outcome.translation:6.3f}  {outcome.least}",
            flush=True,
        )
    return 1 if failed else 0


def run(link: str, fast: bool, seed: int, overrides: list[str]) -> Outcome:
    """One run, as an operator begins it."""
    kind = "can" if link == "can" else "tcp"
    cell = CELLS / f"paper-{kind}{'-fast' if fast else ''}.yaml"
    settings = [*overrides, *([] if link == "can" else [f"backends.cell.link.tcp.dialect={link}"])]
    with tempfile.TemporaryDirectory(prefix="dualcal-factory-") as folder:
        command = [sys.executable, "-m", "tools.cli", "run", str(cell), "--emulate", "--json", "--seed", str(seed)]
        command += ["--out", f"{folder}/session", *(part for each in settings for part in ("--set", each))]
        begun = perf_counter()
        ended = subprocess.run(command, capture_output=True, text=True, check=False)
        seconds = perf_counter() - begun
    least = re.search(r"least distance between the arms (.*)", ended.stderr)
    if not ended.stdout:
        print(ended.stderr[-2000:], file=sys.stderr)
        nan = float("nan")
        return Outcome(ended.returncode, seconds, nan, nan, nan, nan, least[1] if least else "-")
    result = json.loads(ended.stdout)
    after, error = result["mismatch_mm"]["after"], result["truth_error"]
    return Outcome(
        ended.returncode,
        seconds,
        after["mean"],
        after["max"],
        error["active_base_in_passive_base"]["rotation_deg"],
        error["active_base_in_passive_base"]["translation_mm"],
        least[1] if least else "-",
    )


if __name__ == "__main__":
    sys.exit(main())
