"""The command line in the tests' own process."""

from __future__ import annotations

from typer.testing import CliRunner, Result

from tools.cli.app import app


def dualcal(*arguments: object, typed: str = "") -> Result:
    """What it prints and its exit code when that is typed; a traceback would come out of it as one."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], input=typed, catch_exceptions=True)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result
