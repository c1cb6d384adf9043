"""The `dualcal` command line. Heavy libraries are imported when a command needs them, so that --help answers at once."""

from tools.cli.app import main

__all__ = ["main"]
