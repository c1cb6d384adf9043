"""Plain JSON that nobody vouches for, as it is read: what is not of the kind that is asked for is a ValueError.

What a recording or a journal says is believed in its kind here and nowhere later: numbers are finite, lists as long
as they must be, names those that there are.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Self

DEEPEST = 32
"""Lists and objects within each other; what this program writes has less than half of that."""

LARGEST = 1e9
"""Of any number in the units of a record: no arm has an angle, and no run a time, that is larger."""

SPECIAL = ("nan", "inf", "-inf")
"""Numbers that JSON does not have, as they are written."""

_LARGEST_WHOLE = (1 << 63) - 1
_MOST_DIGITS = 20
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def parse(data: bytes) -> Any:
    """The value of a JSON text in UTF-8; ValueError for anything else.

    Refused are NaN and infinities, numbers beyond what a float or 64 bits hold, text that is no Unicode, such as half a
    surrogate pair, and nesting without end.
    """
    text = data.decode("utf-8")
    try:
        value = json.loads(text, parse_constant=_refuse_constant, parse_int=_whole, parse_float=_float)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    _require_shallow(value)
    if _SURROGATE.search(text):
        try:
            json.dumps(value, ensure_ascii=False).encode()
        except UnicodeEncodeError:
            raise ValueError("a text in it is no Unicode: half a surrogate pair") from None
    return value


def _refuse_constant(constant: str) -> float:
    raise ValueError(f"{constant} is no JSON")


def _whole(digits: str) -> int:
    if len(digits) > _MOST_DIGITS:
        raise ValueError(f"a whole number of {len(digits)} digits is too large")
    return int(digits)


def _float(digits: str) -> float:
    number = float(digits)
    if not math.isfinite(number):
        raise ValueError("a number is too large")
    return number


def _require_shallow(value: Any) -> None:
    level = [value]
    for _ in range(DEEPEST + 1):
        level = [below for each in level for below in _below(each) if isinstance(below, dict | list)]
        if not level:
            return
    raise ValueError("it is nested too deeply")


def _below(value: Any) -> Iterable[Any]:
    return value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()


@dataclass
class Fields:
    """A JSON object whose members are asked for by name and kind. Every method raises ValueError for another kind."""

    content: Any
    _where: str = field(default="the record")

    def __post_init__(self) -> None:
        if not isinstance(self.content, dict):
            raise ValueError(f"{self._where} is no JSON object")

    def __contains__(self, name: str) -> bool:
        return name in self.content

    def any(self, name: str) -> Any:
        if name not in self.content:
            raise ValueError(f"{self._where} has no {name!r}")
        return self.content[name]

    def choice(self, name: str, choices: Iterable[str]) -> str:
        """One of these texts."""
        text = self.text(name)
        if text not in choices:
            raise ValueError(f"{name} is none of those that there are: {text[:60]!r}")
        return text

    def is_null(self, name: str) -> bool:
        return self.any(name) is None

    def text(self, name: str) -> str:
        text: str = expect(self.any(name), str, name)
        return text

    def flag(self, name: str) -> bool:
        flag: bool = expect(self.any(name), bool, name)
        return flag

    def whole(self, name: str) -> int:
        value = self.any(name)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= _LARGEST_WHOLE:
            raise ValueError(f"{name} is no whole number from 0 up")
        return value

    def finite(self, name: str) -> float:
        """A number as this program has them: finite, and no larger than any quantity is."""
        return finite(self.any(name), name)

    def finites(self, name: str, count: int | None = None) -> tuple[float, ...]:
        """A list of such numbers, as many as ``count``, else at least one."""
        return finites(self.any(name), name, count)

    def joints(self, name: str) -> tuple[float, ...]:
        """A list of such numbers, none of a stand."""
        return tuple(finite(each, name) for each in self.items(name))

    def items(self, name: str) -> list[Any]:
        return list(expect(self.any(name), list, name))

    def texts(self, name: str) -> tuple[str, ...]:
        return tuple(expect(each, str, name) for each in self.items(name))

    def part(self, name: str) -> Self:
        return type(self)(self.any(name), name)

    def part_or_none(self, name: str) -> Self | None:
        return None if self.is_null(name) else self.part(name)

    def parts(self, name: str) -> Iterator[Self]:
        """Of a list of objects."""
        for number, each in enumerate(self.items(name)):
            yield type(self)(each, f"{name}[{number}]")


def expect(value: Any, kind: type[Any], name: str) -> Any:
    """The value, if it is of that kind of JSON."""
    # What was not read from anywhere has tuples where a file has lists.
    if not isinstance(value, list | tuple if kind is list else kind):
        raise ValueError(f"{name} is no {_KIND_NAMES[kind]}")
    return value


_KIND_NAMES: dict[type[Any], str] = {str: "text", bool: "true or false", list: "list", dict: "object"}


def finite(value: Any, name: str) -> float:
    """As :meth:`Fields.finite`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST:
        raise ValueError(f"{name} is no finite number")
    return float(value)


def finites(value: Any, name: str, count: int | None = None) -> tuple[float, ...]:
    """As :meth:`Fields.finites`."""
    values = expect(value, list, name)
    if len(values) != count if count is not None else not values:
        raise ValueError(f"{name} is no list of {count or 'at least one'}")
    return tuple(finite(each, name) for each in values)


def number_in_text(value: Any, name: str) -> float:
    """A number that may be none: NaN and infinities are text in JSON."""
    if isinstance(value, str) and value in SPECIAL:
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{name} is no number")
    return float(value)
