"""The public captures file."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dualcal_hal.errors import FormatError
from dualcal_hal.session.captures import CaptureRecord, Captures, read_captures, write_captures
from dualcal_hal.session.files import write_atomically
from tests.reference_cell import REFERENCE


def capture(name: str = "calibration/00/0", **changes: Any) -> dict[str, Any]:
    return {
        "id": name,
        "use": "calibration",
        "constraint": "calibration/00",
        "position": 0,
        "active_arrival": 0,
        "active_joints_rad": [0.1, 0.2, 0.3, 0.4, 0.5, 0.6],
        "passive_joints_rad": [0.6, 0.5, 0.4, 0.3, 0.2, 0.1],
        "feature_px": [511.5, 383.5],
        "corners_px": [[500.0, 380.0]] * 9,
        "image_px": [1024, 768],
    } | changes


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write(*captures: Any, **header: Any) -> Path:
        path = tmp_path / "captures.json"
        document = {"format": "dualcal.captures/1", "cell_sha256": "ab", "started": "now", "captures": list(captures)}
        path.write_text(json.dumps(document | header))
        return path

    return write


def problems(path: Path, **cell: Any) -> list[str]:
    with pytest.raises(FormatError) as caught:
        read_captures(path, **cell)
    return [str(problem) for problem in caught.value.problems]


def without(entry: dict[str, Any], *keys: str) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key not in keys}


def test_the_reference_file_is_read_with_its_foreign_keys_ignored() -> None:
    captures = read_captures(REFERENCE, joints=(6, 6), corners=9)
    assert len(captures.captures) == 42
    assert (captures.cell_sha256, captures.started) == (None, None)
    first = captures.captures[0]
    assert (first.id, first.use, first.constraint, first.position) == (
        "calibration/00/0",
        "calibration",
        "calibration/00",
        0,
    )
    assert first.image_size == (1024, 768)
    assert first.aligned
    assert first.order_known


def test_what_is_written_is_read_back_unchanged(tmp_path: Path) -> None:
    entry = CaptureRecord.from_record(capture(aligned=False, order="unknown", corners_px=None))
    captures = Captures("ab", "2020-01-01T00:00:00Z", (entry,))
    write_captures(tmp_path / "captures.json", captures)
    assert read_captures(tmp_path / "captures.json") == captures
    assert not entry.aligned
    assert not entry.order_known


def test_a_record_goes_through_the_journal_unchanged() -> None:
    entry = CaptureRecord.from_record(capture())
    assert CaptureRecord.from_record(json.loads(json.dumps(entry.to_record()))) == entry


def test_corners_that_were_not_seen_are_null_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "captures.json"
    entry = CaptureRecord.from_record(capture(corners_px=[None, [500.0, 380.0], *[None] * 7]))
    write_captures(path, Captures("ab", "now", (entry,)))
    assert json.loads(path.read_text())["captures"][0]["corners_px"][:2] == [None, [500.0, 380.0]]
    assert read_captures(path, corners=9, feature=0).captures == (entry,)


def test_without_arrivals_each_constraint_is_one(write: Callable[..., Path]) -> None:
    entries = [
        without(capture("a", constraint="0"), "active_arrival"),
        without(capture("b", constraint="1"), "active_arrival"),
        without(capture("c", constraint="0"), "active_arrival"),
        capture("d", constraint="2", active_arrival=7),
    ]
    a, b, c, d = (entry.active_arrival for entry in read_captures(write(*entries)).captures)
    assert a == c
    assert len({a, b, d}) == 3
    assert d == 7


def test_names_may_be_numbers(write: Callable[..., Path]) -> None:
    read = read_captures(write(capture(5, constraint=3))).captures[0]
    assert (read.id, read.constraint) == ("5", "3")


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("key", ["active_joints_rad", "passive_joints_rad"])
def test_numbers_that_are_not_finite_are_named_with_capture_and_joint(
    write: Callable[..., Path], key: str, number: float
) -> None:
    (problem,) = problems(write(capture(**{key: [0, 0, 0, number, 0, 0]})))
    assert problem.startswith(f"calibration/00/0: {key}[3]: ")
    assert "finite" in problem


def test_a_wrong_joint_count_is_said_when_the_cell_is_known(write: Callable[..., Path]) -> None:
    path = write(capture("a", active_joints_rad=[0.0] * 5), capture("b", passive_joints_rad=[0.0] * 7))
    read_captures(path)
    assert problems(path, joints=(6, 6)) == [
        "a: active_joints_rad: 5 joint angles, the arm has 6",
        "b: passive_joints_rad: 7 joint angles, the arm has 6",
    ]


def test_a_wrong_corner_count_is_said_when_the_cell_is_known(write: Callable[..., Path]) -> None:
    path = write(capture("a", corners_px=[[1, 2]] * 8), capture("b", corners_px=None))
    assert problems(path, corners=9) == ["a: corners_px: 8 corners, the target has 9"]


def test_where_the_target_was_seen_by_another_program_goes_without_an_image(write: Callable[..., Path]) -> None:
    pose = {"matrix": [[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]]}
    entry = without(capture(), "feature_px", "corners_px", "image_px") | {"target_in_camera": pose}
    read = read_captures(write(entry), image_size=(1024, 768)).captures[0]
    assert read.image_size is None
    assert "image_px" not in read.to_record()
    assert CaptureRecord.from_record(read.to_record()).board_pose == read.board_pose


def test_all_problems_are_reported_at_once(write: Callable[..., Path]) -> None:
    found = problems(
        write(
            capture("a", use="testing"),
            capture("a"),
            without(capture("b"), "passive_joints_rad", "image_px"),
            capture("c", feature_px=[1.0]),
            capture("d", feature_px=["left", 2.0], position="first"),
            "nonsense",
            without(capture(), "id"),
        )
    )
    text = "\n".join(found)
    assert "a: use: " in text
    assert "a: id: used by 2 captures" in text
    assert "b: passive_joints_rad: missing" in text
    assert "b: image_px: missing" in text
    assert "c: feature_px[1]: missing" in text
    assert "d: feature_px[0]: " in text
    assert "d: position: " in text
    assert "captures[5]: is not a JSON object" in text
    assert "captures[6]: id: missing" in text
    assert len(found) == 9


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is not JSON"),
        ("{", "is not JSON"),
        ("[]", "is not a JSON object"),
        ('{"captures": []}', "key 'format' is missing"),
        ('{"format": "dualcal.captures/2", "captures": []}', "format 'dualcal.captures/2' is not known"),
        ('{"format": "dualcal.captures/1"}', "captures: missing"),
        ('{"format": "dualcal.captures/1", "captures": []}', "captures: is empty"),
        ('{"format": "dualcal.captures/1", "captures": {}}', "captures: must be a list"),
    ],
)
def test_what_is_no_captures_file_is_refused_with_its_name(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "captures.json"
    path.write_text(text)
    (problem,) = problems(path)
    assert problem.startswith(f"{path}: {what}")


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "captures.json"
    path.write_bytes(b'{"format": "\xff\xfe"}')
    assert "is not JSON" in problems(path)[0]


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    assert problems(tmp_path / "none.json") == [f"{tmp_path / 'none.json'}: cannot be read: No such file or directory"]


def test_a_journal_record_without_arrival_is_refused() -> None:
    with pytest.raises(FormatError, match="active_arrival: missing"):
        CaptureRecord.from_record(without(capture(), "active_arrival"))


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "captures.json"
    write_atomically(path, b"old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_numbers_that_json_does_not_have_are_never_written(tmp_path: Path) -> None:
    entry = CaptureRecord.from_record(capture())
    broken = CaptureRecord(**{**vars(entry), "feature": (math.nan, 0.0)})
    with pytest.raises(ValueError, match="JSON compliant"):
        write_captures(tmp_path / "captures.json", Captures(None, None, (broken,)))
    assert not list(tmp_path.iterdir())
