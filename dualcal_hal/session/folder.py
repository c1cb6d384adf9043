"""The folder of a run."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from dualcal_hal.camera import Image
from dualcal_hal.errors import FormatError, UsageError
from dualcal_hal.session.files import read_document, read_object, write_atomically, write_document
from dualcal_hal.session.images import decode, encode_png
from dualcal_hal.session.journal import Journal

CELL_FILE = "cell.yaml"


class Session:
    """``cell.yaml`` as used, ``plan.json``, ``journal.jsonl``, ``captures.json``, ``images/``, ``result.json``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.journal = Journal(folder / "journal.jsonl")

    @classmethod
    def create(
        cls, folder: Path, cell_text: str, started: str | None = None, copies: Mapping[str, Path] | None = None
    ) -> Self:
        """A new session, begun at a time (ISO 8601), in an empty or not yet existing folder, else UsageError.

        copies: files that the cell file needs, by their paths in the session.
        """
        try:
            if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
                raise UsageError(f"{folder}: exists and is not an empty folder; name another with --out")
            (folder / "images").mkdir(parents=True)
            for name, original in (copies or {}).items():
                (folder / name).parent.mkdir(exist_ok=True)
                write_atomically(folder / name, original.read_bytes())
            write_atomically(folder / CELL_FILE, cell_text.encode())
            session = cls(folder)
            session.journal.begin(started)
        except OSError as error:
            raise UsageError(f"{folder}: cannot be written: {error.strerror}") from error
        return session

    def go_on(self, now: str) -> None:
        """Have all be there that a run writes into, also what was lost; ``now`` (ISO 8601) if nothing was begun."""
        self._images.mkdir(exist_ok=True)
        self.journal.begin(now)

    @property
    def _images(self) -> Path:
        return self.folder / "images"

    @property
    def started(self) -> str | None:
        """When the run was begun first (ISO 8601), None if nothing tells."""
        if self.journal.started is None and self.captures_path.exists():
            with suppress(FormatError):
                return read_object(self.captures_path).get("started")
        return self.journal.started

    @property
    def cell_path(self) -> Path:
        return self.folder / CELL_FILE

    @property
    def captures_path(self) -> Path:
        return self.folder / "captures.json"

    @property
    def result_path(self) -> Path:
        return self.folder / "result.json"

    @property
    def summary_path(self) -> Path:
        return self.folder / "summary.png"

    def image_path(self, name: str) -> Path:
        """Where the image of a capture or look is kept."""
        return self._images / f"{name.replace('/', '-')}.png"

    def write_image(self, name: str, image: Image) -> None:
        """Store an image losslessly and durably."""
        write_atomically(self.image_path(name), encode_png(image))

    def read_image(self, name: str) -> Image:
        """An image as it was stored; UsageError if it is not there."""
        path = self.image_path(name)
        try:
            return decode(path.read_bytes(), "png")
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise UsageError(f"{path}: there is no readable image: {why}") from error

    def read_document(self, file_name: str, expected_format: str) -> dict[str, Any]:
        """A JSON document of the session; FormatError if it is none of that format."""
        return read_document(self.folder / file_name, expected_format)

    def write_document(self, file_name: str, document: dict[str, Any]) -> None:
        """Store a JSON document durably, all of it or nothing."""
        write_document(self.folder / file_name, document)
