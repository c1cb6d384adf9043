"""What a log says that no viewer needs to understand: small records, each JSON with a schema.

They are the contract between those who record and those who replay. Floats come back to the last bit; NaN and
infinities, which JSON does not have and a broken device may well send, are written as text.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

from dualcal_hal import errors
from dualcal_hal.errors import DeviceError, DualcalError, LogDamaged, Problem
from dualcal_hal.robot import JointPath, Joints, Mode, MotionState, RobotState, StopResult
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.plain import SPECIAL, Fields, expect, number_in_text, parse

LONGEST_RECORD = 1 << 20
"""Bytes of JSON that are read as one record, which may take thirty times as many in memory. A plan is the longest: of
the paper's 28 + 14 positions it takes 14 kB.
"""

Level = Literal["debug", "info", "warning", "error"]


@dataclass(frozen=True)
class FrameRef:
    """A frame that a camera gave: its pixels are the image of that camera with that sequence; ``time`` is exact."""

    camera: str
    sequence: int
    time: float


Value = bool | int | float | str | JointPath | RobotState | StopResult | FrameRef | None
"""What is handed to a device or comes back from it."""


@dataclass(frozen=True)
class RecordedError:
    """An error of the tree as it can be raised again: the class's name and what its constructor takes."""

    name: str
    fields: Mapping[str, Any]

    @staticmethod
    def of(error: BaseException) -> RecordedError:
        """Of any error; one from outside the tree is recorded as a DeviceError that names it."""
        name = type(error).__name__
        if not isinstance(error, DualcalError) or _TREE.get(name) is not type(error):
            attributes = {"device": "device", "attempted": "answer", "why": f"{name}: {error}", "advice": ""}
            return RecordedError("DeviceError", attributes)
        return RecordedError(name, _fields_of(error))

    def error(self) -> DualcalError:
        """The error anew, of the same class and with the same message."""
        return _error_from(_TREE[self.name], self.fields)


@dataclass(frozen=True)
class Call:
    """A device was asked for something. ``index`` counts the calls of one device from 0; ``time``: s of the clock."""

    device: str
    index: int
    method: str
    arguments: Mapping[str, Value]
    time: float


@dataclass(frozen=True)
class Reply:
    """What came of the call of that index: a value, or an error. An accepted motion's value is None."""

    device: str
    index: int
    value: Value
    time: float
    error: RecordedError | None = None


@dataclass(frozen=True)
class MotionEnded:
    """The motion that the call of that index began has come to an end."""

    device: str
    index: int
    state: MotionState
    final: RobotState | None
    time: float
    error: RecordedError | None = None


@dataclass(frozen=True)
class StepBegun:
    """A step of the procedure begins."""

    key: StepKey
    time: float


@dataclass(frozen=True)
class StepFinished:
    """A step's result is in the journal. One that was begun and never finished was interrupted."""

    key: StepKey
    time: float


@dataclass(frozen=True)
class Arrived:
    """A state arrived at whoever subscribed by the call of that index."""

    device: str
    index: int
    state: RobotState
    time: float


@dataclass(frozen=True)
class Worked:
    """Something was worked out without a device. ``index`` counts them from 0.

    asked: what for; result: what came of it, None for an error. Both are plain JSON.
    """

    index: int
    what: str
    asked: Any
    result: Any
    time: float
    error: RecordedError | None = None


@dataclass(frozen=True)
class Note:
    """A line for a person."""

    level: Level
    text: str
    time: float


@dataclass(frozen=True)
class RunEnded:
    """The run, or this part of it, has come to its end; a file without this was cut off. None: to its good end."""

    error: RecordedError | None
    time: float


Record = Call | Reply | MotionEnded | Arrived | StepBegun | StepFinished | Worked | Note | RunEnded


def to_json(record: Record) -> bytes:
    """One line of JSON; ValueError for a ``result`` that holds what JSON has not."""
    document = _FORMS[type(record)].write(record)
    # A device's text may be no Unicode, such as the name of a file: what has no letter then is a question mark.
    return json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":")).encode(errors="replace")


def from_json(kind: type[Record], data: bytes) -> Record:
    """The record again; ValueError says what is wrong with it."""
    if len(data) > LONGEST_RECORD:
        raise ValueError(f"a record of {len(data)} bytes is not read")
    record: Record = _FORMS[kind].read(_Fields(parse(data)))
    return record


def schema_of(kind: type[Record]) -> dict[str, Any]:
    """The JSON Schema of a record."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"dualcal.{kind.__name__}",
        "description": " ".join((kind.__doc__ or "").split()),
        **_object(**_FORMS[kind].schema),
    }


# Parts of records, written


def _number(value: float) -> float | str:
    value = float(value)
    return value if math.isfinite(value) else str(value)


def _numbers(values: Joints) -> list[float | str]:
    return [_number(value) for value in values]


def _state(state: RobotState) -> dict[str, Any]:
    return {
        "positions_rad": _numbers(state.positions),
        "velocities_rad_s": _numbers(state.velocities),
        "mode": str(state.mode),
        "faults": list(state.faults),
        "time_s": _number(state.time),
        "sequence": state.sequence,
    }


def _path(path: JointPath) -> dict[str, Any]:
    return {
        "waypoints_rad": [_numbers(waypoint) for waypoint in path.waypoints],
        "speed_rad_s": _numbers(path.speed),
        "acceleration_rad_s2": _numbers(path.acceleration),
    }


def _value(value: Value) -> Any:
    match value:
        case None | bool() | str():
            return value
        case int():
            return int(value)
        case float():
            # A text that looks like a number that is none would come back as text.
            return float(value) if math.isfinite(value) else {"number": str(float(value))}
        case RobotState():
            return {"state": _state(value)}
        case JointPath():
            return {"path": _path(value)}
        case StopResult():
            return {"stop": asdict(value)}
        case FrameRef():
            return {"frame": {"camera": value.camera, "sequence": value.sequence, "time_s": _number(value.time)}}
    raise ValueError(f"a {type(value).__name__} cannot be recorded")


def _error(error: RecordedError | None) -> dict[str, Any] | None:
    return None if error is None else {"class": error.name, **error.fields}


def _or_none(write: Callable[[Any], Any], value: Any) -> Any:
    return None if value is None else write(value)


# Parts of records, read. Every method raises ValueError for what is not of its kind.


class _Fields(Fields):
    """The same with what devices send: numbers that may be none, and values of the kinds that are recorded."""

    def number(self, name: str) -> float:
        return number_in_text(self.any(name), name)

    def joints(self, name: str) -> Joints:
        return _read_joints(self.any(name), name)

    def value(self, name: str) -> Value:
        return _read_value(self.any(name), name)

    def values(self, name: str) -> dict[str, Value]:
        return {key: _read_value(value, key) for key, value in self.part(name).content.items()}


def _read_joints(value: Any, name: str) -> Joints:
    return tuple(number_in_text(each, name) for each in expect(value, list, name))


def _read_state(fields: _Fields) -> RobotState:
    return RobotState(
        fields.joints("positions_rad"),
        fields.joints("velocities_rad_s"),
        Mode(fields.text("mode")),
        fields.texts("faults"),
        fields.number("time_s"),
        fields.whole("sequence"),
    )


def _read_path(fields: _Fields) -> JointPath:
    waypoints = expect(fields.any("waypoints_rad"), list, "waypoints_rad")
    return JointPath(
        tuple(_read_joints(waypoint, "waypoints_rad") for waypoint in waypoints),
        fields.joints("speed_rad_s"),
        fields.joints("acceleration_rad_s2"),
    )


def _read_value(value: Any, name: str) -> Value:
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return number_in_text(value, name)
    fields = _Fields(value, name)
    match list(fields.content):
        case ["number"]:
            return fields.number("number")
        case ["state"]:
            return _read_state(fields.part("state"))
        case ["path"]:
            return _read_path(fields.part("path"))
        case ["stop"]:
            stop = fields.part("stop")
            return StopResult(stop.flag("confirmed"), stop.text("detail"))
        case ["frame"]:
            frame = fields.part("frame")
            return FrameRef(frame.text("camera"), frame.whole("sequence"), frame.number("time_s"))
    raise ValueError(f"{name} is of no known kind")


def _read_error(fields: _Fields | None) -> RecordedError | None:
    if fields is None:
        return None
    name = fields.text("class")
    kind = _TREE.get(name)
    if kind is None:
        raise ValueError(f"{name!r} is no error of this program")
    recorded = {key: value for key, value in fields.content.items() if key != "class"}
    _check_error_fields(kind, _Fields(recorded, "error"))
    return RecordedError(name, recorded)


# Errors. Only those of the tree are ever made from a log, by a table that no log can extend.


def _tree(kind: type[DualcalError]) -> dict[str, type[DualcalError]]:
    tree = {kind.__name__: kind} if kind.__module__ == errors.__name__ else {}
    for below in kind.__subclasses__():
        tree.update(_tree(below))
    return tree


_TREE = {name: kind for name, kind in _tree(DualcalError).items() if not name.startswith("_")}
_DEVICE_FIELDS = ("device", "attempted", "why", "advice")


def _fields_of(error: DualcalError) -> dict[str, Any]:
    if isinstance(error, DeviceError):
        return {name: str(getattr(error, name)) for name in _DEVICE_FIELDS}
    if isinstance(error, errors.CellFileError | errors.FormatError):
        return {"problems": [asdict(problem) for problem in error.problems]}
    if isinstance(error, LogDamaged):
        return {"file": error.file, "offset": error.offset, "why": error.why}
    return {"message": str(error)}


def _check_error_fields(kind: type[DualcalError], fields: _Fields) -> None:
    if issubclass(kind, DeviceError):
        for name in _DEVICE_FIELDS:
            fields.text(name)
    elif issubclass(kind, errors.CellFileError | errors.FormatError):
        for problem in expect(fields.any("problems"), list, "problems"):
            _Fields(problem, "problem").text("where")
            _Fields(problem, "problem").text("what")
    elif issubclass(kind, LogDamaged):
        fields.text("file")
        fields.text("why")
        if fields.any("offset") is not None:
            fields.whole("offset")
    else:
        fields.text("message")


def _error_from(kind: type[DualcalError], fields: Mapping[str, Any]) -> DualcalError:
    if issubclass(kind, DeviceError):
        return kind(*(fields[name] for name in _DEVICE_FIELDS))
    if issubclass(kind, errors.CellFileError | errors.FormatError):
        return kind([Problem(problem["where"], problem["what"]) for problem in fields["problems"]])
    if issubclass(kind, LogDamaged):
        return kind(fields["file"], fields["offset"], fields["why"])
    return kind(fields["message"])


# Schemas


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _nullable(schema: Mapping[str, Any]) -> dict[str, Any]:
    return {"anyOf": [{"type": "null"}, schema]}


_TEXT = {"type": "string"}
_WHOLE = {"type": "integer", "minimum": 0}
_NUMBER = {"anyOf": [{"type": "number"}, {"enum": list(SPECIAL)}]}
_NUMBERS = {"type": "array", "items": _NUMBER}
_STATE = _object(
    positions_rad=_NUMBERS,
    velocities_rad_s=_NUMBERS,
    mode={"enum": [str(mode) for mode in Mode]},
    faults={"type": "array", "items": _TEXT},
    time_s=_NUMBER,
    sequence=_WHOLE,
)
_PATH = _object(waypoints_rad={"type": "array", "items": _NUMBERS}, speed_rad_s=_NUMBERS, acceleration_rad_s2=_NUMBERS)
_VALUE = {
    "anyOf": [
        {"type": ["null", "boolean", "number", "string"]},
        _object(number={"enum": list(SPECIAL)}),
        _object(state=_STATE),
        _object(path=_PATH),
        _object(stop=_object(confirmed={"type": "boolean"}, detail=_TEXT)),
        _object(frame=_object(camera=_TEXT, sequence=_WHOLE, time_s=_NUMBER)),
    ]
}
_ERROR = _nullable({"type": "object", "properties": {"class": {"enum": sorted(_TREE)}}, "required": ["class"]})
_KEY = _object(phase=_TEXT, constraint=_nullable(_TEXT), position=_nullable(_WHOLE), kind=_TEXT)


@dataclass(frozen=True)
class _Form:
    """How one kind of record is written and read, and the schema of that."""

    write: Callable[[Any], dict[str, Any]]
    read: Callable[[_Fields], Any]
    schema: Mapping[str, Any]


def _of_device(record: Call | Reply | MotionEnded | Arrived) -> dict[str, Any]:
    return {"device": record.device, "index": record.index}


def _step_form(kind: type[StepBegun] | type[StepFinished]) -> _Form:
    return _Form(
        lambda r: {"step": asdict(r.key), "time_s": _number(r.time)},
        lambda f: kind(StepKey.from_fields(f.part("step")), f.number("time_s")),
        {"step": _KEY, "time_s": _NUMBER},
    )


def _read_level(fields: _Fields) -> Level:
    for level in _LEVELS:
        if fields.text("level") == level:
            return level
    raise ValueError(f"level is none of {', '.join(_LEVELS)}")


_LEVELS: tuple[Level, ...] = get_args(Level)

_FORMS: dict[type[Any], _Form] = {
    Call: _Form(
        lambda r: {
            **_of_device(r),
            "method": r.method,
            "arguments": {name: _value(value) for name, value in r.arguments.items()},
            "time_s": _number(r.time),
        },
        lambda f: Call(f.text("device"), f.whole("index"), f.text("method"), f.values("arguments"), f.number("time_s")),
        {
            "device": _TEXT,
            "index": _WHOLE,
            "method": _TEXT,
            "arguments": {"type": "object", "additionalProperties": _VALUE},
            "time_s": _NUMBER,
        },
    ),
    Reply: _Form(
        lambda r: {**_of_device(r), "value": _value(r.value), "error": _error(r.error), "time_s": _number(r.time)},
        lambda f: Reply(
            f.text("device"),
            f.whole("index"),
            f.value("value"),
            f.number("time_s"),
            _read_error(f.part_or_none("error")),
        ),
        {"device": _TEXT, "index": _WHOLE, "value": _VALUE, "error": _ERROR, "time_s": _NUMBER},
    ),
    MotionEnded: _Form(
        lambda r: {
            **_of_device(r),
            "state": str(r.state),
            "final": _or_none(_state, r.final),
            "error": _error(r.error),
            "time_s": _number(r.time),
        },
        lambda f: MotionEnded(
            f.text("device"),
            f.whole("index"),
            MotionState(f.text("state")),
            _or_none(_read_state, f.part_or_none("final")),
            f.number("time_s"),
            _read_error(f.part_or_none("error")),
        ),
        {
            "device": _TEXT,
            "index": _WHOLE,
            "state": {"enum": [str(state) for state in MotionState]},
            "final": _nullable(_STATE),
            "error": _ERROR,
            "time_s": _NUMBER,
        },
    ),
    Arrived: _Form(
        lambda r: {**_of_device(r), "state": _state(r.state), "time_s": _number(r.time)},
        lambda f: Arrived(f.text("device"), f.whole("index"), _read_state(f.part("state")), f.number("time_s")),
        {"device": _TEXT, "index": _WHOLE, "state": _STATE, "time_s": _NUMBER},
    ),
    StepBegun: _step_form(StepBegun),
    StepFinished: _step_form(StepFinished),
    Worked: _Form(
        lambda r: {
            "index": r.index,
            "what": r.what,
            "asked": r.asked,
            "result": r.result,
            "error": _error(r.error),
            "time_s": _number(r.time),
        },
        lambda f: Worked(
            f.whole("index"),
            f.text("what"),
            f.any("asked"),
            f.any("result"),
            f.number("time_s"),
            _read_error(f.part_or_none("error")),
        ),
        {"index": _WHOLE, "what": _TEXT, "asked": {}, "result": {}, "error": _ERROR, "time_s": _NUMBER},
    ),
    Note: _Form(
        lambda r: {"level": r.level, "text": r.text, "time_s": _number(r.time)},
        lambda f: Note(_read_level(f), f.text("text"), f.number("time_s")),
        {"level": {"enum": list(_LEVELS)}, "text": _TEXT, "time_s": _NUMBER},
    ),
    RunEnded: _Form(
        lambda r: {"error": _error(r.error), "time_s": _number(r.time)},
        lambda f: RunEnded(_read_error(f.part_or_none("error")), f.number("time_s")),
        {"error": _ERROR, "time_s": _NUMBER},
    ),
}
