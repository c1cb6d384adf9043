"""The operator's commands: asked, carried out, and the arm's state afterwards said as it is."""

from __future__ import annotations

import pytest

from backends.simulator import SimulatorBackend
from backends.simulator.robot import SimulatedRobot
from dualcal_hal.errors import CommandRefused, LinkLost
from dualcal_hal.robot import Mode
from tests.cells import TINY
from tests.command_line import dualcal


@pytest.fixture
def arms(monkeypatch):
    """What was asked of which arm, and of which how it is said to be."""
    asked = []
    for name in ("enable", "disable", "reset_fault"):
        original = getattr(SimulatedRobot, name)

        def command(self, timeout, name=name, original=original):
            asked.append((name, self.name))
            original(self, timeout)

        monkeypatch.setattr(SimulatedRobot, name, command)
    monkeypatch.setattr(SimulatedRobot, "start", lambda *_: pytest.fail("moved"))
    return asked


@pytest.mark.parametrize(
    ("command", "method", "said"),
    [("enable", "enable", "ready"), ("disable", "disable", "disabled"), ("reset", "reset_fault", "ready")],
)
@pytest.mark.parametrize("answered", [True, False])
def test_a_command_is_carried_out_on_the_arm_that_is_named_and_on_no_other(arms, command, method, said, answered):
    result = dualcal(command, TINY, "--arm", "right", *([] if answered else ["--yes"]), typed="y\n")
    assert result.exit_code == 0, result.output
    assert arms == [(method, "right")]
    assert f"right: {said}; no faults" in result.output
    assert ("[y/n]" in result.output) == answered


@pytest.mark.parametrize("typed", ["n\n", "", "perhaps\nn\n"])
@pytest.mark.parametrize("command", ["enable", "disable", "reset"])
def test_without_a_yes_nothing_is_opened(arms, monkeypatch, command, typed):
    monkeypatch.setattr(SimulatorBackend, "open_alone", lambda *_: pytest.fail("opened"))
    result = dualcal(command, TINY, "--arm", "left", typed=typed)
    assert result.exit_code == 2
    assert "not confirmed; nothing was done" in result.stderr


def test_only_the_backend_of_the_arm_is_opened_and_it_is_closed_again(monkeypatch):
    opened, closed = [], []
    original = SimulatorBackend.open_alone
    close = SimulatorBackend.close
    monkeypatch.setattr(
        SimulatorBackend, "open_alone", lambda self, device, timeout: opened.append(device) or original(self, device, 1)
    )
    monkeypatch.setattr(SimulatorBackend, "close", lambda self: closed.append(1) or close(self))
    assert dualcal("disable", TINY, "--arm", "left", "--yes").exit_code == 0
    assert opened == ["left"]
    assert closed


def test_an_enabling_that_does_not_outlive_the_command_is_said_with_what_does(monkeypatch):
    """As on CAN, where drives are switched off when the program that supervises them goes."""
    original = SimulatorBackend.open

    def opened(self, timeout):
        original(self, timeout)
        self.robot("left").disable(1.0)

    monkeypatch.setattr(SimulatorBackend, "open", opened)
    result = dualcal("enable", TINY, "--arm", "left", "--yes")
    assert result.exit_code == 1
    assert "left: ready; no faults" in result.output
    assert "left: disabled; no faults, now that this command has ended" in result.output
    assert f"dualcal run {TINY} --enable" in result.output


def test_whether_it_stays_enabled_is_not_guessed_where_it_cannot_be_seen(monkeypatch):
    original, calls = SimulatorBackend.open, []

    def opened(self, timeout):
        calls.append(1)
        if len(calls) > 1:
            raise LinkLost("left", "open", "connection refused")
        original(self, timeout)

    monkeypatch.setattr(SimulatorBackend, "open", opened)
    result = dualcal("enable", TINY, "--arm", "left", "--yes")
    assert result.exit_code == 1
    assert "is not known: left: open: connection refused" in result.output


def test_what_a_controller_refuses_is_told_as_it_says_it(monkeypatch):
    def refuse(self, timeout):
        raise CommandRefused("left", "enable", "this controller has no command for it", "use its pendant")

    monkeypatch.setattr(SimulatedRobot, "enable", refuse)
    result = dualcal("enable", TINY, "--arm", "left", "--yes")
    assert result.exit_code == 1
    assert "this controller has no command for it; use its pendant" in result.stderr


def test_a_fault_that_is_left_is_a_failure(monkeypatch):
    monkeypatch.setattr(SimulatedRobot, "reset_fault", lambda *_: None)
    original = SimulatedRobot.read

    def read(self, timeout):
        state = original(self, timeout)
        return type(state)(
            state.positions, state.velocities, Mode.FAULT, ("drive 3: overcurrent",), state.time, state.sequence
        )

    monkeypatch.setattr(SimulatedRobot, "read", read)
    result = dualcal("reset", TINY, "--arm", "left", "--yes")
    assert result.exit_code == 1
    assert "left: fault; faults: drive 3: overcurrent" in result.output


def test_an_arm_that_there_is_not_is_a_wrong_call():
    result = dualcal("enable", TINY, "--arm", "middle", "--yes")
    assert result.exit_code == 2
    assert "there are: left, right" in result.stderr
