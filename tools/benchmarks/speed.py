"""Speed and memory over several rounds on this machine.

python -m tools.benchmarks.speed
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from backends.simulator.rendering import Renderer
from dualcal_hal.cellfile import load_cell
from dualcal_hal.kinematics import random_joints
from dualcal_hal.session.captures import read_captures
from dualcal_hal.session.folder import Session
from dualcal_hal.transforms import inverse
from procedures.analysis import analyse
from procedures.calibrate import requests_of
from procedures.detection import Detection, Detector, Missed
from procedures.planning.first_look import find_stand_off
from procedures.planning.model import CellModel
from procedures.planning.poses import PosePlanner
from procedures.planning.ways import WayFinder
from tools.benchmarks.clutter import clutter

CELL = Path("cells/paper.yaml")


def median_ms(function: Callable[[], object], rounds: int) -> str:
    """Median, 95th percentile and largest of so many calls after one that warms up."""
    function()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        function()
        times.append((time.perf_counter() - start) * 1e3)
    return (
        f"{statistics.median(times):8.2f} ms median, {np.percentile(times, 95):8.2f} ms p95,"
        f" {max(times):8.2f} ms max of {rounds}"
    )


def command_s(rounds: int, *arguments: str) -> str:
    """Median wall time of a whole ``dualcal`` command, and the peak memory over all children so far."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        command = [sys.executable, "-c", "from tools.cli import main; main()", *arguments]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        times.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    return f"{statistics.median(times):8.2f} s median of {rounds}, peak {peak:.0f} MiB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    rounds = parser.parse_args().rounds
    print(f"dualcal --help             {command_s(2 * rounds, '--help')}")
    with tempfile.TemporaryDirectory() as folder:
        sessions = (str(Path(folder) / str(number)) for number in range(rounds))
        times = [command_s(1, "run", str(CELL), "--out", session) for session in sessions]
        print(f"dualcal run                {times[-1]} (runs: {', '.join(t.split()[0] for t in times)} s)")
        session = Path(folder) / "0"
        measure_parts(session, rounds)


def measure_parts(session: Path, rounds: int) -> None:
    """The parts that have a figure of their own, on the data of a finished run."""
    cell = load_cell(CELL).cell
    model = CellModel(cell)
    chain = cell.active.chain
    q = random_joints(np.random.default_rng(1), 1000, cell.active.lower, cell.active.upper)
    print(f"forward kinematics, 1000   {median_ms(lambda: chain.forward(q), 20 * rounds)}")

    captures = read_captures(session / "captures.json")
    print(f"estimate and verify        {median_ms(lambda: analyse(captures, cell, 'paper'), 4 * rounds)}")

    ways = WayFinder(model, model.nominal, [model.home])
    stand_off = find_stand_off(model, model.nominal, ways, model.home, 1).posture
    belief = model.nominal.as_if_looked()
    model = model.believing(belief)
    ways = WayFinder(model, belief, [stand_off, model.home])
    seeds = iter(range(1, 10 * rounds))

    def plan() -> None:
        planner = PosePlanner(model, belief, ways, [next(seeds)])
        planner.plan(requests_of(cell.procedure), stand_off, provisional=True)

    print(f"pose set, 7 x 4 + 2 x 7    {median_ms(plan, 2 * rounds)}")
    measure_images(session, model, rounds)


def measure_images(session: Path, model: CellModel, rounds: int) -> None:
    """Detection on the run's own images, tracked and not, and in clutter without a target; rendering."""
    captures = [c for c in read_captures(session / "captures.json").captures if c.corners is not None]
    stored = Session(session)
    images = [stored.read_image(capture.id) for capture in captures]
    detector = Detector(model.board, model.intrinsics.size)
    each = iter(range(10**6))

    def tracked() -> None:
        k = next(each) % len(captures)
        assert isinstance(detector.detect(images[k], np.array(captures[k].corners) + 3.0), Detection)

    def full() -> None:
        k = next(each) % len(captures)
        assert isinstance(Detector(model.board, model.intrinsics.size).detect(images[k]), Detection)

    print(f"detection, tracked         {median_ms(tracked, 20 * rounds)}")
    rng = np.random.default_rng(1)
    size = model.intrinsics.size
    workshops = iter([clutter(rng, size) for _ in range(20 * rounds + 1)])

    def without() -> None:
        assert isinstance(detector.detect(next(workshops)), Missed)

    print(f"detection, full search     {median_ms(full, 20 * rounds)}")
    print(f"... without a target       {median_ms(without, 20 * rounds)}")
    first = captures[0]
    truth = json.loads((session / "result.json").read_text())["transforms"]
    T_P_E = (
        np.array(truth["active_base_in_passive_base"]["matrix"])
        @ model.active.chain.forward(first.active_joints)
        @ np.array(truth["camera_in_active_flange"]["matrix"])
    )
    T_E_T = inverse(T_P_E) @ model.target_in_passive(first.passive_joints)
    renderer = Renderer(model.board, 0.01, model.intrinsics, 0.6)
    print(f"rendering                  {median_ms(lambda: renderer.render(T_E_T), 10 * rounds)}")


if __name__ == "__main__":
    main()
