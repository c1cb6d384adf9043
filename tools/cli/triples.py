"""``dualcal estimate`` on pose triples, which need no cell."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from dualcal_hal.errors import FormatError, Problem, UsageError
from dualcal_hal.session.files import read_object
from dualcal_hal.session.plain import finite
from dualcal_hal.session.triples import PoseTriples, read_triples
from dualcal_hal.session.triples_result import write_triples_result
from dualcal_hal.transforms import Array
from procedures.estimation.triples import TripleNoise
from procedures.report import triples_tables
from procedures.triples_analysis import analyse_triples
from tools.cli.terminal import Screen

_KIND = "dualcal.triples/"  # of any version: the reader tells which it reads


@dataclass(frozen=True)
class TriplesOptions:
    """What the command line says; sigmas: by A, B, C as they were typed, None for what is left to the file."""

    triples: Path
    sigmas: Mapping[str, str | None]
    out: Path | None
    json: bool


def holds_triples(path: Path) -> bool:
    """Whether a file is to be read as triples: CSV by its ending, JSON by its format; FormatError for broken JSON."""
    if not path.is_file():
        return False
    if path.suffix.lower() == ".csv":
        return True
    document = read_object(path)
    kind = document.get("format")
    return "triples" in document if kind is None else str(kind).startswith(_KIND)


def estimate_from_triples(options: TriplesOptions) -> None:
    """Print what the triples say and write it where asked; ``out`` has been checked."""
    typed = {name: _sigmas(name, text) for name, text in options.sigmas.items() if text is not None}
    triples = read_triples(options.triples)
    noise = _noise(options.triples, triples, typed)
    stated_in = {name: "option" if name in typed else "file" for name in "ABC"}
    result = analyse_triples(triples, noise, stated_in)
    if options.out is not None:
        try:
            write_triples_result(options.out, result)
        except OSError as error:
            raise UsageError(f"{options.out}: cannot be written: {error.strerror}") from error
    console = Screen(stderr=options.json)
    if options.json:
        typer.echo(json.dumps(result.to_document(), indent=1, allow_nan=False))
    else:
        console.print(triples_tables(result), highlight=False)
    if options.out is None:
        console.print("Not written to a file; --out FILE does that.")


def _sigmas(name: str, text: str) -> Array:
    """Covariance (6, 6) from ``MM,DEG``."""
    try:
        mm, deg = (finite(float(part), "a sigma") for part in text.split(","))
    except ValueError:
        mm = deg = -1.0
    if min(mm, deg) < 0:
        raise UsageError(f"{_option(name)} {text}: must be MM,DEG, two numbers from 0 up such as 0.5,0.1")
    return np.diag(np.repeat(np.square([1e-3 * mm, np.radians(deg)]), 3))


def _noise(path: Path, triples: PoseTriples, typed: Mapping[str, Array]) -> TripleNoise:
    """What is typed goes before what the file has."""
    stated = {name: typed.get(name, triples.covariances[name]) for name in "ABC"}
    known = {name: covariance for name, covariance in stated.items() if covariance is not None}
    if missing := [name for name in stated if name not in known]:
        options = " ".join(f"{_option(name)} MM,DEG" for name in missing)
        raise UsageError(
            f"{path}: does not say how exact the poses of {', '.join(missing)} are; give {options}, the sigma per axis"
            " (0,0 for an exact A or C), or write it into the file"
        )
    try:
        return TripleNoise(**known)
    except ValueError as error:
        if "B" in typed:
            raise UsageError(f"{_option('B')}: {error}") from error
        raise FormatError([Problem(str(path), str(error))]) from error


def _option(name: str) -> str:
    return f"--sigma-{name.lower()}"
