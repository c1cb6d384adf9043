"""What a session keeps of how it was run."""

from __future__ import annotations

import pytest

from dualcal_hal.pace import Pace
from dualcal_hal.session.conduct import CONDUCT, Conduct, keep_conduct, read_conduct
from dualcal_hal.session.folder import Session
from tests.cells import paper_cell


@pytest.fixture
def session(tmp_path):
    return Session.create(tmp_path / "session", paper_cell().text)


def test_a_run_as_the_cell_file_alone_has_it_says_nothing(session):
    keep_conduct(session, Conduct())
    assert not (session.folder / CONDUCT).exists()
    assert read_conduct(session) == Conduct()


def test_how_a_session_goes_on_replaces_how_it_was_begun(session):
    for conduct in (Conduct(Pace(0.5, 0.25), emulated=True), Conduct(Pace(0.5)), Conduct()):
        keep_conduct(session, conduct)
        assert read_conduct(session) == conduct
