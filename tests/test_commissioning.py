"""The commissioning record: which cell file it holds for, what is missing, what a session's copy is worth."""

from __future__ import annotations

import json

import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.commissioning import Commissioning
from dualcal_hal.errors import FormatError, UsageError
from tests.cells import TINY


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "line 3.yaml"
    path.write_text(TINY.read_text())
    return path


def of(path, *overrides):
    return Commissioning.of(path, load_cell(path, overrides))


def commissioned(path, *overrides):
    commissioning = of(path, *overrides)
    for arm in ("left", "right"):
        commissioning.record_flange(arm, True, "within 1.2 mm")
        commissioning.record_wiggle(arm, True, "all joints")
    return commissioning


def test_of_a_new_cell_all_is_missing_and_it_is_said_how_it_is_done(path):
    missing = of(path).missing()
    assert len(missing) == 4
    assert missing[0] == (
        f"the flange check of 'left' was not done yet; do it by: dualcal doctor '{path}' --flange --arm left"
    )
    assert missing[3].endswith("--wiggle --arm right")
    assert not of(path).verified


def test_what_was_done_is_beside_the_cell_file_for_the_next_process(path):
    commissioned(path)
    assert (path.parent / "line 3.commissioning.json").exists()
    after = of(path)
    assert after.missing() == []
    assert after.flange_checked("left")
    assert after.wiggled("right")
    assert not after.verified


def test_one_arm_is_not_the_other_and_one_check_not_the_other(path):
    of(path).record_flange("left", True, "good")
    after = of(path)
    assert after.flange_checked("left")
    assert not after.wiggled("left")
    assert not after.flange_checked("right")


def test_a_check_that_was_not_passed_counts_as_missing_with_what_it_said(path):
    commissioned(path).record_wiggle("left", False, "joint 3 turned the other way")
    after = of(path)
    assert not after.wiggled("left")
    assert after.flange_checked("left")
    (missing,) = after.missing()
    assert "was not passed: joint 3 turned the other way" in missing


def test_a_check_made_now_replaces_an_older_one_also_where_the_calendar_was_set_back(path):
    commissioned(path)
    document = json.loads(of(path).path.read_text())
    document["flange"]["left"]["time"] = "2999-01-01T00:00:00.000+00:00"
    of(path).path.write_text(json.dumps(document))
    of(path).record_flange("left", False, "joint 2 is off")
    assert not of(path).flange_checked("left")


@pytest.mark.parametrize(
    "override",
    [
        "robots.left.kinematics.dh.2.theta_deg=1",
        "robots.right.limits_deg.0=[-90, 90]",
        "robots.right.speed_deg_s=[100, 120, 120, 200, 200, 240]",
        "backends={sim: {type: replay, session: elsewhere}}",
    ],
)
def test_what_decides_how_arms_move_voids_the_checks(path, override):
    commissioned(path).record_verified("ok")
    file = load_cell(path, [override, "simulation=null"] if "replay" in override else [override])
    changed = Commissioning.of(path, file)
    assert len(changed.missing()) == 4
    assert "was for other backends or robots" in changed.missing()[0]
    assert not changed.verified


@pytest.mark.parametrize(
    "override",
    [
        "procedure.tolerance_px=0.2",
        "procedure.seed=7",
        "simulation.seed=3",
        "nominal.camera_in_active_flange.translation_mm=[-52.7, 53.2, 25.4]",
        "session.frames=jpeg",
        "name=other",
    ],
)
def test_tolerances_and_the_found_transforms_void_nothing(path, override):
    commissioned(path).record_verified("ok")
    changed = of(path, override)
    assert changed.missing() == []
    assert changed.verified


def test_comments_and_layout_do_not_count(path):
    commissioned(path).record_verified("ok")
    text = path.read_text().replace("a_mm: 60,", "a_mm: 60.0,").replace("  # chosen\n", "\n")
    assert text != path.read_text()
    path.write_text("# another head\n" + text)
    assert of(path).missing() == []
    assert of(path).verified


@pytest.mark.parametrize(
    "override", ["camera.matrix=[[410, 0, 255.5], [0, 406, 191.5], [0, 0, 1]]", "target.square_mm=30"]
)
def test_another_camera_or_target_voids_the_verification_alone(path, override):
    commissioned(path).record_verified("ok")
    changed = of(path, override)
    assert changed.missing() == []
    assert not changed.verified


def test_another_mount_of_the_target_voids_the_verification(path):
    commissioned(path).record_verified("ok")
    changed = of(path, "robots.right.target_mount={translation_mm: [0, 0, 9], rotation_vector_deg: [0, 0, 0]}")
    assert not changed.verified


# Sessions


@pytest.fixture
def session(path, tmp_path):
    folder = tmp_path / "session"
    folder.mkdir()
    (folder / "cell.yaml").write_text(path.read_text())
    return folder / "cell.yaml"


def test_a_sessions_copy_knows_what_the_original_did(path, session):
    commissioned(path).copy_beside(session)
    assert (session.parent / "cell.commissioning.json").exists()
    assert of(session).missing() == []


def test_a_sessions_copy_is_worth_something_without_the_original(path, session):
    commissioned(path).copy_beside(session)
    of(path).path.unlink()
    path.unlink()
    assert of(session).missing() == []
    assert "line 3.yaml" in of(session, "robots.left.kinematics.dh.2.theta_deg=1").missing()[0]


def test_what_the_original_has_learnt_since_counts_for_the_copy(path, session):
    commissioned(path).copy_beside(session)
    of(path).record_wiggle("right", False, "joint 1 and 2 are exchanged")
    assert not of(session).wiggled("right")


def test_what_a_session_verifies_is_known_to_the_original(path, session):
    commissioned(path).copy_beside(session)
    of(session).record_verified("mean mismatch 0.11 mm")
    assert of(path).verified
    assert of(session).verified
    assert of(path).missing() == []


def test_a_copy_of_the_cell_file_by_hand_is_a_cell_file_of_its_own(path, tmp_path):
    commissioned(path)
    other = tmp_path / "other.yaml"
    other.write_text(path.read_text())
    assert len(of(other).missing()) == 4


def test_two_that_record_at_a_time_lose_nothing_of_each_other(path):
    first, second = of(path), of(path)
    first.record_flange("left", True, "good")
    second.record_flange("right", True, "good")
    assert of(path).flange_checked("left")
    assert of(path).flange_checked("right")


# What is refused


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("", "is not JSON"),
        ('{"format": "dualcal.commissioning/1", "copy_of": null, "fl', "is not JSON"),
        ("[1]", "is not a JSON object"),
        ('{"format": "dualcal.result/1"}', "format 'dualcal.result/1' is not known"),
        ("{}", "key 'format' is missing"),
        ('{"format": "dualcal.commissioning/1"}', "is no record of a commissioning: the record has no 'flange'"),
        (
            '{"format": "dualcal.commissioning/1", "copy_of": null, "verified": null, "wiggle": {},'
            ' "flange": {"left": {"key": "", "time": "", "good": 1, "said": ""}}}',
            "good is no true or false",
        ),
        (
            '{"format": "dualcal.commissioning/1", "copy_of": 3, "verified": null, "wiggle": {}, "flange": {}}',
            "copy_of is no text",
        ),
    ],
)
def test_a_damaged_or_foreign_record_is_refused_and_never_taken_for_an_empty_one(path, content, words):
    of(path).path.write_text(content)
    with pytest.raises(FormatError, match=words):
        of(path)


def test_a_record_that_is_not_readable_is_refused(path):
    of(path).path.mkdir()
    with pytest.raises(FormatError, match="cannot be read"):
        of(path)


def test_an_arm_that_there_is_not_is_refused(path):
    with pytest.raises(UsageError, match="there is no arm 'middle'"):
        of(path).record_flange("middle", True, "good")


def test_a_record_that_cannot_be_written_is_said(path, tmp_path, monkeypatch):
    def full(path, document):
        raise OSError(28, "No space left on device")

    commissioning = of(path)
    monkeypatch.setattr("dualcal_hal.commissioning.write_document", full)
    with pytest.raises(UsageError, match="cannot be recorded: No space left"):
        commissioning.record_verified("ok")
    assert not of(path).verified
