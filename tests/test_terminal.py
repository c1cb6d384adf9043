"""What is printed may come from a log, a device or a file: nothing of it is a command for the terminal."""

from __future__ import annotations

import io
import json
import shutil

import pytest
from rich.table import Table

from backends.simulator.robot import SimulatedRobot
from dualcal_hal.errors import LinkLost
from dualcal_hal.robot import Mode, RobotState
from dualcal_hal.session.log import LogWriter
from procedures.events import LookTaken
from tests.cells import TINY
from tests.command_line import dualcal
from tools.benchmarks.mutated_logs import STARTED
from tools.cli.progress import Bars, Lines
from tools.cli.terminal import Screen, plain

EVIL = "a\x1b]0;owned\x1b[2J\x9b31m[red][/blue]:smile:\u202eb"
TOLD = "a?]0;owned?[2J?31m[red][/blue]:smile:?b"


def test_letters_and_lines_stay():
    assert plain(EVIL) == TOLD
    assert plain("\x07\x08\r\x7f\t") == "?????"
    assert plain("Größe 1 °\n\ud800") == "Größe 1 °\n?"


def test_a_screen_prints_no_others_commands_but_its_own():
    output = io.StringIO()
    screen = Screen(file=output, force_terminal=True, color_system="truecolor", width=100)
    table = Table("x", title=EVIL)
    table.add_row(EVIL)
    for each in (EVIL, table):
        screen.print(each, style="red", highlight=False)
    printed = output.getvalue()
    assert "\x1b[31m" in printed
    for own in ("\x1b[31m", "\x1b[3;31m", "\x1b[1;31m", "\x1b[3m", "\x1b[1m", "\x1b[0m"):
        printed = printed.replace(own, "")
    assert "\x1b" not in printed
    assert printed.count(TOLD) == 3


@pytest.mark.parametrize("kind", [Lines, Bars])
@pytest.mark.parametrize("terminal", [True, False])
def test_progress_is_told_plainly(kind, terminal):
    output = io.StringIO()
    with kind(Screen(file=output, force_terminal=terminal, width=200, color_system=None)) as progress:
        progress(LookTaken(0, 3, False, EVIL))
        progress(EVIL)
    printed = output.getvalue()
    assert TOLD in printed
    assert "\x9b" not in printed
    assert "\x1b]0" not in printed


def test_a_devices_words_are_no_command_in_a_run_and_its_replay(tmp_path, monkeypatch):
    start, moves = SimulatedRobot.start, []

    def lossy(self, path):
        moves.append(self.name)
        if len(moves) == 2:
            raise LinkLost(self.name, "move", EVIL, "check the cable")
        return start(self, path)

    with monkeypatch.context() as patch:
        patch.setattr(SimulatedRobot, "start", lossy)
        ran = dualcal("run", TINY, "--out", tmp_path / "session")
    replayed = dualcal("replay", tmp_path / "session")
    for result in (ran, replayed):
        assert f"move: {TOLD}; check the cable" in result.output
        assert "\x1b" not in result.output


@pytest.mark.parametrize("command", [["run", "--resume"], ["run", "--json", "--resume"], ["replay"], ["estimate"]])
def test_a_files_words_are_no_command(recorded, tmp_path, command):
    session = shutil.copytree(recorded, tmp_path / "session")
    document = json.loads((session / "result.json").read_text())
    document["reasons"] = ["no \x9b31m\x7f[/blue]"]
    (session / "result.json").write_text(json.dumps(document, ensure_ascii=False))
    if command == ["estimate"]:
        captures = json.loads((session / "captures.json").read_text())
        captures["captures"][0]["feature_px"] = "no \x1b31m\x7f[/blue]"
        (session / "captures.json").write_text(json.dumps(captures))
        (session / "journal.jsonl").unlink()
    result = dualcal(*command, session)
    assert "no ?31m?[/blue]" in result.output
    assert not {"\x1b", "\x9b", "\x7f"} & set(result.output)


def test_a_logs_words_are_no_command(tmp_path):
    with LogWriter(tmp_path / "log-0001.mcap", STARTED, arms=(EVIL,)) as log:
        log.joint_states(EVIL, RobotState((0.0,), (0.0,), Mode.READY, (), 0.0, 0))
    for command in ("info", "check", "recover", "export"):
        result = dualcal("log", command, tmp_path)
        assert result.exit_code == 0
        assert not {"\x1b", "\x9b"} & set(result.output)
    assert "a?]0;owned?[2J" in dualcal("log", "info", tmp_path).output
