"""JSON that nobody vouches for: what it must be is said where it is read, and all else is a ValueError."""

from __future__ import annotations

import json
from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import FormatError
from dualcal_hal.session.captures import CellShape
from dualcal_hal.session.journal import Journal
from dualcal_hal.session.log import Call, Layout, LogReader, Note, Worked
from dualcal_hal.session.log.layout import RECORD_KINDS
from dualcal_hal.session.log.records import LONGEST_RECORD, from_json, to_json
from dualcal_hal.session.plain import DEEPEST, Fields, parse
from procedures.calibrate import Calibration, point_of
from procedures.detection import Missed
from procedures.detection.outcome import found_from_record, found_to_record
from procedures.planning.belief import Belief
from procedures.planning.model import CellModel
from procedures.planning.ways import WayFinder
from tools.golden import GOLDEN

# -- texts ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (b'{"a": NaN}', "NaN is no JSON"),
        (b'{"a": -Infinity}', "Infinity is no JSON"),
        (b'{"a": 1e999}', "too large"),
        (b'{"a": ' + b"1" * 30 + b"}", "30 digits is too large"),
        (b'{"a": "\\ud800"}', "half a surrogate pair"),
        (b'{"\\uDFFF": 1}', "half a surrogate pair"),
        (b'{"a": "\xed\xa0\x80"}', "utf-8"),
        ('{"a": 1}'.encode("utf-16"), "utf-8"),
        (b'{"a": ' * (DEEPEST + 2) + b"1" + b"}" * (DEEPEST + 2), "nested too deeply"),
        (b"[" * 100_000, "nested too deeply"),
        (b"{", "Expecting"),
    ],
)
def test_what_is_no_plain_json_is_refused(text, why):
    with pytest.raises(ValueError, match=why):
        parse(text)


def test_what_is_plain_json_is_read():
    text = '{"a": "\\ud83d\\ude00 é", "b": [1, 1.5, true, null]}'
    assert parse(text.encode()) == json.loads(text)
    assert parse(b"[" * DEEPEST + b"1" + b"]" * DEEPEST)


@pytest.mark.parametrize("kind", [Note, Call])
def test_half_a_surrogate_pair_in_a_record_is_no_text(kind):
    record = Note("info", "@", 0.0) if kind is Note else Call("@", 0, "read", {}, 0.0)
    with pytest.raises(ValueError, match="half a surrogate pair"):
        from_json(kind, to_json(record).replace(b"@", b"\\ud800"))


def test_half_a_surrogate_pair_in_the_list_of_devices_is_no_text():
    with pytest.raises(ValueError, match="half a surrogate pair"):
        Layout.from_text('{"arms": ["\\ud800"], "camera": "camera"}')


def test_a_devices_name_has_an_end():
    with pytest.raises(ValueError, match="more than"):
        Layout.from_text(json.dumps({"arms": ["x" * 10_000], "camera": "camera"}))


def test_a_text_that_is_no_unicode_is_recorded_with_question_marks():
    """Such as the name of a file, in the words of an error."""
    assert from_json(Note, to_json(Note("error", "a\udc80b", 0.0))) == Note("error", "a?b", 0.0)


# -- members ----------------------------------------------------------------------------------------

FIELDS = Fields({"a": [1, 2.5], "b": True, "c": 1e300, "d": "x", "e": -1, "f": None, "g": [1, "x"], "h": {}, "i": []})


@pytest.mark.parametrize(
    "read",
    [
        lambda: FIELDS.any("missing"),
        lambda: FIELDS.finites("a", 3),
        lambda: FIELDS.finites("i"),
        lambda: FIELDS.finites("g"),
        lambda: FIELDS.finites("d"),
        lambda: FIELDS.finite("b"),
        lambda: FIELDS.finite("c"),
        lambda: FIELDS.finite("f"),
        lambda: FIELDS.whole("e"),
        lambda: FIELDS.whole("b"),
        lambda: FIELDS.whole("c"),
        lambda: FIELDS.text("f"),
        lambda: FIELDS.flag("e"),
        lambda: FIELDS.part("a"),
        lambda: list(FIELDS.parts("a")),
        lambda: FIELDS.items("h"),
        lambda: FIELDS.choice("d", ["y"]),
        lambda: Fields([]),
    ],
)
def test_a_member_of_another_kind_is_refused(read):
    with pytest.raises(ValueError, match=r"\w"):
        read()


def test_a_member_of_its_kind_is_given():
    assert FIELDS.finites("a", 2) == (1.0, 2.5)
    assert FIELDS.choice("d", ["x"]) == "x"
    assert FIELDS.part_or_none("f") is None
    assert FIELDS.part("h").content == {}


# -- what journals and recordings say ---------------------------------------------------------------

ODD = (None, True, -7, 10**18, 1e300, "x", "", [], {}, [[]], [1, 2, 3], [0.0] * 7, {"a": 1})


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Of all that is in it, but of long lists the first two entries alone."""
    if path:
        yield path
    entries = value.items() if isinstance(value, dict) else enumerate(value[:2]) if isinstance(value, list) else ()
    for key, below in entries:
        yield from places(below, (*path, key))


def spoilt(record: Any) -> Iterator[Any]:
    """With one value changed into another, or missing."""
    for path in places(record):
        for odd in (*ODD, KeyError):
            copy = deepcopy(record)
            holder = copy
            for key in path[:-1]:
                holder = holder[key]
            if odd is KeyError:
                del holder[path[-1]]
            else:
                holder[path[-1]] = odd
            yield copy


@pytest.fixture(scope="module")
def cell():
    return load_cell(GOLDEN / "cell.yaml").cell


@pytest.fixture(scope="module")
def calibration(cell):
    return Calibration(cell, CellModel(cell))


def readers(calibration, cell):
    """What reads the recorded work and the journalled steps of a kind, with an example of it."""
    shape, model = CellShape.of(cell), CellModel(cell)
    ways = WayFinder(model, Belief.nominal(cell.nominal), [model.home])
    steps = {key.kind: record for key, record in Journal(GOLDEN / "journal.jsonl").results()}
    with LogReader(GOLDEN / "log-0001.mcap") as log:
        work = {item.what: item.result for item in log.items() if isinstance(item, Worked) and item.result}
    missed = found_to_record(Missed("not found", "no board"))
    return {
        "stand-off": (calibration._stand_off_from, steps["stand-off"]),
        "look": (calibration._look_from, steps["look"]),
        "plan": (calibration._plan_from, steps["plan"]),
        "point": (lambda record: point_of(record, shape), steps["point"]),
        "way": (ways.from_record, work["way"]),
        "look posture": (calibration._posture_from, work["look posture"]),
        "detection": (lambda record: found_from_record(record, shape.corners), work["detection"]),
        "missed": (lambda record: found_from_record(record, shape.corners), missed),
    }


@pytest.mark.parametrize("kind", ["stand-off", "look", "plan", "point", "way", "look posture", "detection", "missed"])
def test_whatever_a_record_says_it_is_read_or_refused_and_what_is_read_can_be_used(calibration, cell, kind):
    read, record = readers(calibration, cell)[kind]
    read(record)
    refused = 0
    for wrong in spoilt(record):
        try:
            found = read(wrong)
        except ValueError:
            refused += 1
            continue
        require_usable(found)
    assert refused > 5


def require_usable(found: Any) -> None:
    """Every number in it is one that can be worked with."""
    if isinstance(found, str):
        return
    if isinstance(found, float | int | np.ndarray):
        # A corner that was not seen is NaN.
        assert not np.any(np.abs(found) > 1e19)
    elif isinstance(found, tuple | list):
        for each in found:
            require_usable(each)
    elif hasattr(found, "__dict__"):
        for each in vars(found).values():
            require_usable(each)


@pytest.mark.parametrize(
    "wrong",
    [
        [{"arm": "middle", "waypoints_rad": [[0.0] * 6]}],
        [{"arm": "left", "waypoints_rad": [[0.0] * 5]}],
        [{"arm": "left", "waypoints_rad": []}],
        [{"arm": "left"}],
        {"arm": "left"},
    ],
)
def test_a_way_is_of_these_arms(cell, wrong):
    model = CellModel(cell)
    ways = WayFinder(model, Belief.nominal(cell.nominal), [model.home])
    assert ways.from_record([{"arm": "left", "waypoints_rad": [[0.0] * 6]}])
    with pytest.raises(ValueError, match=r"\w"):
        ways.from_record(wrong)


def test_a_journalled_value_that_is_wrong_is_named_with_its_line(tmp_path):
    lines = (GOLDEN / "journal.jsonl").read_text().splitlines()
    number = next(i for i, line in enumerate(lines) if '"kind": "point"' in line)
    entry = json.loads(lines[number])
    entry["result"]["servo"] = [[0.0, 0.0], [0.0, "x"]]
    (tmp_path / "journal.jsonl").write_text("\n".join([*lines[:number], json.dumps(entry), *lines[number + 1 :], ""]))
    journal = Journal(tmp_path / "journal.jsonl")
    key = next(key for key, _ in journal.results() if key.kind == "point")
    with pytest.raises(FormatError, match=rf"journal\.jsonl:{number + 1}: .* servo is no finite number"):
        journal.read(key, lambda record: point_of(record, CellShape.of(load_cell(GOLDEN / "cell.yaml").cell)))


def test_a_record_has_an_end():
    longest = Worked(0, "x", "x" * (LONGEST_RECORD - 100), None, 0.0)
    assert from_json(Worked, to_json(longest)) == longest
    with pytest.raises(ValueError, match="bytes is not read"):
        from_json(Worked, to_json(Worked(0, "x", "x" * LONGEST_RECORD, None, 0.0)))


def test_every_record_of_a_run_is_far_from_its_end():
    with LogReader(GOLDEN / "log-0001.mcap") as log:
        assert (
            max(len(message.data) for topic, message in log.messages() if topic in RECORD_KINDS) < LONGEST_RECORD / 100
        )
