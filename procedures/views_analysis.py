"""From photographs with flange poses to a result. No device, no cell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import cv2
import numpy as np

from dualcal_hal.camera import Image, Intrinsics
from dualcal_hal.errors import DegenerateCaptures, FormatError, Problem
from dualcal_hal.session.images import require_bearable
from dualcal_hal.session.triples_result import Found
from dualcal_hal.session.views import View, ViewsFile
from dualcal_hal.session.views_result import (
    Attempt,
    NoiseUsed,
    PlacementFound,
    Predicted,
    Residue,
    ViewResult,
    ViewsResult,
)
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, Mask, inverse
from procedures.detection import Detection, Detector, Missed
from procedures.estimation import Degenerate
from procedures.estimation.refined.as_read import fit_as_read
from procedures.estimation.refined.breakdown import FREE_LENS, break_down
from procedures.estimation.refined.data import Indices
from procedures.estimation.refined.inexact import Inexact
from procedures.estimation.refined.left_out import LeftOut, leave_one_out
from procedures.estimation.refined.motion import logarithm
from procedures.estimation.refined.one_arm import FlangePoses, OneArm, Placement, Views, one_arm
from procedures.views_verdict import verdict_of

PIXEL = 0.1
"""px: sigma of a corner, where none is stated and as long as none is found."""
TRANSLATION, ROTATION = 1e-3, 1e-3
"""m and rad: of a flange pose, as long as none is found; what is found keeps their ratio."""

_MOST_FOR_PLACEMENT = 24  # views that are asked for it
_ROUGH_PIXEL = 1.0  # px: of the first fit
_LEAST_PIXEL, _LEAST_ROTATION = 0.01, 1e-5  # px and rad, from where noise is sought
_TELLS = 3.0  # times that the corners must be farther off with the other placement
_BETTER = 0.9  # of left-out errors: below, the arm is taken where it was read
_MOST_BYTES = 200_000_000

AS_READ, WITH_ERRORS = "as read", "with errors"


@dataclass(frozen=True)
class StatedNoise:
    """Sigmas per axis: of a corner, px, and of a flange pose, m and rad."""

    pixel: float
    translation: float
    rotation: float


@dataclass(frozen=True)
class ViewsChoices:
    """estimate_noise: the sigmas are those that the views show; of what is stated, flange poses keep the ratio of both.
    free_intrinsics: focal lengths, centre and distortion are estimated too. keep_all: no view is dropped.
    """

    noise: StatedNoise = StatedNoise(PIXEL, TRANSLATION, ROTATION)
    estimate_noise: bool = True
    free_intrinsics: bool = False
    keep_all: bool = False

    @property
    def inexact(self) -> Sequence[Inexact]:
        return FREE_LENS if self.free_intrinsics else ()


@dataclass(frozen=True, eq=False)
class Seen:
    """Images of the views, and what was found in them; size: of all images, px."""

    images: tuple[Image, ...]
    outcomes: tuple[Detection | Missed, ...]
    size: tuple[int, int]

    @property
    def corners(self) -> int:
        return sum(int(found.seen.sum()) for found in self.outcomes if isinstance(found, Detection))

    @property
    def with_target(self) -> int:
        """Images that show the target."""
        return sum(isinstance(found, Detection) for found in self.outcomes)


def look_at(file: ViewsFile) -> Seen:
    """Detect the target in all images; FormatError for what is no image, or of another size than the camera's."""
    images: list[Image] = []
    problems = []
    for view in file.views:
        try:
            images.append(_read_image(view))
        except ValueError as error:
            problems.append(Problem(str(view.image), str(error)))
    if problems:
        raise FormatError(problems)
    height, width = images[0].shape
    size = (width, height) if file.intrinsics.size == (0, 0) else file.intrinsics.size
    if problems := list(_other_sizes(file, images, size)):
        raise FormatError(problems)
    detector = Detector(file.board, size)
    return Seen(tuple(images), tuple(detector.detect(image) for image in images), size)


def _other_sizes(file: ViewsFile, images: Sequence[Image], size: tuple[int, int]) -> Iterator[Problem]:
    """Told once where it is the camera's that is another, as all images have one."""
    shapes = {image.shape for image in images}
    if len(shapes) == 1 and size[::-1] not in shapes:
        height, width = images[0].shape
        yield Problem(
            str(file.path), f"camera.size_px: is {size[0]} x {size[1]}, all images have {width} x {height} px"
        )
        return
    of = "the camera's size_px is" if file.intrinsics.size == size else "the first one has"
    for view, image in zip(file.views, images, strict=True):
        if image.shape != size[::-1]:
            said = f"has {image.shape[1]} x {image.shape[0]} px, {of} {size[0]} x {size[1]}"
            yield Problem(str(view.image), said)


def _read_image(view: View) -> Image:
    """Grey, as the sensor has it: not turned as a note in the file may ask for."""
    if view.image.stat().st_size > _MOST_BYTES:
        raise ValueError(f"is larger than {_MOST_BYTES} bytes")
    try:
        image = cv2.imread(str(view.image), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise ValueError(f"is no image that can be read: {error.err}") from error
    if image is None:
        raise ValueError("is no image that can be read")
    require_bearable(image.shape[1], image.shape[0])
    return np.asarray(image, dtype=np.uint8)


def analyse_views(file: ViewsFile, seen: Seen, choices: ViewsChoices) -> ViewsResult:
    """Estimate from what was found in the images; DegenerateCaptures for views that do not determine the transforms."""
    if not seen.with_target:
        raise DegenerateCaptures(
            f"{file.path}: the target is in none of {len(seen.images)} images"
            f" ({file.views[0].name}: {seen.outcomes[0]});"
            " see that target.kind, squares and dictionary are those of the board"
        )
    views = _views(file, seen)
    try:
        placement, views, rough = _placed(file, views)
        if choices.keep_all:
            rough = replace(rough, used=np.asarray(np.any(views.seen, axis=1)), dropped=())
        fits = dict(_fits(views, file.flanges, rough, choices))
        left_out = {name: leave_one_out(views, fit, choices.inexact) for name, fit in fits.items()}
    except Degenerate as error:
        raise DegenerateCaptures(f"{file.path}: the views do not tell where camera and target are: {error}") from error
    attempts = {name: _attempt(fit, left_out[name], rough.used) for name, fit in fits.items()}
    best = min(fits, key=lambda name: attempts[name].left_out_px * (1.0 if name == WITH_ERRORS else 1 / _BETTER))
    residue = Residue(**asdict(break_down(views, fits[best])))
    fit, moved = fits[best], None
    if not choices.free_intrinsics and _lens_is_off(residue):
        fit, moved = _reckoned_with_lens(views, rough, fit)
    scale = 1.0 if choices.estimate_noise else fit.scale
    result = _result(file, seen, choices, placement, views, fit, left_out[best], residue)
    result = replace(result, attempts=attempts, moved_by_lens=moved)
    verdict, reasons = verdict_of(result, scale)
    return replace(result, verdict=verdict, reasons=reasons)


def _fits(views: Views, flanges: Array, rough: OneArm, choices: ViewsChoices) -> Iterator[tuple[str, OneArm]]:
    """By what is supposed of the flange poses; the most likely fit begins with the lens and the noise of the other."""
    read = fit_as_read(views, rough, choices.inexact)
    noise = choices.noise
    if choices.estimate_noise:
        yield AS_READ, read
        rotation = max(read.arm_sigma, _LEAST_ROTATION)
        lever = noise.translation / noise.rotation
        noise = StatedNoise(max(read.pixel_sigma, _LEAST_PIXEL), lever * rotation, rotation)
    begun = replace(
        views,
        arm=FlangePoses(flanges, noise.translation, noise.rotation),
        matrix=read.matrix,
        distortion=read.distortion,
    )
    try:
        likely = one_arm(
            begun,
            rough.placement,
            noise.pixel,
            keep_all=choices.keep_all,
            estimate_noise=choices.estimate_noise,
            inexact=choices.inexact,
        )
    except Degenerate:
        if not choices.estimate_noise:
            raise
        return  # errors as large as the views would need leave nothing that could be told
    yield WITH_ERRORS, likely


def _lens_is_off(residue: Residue) -> bool:
    """Whether the lens explains more of the residuals than the arm, which a wrong lens hides behind."""
    shares = residue.shares
    return "arm" in shares and shares["lens"] > shares["arm"]


def _reckoned_with_lens(views: Views, rough: OneArm, fit: OneArm) -> tuple[OneArm, float | None]:
    """The fit with a covariance that has by how much it moves as the lens is left to the images, and by how much the
    camera then moves, m; None where that cannot be told.
    """
    try:
        freed = fit_as_read(views, rough, FREE_LENS)
    except Degenerate:
        return fit, None
    off = np.concatenate([logarithm(fit.camera, freed.camera), logarithm(fit.target, freed.target)])
    of_lens = np.outer(off, off)
    fit = replace(fit, covariance=fit.covariance + of_lens, contributions={**fit.contributions, "lens": of_lens})
    return fit, float(np.linalg.norm(freed.camera[:3, 3] - fit.camera[:3, 3]))


def _views(file: ViewsFile, seen: Seen) -> Views:
    corners = len(file.board.corners)
    nothing = np.full((corners, 2), np.nan)
    pixels = np.stack([found.corners if isinstance(found, Detection) else nothing for found in seen.outcomes])
    order_known = np.array([not isinstance(found, Detection) or found.order_known for found in seen.outcomes])
    if not order_known.any() or not np.isfinite(pixels[order_known]).any():
        # Turned by half a turn in all views it is the same board: the best one seen says which way up it is.
        order_known[np.argmax(np.isfinite(pixels[..., 0]).sum(axis=1))] = True
    return Views(
        arm=FlangePoses(file.flanges, TRANSLATION, ROTATION),
        pixels=pixels,
        corners=file.board.corners,
        matrix=file.intrinsics.matrix,
        distortion=file.intrinsics.distortion,
        order_known=order_known,
    )


def _placed(file: ViewsFile, views: Views) -> tuple[PlacementFound, Views, OneArm]:
    """As the file states it, else the one with which the corners are far less off; the views with their corners in
    order, and a first fit whose noise is so large that a wrong lens makes no view doubtful.
    """
    if file.placement is not None:
        return PlacementFound(file.placement, True, None), *_first_fit(file, views, Placement(file.placement))
    some = _only(views, np.unique(np.linspace(0, len(views) - 1, _MOST_FOR_PLACEMENT).astype(int)))
    off: dict[Placement, float] = {}
    reasons: dict[Placement, Degenerate] = {}
    for placement in Placement:
        try:
            off[placement] = _typically_off(_first_fit(file, some, placement)[1])
        except Degenerate as error:
            reasons[placement] = error
    if not off:
        raise next(iter(reasons.values()))
    best, *others = sorted(off, key=lambda placement: off[placement])
    ratio = off[others[0]] / off[best] if others else None
    if ratio is not None and ratio < _TELLS:
        raise Degenerate(
            "whether the camera is on the arm or stays beside it does not show; write "
            f'"placement": "{Placement.ON_ARM}" or "{Placement.FIXED}" into the file'
        )
    return PlacementFound(best.value, False, ratio), *_first_fit(file, views, best)


def _first_fit(file: ViewsFile, views: Views, placement: Placement) -> tuple[Views, OneArm]:
    board = file.board
    if isinstance(board, Checkerboard) and board.rows == board.columns:
        views = _by_quarters(views, board.rows, placement)
    return views, one_arm(views, placement, _ROUGH_PIXEL)


def _by_quarters(views: Views, side: int, placement: Placement) -> Views:
    """With the corners of a square board listed from the same side in all views.

    Each view is taken twice, as it is and turned by a quarter, but for the one that says where the first side is; those
    that agree with each other are the ones in order.
    """
    listed = views.pixels.reshape(len(views), side, side, 2)
    turned = replace(views, pixels=np.rot90(listed, axes=(1, 2)).reshape(views.pixels.shape))
    first = int(np.argmax(views.seen.sum(axis=1)))
    twice = np.concatenate([np.arange(len(views)), np.delete(np.arange(len(views)), first)])
    both = _only(views, twice)
    both.pixels[len(views) :] = turned.pixels[twice[len(views) :]]
    fit = one_arm(both, placement, _ROUGH_PIXEL)
    fits = np.delete(fit.used[: len(views)], first) < fit.used[len(views) :]
    better = np.zeros(len(views), dtype=bool)
    better[twice[len(views) :]] = fits
    return replace(views, pixels=np.where(better[:, None, None], turned.pixels, views.pixels))


def _only(views: Views, chosen: Indices) -> Views:
    assert isinstance(views.arm, FlangePoses)
    assert views.order_known is not None
    arm = replace(views.arm, flange=views.arm.flange[chosen])
    return replace(views, arm=arm, pixels=views.pixels[chosen], order_known=views.order_known[chosen])


def _typically_off(fit: OneArm) -> float:
    """px: the median over all views, used or not, of a corner's distance in each axis."""
    seen = np.isfinite(fit.residuals).any(axis=(1, 2))
    return float(np.median(np.sqrt(np.nanmean(fit.residuals[seen] ** 2, axis=(1, 2))))) + 1e-3


def _attempt(fit: OneArm, left_out: LeftOut, used: Mask) -> Attempt:
    """Over the same views (k,) for all."""
    pixels, metres = (values[used] for values in left_out.rms())
    rms = float(np.sqrt(np.nanmean(fit.residuals[used] ** 2)))
    return Attempt(rms, float(np.sqrt(np.mean(pixels**2))), float(np.sqrt(np.mean(metres**2))))


def _result(
    file: ViewsFile,
    seen: Seen,
    choices: ViewsChoices,
    placement: PlacementFound,
    views: Views,
    fit: OneArm,
    left_out: LeftOut,
    residue: Residue,
) -> ViewsResult:
    found = fit.found
    lever = choices.noise.translation / choices.noise.rotation
    row, column = divmod(file.board.feature, file.board.columns)
    given = replace(file.intrinsics, size=seen.size)
    return ViewsResult(
        placement=placement,
        transforms={name: Found(T, fit.covariance_of(name)) for name, T in fit.transforms.items()},
        covariance=fit.covariance,
        poses=AS_READ if fit.as_read else WITH_ERRORS,
        attempts={},
        noise=NoiseUsed(
            fit.pixel_sigma,
            lever * fit.arm_sigma,
            fit.arm_sigma,
            choices.estimate_noise,
            {}
            if found is None or fit.as_read
            else {"corners": found.pixel.identified, "flange": found.joint.identified},
        ),
        rms=fit.rms,
        residue=residue,
        camera_error=_predicted(fit, np.zeros(3)),
        point_error=_predicted(fit, _middle(file, fit)),
        moved_by_lens=None,
        views=tuple(_view_results(file, seen, views, fit, left_out)),
        intrinsics_given=given,
        distortion_known=file.distortion_known,
        intrinsics=Intrinsics(fit.matrix, fit.distortion, seen.size),
        intrinsics_sigmas={known.name: known.sigma for known in fit.known},
        corners=file.board.corners,
        feature=(row, column),
        verdict="",
        reasons=(),
        warnings=tuple(_warnings(file, fit)),
    )


def _middle(file: ViewsFile, fit: OneArm) -> Array:
    """(3,): where the targets were on average, in the camera."""
    flanges = file.flanges[fit.used]
    carried = flanges if fit.placement is Placement.FIXED else inverse(flanges)
    return np.asarray((inverse(fit.camera) @ carried @ fit.target)[:, :3, 3].mean(axis=0))


def _predicted(fit: OneArm, point: Array) -> Predicted:
    error = fit.spatial_error(point)
    return Predicted(float(error.rms), float(error.p95))


def _view_results(file: ViewsFile, seen: Seen, views: Views, fit: OneArm, left_out: LeftOut) -> Iterator[ViewResult]:
    dropped = {drop.capture: drop.reason for drop in fit.dropped}
    pixels, metres = left_out.rms()
    distances = np.sqrt(fit.distances / np.maximum(fit.freedoms, 1))
    for k, (view, found) in enumerate(zip(file.views, seen.outcomes, strict=True)):
        missed = str(found) if isinstance(found, Missed) else None
        yield ViewResult(
            name=view.name,
            image=str(view.image),
            missed=missed,
            dropped=None if missed else dropped.get(k),
            corners=views.pixels[k, ::-1] if fit.flipped[k] else views.pixels[k],
            residuals=fit.residuals[k],
            left_out_px=float(pixels[k]),
            left_out=float(metres[k]),
            distance=float(distances[k]),
        )


def _warnings(file: ViewsFile, fit: OneArm) -> Iterator[str]:
    yield from fit.warnings
    if not file.distortion_known and not fit.known:
        yield "the lens's distortion is not known, by the file; none was reckoned with: --free intrinsics finds it"
    if fit.found is not None and not fit.as_read and not fit.found.joint.identified:
        yield "an error of the flange poses cannot be told from none; its upper bound was reckoned with"
