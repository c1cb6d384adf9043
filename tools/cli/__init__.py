"""The `dualcal` command line. Heavy imports wait until a command needs them: --help answers at once."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Entry point of the ``dualcal`` command."""
    from tools.cli.exits import ended_in_order, handle_signals, ignore_signals

    _open_missing_streams()
    handle_signals()
    try:
        with ended_in_order():
            from tools.cli.app import app

            app()
    finally:
        ignore_signals()
    sys.exit(0)


def _open_missing_streams() -> None:
    """Started with a stream closed, there is none to write to: what is meant for it goes nowhere."""
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - for as long as the program runs
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115


__all__ = ["main"]
