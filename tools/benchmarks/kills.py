"""Runs that are killed at random moments (SIGKILL), gone on with, perhaps killed again, and compared to the last bit
with one that was not. Exit code 1 if anything differs or is missing.

python -m tools.benchmarks.kills [cells/tiny.yaml] --kills 30 --seed 1 [--set PATH=VALUE]...
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import DualcalError, LogDamaged, LogMissing
from dualcal_hal.session.folder import CELL_FILE, Session
from dualcal_hal.session.log import segment_paths
from dualcal_hal.session.log.check import check_log
from procedures.calibrate import captures_of

CELL = Path("cells/tiny.yaml")

Moment = Callable[[], bool]
"""Whether it has come."""

_AGAIN = 0.4  # the chance that a run that goes on is killed too
_POINT = re.compile(r"^(\w+/\d+) position (\d+)/\d+: aligned ", re.MULTILINE)


@dataclass
class Trial:
    """One session.

    kills: the moment (s) of each, and what was there then; reported: points that were told as done; wrong: what is not
    as it should be.
    """

    kills: list[str] = field(default_factory=list)
    reported: set[str] = field(default_factory=set)
    wrong: list[str] = field(default_factory=list)
    files_of_log: int = 0


def survive(
    cell: Path, overrides: Sequence[str], folder: Path, reference: Path, moment: Callable[[], Moment | None]
) -> Trial:
    """Run a cell in ``folder`` and kill it at ``moment()``, until that gives None; compare with a whole run.

    ``reference``: the session of a run of the same cell that nothing has interrupted.
    """
    trial = Trial()
    settings = [part for override in overrides for part in ("--set", override)]
    while True:
        begun = (folder / CELL_FILE).exists()
        if not begun and folder.exists():
            shutil.rmtree(folder)  # nothing was begun, as the operator is told
        arguments = ["--resume", str(folder)] if begun else [str(cell), "--out", str(folder), *settings]
        code, output, errors, seconds = _run(arguments, moment())
        trial.reported |= {f"{constraint}/{int(position) - 1}" for constraint, position in _POINT.findall(output)}
        if code is not None:
            break
        trial.kills.append(f"{seconds:.1f} s: {_state(folder)}")
        trial.wrong += _missing(folder, trial.reported)
    if code != 0:
        trial.wrong.append(f"exit code {code}: {errors.strip() or output.strip()[-500:]}")
        return trial
    trial.wrong += differences_from(folder, reference, trial.reported)
    trial.files_of_log = len(segment_paths(folder))
    return trial


def differences_from(folder: Path, reference: Path, reported: set[str]) -> list[str]:
    """How a finished session is not as one that nothing has interrupted, or lacks points that were reported as done."""
    differing = [f"{name} differs" for name in ("captures.json", "result.json") if _differs(name, folder, reference)]
    return [*_missing(folder, reported), *differing, *_damage(folder)]


def after(seconds: float) -> Moment:
    """So many seconds from the start."""
    begun = perf_counter()
    return lambda: perf_counter() - begun >= seconds


def once_journalled(folder: Path, steps: int) -> Moment:
    """When the session in ``folder`` has so many lines in its journal."""
    journal = folder / "journal.jsonl"
    return lambda: journal.exists() and journal.read_bytes().count(b"\n") >= steps


def _run(arguments: Sequence[str], moment: Moment | None) -> tuple[int | None, str, str, float]:
    """``dualcal run``, killed at a moment: its exit code (None if it was), its outputs, how long it ran."""
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        command = [sys.executable, "-u", "-c", "from tools.cli import main; main()", "run", *arguments]
        begun = perf_counter()
        with subprocess.Popen(command, stdout=output, stderr=errors) as process:
            code = process.wait() if moment is None else _killed_at(moment, process)
        seconds = perf_counter() - begun
        output.seek(0)
        errors.seek(0)
        return code, output.read(), errors.read(), seconds


def _killed_at(moment: Moment, process: subprocess.Popen[bytes]) -> int | None:
    """The exit code of one that ended before."""
    while True:
        try:
            return process.wait(0.01)
        except subprocess.TimeoutExpired:
            if moment():
                process.kill()
                process.wait()
                return None


def _state(folder: Path) -> str:
    if not (folder / CELL_FILE).exists():
        return "nothing begun"
    session = Session(folder)
    ends = (session.summary_path, session.result_path, session.captures_path)
    done = next((f", {path.name} written" for path in ends if path.exists()), "")
    return f"{len(session.journal.results())} steps finished{done}"


def _missing(folder: Path, reported: set[str]) -> list[str]:
    """Points that were reported as done and are not in the journal, or not as an image."""
    if not (folder / CELL_FILE).exists():
        return [f"{point} was reported, and there is no session" for point in sorted(reported)]
    session, lost = Session(folder), []
    kept = {f"{key.constraint}/{key.position}" for key, _ in session.journal.results() if key.kind == "point"}
    for point in sorted(reported):
        if point not in kept:
            lost.append(f"{point} was reported and is not in the journal")
    for capture in captures_of(session.journal, "", None).captures:
        try:
            session.read_image(capture.id)
        except DualcalError as error:
            lost.append(str(error))
    return lost


def _differs(name: str, folder: Path, reference: Path) -> bool:
    documents = [json.loads((each / name).read_text()) for each in (folder, reference)]
    for document in documents:
        document.pop("started", None)
    return bool(documents[0] != documents[1])


def _damage(folder: Path) -> list[str]:
    """What a log has beyond an end that was not written."""
    found = []
    for path in segment_paths(folder):
        try:
            found += [f"{path.name}: {finding.what}" for finding in check_log(path).findings if finding.damage]
        except (LogDamaged, LogMissing) as error:
            found.append(str(error))
    return found


def kill_many(cell: Path, overrides: Sequence[str], kills: int, chance: random.Random, folder: Path) -> list[Trial]:
    """Trials with so many kills in all, at moments spread over the time that a whole run takes."""
    settings = [part for override in overrides for part in ("--set", override)]
    whole = folder / "whole"
    code, output, errors, seconds = _run([str(cell), "--out", str(whole), *settings], None)
    if code != 0:
        sys.exit(f"the run without interruption ends with exit code {code}: {errors or output}")
    print(f"A run of {load_cell(cell).cell.name} takes {seconds:.1f} s.")
    trials: list[Trial] = []
    while (left := kills - sum(len(trial.kills) for trial in trials)) > 0:
        given = 0

        def moment(left: int = left) -> Moment | None:
            nonlocal given
            given += 1
            if given > left or (given > 1 and chance.random() >= _AGAIN):
                return None
            return after(chance.uniform(0.0, seconds))

        trial = survive(cell, overrides, folder / f"{len(trials)}", whole, moment)
        trials.append(trial)
        print(_line(len(trials), trial), flush=True)
    return trials


def _line(number: int, trial: Trial) -> str:
    verdict = "the same" if not trial.wrong else "; ".join(trial.wrong)
    kills = " | ".join(trial.kills) or "ended before it was killed"
    return f"{number:3}  {len(trial.reported):3} points  {trial.files_of_log} files of log  {verdict}  <- {kills}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cell", type=Path, nargs="?", default=CELL)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="PATH=VALUE")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        chance = random.Random(arguments.seed)
        trials = kill_many(arguments.cell, arguments.overrides, arguments.kills, chance, Path(folder))
    kills, wrong = sum(len(trial.kills) for trial in trials), sum(bool(trial.wrong) for trial in trials)
    print(f"{kills} kills in {len(trials)} sessions; {len(trials) - wrong} came to the same, {wrong} did not")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
