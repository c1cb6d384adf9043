"""The journal: what is finished stays finished, and a cut-off line is not."""

from __future__ import annotations

import pytest

from dualcal_hal.errors import FormatError
from dualcal_hal.session.journal import Journal, StepKey

FIRST = StepKey("calibration", "calibration/00", 0, "point")
SECOND = StepKey("calibration", "calibration/00", 1, "point")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "journal.jsonl"


def test_a_finished_step_is_answered_by_a_journal_opened_anew(path):
    Journal(path).append(FIRST, {"offset_px": [0.1, 1 / 3]})
    reopened = Journal(path)
    assert reopened.result(FIRST) == {"offset_px": [0.1, 1 / 3]}
    assert reopened.result(SECOND) is None


def test_steps_keep_their_order(path):
    journal = Journal(path)
    journal.append(SECOND, {"n": 2})
    journal.append(FIRST, {"n": 1})
    assert [key for key, _ in Journal(path).results()] == [SECOND, FIRST]


def test_a_step_is_finished_once(path):
    journal = Journal(path)
    journal.append(FIRST, {})
    with pytest.raises(ValueError, match="finished already"):
        journal.append(FIRST, {})


@pytest.mark.parametrize("cut", [1, 5, 30])
def test_a_line_cut_off_in_the_writing_is_not_finished(path, cut):
    journal = Journal(path)
    journal.append(FIRST, {"n": 1})
    journal.append(SECOND, {"n": 2})
    path.write_bytes(path.read_bytes()[:-cut])
    reopened = Journal(path)
    assert reopened.result(FIRST) == {"n": 1}
    assert reopened.result(SECOND) is None


def test_damaged_lines_and_unknown_versions_are_named_all_at_once(path):
    journal = Journal(path)
    journal.append(FIRST, {"n": 1})
    lines = path.read_text().splitlines()
    path.write_text("\n".join(['{"format": "dualcal.journal/9"}', lines[1], "nonsense", '{"step": 3}', ""]))
    with pytest.raises(FormatError) as refusal:
        Journal(path)
    assert [problem.where.rsplit(":", 1)[1] for problem in refusal.value.problems] == ["1", "3", "4"]
    assert "dualcal.journal/9" in str(refusal.value)


def test_what_json_cannot_hold_is_refused_and_nothing_is_written(path):
    journal = Journal(path)
    journal.begin()
    before = path.read_bytes()
    with pytest.raises(ValueError, match="not JSON compliant"):
        journal.append(FIRST, {"x": float("nan")})
    assert path.read_bytes() == before


def test_a_line_is_on_disk_before_its_step_counts_as_finished(path, monkeypatch):
    synced = []
    journal = Journal(path)
    journal.begin()
    monkeypatch.setattr("os.fsync", lambda descriptor: synced.append(path.read_bytes()))
    journal.append(FIRST, {"n": 1})
    assert synced[-1] == path.read_bytes()
    assert b'"n": 1' in synced[-1]


def test_a_cut_off_line_longer_than_the_next_one_leaves_nothing_behind(path):
    journal = Journal(path)
    journal.append(FIRST, {"n": 1})
    with path.open("ab") as file:
        file.write(b'{"step": ' + b"x" * 1000)
    Journal(path).append(SECOND, {"n": 2})
    assert b"xxx" not in path.read_bytes()
    assert [key for key, _ in Journal(path).results()] == [FIRST, SECOND]


def test_going_on_after_a_cut_off_line_keeps_the_journal_readable(path):
    journal = Journal(path)
    journal.append(FIRST, {"n": 1})
    with path.open("ab") as file:
        file.write(b'{"step": {"phase"')
    Journal(path).append(SECOND, {"n": 2})
    assert [key for key, _ in Journal(path).results()] == [FIRST, SECOND]
