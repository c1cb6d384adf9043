"""Each fault during a run: what ends it, how soon the arm is told to stop, and that the session can be gone on with.

    python -m tools.benchmarks.faults [--only can --only rep] [--fault NAME]... [--repeat N] [--set PATH=VALUE]...

A run of a small plan over each kind of wire, against the emulator in another process; times are the emulator's own,
from a fault to the first stop that the arm is told behind it (over CAN: to targets that come slower, or a controlword)
and to its rest. A run that a fault may end is gone on with, by ``--resume``, to its verdict. Exit code 1 if anything is
not as it has to be.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

CELLS = Path(__file__).parents[2] / "cells"
DIALECTS = ("rep", "abb", "fanuc", "motoman")
LINKS = (*DIALECTS, "can")
KEEPS_SPEED = ("rep", "motoman")
"""Dialects whose controllers are as fast as they are told; they refuse points, too, while they cannot move."""

SMALL = (
    "simulation.stepper=kinematic",
    "procedure.constraints=3",
    "procedure.positions=3",
    "procedure.first_looks=3",
    "procedure.verification.constraints=1",
    "procedure.verification.positions=3",
    "procedure.verification.limit_mm=2",
)
"""A plan as small as there is."""

SLOWER = 0.3
"""Of the arms' own speed, where a controller keeps it: so that motions last until the fault, and targets that come
slower do so for a stop and not for their end."""

SOON = 0.050
"""Seconds to the stop, in the median, after a fault that a reply or a PDO tells, or a PDO that is missing."""

STANDS_WITHIN = 5.0
"""Seconds after a fault within which all arms stand, whatever it was: a lost link is noticed last."""


@dataclass(frozen=True)
class Case:
    """A fault, when it comes, and what is to become of the run.

    seen: what first tells of it. told: what the run's error has to name, a regular expression, None where the run has
    to survive.
    """

    fault: str
    when: str
    seen: str
    told: str | None

    def __str__(self) -> str:
        return f"{self.fault}@{self.when}"

    @property
    def soon(self) -> bool:
        """Whether :data:`SOON` holds for it."""
        return self.seen in ("reply", "PDO")


_ARM = r"(left|right): "
_DRIVE = r"joint 2 \(node 2\)"
_STREAMING = "point:10"
_MOVING = "motion:3"

_ON_CAN = (
    Case("estop", _MOVING, "PDO", _ARM + r".*no voltage"),
    Case("drive-fault", _MOVING, "PDO", _ARM + rf".*{_DRIVE}.*0x2310"),
    Case("emergency", _MOVING, "PDO", _ARM + rf".*{_DRIVE}.*0x4210"),
    Case("node-reboot", _MOVING, "PDO", _ARM + rf".*{_DRIVE} (has rebooted|did not answer)"),
    Case("missing-pdo", _MOVING, "PDO", _ARM + rf".*{_DRIVE} did not answer"),
    Case("following-error", _MOVING, "position", _ARM + rf".*({_DRIVE}.*0x8611|joint 2 is .* off its path)"),
    Case("heartbeat-loss", _MOVING, "heartbeat", _ARM + rf".*{_DRIVE} has sent no heartbeat"),
    Case("sdo-abort", "0", "SDO", _ARM + rf".*{_DRIVE}.*0x06060000"),
    Case("sdo-abort", _MOVING, "-", None),
    Case("lost-link", _MOVING, "link", _ARM + r".*the bus .* failed"),
)

_CONDITIONS = {"estop": "emergency stop", "mode": "(manual mode|remote mode)", "drive-fault": "(34252|5001: alarm)"}


def cases(link: str) -> Iterator[Case]:
    """All that there are over one kind of wire."""
    if link == "can":
        yield from _ON_CAN
        return
    for fault, words in _CONDITIONS.items():
        yield Case(fault, _MOVING, "STATUS", _ARM + f".*{words}")
        if link in KEEPS_SPEED:  # the others take points whatever is wrong
            yield Case(fault, _STREAMING, "reply", _ARM + f".*{words}")
    yield Case("drop", _STREAMING, "no reply", _ARM + ".*no reply in time")
    yield Case("delay", _STREAMING, "no reply", None if link == "fanuc" else _ARM + ".*no reply in time")
    yield Case("delay", f"{_STREAMING}~0.3", "-", None)
    yield Case("split", _MOVING, "-", None)
    yield Case("merge", _MOVING, "-", None)
    yield Case("corrupt", _MOVING, "state", _ARM + ".*no message")
    yield Case("stale", _MOVING, "no state", _ARM + ".*(no state|feedback)")
    yield Case("half-open", _MOVING, "no state", _ARM + ".*(no state|feedback|no reply)")
    yield Case("lost-link", _MOVING, "link", _ARM + ".*(reset|closed)")


@dataclass
class Trial:
    """to_stop: seconds from the fault to the first stop, None if none came; wrong: what is not as it has to be."""

    code: int
    error: str
    to_stop: float | None
    to_rest: float | None
    wrong: list[str] = field(default_factory=list)


def main() -> int:
    """Run all that is asked for; 1 if anything is wrong."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", choices=LINKS, help="a kind of wire; may be repeated")
    parser.add_argument("--fault", action="append", metavar="NAME", help="one of the faults; may be repeated")
    parser.add_argument("--repeat", type=int, default=1, help="trials of each; the first is gone on with")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="PATH=VALUE")
    options = parser.parse_args()
    titles = f"{'exit':>4} {'stop ms':>8} {'of':>3} {'rest ms':>8} {'resumed':8} ended by"
    print(f"{'link':8} {'fault':26} {'seen by':9} {titles}")
    wrong, soon = 0, []
    for link in options.only or LINKS:
        for case in cases(link):
            if options.fault and case.fault not in options.fault:
                continue
            trials, resumed = tried(link, case, options.overrides, options.repeat)
            stops = [trial.to_stop for trial in trials if trial.to_stop is not None]
            rests = [trial.to_rest for trial in trials if trial.to_rest is not None]
            soon += stops if case.soon else []
            print(
                f"{link:8} {case!s:26} {case.seen:9} {trials[0].code:4} {_milliseconds(stops):>8} {len(stops):>3} "
                f"{_milliseconds(rests):>8} {resumed:8} {trials[0].error}",
                flush=True,
            )
            for complaint in dict.fromkeys(each for trial in trials for each in trial.wrong):
                wrong += 1
                print(f"{'':8} WRONG: {complaint}", flush=True)
    if soon:
        wrong += statistics.median(soon) > SOON
        print(f"seen by a reply or a PDO: median {_milliseconds(soon)} ms to the stop, of {len(soon)}")
    return 1 if wrong else 0


def _milliseconds(seconds: Sequence[float]) -> str:
    return f"{1e3 * statistics.median(seconds):.1f}" if seconds else "-"


def tried(link: str, case: Case, overrides: Sequence[str], times: int) -> tuple[list[Trial], str]:
    """So many runs with that fault, and the verdict that the first was brought to."""
    trials, resumed = [], "-"
    for number in range(times):
        with tempfile.TemporaryDirectory(prefix="dualcal-faults-") as folder:
            session = Path(folder) / "session"
            trial = run(link, case, overrides, session)
            if number == 0 and trial.code != 0:
                resumed = _verdict(dualcal("run", "--resume", str(session), "--emulate", "--json", "--speed", "1"))
                if resumed != "ok":
                    trial.wrong.append(f"gone on with, it comes to: {resumed}")
        trials.append(trial)
    return trials, resumed


def run(link: str, case: Case, overrides: Sequence[str], session: Path) -> Trial:
    """One run with that fault, judged."""
    kind = "can" if link == "can" else "tcp"
    settings = [*SMALL, *overrides, *([] if link == "can" else [f"backends.cell.link.tcp.dialect={link}"])]
    arguments = [str(CELLS / f"paper-{kind}-fast.yaml"), "--emulate", "--json", "--out", str(session)]
    arguments += [part for setting in settings for part in ("--set", setting)]
    arguments += ["--speed", str(SLOWER)] if link in ("can", *KEEPS_SPEED) else []
    ended = dualcal("run", *arguments, "--fault", str(case))
    struck = re.search(r"fault: .*?(\d+\.\d+) s of the clock", ended.stderr)
    begin = float(struck[1]) if struck else None
    stops = dict(re.findall(r"stop: (\w+) is told to, (\d+\.\d+) s of the clock", ended.stderr))
    rests = dict(re.findall(r"emulate: (\w+): (moves|has never moved|rests since \d+\.\d+)", ended.stderr))
    error = re.search(rf"^dualcal: ({_ARM}.*)$", ended.stderr, re.MULTILINE)
    told = float(stops[error[2]]) if error and error[2] in stops else None
    trial = Trial(
        ended.returncode,
        error[1] if error else f"verdict {_verdict(ended)}",
        told - begin if told is not None and begin is not None else None,
        _rest_after(begin, rests) if error else None,
    )
    trial.wrong += _what_is_wrong(case, trial, ended.stderr, rests)
    if error and case.fault == "lost-link" and len(stops) != 1:
        trial.wrong.append(f"the other arm was not stopped: {stops}")
    return trial


def _rest_after(begin: float | None, rests: dict[str, str]) -> float | None:
    """Seconds from a fault until the last arm stood, None if all have stood before."""
    since = [float(text.split()[-1]) for text in rests.values() if text.startswith("rests")]
    return max(since) - begin if begin is not None and max(since, default=begin) > begin else None


def _what_is_wrong(case: Case, trial: Trial, said: str, rests: dict[str, str]) -> Iterator[str]:
    if "Traceback" in said:
        yield f"a traceback: {said}"
    if "fault: " not in said:
        yield "the fault has not come"
    if case.told is None:
        if trial.code != 0:
            yield "it had to survive this"
        return
    if trial.code != 1:
        yield f"exit code {trial.code}, and not 1"
    if not re.search(f"^dualcal: {case.told}", said, re.MULTILINE):
        yield f"its error does not say: {case.told}"
    if len(rests) != 2 or "moves" in rests.values():
        yield f"an arm moves on: {rests}"
    elif trial.to_rest is not None and trial.to_rest > STANDS_WITHIN:
        yield f"an arm has moved for {trial.to_rest:.1f} s"


def _verdict(ended: subprocess.CompletedProcess[str]) -> str:
    if not ended.stdout:
        return f"exit code {ended.returncode}: {ended.stderr.strip()[-500:]}"
    return str(json.loads(ended.stdout)["verdict"])


def dualcal(*arguments: str) -> subprocess.CompletedProcess[str]:
    """As an operator types it."""
    return subprocess.run([sys.executable, "-m", "tools.cli", *arguments], capture_output=True, text=True, check=False)


if __name__ == "__main__":
    sys.exit(main())
