"""The `dualcal` command line. Heavy imports wait until a command needs them: --help answers at once."""

from tools.cli.app import main

__all__ = ["main"]
