"""What came of pose triples: the public format ``dualcal.triples-result/1``.

Metres and radians here; in the file the unit is in the key's name, and covariances are in m and rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dualcal_hal.session.files import write_document
from dualcal_hal.session.result import T_H_E_NAME, transform_document
from dualcal_hal.transforms import Array

FORMAT = "dualcal.triples-result/1"
T_A_P_NAME = "passive_base_in_active_base"
T_F_T_NAME = "target_in_passive_flange"

LETTERS = {"X": T_H_E_NAME, "Y": T_A_P_NAME, "Z": T_F_T_NAME}
"""Of AXB = YCZ, with the camera on the active arm and the target on the passive one."""

ORDER = ["translation x", "translation y", "translation z", "rotation x", "rotation y", "rotation z"]
FRAME = "child: log(T_found^-1 T_true), along and about the axes of the frame that the name begins with"
UNITS = "m and rad"


@dataclass(frozen=True, eq=False)
class Found:
    """A transform T (4, 4), m, and the covariance (6, 6) of log(T_found^-1 T_true), [translation; rotation]."""

    T: Array
    covariance: Array

    def block(self, of: str) -> Array:
        """Covariance (3, 3) of the ``position`` or the ``rotation``, along and about the axes of the outer frame."""
        at = slice(0, 3) if of == "position" else slice(3, 6)
        R = self.T[:3, :3]
        return np.asarray(R @ self.covariance[at, at] @ R.T)

    def sigmas(self, of: str) -> Array:
        """(3,) m or rad, of the same."""
        return np.asarray(np.sqrt(np.diag(self.block(of))))

    def least_certain(self, of: str) -> tuple[float, Array]:
        """The largest sigma in any direction, and that direction (3,) in the outer frame."""
        values, vectors = np.linalg.eigh(self.block(of))
        direction = vectors[:, -1]
        return float(np.sqrt(values[-1])), direction * np.sign(direction[np.argmax(np.abs(direction))])


@dataclass(frozen=True)
class StatedNoise:
    """Sigmas per axis, m and rad, rms over the triples, and where they were stated: ``file`` or ``option``."""

    translation: float
    rotation: float
    stated_in: str


@dataclass(frozen=True)
class TripleResidual:
    """square: the triple's part of the cost, some 6 if it is as exact as stated. translation (m) and rotation (rad):
    from the measured B to what the measured A and C and the found X, Y and Z make of it, in the target's frame.
    """

    id: str
    square: float
    translation: tuple[float, ...]
    rotation: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class TriplesResult:
    """transforms: by their names in the file; covariance (18, 18): of X, then Y, then Z; the rest as
    ``procedures.estimation.triples.TripleEstimate`` has it. noise: by A, B, C.
    """

    transforms: Mapping[str, Found]
    covariance: Array
    noise: Mapping[str, StatedNoise]
    cost: float
    degrees_of_freedom: int
    scale: float
    noise_fits: bool
    conditioning: float
    conditioning_needed: float
    rise: float
    residuals: tuple[TripleResidual, ...]
    warnings: tuple[str, ...]

    @property
    def covariance_is_scaled(self) -> bool:
        """Whether the covariance is larger than that of the stated noise, by scale squared."""
        return not self.noise_fits and self.scale > 1

    def worst(self, most: int) -> tuple[TripleResidual, ...]:
        """Those that fit worst, the worst first."""
        return tuple(sorted(self.residuals, key=lambda residual: -residual.square)[:most])

    def to_document(self) -> dict[str, Any]:
        """The public document."""
        return {
            "format": FORMAT,
            "equation": {"form": "A X B = Y C Z", **LETTERS},
            "transforms": {name: found_document(found) for name, found in self.transforms.items()},
            "covariance": {
                "of": [f"{name}: {component}" for name in LETTERS.values() for component in ORDER],
                "frame": FRAME,
                "units": UNITS,
                "matrix": self.covariance.tolist(),
            },
            "noise": {
                "stated": {name: _noise(stated) for name, stated in self.noise.items()},
                "scale": self.scale,
                "as_stated": self.noise_fits,
                "covariance_is_scaled": self.covariance_is_scaled,
                "cost": self.cost,
                "degrees_of_freedom": self.degrees_of_freedom,
            },
            "observability": {
                "unobservable": [],  # where there is something no result is given
                "conditioning": self.conditioning,
                "conditioning_needed": self.conditioning_needed,
                "cost_of_one_sigma": self.rise,
                "least_certain": [
                    _least_certain(name, self.transforms[name], of)
                    for name in LETTERS.values()
                    for of in ("position", "rotation")
                ],
            },
            "residuals": [_residual(residual) for residual in self.residuals],
            "warnings": list(self.warnings),
        }


def write_triples_result(path: Path, result: TriplesResult) -> None:
    """Write the public file atomically."""
    write_document(path, result.to_document())


def found_document(found: Found) -> dict[str, Any]:
    """A transform with its covariance, as public files have it."""
    return {
        **transform_document(found.T),
        "sigma_mm": (1e3 * found.sigmas("position")).tolist(),
        "sigma_deg": np.degrees(found.sigmas("rotation")).tolist(),
        "covariance": {"of": ORDER, "frame": FRAME, "units": UNITS, "matrix": found.covariance.tolist()},
    }


def _noise(stated: StatedNoise) -> dict[str, Any]:
    return {
        "sigma_mm": 1e3 * stated.translation,
        "sigma_deg": float(np.degrees(stated.rotation)),
        "stated_in": stated.stated_in,
    }


def _least_certain(name: str, found: Found, of: str) -> dict[str, Any]:
    sigma, direction = found.least_certain(of)
    in_unit = {"sigma_mm": 1e3 * sigma} if of == "position" else {"sigma_deg": float(np.degrees(sigma))}
    return {"of": name, "what": of, "direction": direction.tolist(), **in_unit}


def _residual(residual: TripleResidual) -> dict[str, Any]:
    return {
        "id": residual.id,
        "square": residual.square,
        "translation_m": list(residual.translation),
        "rotation_rad": list(residual.rotation),
    }
