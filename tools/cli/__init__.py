"""The `dualcal` command line. Heavy imports wait until a command needs them: --help answers at once."""

from __future__ import annotations

import sys


def main() -> None:
    """Entry point of the ``dualcal`` command."""
    from tools.cli.exits import ended_in_order, handle_signals, ignore_signals

    handle_signals()
    try:
        with ended_in_order():
            from tools.cli.app import app

            app()
    finally:
        ignore_signals()
    sys.exit(0)


__all__ = ["main"]
