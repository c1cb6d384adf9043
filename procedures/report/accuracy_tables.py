"""Tables of what a refined result is worth: rich renderables of at most 80 columns, nothing is printed here.

What a person at the cell needs comes first and is short; all of it is in ``result.json``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text
from scipy.special import chdtrc

from dualcal_hal.session.accuracy import (
    Accuracy,
    DirectionRecord,
    FoundSigmaRecord,
    KnownRecord,
    NoiseRecord,
    Verification,
)
from dualcal_hal.session.result import Result
from dualcal_hal.transforms import Array, vector_from_rotation

MOST_KNOWNS = 6
"""Inexact knowns that are shown, those found farthest off."""

MOST_HIDDEN = 3
"""Of what cannot be seen, the largest."""

MOST_TURNED = 4
"""Captures whose corners were listed from the other end that are named."""

_LEAST_TOLD = 1e-4  # a probability below it is not told more exactly

_UNITS = {"m": ("mm", 1e3), "rad": ("deg", float(np.degrees(1.0)))}


def accuracy_tables(result: Result, accuracy: Accuracy) -> Group:
    """Both transforms with their sigmas, the predicted error of a point, where it comes from, and what is doubtful."""
    parts: list[RenderableType] = [
        _transforms(result, accuracy),
        Text("\n".join(_transform_notes(accuracy))),
        "",
        Text("\n".join(_error_3d_words(accuracy))),
        "",
        _budget(accuracy),
        Text("Roots of sums over three axes; 3D error in the middle of the region."),
        "",
        Text("\n".join(_fit_words(accuracy))),
    ]
    if accuracy.found_noise is not None or accuracy.noise != accuracy.stated_noise:
        parts += ["", _noise(accuracy)]
    if accuracy.knowns:
        parts += ["", _knowns(accuracy.knowns)]
    if accuracy.cannot_be_seen:
        parts += ["", Text("\n".join(_hidden_words(accuracy)))]
    return Group(*parts)


def advice(accuracy: Accuracy, verification: Verification | None) -> Iterator[str]:
    """What is to be done: captures that would help, and what to look at where the result fails."""
    yield from (f"would help: {words}" for words in accuracy.would_help)
    if verification is not None and verification.look_at:
        yield "look next at, in this order:"
        yield from (f"{number}. {words}" for number, words in enumerate(verification.look_at, start=1))


# -- transforms --------------------------------------------------------------------------------------------------------


def _transforms(result: Result, accuracy: Accuracy) -> Table:
    table = _table("Transforms", "x\nmm", "y\nmm", "z\nmm", "rx\ndeg", "ry\ndeg", "rz\ndeg")
    for name, T in (("T_P_A", result.T_P_A), ("T_H_E", result.T_H_E)):
        table.add_row(name, *_pose(T), style="bold")
    table.add_section()
    for number, frame in enumerate(("base", "camera")):
        of_frame = accuracy.directions[6 * number : 6 * number + 6]
        table.add_row(f"sigma, {frame}", *(_sigma(direction) for direction in of_frame))
    for number, other in enumerate(accuracy.alternatives, start=2):
        table.add_section()
        table.add_row(f"T_P_A ({number})", *_pose(other.active_base_in_passive_base), style="yellow")
        table.add_row(f"T_H_E ({number})", *_pose(other.camera_in_active_flange), style="yellow")
    return table


def _sigma(direction: DirectionRecord) -> str:
    mark = "" if direction.observable else "*"
    if direction.sigma_mm is not None:
        return f"{direction.sigma_mm:.3f}{mark}"
    return f"{direction.sigma_deg:.4f}{mark}"


def _transform_notes(accuracy: Accuracy) -> Iterator[str]:
    yield "T_P_A: active_base_in_passive_base; T_H_E: camera_in_active_flange."
    yield "rx, ry, rz: rotation vector. sigma: in the axes of active base and camera."
    if not all(direction.observable for direction in accuracy.directions):
        limits = f"{accuracy.limits.translation_mm:g} mm or {accuracy.limits.rotation_deg:g} deg"
        yield f"* Not observable: a sigma above {limits}; not to be relied on."
    for number, other in enumerate(accuracy.alternatives, start=2):
        yield f"({number}): another solution, which costs {other.cost_ratio:.2f} times as much and may be the true one."


def _pose(T: ArrayLike) -> list[str]:
    T = np.asarray(T, dtype=float)
    return [*_cells(1e3 * T[:3, 3], 3), *_cells(np.degrees(vector_from_rotation(T[:3, :3])), 4)]


# -- error of a point --------------------------------------------------------------------------------------------------


def _error_3d_words(accuracy: Accuracy) -> Iterator[str]:
    space = accuracy.error_3d
    sides = (
        f"{letter} {low:.0f} to {high:.0f}"
        for letter, low, high in zip("xyz", space.region.low_mm, space.region.high_mm, strict=True)
    )
    yield f"Predicted 3D error of a point (95 %), where {space.required_mm:g} mm is required:"
    yield f"  in the region at most {space.p95_mm:.3f} mm (1 sigma: {space.rms_mm:.3f} mm)"
    if space.map.p95_mm:
        yield f"  over the shared workspace {min(space.map.p95_mm):.3f} to {max(space.map.p95_mm):.3f} mm"
    yield f"  region: {', '.join(sides)} mm in the passive base"


def _budget(accuracy: Accuracy) -> Table:
    headers = ("T_P_A\nmm", "T_P_A\ndeg", "T_H_E\nmm", "T_H_E\ndeg", "3D error\nmm")
    table = _table("Where the uncertainty comes from, 1 sigma", *headers)
    for part in sorted(accuracy.budget, key=lambda part: -part.error_mm):
        table.add_row(
            Text(part.input),
            f"{part.base_translation_mm:.3f}",
            f"{part.base_rotation_deg:.4f}",
            f"{part.camera_translation_mm:.3f}",
            f"{part.camera_rotation_deg:.4f}",
            f"{part.error_mm:.3f}",
        )
    return table


# -- how it fits -------------------------------------------------------------------------------------------------------


def _fit_words(accuracy: Accuracy) -> Iterator[str]:
    fit = accuracy.fit
    p = float(chdtrc(fit.degrees_of_freedom, fit.chi_square)) if fit.degrees_of_freedom > 0 else 1.0
    numbers = f"chi-square {fit.chi_square:.0f} of {fit.degrees_of_freedom}"
    chance = f"p {p:.2g}" if p >= _LEAST_TOLD else f"p < {_LEAST_TOLD:g}"
    if fit.scale > 1:
        yield f"Calibration captures do not fit the noise ({numbers}, {chance})."
    elif 1 - p < _LEAST_TOLD:
        yield f"Calibration captures fit better than the noise allows ({numbers}):"
        yield "some of it is less than stated; --noise estimate says which."
    else:
        yield f"Calibration captures fit the noise ({numbers}, {chance})."
    turned = [capture.id for capture in accuracy.captures if capture.turned]
    if turned:
        more = f" and {len(turned) - MOST_TURNED} more" if len(turned) > MOST_TURNED else ""
        yield f"Corners listed from the other end, and turned: {', '.join(turned[:MOST_TURNED])}{more}."
    if accuracy.found_noise is None and accuracy.noise == accuracy.stated_noise:
        noise = accuracy.noise
        joints = f"{noise.active_joint_mrad:.3g} and {noise.passive_joint_mrad:.3g} mrad"
        yield f"Noise as stated, 1 sigma: corners {noise.pixel_px:.3g} px, joints {joints}."


def _noise(accuracy: Accuracy) -> Table:
    table = _table("Noise, 1 sigma", "corners\npx", "active joints\nmrad", "passive joints\nmrad")
    table.add_row("stated", *_noise_cells(accuracy.stated_noise))
    if accuracy.found_noise is not None:
        found = {sigma.name: sigma for sigma in accuracy.found_noise}
        sigmas = [found[name] for name in NoiseRecord.model_fields]
        table.add_row("found", *(f"{sigma.value:.3g}" if sigma.identified else "-" for sigma in sigmas))
        table.add_row("  95 %", *(_interval(sigma) for sigma in sigmas))
    table.add_row("reckoned with", *_noise_cells(accuracy.noise))
    return table


def _interval(sigma: FoundSigmaRecord) -> str:
    return f"{sigma.lower:.3g} to {sigma.upper:.3g}" if sigma.identified else f"at most {sigma.upper:.3g}"


def _noise_cells(noise: NoiseRecord) -> list[str]:
    return [f"{getattr(noise, name):.3g}" for name in NoiseRecord.model_fields]


# -- knowns ------------------------------------------------------------------------------------------------------------


def _knowns(knowns: Sequence[KnownRecord]) -> Table:
    """Those that were found farthest off, and how many there are besides."""
    table = _table("Knowns that are not exact", "unit", "found\noff by", "sigma\nbefore", "sigma\nnow")
    ordered = sorted(knowns, key=_off, reverse=True)
    for known in ordered[:MOST_KNOWNS]:
        unit, scale = _UNITS.get(known.unit, (known.unit, 1.0))
        before = "free" if known.prior_sigma is None else f"{scale * known.prior_sigma:.3g}"
        now = f"{scale * known.sigma:.3g}" if known.seen else "not seen"
        table.add_row(Text(known.name), unit, f"{scale * known.value:z.3g}", before, now)
    left = ordered[MOST_KNOWNS:]
    if left:
        unseen = sum(not known.seen for known in left)
        which = f", {unseen} of them not seen" if unseen else ""
        table.caption = Text(f"and {len(left)} more{which}; all are in result.json")
    return table


def _off(known: KnownRecord) -> float:
    """In sigmas; what was free counts by what is known of it now."""
    sigma = known.sigma if known.prior_sigma is None else known.prior_sigma
    return abs(known.value) / sigma if sigma > 0 else 0.0


def _hidden_words(accuracy: Accuracy) -> Iterator[str]:
    yield "Cannot be seen in any capture, and puts a point off by:"
    ordered = sorted(accuracy.cannot_be_seen, key=lambda hidden: -hidden.error_mm)
    for hidden in ordered[:MOST_HIDDEN]:
        yield f"  {hidden.error_mm:.2f} mm: {hidden.by} of {hidden.what}"
    if len(ordered) > MOST_HIDDEN:
        yield f"  and {len(ordered) - MOST_HIDDEN} more, all of them in result.json"


# -- layout ------------------------------------------------------------------------------------------------------------


def _table(title: str, *headers: str) -> Table:
    table = Table(title=Text(title), box=box.SIMPLE_HEAD, title_justify="left", caption_justify="left", pad_edge=False)
    table.add_column("", overflow="fold")
    for header in headers:
        table.add_column(header, justify="left" if header == "unit" else "right")
    return table


def _cells(values: Array, digits: int) -> list[str]:
    return [f"{value:z.{digits}f}" for value in values]
