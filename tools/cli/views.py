"""``dualcal estimate`` on photographs with flange poses, which need no cell."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from dualcal_hal.errors import UsageError
from dualcal_hal.session.files import read_object
from dualcal_hal.session.plain import finite
from dualcal_hal.session.views import ViewsFile, read_views
from dualcal_hal.session.views_result import write_views_result
from procedures.report.views_tables import views_tables
from procedures.views_analysis import PIXEL, ROTATION, TRANSLATION, StatedNoise, ViewsChoices, analyse_views, look_at
from tools.cli.terminal import Screen

_KIND = "dualcal.views/"  # of any version: the reader tells which it reads

FREE = ("intrinsics",)
"""What may be left to the views; the target's place is sought anyway."""


@dataclass(frozen=True)
class ViewsOptions:
    """What the command line says; sigma_flange and sigma_pixel: as typed, None where they are not."""

    views: Path
    noise: str | None
    sigma_flange: str | None
    sigma_pixel: float | None
    keep_all: bool
    free: Sequence[str]
    out: Path | None
    json: bool


def holds_views(path: Path) -> bool:
    """Whether a JSON file is to be read as views, by its format or what it has; FormatError for broken JSON."""
    if not path.is_file() or path.suffix.lower() == ".csv":
        return False
    document = read_object(path)
    kind = document.get("format")
    return "views" in document if kind is None else str(kind).startswith(_KIND)


def estimate_from_views(options: ViewsOptions) -> None:
    """Print what the photographs say and write it where asked, with pictures beside it."""
    choices = _choices(options)
    file = read_views(options.views)
    pictures = _pictures(options.out, file)
    console = Screen(stderr=options.json)
    seen = look_at(file)
    console.print(
        f"{seen.corners} corners detected in {seen.with_target} of {len(seen.images)} images", highlight=False
    )
    result = analyse_views(file, seen, choices)
    if options.out is not None:
        from procedures.report.views import draw_residuals, draw_views

        try:
            write_views_result(options.out, result)
            draw_residuals(pictures[0], result)
            draw_views(pictures[1], result, seen.images)
        except OSError as error:
            raise UsageError(f"{options.out}: cannot be written: {error.strerror}") from error
    if options.json:
        typer.echo(json.dumps(result.to_document(), indent=1, allow_nan=False))
    else:
        console.print(views_tables(result), highlight=False)
    if options.out is None:
        console.print("Not written to a file; --out FILE does that, with pictures.")
    else:
        console.print(f"Written: {', '.join(map(str, (options.out, *pictures)))}", highlight=False, soft_wrap=True)


def _choices(options: ViewsOptions) -> ViewsChoices:
    if unknown := [name for name in options.free if name not in FREE]:
        raise UsageError(f"--free {unknown[0]}: of views only {', '.join(FREE)} can be left to them")
    stated = options.noise == "stated" or (options.noise is None and options.sigma_flange is not None)
    if stated and options.sigma_flange is None:
        raise UsageError("--noise stated: needs --sigma-flange MM,DEG, how exact the flange poses are")
    translation, rotation = TRANSLATION, ROTATION
    if options.sigma_flange is not None:
        translation, rotation = _sigmas(options.sigma_flange)
    pixel = PIXEL if options.sigma_pixel is None else options.sigma_pixel
    if not 0 < pixel <= 100:
        raise UsageError(f"--sigma-pixel {pixel:g}: must be above 0 px, and at most 100")
    return ViewsChoices(
        StatedNoise(pixel, translation, rotation), not stated, "intrinsics" in options.free, options.keep_all
    )


def _sigmas(text: str) -> tuple[float, float]:
    """m and rad from ``MM,DEG``."""
    try:
        mm, deg = (finite(float(part), "a sigma") for part in text.split(","))
    except ValueError:
        mm = deg = -1.0
    if min(mm, deg) <= 0:
        raise UsageError(f"--sigma-flange {text}: must be MM,DEG, two numbers above 0 such as 0.5,0.05")
    return 1e-3 * mm, float(np.radians(deg))


def _pictures(out: Path | None, file: ViewsFile) -> tuple[Path, ...]:
    """Where residuals and views are drawn; UsageError if an image of the views is there, or at ``out``."""
    if out is None:
        return ()
    pictures = tuple(out.with_name(f"{out.stem}-{what}.png") for what in ("residuals", "views"))
    for written in (out, *pictures):
        if written.exists() and any(written.samefile(view.image) for view in file.views):
            raise UsageError(f"{written}: is one of the images; name another file with --out")
    return pictures
