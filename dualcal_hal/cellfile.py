"""Reading a cell file: YAML with line marks, values set from the command line, all problems at once."""

from __future__ import annotations

import difflib
import hashlib
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from io import StringIO
from itertools import takewhile
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic.json_schema import models_json_schema
from pydantic_core import ErrorDetails
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.constructor import RoundTripConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import CollectionNode, MappingNode, Node, SequenceNode
from ruamel.yaml.reader import ReaderError

from dualcal_hal.config import (
    CellConfig,
    CellDocument,
    Location,
    OneArmCell,
    OneArmConfig,
    OneArmDocument,
    SimulationConfig,
    is_of_one_arm,
    one_arm_problems,
    reference_problems,
)
from dualcal_hal.config.backends import BACKENDS_ARE_KNOWN
from dualcal_hal.config.fixtures import FOLDER, MESHES_ARE_READ
from dualcal_hal.errors import CellFileError, Problem


@dataclass(frozen=True)
class CellFile:
    """A cell file that is in order.

    text: the file as used, values set from the command line included, comments kept; sha256: of its UTF-8.
    """

    cell: CellConfig
    simulation: SimulationConfig | None
    text: str
    sha256: str

    @property
    def one_arm(self) -> OneArmConfig | None:
        """What a file of a cell with one arm says, None for one of two."""
        return self.cell.one_arm if isinstance(self.cell, OneArmCell) else None


def load_cell(
    path: Path,
    overrides: Sequence[str] = (),
    *,
    meshes: bool = True,
    backends: bool = True,
    instead: Mapping[str, Any] | None = None,
) -> CellFile:
    """Read and check a cell file, with ``overrides`` such as ``procedure.tolerance_px=0.01`` applied.

    ``meshes`` False leaves the files of meshes unread, where no arm is to move: a session has none of them.
    ``backends`` False leaves the backends unchecked, where no device is used: they need not be installed. ``instead``
    is an entry of ``backends`` through which all devices are reached in place of what the file says.

    An override is a path of keys and list indices, and a YAML scalar or flow value. Raises CellFileError
    with all problems found, each at ``FILE:LINE:COLUMN`` or ``--set PATH``.
    """
    text = _read(path)
    try:
        context = {FOLDER: path.parent, MESHES_ARE_READ: meshes, BACKENDS_ARE_KNOWN: backends}
        return _load(path, text, overrides, context, instead)
    except RecursionError as error:
        raise CellFileError([Problem(str(path), "values are nested too deeply, in the file or with --set")]) from error


def _load(
    path: Path, text: str, overrides: Sequence[str], context: Mapping[str, Any], instead: Mapping[str, Any] | None
) -> CellFile:
    source = _Source(str(path), text)
    document = source.document()
    if instead is not None:
        _reach_through(document, instead)
    _, as_written = _checked(document, context)
    settings, refused = _apply(document, overrides)
    checked, findings = _checked(document, context)
    problems = [*source.key_problems(), *source.cited(findings, as_written, settings)]
    if problems or refused or checked is None:
        raise CellFileError([problem for _, problem in sorted(problems, key=lambda p: p[0])] + refused)
    if overrides or instead is not None:
        text = _dumped(document)
    return CellFile(checked.cell, checked.world, text, hashlib.sha256(text.encode()).hexdigest())


def _reach_through(document: CommentedMap, entry: Mapping[str, Any]) -> None:
    """Have all devices of the document be those of one backend; what is no device is left for the check to find."""
    name = str(entry["type"])
    document["backends"] = CommentedMap({name: CommentedMap(entry)})
    robots = document.get("robots")
    devices = [*(robots.values() if isinstance(robots, CommentedMap) else ()), document.get("camera")]
    for device in devices:
        if isinstance(device, CommentedMap):
            device["backend"] = name


def standing_alone(file: CellFile) -> tuple[str, dict[str, Path]]:
    """The text of a cell file for another folder, and which file each of the files that it needs there is a copy of.

    Meshes are named ``meshes/<hash of the content>.stl``, what backends read by its whole path; a text that names
    neither stays as it is.
    """
    copies: dict[str, Path] = {}
    document = _Source("cell.yaml", file.text).document()
    moved = False
    for name, entry in file.cell.backends.items():
        moved |= _name_whole_paths(document["backends"][name], dict(entry.checked))
    for name, fixture in file.cell.fixtures.items():
        if fixture.mesh is not None:
            original = Path(fixture.mesh.file)
            digest = hashlib.sha256(original.read_bytes()).hexdigest()
            own = f"meshes/{digest[:16]}{original.suffix.lower()}"
            copies[own] = original
            document["fixtures"][name]["mesh"]["file"] = own
    return (_dumped(document) if copies or moved else file.text), copies


def _name_whole_paths(options: Any, checked: Any) -> bool:
    """Have what backends read be named by its whole path, however deep in their options; says whether any was not."""
    moved = False
    written = range(len(options)) if isinstance(options, list) else options.keys()
    for place, value in enumerate(checked) if isinstance(checked, tuple) else checked.items():
        if place not in written:
            continue  # left out, so its default is no file
        if isinstance(value, Path) and options[place] != str(value):
            options[place] = str(value)
            moved = True
        elif isinstance(value, BaseModel):
            moved |= _name_whole_paths(options[place], dict(value))
        elif isinstance(value, tuple | dict):
            moved |= _name_whole_paths(options[place], value)
    return moved


def differences(used: str, given: str) -> str:
    """Where the text of one cell file says something else than the other's, as a diff; "" if all values are the same.

    Comments and layout do not count.
    """
    documents = [_Source("cell.yaml", text).document() for text in (used, given)]
    before, after = map(_plain, documents)
    if before == after:
        return ""
    old, new = (_dumped(document).splitlines() for document in documents)
    return "\n".join(difflib.unified_diff(old, new, "cell.yaml of the session", "as given", n=1, lineterm=""))


def cell_schema() -> dict[str, Any]:
    """The JSON Schema (2020-12) of a cell file, units and meanings in the descriptions.

    A file with one robot, which has no role, is of a cell of one arm.
    """
    documents, definitions = models_json_schema([(CellDocument, "validation"), (OneArmDocument, "validation")])
    two, one = (documents[model, "validation"] for model in (CellDocument, OneArmDocument))
    alone = {"maxProperties": 1, "additionalProperties": {"not": {"required": ["role"]}}}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **definitions,
        "if": {"properties": {"robots": alone}},
        "then": one,
        "else": two,
    }


@dataclass(frozen=True)
class _Finding:
    """Something wrong at a location; ``at_key``: with the key there rather than with its value."""

    location: Location
    what: str
    at_key: bool = False


def _checked(
    document: CommentedMap, context: Mapping[str, Any]
) -> tuple[CellDocument | OneArmDocument | None, list[_Finding]]:
    plain = _plain(document)
    model: type[CellDocument | OneArmDocument] = OneArmDocument if is_of_one_arm(plain) else CellDocument
    problems = one_arm_problems if model is OneArmDocument else reference_problems
    findings = [_Finding(*found) for found in problems(plain)]
    try:
        return model.model_validate(plain, context=dict(context)), findings
    except ValidationError as error:
        return None, findings + _in_words(error, model)


# The file and its line marks

_Position = tuple[int, int]
_MOST_ENTRIES = 100_000  # far beyond any cell; aliases of aliases can stand for more than a memory holds
_SET_LAST: _Position = (sys.maxsize, 0)


class _Source:
    """The file as written, for citing: its YAML nodes know their lines and columns."""

    def __init__(self, name: str, text: str) -> None:
        self._name = name
        self._text = text
        self._yaml = _round_trip()
        self._yaml.allow_duplicate_keys = True  # key_problems tells of all of them, with their places
        self._root = self._composed()
        self._check_size(self._root, [])

    def _composed(self) -> Node:
        try:
            root = self._yaml.compose(self._text)
        except MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            what = "; ".join(part for part in (error.context, error.problem) if part)
            raise CellFileError([self._problem(mark, f"is no YAML: {what}")[1]]) from error
        except ReaderError as error:
            position = _position(self._text, error.position)
            what = f"is no YAML: character {error.character:#04x} is not allowed"
            raise CellFileError([Problem(self._where(position), what)]) from error
        if root is None:
            raise CellFileError([Problem(self._where((1, 1)), "the file is empty")])
        if not isinstance(root, MappingNode):
            raise CellFileError([self._problem(root.start_mark, "must be a mapping of keys to values")[1]])
        return root

    def _check_size(self, node: Node, within: list[Node], size: int = 0) -> int:
        """Entries of a node with its aliases written out; CellFileError if one contains itself or all are too many."""
        for _, key, value in _children(node):
            size += 1
            if value in (*within, node):
                raise CellFileError([self._problem(key.start_mark, "the alias stands for what it is part of")[1]])
            if size > _MOST_ENTRIES:
                raise CellFileError([self._problem(key.start_mark, f"more than {_MOST_ENTRIES} values")[1]])
            size = self._check_size(value, [*within, node], size)
        return size

    def document(self) -> CommentedMap:
        """The document that keeps comments and layout; of a key given twice, the first; aliases are copies."""
        try:
            document: CommentedMap = self._yaml.constructor.construct_document(self._root)
        except ValueError as error:  # an impossible date, say
            raise CellFileError([Problem(self._name, f"is no YAML: {error}")]) from error
        _write_aliases_out(document, set())
        return document

    def key_problems(self) -> list[tuple[_Position, Problem]]:
        """Keys given twice and keys that are not text."""
        return [self._problem(mark, what) for mark, what in _key_problems(self._root, ())]

    def cited(
        self, findings: Sequence[_Finding], as_written: Sequence[_Finding], settings: Sequence[Location]
    ) -> Iterator[tuple[_Position, Problem]]:
        """Where to look for each finding: the file's line and column, or what was set if the file is not to blame."""
        for finding in findings:
            if finding in as_written:
                yield self._problem(self._mark(finding), _said(finding.location, finding.what))
                continue
            setting = _nearest(finding.location, settings)
            rest = () if setting == finding.location else finding.location
            yield _SET_LAST, Problem(f"--set {_dotted(setting)}", _said(rest, finding.what))

    def _mark(self, finding: _Finding) -> Any:
        """The mark of a finding; of what should hold it if its location does not exist."""
        node, mark = self._root, self._root.start_mark
        for part in finding.location:
            child = next((child for child in _children(node) if child[0] == part), None)
            if child is None:
                return mark
            mark, node = child[1].start_mark, child[2]
        return mark if finding.at_key else node.start_mark

    def _problem(self, mark: Any, what: str) -> tuple[_Position, Problem]:
        position = (mark.line + 1, mark.column + 1)
        return position, Problem(self._where(position), what)

    def _where(self, position: _Position) -> str:
        return f"{self._name}:{position[0]}:{position[1]}"


def _read(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CellFileError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        line, column = _position(data[: error.start].decode("utf-8"), error.start)
        what = f"is not UTF-8: byte {data[error.start]:#04x}"
        raise CellFileError([Problem(f"{path}:{line}:{column}", what)]) from error


def _position(text: str, index: int) -> _Position:
    before = text[:index]
    return before.count("\n") + 1, len(before) - (before.rfind("\n") + 1) + 1


def _children(node: Node) -> Iterator[tuple[Any, Node, Node]]:
    """(key or index, the node to cite for it, the value's node) for each entry of a node."""
    if isinstance(node, MappingNode):
        for key, value in node.value:
            yield key.value, key, value
    elif isinstance(node, SequenceNode):
        for index, value in enumerate(node.value):
            yield index, value, value


def _write_aliases_out(value: CommentedMap | CommentedSeq, seen: set[int]) -> None:
    """Give every place a value of its own, so that setting one does not change another."""
    entries = value.items() if isinstance(value, CommentedMap) else enumerate(value)
    for key, item in list(entries):
        if isinstance(item, CommentedMap | CommentedSeq):
            own = deepcopy(item) if id(item) in seen else item
            value[key] = own
            seen.add(id(own))
            _write_aliases_out(own, seen)


def _key_problems(node: Node, location: Location) -> Iterator[tuple[Any, str]]:
    first: dict[Any, int] = {}
    for part, key, value in _children(node):
        if isinstance(node, MappingNode) and key.tag != "tag:yaml.org,2002:str":
            yield key.start_mark, _said(location, "a key must be text")
            continue
        here = (*location, part)
        if part in first:
            yield key.start_mark, _said(here, f"duplicate key, first in line {first[part]}")
        first.setdefault(part, key.start_mark.line + 1)
        yield from _key_problems(value, here)


class _Constructor(RoundTripConstructor):
    """Numbers with an exponent as plain floats: ruamel's own come out changed in their last digits."""

    def construct_exact_float(self, node: Any) -> float:
        number: float = self.construct_yaml_float(node)
        return float(number) if "e" in node.value.lower() else number


_Constructor.add_constructor("tag:yaml.org,2002:float", _Constructor.construct_exact_float)


def _round_trip() -> YAML:
    yaml = YAML()
    yaml.Constructor = _Constructor
    yaml.preserve_quotes = True
    yaml.width = 1_000_000
    yaml.indent(mapping=2, sequence=4, offset=2)
    return yaml


def _dumped(document: CommentedMap) -> str:
    stream = StringIO()
    _round_trip().dump(document, stream)
    return stream.getvalue()


def _plain(value: Any) -> Any:
    """The document as plain dicts and lists, without keys that are not text."""
    if isinstance(value, CommentedMap):
        return {str(key): _plain(item) for key, item in value.items() if isinstance(key, str)}
    if isinstance(value, CommentedSeq):
        return [_plain(item) for item in value]
    return value


# Values set from the command line


def _apply(document: CommentedMap, overrides: Sequence[str]) -> tuple[list[Location], list[Problem]]:
    """Set what can be set; the locations set, and what is wrong with the others."""
    settings, refused = [], []
    for override in overrides:
        path, equals, text = override.partition("=")
        try:
            if not equals:
                raise ValueError("must read PATH=VALUE")
            settings.append(_set(document, path.split("."), _value(text)))
        except ValueError as error:
            refused.append(Problem(f"--set {path}", str(error)))
    return settings, refused


def _value(text: str) -> Any:
    try:
        node = YAML().compose(text)
        value = _round_trip().load(text)
    except YAMLError as error:
        raise ValueError(f"'{text}' is no YAML value") from error
    if isinstance(node, CollectionNode) and not node.flow_style:
        raise ValueError(f"'{text}' is no YAML scalar or flow value")
    return value


def _set(document: CommentedMap, path: Sequence[str], value: Any) -> Location:
    holder: Any = document
    location: Location = ()
    for part in path[:-1]:
        key = _key(holder, part, location)
        if isinstance(holder, CommentedMap) and holder.get(key) is None:
            _put(holder, key, CommentedMap())
        holder, location = holder[key], (*location, key)
    key = _key(holder, path[-1], location)
    _put(holder, key, value)
    return (*location, key)


def _key(holder: Any, part: str, location: Location) -> str | int:
    """``part`` as a key or index of ``holder``; ValueError if it can be neither."""
    if isinstance(holder, CommentedMap):
        return part
    if not isinstance(holder, CommentedSeq):
        raise ValueError(f"{_dotted(location)} is neither a mapping nor a list")
    if not re.fullmatch(r"[0-9]+", part) or int(part) >= len(holder):
        raise ValueError(f"{_dotted(location)} is a list of {len(holder)}: '{part}' is no index of it")
    return int(part)


def _put(holder: Any, key: str | int, value: Any) -> None:
    if isinstance(holder, CommentedMap) and key not in holder:
        # At the end it would slip behind the comment that introduces the next section.
        holder.insert(0, key, value)
    else:
        holder[key] = value


def _nearest(location: Location, settings: Sequence[Location]) -> Location:
    """The setting that has most of its path in common with ``location``; of several the last."""

    def in_common(setting: Location) -> int:
        same = (a == b for a, b in zip(setting, location, strict=False))
        return sum(1 for _ in takewhile(bool, same))

    return max(reversed(settings), key=in_common)


# In an operator's words

_WORDS = {
    "missing": "missing key",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "string_type": "must be text",
    "string_unicode": "must be text",
    "tuple_type": "must be a list",
    "dict_type": "must be a mapping",
    "model_type": "must be a mapping",
    "finite_number": "must be a finite number",
    "greater_than": "must be greater than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "literal_error": "must be {expected}",
    "too_short": "must have at least {min_length} entry, has {actual_length}",
    "too_long": "must have {max_length} entries, has {actual_length}",
    "value_error": "{error}",
}
_WORDS_ALONE = {"missing", "too_short", "too_long", "value_error"}


def _in_words(error: ValidationError, model: type[BaseModel]) -> list[_Finding]:
    findings = [_finding(details, model) for details in error.errors(include_url=False)]
    return list(dict.fromkeys(findings))  # a list short of two entries says so once


def _finding(details: ErrorDetails, model: type[BaseModel]) -> _Finding:
    location, kind = details["loc"], details["type"]
    if kind == "extra_forbidden":
        return _Finding(location, "unknown key" + _suggestion(location, model), at_key=True)
    if kind == "missing" and isinstance(location[-1], int):
        return _Finding(location[:-1], f"has too few entries: {len(details['input'])}")
    if kind not in _WORDS:
        return _Finding(location, details["msg"])
    words = _WORDS[kind].format(**details.get("ctx", {}))
    return _Finding(location, words if kind in _WORDS_ALONE else f"{words}, not {_seen(details['input'])}")


def _seen(value: Any) -> str:
    if isinstance(value, Mapping):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    if value is None:
        return "null"
    return repr(value) if isinstance(value, str | int | float) else str(value)


def _suggestion(location: Location, model: type[BaseModel]) -> str:
    near = difflib.get_close_matches(str(location[-1]), _known_keys(location[:-1], model), n=1)
    return f"; did you mean '{near[0]}'?" if near else ""


def _known_keys(location: Location, model: type[BaseModel]) -> list[str]:
    """The keys of the section at ``location``; none where the schema leaves them to a backend's options."""
    schema = model.model_json_schema()
    section = schema
    for part in location:
        inner = section.get("properties", {}).get(part) or section.get("items")
        further = section.get("additionalProperties")
        section = _resolved(schema, inner or (further if isinstance(further, dict) else {}))
    return list(section.get("properties", {}))


def _resolved(schema: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    for choice in part.get("anyOf", ()):
        if choice.get("type") != "null":
            return _resolved(schema, choice)
    if "$ref" in part:
        return dict(schema["$defs"][part["$ref"].rpartition("/")[2]])
    return part


def _dotted(location: Location) -> str:
    return ".".join(map(str, location))


def _said(location: Location, what: str) -> str:
    return f"{_dotted(location)}: {what}" if location else what
