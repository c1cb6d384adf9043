"""What an operator types: lines, one for each question."""

from __future__ import annotations

import sys

from rich.console import Console


def answer(console: Console, question: str) -> str | None:
    """The line that is typed, None at the end of the input. Any signal breaks in: no arm may be under way."""
    console.print(f"{question} ", end="", soft_wrap=True, highlight=False)
    line = "" if sys.stdin is None else sys.stdin.readline()
    if not line:
        console.print("")
        return None
    return line.strip()


def yes_or_no(console: Console, question: str) -> bool | None:
    """y or n, asked again for anything else; None at the end of the input."""
    while (said := answer(console, f"{question} [y/n]:")) is not None:
        if said.lower() in ("y", "yes", "n", "no"):
            return said.lower() in ("y", "yes")
    return None
