"""The golden session: a recorded run of ``cells/tiny.yaml`` that every later version must replay to the same result.

python -m tools.golden             # replays it; exit code 1 and the differences if anything else comes out
python -m tools.golden --update    # makes it anew: only where the procedure is meant to do something else now
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from pathlib import Path

from tools.cli.replay import ReplayOptions, replay_session
from tools.cli.run import RunOptions, run_cell

ROOT = Path(__file__).parents[1]
CELL = ROOT / "cells" / "tiny.yaml"
GOLDEN = ROOT / "tests" / "data" / "golden-tiny"

KEPT = ("cell.yaml", "plan.json", "journal.jsonl", "captures.json", "result.json", "log-0001.mcap")
"""What of a session is kept: all but what is made of these."""


def update(golden: Path) -> None:
    """Run the cell and keep its session in place of the old one."""
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        code = run_cell(RunOptions(CELL, out=session))
        if code:
            sys.exit(code)
        if golden.exists():
            shutil.rmtree(golden)
        golden.mkdir(parents=True)
        for name in KEPT:
            shutil.copyfile(session / name, golden / name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--update", action="store_true")
    parser.add_argument("--session", type=Path, default=GOLDEN)
    options = parser.parse_args()
    if options.update:
        update(options.session)
    sys.exit(replay_session(ReplayOptions(options.session, None, json=False)))


if __name__ == "__main__":
    main()
