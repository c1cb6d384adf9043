"""The question that an operator is asked while devices are open."""

from __future__ import annotations

import os
import sys
import threading
from contextlib import nullcontext

import pytest

from tools.cli.operator import Operator, confirmed
from tools.cli.terminal import Screen

AMPLE = 20.0


class Still:
    """A display that shows nothing."""

    def paused(self):
        return nullcontext()


@pytest.fixture
def keyboard(monkeypatch):
    """What is typed is written to it; it stays open."""
    end, typed = os.pipe()
    stdin = os.fdopen(end)
    monkeypatch.setattr(sys, "stdin", stdin)
    yield typed
    os.close(typed)
    stdin.close()


@pytest.mark.parametrize(("line", "agreed"), [("y", True), ("YES", True), ("n", False), ("", False), ("yep", False)])
def test_a_yes_is_a_yes_and_all_else_is_none(keyboard, line, agreed):
    os.write(keyboard, f"{line}\n".encode())
    assert confirmed(Screen(), "Go on?", lambda: False) is agreed


def test_a_question_ends_when_the_run_is_aborted(keyboard):
    operator, aborted, answers = Operator(Screen(), Still(), asked=True), threading.Event(), []
    asking = threading.Thread(
        target=lambda: answers.append(operator.agrees("Switch the drives of both arms on?", aborted.is_set))
    )
    asking.start()
    aborted.set()
    asking.join(AMPLE)
    assert answers == [False]


def test_where_there_is_no_input_nobody_agrees(monkeypatch):
    monkeypatch.setattr(sys, "stdin", None)
    assert not confirmed(Screen(), "Go on?", lambda: False)


def test_where_nobody_has_to_agree_nobody_is_asked(monkeypatch, capsys):
    monkeypatch.setattr(sys, "stdin", None)
    assert Operator(Screen(), Still(), asked=False).agrees("Go on?", lambda: False)
    assert not capsys.readouterr().out
