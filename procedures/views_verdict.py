"""What residuals of views mean, in words: how far they are above the corners' noise, what that does to the camera's
position, and what to look at.
"""

from __future__ import annotations

from collections.abc import Iterator

from dualcal_hal.session.views_result import Residue, ViewsResult
from procedures.figures import two_digits

FAR_ABOVE = 3.0
"""Times the corners' own noise, from where residuals are told to be far above it."""

DETECTOR = 0.05
"""px: what corners scatter in sharp photographs, where the views do not tell."""

COARSE = 0.005
"""m: of the camera's position, 95 %, above which the result counts as coarse where nothing else does."""

_NOTABLE = 2.0  # times the corners' own noise, from where a share is worth looking at

_LOOK_AT = {
    "arm": "the robot: its accuracy and mastering, the flange frame that its poses are of, a loose camera or target",
    "board": "the board: whether it is flat and printed to scale",
    "lens": "the camera's intrinsics",
}


def verdict_of(result: ViewsResult, scale: float) -> tuple[str, tuple[str, ...]]:
    """``ok``; ``coarse``, residuals far above the corners' noise or an uncertain camera; or ``fail``, where they do not
    fit the noise that was stated: scale, of their squares over its, is above 1 then.
    """
    corners, told = corner_noise(result.residue)
    far = result.rms > FAR_ABOVE * corners
    position = (
        f"{two_digits(1e3 * result.camera_error.rms)} mm (rms), {two_digits(1e3 * result.camera_error.p95)} mm (95 %)"
    )
    name = next(iter(result.transforms))
    reasons = []
    if scale > 1:
        reasons.append(
            f"the residuals do not fit the stated noise: they are {scale**0.5:.1f} times what it explains; "
            "the covariance is widened"
        )
    if far:
        source = "scatter" if told else "usually scatter"
        reasons.append(
            f"corners are off by {result.rms:.2f} px rms per axis, {result.rms / corners:.0f} times the"
            f" {two_digits(corners)} px that they themselves {source}: what is off is something else"
        )
        reasons.append(f"for {name} that means: the camera's position is uncertain by {position}")
        if result.moved_by_lens is not None:
            reasons.append(
                f"it moves by {two_digits(1e3 * result.moved_by_lens)} mm as the intrinsics are left to the images"
            )
        reasons += _look_at(result.residue, corners, freed=bool(result.intrinsics_sigmas))
    else:
        reasons.append(f"corners are off by {two_digits(result.rms)} px rms per axis, hardly more than their own noise")
        reasons.append(f"{name}: the camera's position is uncertain by {position}")
    coarse = far or result.camera_error.p95 > COARSE
    return "fail" if scale > 1 else "coarse" if coarse else "ok", tuple(reasons)


def corner_noise(residue: Residue) -> tuple[float, bool]:
    """px per axis, and whether the views tell it."""
    return (DETECTOR, False) if residue.corners_free is None else (max(residue.corners_free, 1e-3), True)


def _look_at(residue: Residue, corners: float, *, freed: bool) -> Iterator[str]:
    """The largest share first."""
    shares = {what: share for what, share in residue.shares.items() if not (what == "lens" and freed)}
    for what, share in sorted(shares.items(), key=lambda item: -item[1]):
        if share < _NOTABLE * corners:
            continue
        said = f"look at {_LOOK_AT[what]}: {share:.2f} px go when {_LEFT[what]}"
        if what == "board" and residue.off_places is not None:
            across, out = (two_digits(1e3 * off) for off in residue.off_places)
            said += f"; corners then lie {across} mm (rms) beside their places and {out} mm out of the plane"
        if what == "lens":
            said += "; calibrate the camera, or try --free intrinsics"
        yield said
    if not shares:
        every = "; ".join(_LOOK_AT.values())
        yield f"too few views to tell where it comes from; look at {every}"


_LEFT = {
    "arm": "the arm's poses are left to the images",
    "board": "the places of its corners are",
    "lens": "lens and focal length are left to the images",
}
