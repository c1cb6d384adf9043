"""From pose triples to a result. No device, no cell."""

from __future__ import annotations

from collections.abc import Mapping

from dualcal_hal.errors import DegenerateCaptures
from dualcal_hal.session.result import T_H_E_NAME, T_P_A_NAME
from dualcal_hal.session.triples import PoseTriples
from dualcal_hal.session.triples_result import (
    T_A_P_NAME,
    T_F_T_NAME,
    Found,
    StatedNoise,
    TripleResidual,
    TriplesResult,
)
from dualcal_hal.transforms import inverse
from procedures.estimation import Degenerate
from procedures.estimation.refined.motion import motion_between
from procedures.estimation.triples import TripleEstimate, TripleNoise, estimate_triples
from procedures.estimation.triples.degeneracy import DEGENERATE


def analyse_triples(triples: PoseTriples, noise: TripleNoise, stated_in: Mapping[str, str]) -> TriplesResult:
    """Estimate from all triples; stated_in: by A, B, C, where its noise was stated.

    Raises DegenerateCaptures for triples that do not determine the transforms.
    """
    try:
        found = estimate_triples(triples.A, triples.B, triples.C, noise, triples.names)
    except Degenerate as error:
        raise DegenerateCaptures(f"the triples give no X, Y and Z: {error}") from error
    return TriplesResult(
        transforms={
            T_P_A_NAME: Found(found.T_P_A, found.covariance_of_T_P_A),
            T_H_E_NAME: Found(found.X, found.covariance_of("X")),
            T_A_P_NAME: Found(found.Y, found.covariance_of("Y")),
            T_F_T_NAME: Found(found.Z, found.covariance_of("Z")),
        },
        covariance=found.covariance,
        noise={
            name: StatedNoise(noise.translation_sigma(name), noise.rotation_sigma(name), stated_in[name])
            for name in "ABC"
        },
        cost=found.cost,
        degrees_of_freedom=found.degrees_of_freedom,
        scale=found.scale,
        noise_fits=found.noise_fits,
        conditioning=found.conditioning,
        conditioning_needed=DEGENERATE,
        rise=found.rise,
        residuals=_residuals(triples, found),
        warnings=found.warnings,
    )


def _residuals(triples: PoseTriples, found: TripleEstimate) -> tuple[TripleResidual, ...]:
    B = inverse(triples.A @ found.X) @ found.Y @ triples.C @ found.Z
    motions = motion_between(triples.B, B).tolist()
    return tuple(
        TripleResidual(name, square, tuple(motion[:3]), tuple(motion[3:]))
        for name, square, motion in zip(triples.names, found.squares.tolist(), motions, strict=True)
    )
