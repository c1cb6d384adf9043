"""Files that are either there whole or not at all, and documents that say what they are."""

from __future__ import annotations

import json
import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dualcal_hal.errors import FormatError, Problem


def write_atomically(path: Path, content: bytes) -> None:
    """Replace ``path`` by ``content``, durably; after a crash there is the old file or the new one, never a part."""
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)  # a full disk does not say which file found no room
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def write_document(path: Path, document: dict[str, Any]) -> None:
    """Write a JSON document atomically; ValueError for NaN and infinities, which JSON does not have."""
    write_atomically(path, document_bytes(document))


def document_bytes(document: Mapping[str, Any]) -> bytes:
    """A JSON document as it is kept; ValueError for NaN and infinities."""
    return json.dumps(document, indent=1, allow_nan=False).encode() + b"\n"


def read_document(path: Path, expected_format: str) -> dict[str, Any]:
    """A JSON object whose ``format`` is ``expected_format``, else FormatError. NaN and infinities are let through."""
    document = read_object(path)
    found = document.get("format")
    if found != expected_format:
        what = "key 'format' is missing" if found is None else f"format {found!r} is not known"
        raise FormatError([Problem(str(path), f"{what}; this version reads {expected_format!r}")])
    return document


def read_object(path: Path) -> dict[str, Any]:
    """A JSON object, else FormatError."""
    try:
        document = json.loads(path.read_bytes(), object_pairs_hook=_without_duplicates)
    except OSError as error:
        raise FormatError([Problem(str(path), f"cannot be read: {error.strerror}")]) from error
    except (ValueError, RecursionError) as error:
        raise FormatError([Problem(str(path), f"is not JSON: {error}")]) from error
    if not isinstance(document, dict):
        raise FormatError([Problem(str(path), "is not a JSON object")])
    return document


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(f"key {next(name for name in names if names.count(name) > 1)!r} is given twice")
    return entries
