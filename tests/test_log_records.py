"""Records of a log: they come back as they were, to the last bit, and nothing else is taken for one."""

from __future__ import annotations

import json
import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualcal_hal import errors
from dualcal_hal.robot import JointPath, Mode, MotionState, RobotState, StopResult
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.log import (
    Arrived,
    Call,
    FrameRef,
    MotionEnded,
    Note,
    RecordedError,
    Reply,
    StepBegun,
    StepFinished,
    Worked,
)
from dualcal_hal.session.log.layout import RECORD_TOPICS
from dualcal_hal.session.log.records import from_json, schema_of, to_json

STATE = RobotState((0.1, 1 / 3), (-0.0, 5e-324), Mode.READY, ("E12", "naïve"), 1e9 / 7, 12)
KEY = StepKey("calibration", None, 3, "point")
ERROR = RecordedError.of(errors.DeviceTimeout("left", "move", "not arrived", "check it"))
RECORDS = [
    Call("left", 0, "start", {"path": JointPath(((0.1, 0.2), (1 / 3, 2.0)), (1.0, 2.0), (3.0, 4.0))}, 0.1),
    Call("left", 1, "stop", {"reason": "é {'x'}"}, 0.2),
    Call("camera", 0, "grab", {"not_before_s": 0.1 + 0.2, "timeout_s": 2}, 0.3),
    Reply("left", 0, None, 0.4),
    Reply("left", 1, StopResult(False, "no answer"), 0.5),
    Reply("left", 2, STATE, 0.6),
    Reply("left", 3, True, 0.6),
    Reply("left", 4, "text", 0.6),
    Reply("left", 5, math.inf, 0.6),
    Reply("left", 6, "inf", 0.6),
    Reply("camera", 0, FrameRef("camera", 7, 1 / 7), 0.7),
    Reply("left", 7, None, 0.8, ERROR),
    MotionEnded("left", 0, MotionState.SETTLED, STATE, 0.9),
    MotionEnded("left", 1, MotionState.FAILED, None, 1.0, ERROR),
    StepBegun(KEY, 1.1),
    StepFinished(StepKey("looks", "calibration/00", None, "look"), 1.2),
    Arrived("left", 8, STATE, 1.2),
    Worked(0, "way", {"to": [0.1]}, None, 1.3),
    Worked(1, "plan", None, {"poses": [[0.1, 1e-300]]}, 1.4),
    Worked(2, "plan", None, None, 1.4, ERROR),
    Note("warning", "line\nbreak", 1.5),
]


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_a_record_comes_back_equal(record):
    assert from_json(type(record), to_json(record)) == record


@given(st.lists(st.floats(), min_size=1, max_size=7), st.floats())
def test_floats_survive_to_the_last_bit_whatever_a_device_sends(values, time):
    state = RobotState(tuple(values), tuple(values), Mode.UNKNOWN, (), time, 0)
    again = from_json(Reply, to_json(Reply("left", 0, state, time)))
    assert _bits((*again.value.positions, again.value.time, again.time)) == _bits((*values, time, time))


@given(st.floats())
def test_a_float_handed_over_alone_survives_too(value):
    again = from_json(Call, to_json(Call("left", 0, "f", {"x": value}, 0.0))).arguments["x"]
    assert type(again) is float
    assert _bits((again,)) == _bits((value,))


def _bits(values):
    # Every NaN is as good as another.
    return [b"nan" if math.isnan(value) else struct.pack("<d", value) for value in values]


@pytest.mark.parametrize(
    "error",
    [
        errors.DeviceTimeout("left", "move", "why", "advice"),
        errors.Contact("left", "move", "forearm and table"),
        errors.StopFailed("right", "stop", "no answer"),
        errors.FormatError([errors.Problem("file:1", "bad"), errors.Problem("", "worse")]),
        errors.LogDamaged("log", 7, "flipped"),
        errors.LogDamaged("log", None, "flipped"),
        errors.UsageError("no"),
        errors.Interrupted("SIGINT"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_error_can_be_raised_again(error):
    reply = from_json(Reply, to_json(Reply("left", 0, None, 0.0, RecordedError.of(error))))
    again = reply.error.error()
    assert type(again) is type(error)
    assert str(again) == str(error)
    assert vars(again) == vars(error)


def test_every_error_of_the_tree_can_be_raised_again():
    for kind in _leaves(errors.DualcalError):
        if kind.__module__ != errors.__name__ or kind.__name__.startswith("_"):
            continue
        if issubclass(kind, errors.DeviceError):
            error = kind("a", "b", "c", "d")
        elif issubclass(kind, errors.LogDamaged):
            error = kind("a", 1, "b")
        else:
            error = kind([] if issubclass(kind, errors.CellFileError | errors.FormatError) else "a")
        assert type(RecordedError.of(error).error()) is kind


def _leaves(kind):
    yield kind
    for below in kind.__subclasses__():
        yield from _leaves(below)


def test_an_error_from_outside_the_tree_is_recorded_as_one_that_names_it():
    again = RecordedError.of(ZeroDivisionError("by nothing")).error()
    assert type(again) is errors.DeviceError
    assert "ZeroDivisionError: by nothing" in str(again)


@pytest.mark.parametrize("name", ["SystemExit", "os.system", "_WithProblems", "Problem", "dataclass", "", "Exception"])
def test_no_class_but_an_error_of_the_tree_is_ever_made(name):
    document = json.loads(to_json(Reply("left", 0, None, 0.0, ERROR)))
    document["error"]["class"] = name
    with pytest.raises(ValueError, match="no error of this program"):
        from_json(Reply, json.dumps(document).encode())


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"[]",
        b"null",
        b"{",
        b"\xff",
        b"{}",
        b'{"level": "shout", "text": "x", "time_s": 0}',
        b'{"level": "info", "text": 3, "time_s": 0}',
        b'{"level": "info", "text": "x", "time_s": NaN}',
        b'{"level": "info", "text": "x", "time_s": true}',
        b'{"level": "info", "text": "x", "time_s": "1"}',
        b'{"level": "info", "text": "x", "time_s": 1' + b"0" * 400 + b"}",
        b"[" * 100_000,
    ],
)
def test_what_is_no_record_is_refused(text):
    with pytest.raises(ValueError, match=r"\w"):
        from_json(Note, text)


def test_a_value_of_unknown_kind_is_refused_in_both_directions():
    with pytest.raises(ValueError, match="cannot be recorded"):
        to_json(Call("left", 0, "f", {"x": object()}, 0.0))
    with pytest.raises(ValueError, match="of no known kind"):
        from_json(Reply, b'{"device":"l","index":0,"value":{"odd":1},"error":null,"time_s":0}')


def test_work_that_json_cannot_hold_is_refused_when_it_is_recorded():
    with pytest.raises(ValueError, match="not JSON compliant"):
        to_json(Worked(0, "plan", None, {"x": math.nan}, 0.0))


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_a_record_keeps_its_schema(record):
    _require(json.loads(to_json(record)), schema_of(type(record)))


@pytest.mark.parametrize("kind", RECORD_TOPICS, ids=lambda kind: kind.__name__)
def test_a_schema_names_the_units_of_what_has_one(kind):
    schema = schema_of(kind)
    assert schema["title"] == f"dualcal.{kind.__name__}"
    assert "time_s" in schema["required"]


def _require(value, schema):
    """What of JSON Schema our schemas use."""
    if "anyOf" in schema:
        assert any(_fits(value, each) for each in schema["anyOf"]), (value, schema)
    if "enum" in schema:
        assert value in schema["enum"]
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    assert not kinds or any(_is(value, kind) for kind in kinds), (value, kinds)
    if isinstance(value, dict):
        properties = schema.get("properties", {})
        assert set(schema.get("required", [])) <= set(value)
        for name, member in value.items():
            _require(member, properties.get(name, schema.get("additionalProperties", {})))
    if isinstance(value, list):
        for each in value:
            _require(each, schema.get("items", {}))


def _fits(value, schema):
    try:
        _require(value, schema)
    except AssertionError:
        return False
    return True


def _is(value, kind):
    kinds = {
        "null": type(None),
        "boolean": bool,
        "integer": int,
        "number": int | float,
        "string": str,
        "array": list,
        "object": dict,
    }
    return isinstance(value, kinds[kind]) and (kind == "boolean" or not isinstance(value, bool))
