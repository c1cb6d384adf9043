"""The operator at the cell: what is shown before arms move, and whether they may."""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

import typer
from rich.console import Console

from procedures.events import LooksProposed, PlanReady
from procedures.intrinsics.procedure import ViewsProposed
from procedures.one_arm.procedure import ViewsReady
from procedures.report import plan_table, posture_table, views_table, way_table

_POLL = 0.1  # s between two looks whether the run was aborted


class Pausable(Protocol):
    """A display that stays out of the way of a question."""

    def paused(self) -> AbstractContextManager[None]:
        """While this lasts it shows nothing."""
        ...


class Operator:
    """``asked``: whether there is anybody who has to agree; without one all is agreed to."""

    def __init__(self, console: Console, display: Pausable, *, asked: bool) -> None:
        self._console = console
        self._display = display
        self._asked = asked

    def confirms(self, shown: Callable[[], object], aborted: Callable[[], bool]) -> bool:
        """Show what the procedure is about to do, and ask."""
        if not self._asked:
            return True
        with self._display.paused():
            question = self._show(shown())
            return confirmed(self._console, question, aborted)

    def agrees(self, question: str, aborted: Callable[[], bool]) -> bool:
        """Ask, with nothing to show."""
        if not self._asked:
            return True
        with self._display.paused():
            return confirmed(self._console, question, aborted)

    def _show(self, proposal: object) -> str:
        """Show it; the question to ask."""
        match proposal:
            case LooksProposed(stand_off, way, count):
                self._console.print("The stand-off, where the first looks are taken from:")
                self._console.print(posture_table(stand_off))
                if way:
                    self._console.print("The way there:")
                    self._console.print(way_table(way))
                return f"Both arms will move there, and take {count} looks by moves of their wrists. Go on?"
            case ViewsReady(plan):
                self._console.print("The plan:")
                self._console.print(views_table(plan))
                return "The arm will move by this plan. Go on?"
            case PlanReady(plan):
                self._console.print("The plan:")
                self._console.print(plan_table(plan))
                return "Both arms will move by this plan. Go on?"
            case ViewsProposed():
                self._console.print(str(proposal), highlight=False)
                return "The passive arm will show the target so. Go on?"
        raise TypeError(f"{proposal!r} is nothing to be shown")


def confirmed(console: Console, question: str, aborted: Callable[[], bool]) -> bool:
    """Whether the operator says yes; anything else, an end of the input and an abort meanwhile are a no.

    Signals break into nothing while devices are open, so the answer is waited for with an eye on ``aborted``.
    """
    console.print(f"{question} [y/N]: ", end="", soft_wrap=True, highlight=False)
    if sys.stdin is None:  # closed by whoever started this
        return False
    try:
        descriptor = sys.stdin.fileno()
    except (io.UnsupportedOperation, ValueError):
        return _yes(typer.get_text_stream("stdin").readline())
    while not aborted():
        if select.select([descriptor], [], [], _POLL)[0]:
            return _yes(_line(descriptor))
    return False


def _line(descriptor: int) -> str:
    """One line and no more: what comes behind it may be the next answer, and has to be seen by ``select``."""
    line = b""
    while not line.endswith(b"\n") and (letter := os.read(descriptor, 1)):
        line += letter
    return line.decode(errors="replace")


def _yes(answer: str) -> bool:
    return answer.strip().lower() in ("y", "yes")
