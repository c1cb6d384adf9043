"""One arm alone: the estimate with the other arm absent, the target's place sought like the camera's.

A camera on the arm before a target that stays is the problem of two arms with a passive base that is the target.
A camera that stays before a target on the arm is the same looked at from the flange: the inverted flange pose takes the
arm's place, the flange that of its base.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from dualcal_hal.kinematics import Chain
from dualcal_hal.transforms import Array, Mask, apply, inverse
from procedures.estimation.degenerate import Degenerate
from procedures.estimation.refined.arms import Arm, Inverted, MeasuredFlange, NoArm
from procedures.estimation.refined.data import CaptureArrays, Indices, Knowns, Noise, Words
from procedures.estimation.refined.estimate import Dropped, Refined, refined
from procedures.estimation.refined.fit import minimise
from procedures.estimation.refined.geometry import refuse_one_axis
from procedures.estimation.refined.inexact import Inexact, Known
from procedures.estimation.refined.model import CELL, Model
from procedures.estimation.refined.motion import adjoint
from procedures.estimation.refined.noise import FoundNoise
from procedures.estimation.refined.uncertainty import Direction, Limits, SpatialError, directions, spatial_error

FEWEST_VIEWS = 3
"""Turned about two axes; each with the four corners that make a pose of the board."""

FEWEST_CORNERS = 4

_LARGE = 0.005  # m; a predicted sigma above it is warned of


class Placement(StrEnum):
    """Where the camera is; the target is where it is not."""

    ON_ARM = "eye-in-hand"
    FIXED = "eye-to-hand"

    @property
    def names(self) -> tuple[str, str]:
        """What the camera's and the target's transforms are called."""
        if self is Placement.ON_ARM:
            return "camera_in_flange", "target_in_base"
        return "camera_in_base", "target_in_flange"


@dataclass(frozen=True, eq=False)
class JointReadings:
    """joints (k, n): as read, rad; sigma: by which each misses where the arm stood, rad."""

    chain: Chain
    joints: Array
    sigma: float

    @property
    def arm(self) -> Arm:
        return self.chain

    @property
    def values(self) -> Array:
        return self.joints


@dataclass(frozen=True, eq=False)
class FlangePoses:
    """flange (k, 4, 4): in the base, as the robot states it; by which it is off along and about each of its axes:
    translation, m, and rotation, rad, 1 sigma.
    """

    flange: Array
    translation: float
    rotation: float

    def __post_init__(self) -> None:
        if not (self.translation > 0 and self.rotation > 0):
            raise ValueError("both sigmas of a flange pose must be positive")

    @property
    def arm(self) -> Arm:
        return MeasuredFlange(self.translation / self.rotation)

    @property
    def values(self) -> Array:
        return MeasuredFlange.readings(self.flange)

    @property
    def sigma(self) -> float:
        return self.rotation


@dataclass(frozen=True, eq=False)
class Views:
    """k views of a target with n corners.

    pixels (k, n, 2): measured corners in the distorted image, NaN for one not seen; corners (n, 3) in the target, m;
    matrix (3, 3), px, and distortion (5,) of the camera; order_known (k,): False where the corners may as well be
    listed from the other end, None: all are known; board_poses: T_camera_target of each view, (4, 4) or its candidates
    (c, 4, 4), or None; None: none are known; weights (k, 2n, 2n): as those of ``CaptureArrays``; stops (k,): views of
    one number were taken from where the arm had stopped once, and share its error; None: each has its own.
    """

    arm: JointReadings | FlangePoses
    pixels: Array
    corners: Array
    matrix: Array
    distortion: Array
    order_known: Mask | None = None
    board_poses: Sequence[ArrayLike | None] | None = None
    weights: Array | None = None
    stops: Indices | None = None

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def seen(self) -> Mask:
        """(k, n): which corners were seen."""
        return np.asarray(np.isfinite(self.pixels).all(axis=-1))


@dataclass(frozen=True)
class OtherSolution:
    """Another optimum: camera and target (4, 4), and its cost over the best one's."""

    camera: Array
    target: Array
    ratio: float


@dataclass(frozen=True)
class OneArm:
    """camera, target (4, 4): called by ``placement.names``; covariance (12, 12) of error = log(T_est^-1 T_true),
    translation (m) then rotation (rad) in the child frame, of camera then of target.

    directions: of these twelve. cost: sum of squares in units of sigma, of ``freedom`` degrees of freedom; scale: by
    how much squares exceed those of the stated noise, 1 if that may be chance; the covariance is then that of the noise
    which the views show. residuals (k, n, 2): px, found minus seen, with the arm as it was read, NaN for corners not
    seen; views that were dropped have theirs too. distances (k,): squared Mahalanobis distance of each view from where
    the others put it, of freedoms (k,) degrees of freedom, NaN for those dropped. used, flipped (k,): flipped views
    are taken with their corners from the other end.

    pixel_sigma, px, and arm_sigma, rad (of a joint, or of a flange pose's rotation): reckoned with; found: what the
    views say of both, if that was asked for. matrix, distortion: reckoned with, after the estimate where they were
    freed; known: inexact knowns after it. contributions: to the covariance (12, 12), of ``pixels``, ``arm`` and each
    inexact known.

    as_read: whether camera and target fit the corners best with the arm exactly where it was read (``fit_as_read``);
    cost, scale and distances stay those of the fit with the arm's errors. notes: what there is to be warned of besides
    large sigmas.
    """

    placement: Placement
    camera: Array
    target: Array
    covariance: Array
    directions: tuple[Direction, ...]
    condition: float
    cost: float
    freedom: int
    scale: float
    residuals: Array
    distances: Array
    freedoms: Array
    used: Mask
    flipped: Mask
    dropped: tuple[Dropped, ...]
    alternatives: tuple[OtherSolution, ...]
    notes: tuple[str, ...]
    pixel_sigma: float
    arm_sigma: float
    found: FoundNoise | None
    matrix: Array
    distortion: Array
    known: tuple[Known, ...]
    contributions: dict[str, Array]
    as_read: bool = False

    @property
    def warnings(self) -> tuple[str, ...]:
        """In words: what is uncertain, then the notes."""
        return (*_uncertain(self.directions), *self.notes)

    @property
    def transforms(self) -> dict[str, Array]:
        """Both (4, 4), by their names."""
        return dict(zip(self.placement.names, (self.camera, self.target), strict=True))

    def covariance_of(self, name: str) -> Array:
        """(6, 6) of one of the transforms."""
        at = 6 * self.placement.names.index(name)
        return self.covariance[at : at + 6, at : at + 6]

    @property
    def rms(self) -> float:
        """px per axis, of the corners of the views used."""
        return float(np.sqrt(np.nanmean(self.residuals[self.used] ** 2)))

    def spatial_error(self, points: ArrayLike) -> SpatialError:
        """Predicted, of where points (..., 3) of the camera are put in the frame that carries it, m."""
        there = apply(self.camera, np.reshape(points, (-1, 3))).reshape(np.shape(points))
        return spatial_error(self.camera, self.covariance[:6, :6], there)


def one_arm(
    views: Views,
    placement: Placement,
    pixel_sigma: float,
    *,
    further_starts: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    keep_all: bool = False,
    estimate_noise: bool = False,
    inexact: Sequence[Inexact] = (),
    estimate_inexact: bool = True,
    observable: Limits | None = None,
) -> OneArm:
    """Where camera and target are, from views alone; pixel_sigma: of a corner, px per axis.

    further_starts: pairs of camera and target (4, 4), tried besides those found from the views. keep_all: no view is
    dropped. estimate_noise: both sigmas are found from the views; what is stated tells where to begin, and of flange
    poses how translation and rotation compare. inexact: knowns with a sigma (intrinsics and square size; what the arm
    has is called ``active``, and the target's mount is sought anyway), estimated with it as their prior or only
    reckoned with. Raises Degenerate for views that do not determine both transforms.
    """
    result = refined_views(
        views,
        placement,
        pixel_sigma,
        further_starts=further_starts,
        keep_all=keep_all,
        estimate_noise=estimate_noise,
        inexact=inexact,
        estimate_inexact=estimate_inexact,
        observable=observable,
    )
    return described(views, placement, result, observable)


def refined_views(
    views: Views,
    placement: Placement,
    pixel_sigma: float,
    *,
    further_starts: Sequence[tuple[ArrayLike, ArrayLike]] = (),
    keep_all: bool = False,
    estimate_noise: bool = False,
    inexact: Sequence[Inexact] = (),
    estimate_inexact: bool = True,
    observable: Limits | None = None,
) -> Refined:
    """As :func:`one_arm`, the result as that of two arms, of which one is none: what ``verify`` takes."""
    data, knowns = as_captures(views, placement)
    enough = views.seen.sum(axis=1) >= FEWEST_CORNERS
    if enough.sum() < FEWEST_VIEWS:
        count = f"{enough.sum()} view{'s' if enough.sum() != 1 else ''}"
        raise Degenerate(f"{count} with at least {FEWEST_CORNERS} corners seen, at least {FEWEST_VIEWS} are needed")
    sigma = views.arm.sigma
    result = refined(
        data,
        knowns,
        Noise(pixel_sigma, sigma, sigma),
        further_starts=[(inverse(target), camera) for camera, target in further_starts],
        keep_all=keep_all,
        estimate_noise=estimate_noise,
        inexact=inexact,
        estimate_inexact=estimate_inexact,
        observable=observable,
    )
    agree, seen = int(result.used.sum()), int(np.any(views.seen, axis=1).sum())
    if 2 * agree <= seen:
        raise Degenerate(
            f"only {agree} of {seen} views agree with each other: see that each image has its own pose, that the camera"
            f" {'is on the arm' if placement is Placement.ON_ARM else 'stays'} and that the target is the right one"
        )
    return result


def as_captures(views: Views, placement: Placement) -> tuple[CaptureArrays, Knowns]:
    """Views as captures whose arrivals are the arm's stops, of a passive arm that is none."""
    k = len(views)
    data = CaptureArrays(
        active=views.arm.values,
        passive=np.zeros((k, 0)),
        arrivals=np.arange(k) if views.stops is None else views.stops,
        pixels=views.pixels,
        order_known=views.order_known,
        board_poses=views.board_poses,
        weights=views.weights,
    )
    arm = views.arm.arm
    return data, Knowns(
        active=arm if placement is Placement.ON_ARM else Inverted(arm),
        passive=NoArm(),
        T_F_T=np.eye(4),
        corners=views.corners,
        matrix=views.matrix,
        distortion=views.distortion,
        words=Words("flange", "views"),
    )


def described(views: Views, placement: Placement, result: Refined, observable: Limits | None = None) -> OneArm:
    """The result of ``refined_views`` as that of one arm."""
    data, _ = as_captures(views, placement)
    turned = data.turned(result.flipped)
    model = Model(turned, result.knowns, result.noise)
    residuals = model.residuals(model.state(result.T_P_A, result.T_H_E)) * result.noise.pixel
    M = camera_and_target(result.T_P_A)

    def seen_so(covariance: Array) -> Array:
        return np.asarray(M @ covariance @ M.T)

    covariance = seen_so(result.covariance)
    found = directions(covariance, observable or Limits(), ("camera", "target"))
    parts = {"arm" if what == "active joints" else what: seen_so(part) for what, part in result.contributions.items()}
    parts.pop("passive joints")
    return OneArm(
        placement=placement,
        camera=result.T_H_E,
        target=inverse(result.T_P_A),
        covariance=covariance,
        directions=found,
        condition=result.condition,
        cost=result.cost,
        freedom=result.freedom,
        scale=result.scale,
        residuals=np.where(model.seen[..., None], residuals, np.nan),
        distances=result.distances,
        freedoms=result.freedoms,
        used=result.used,
        flipped=result.flipped,
        dropped=result.dropped,
        alternatives=tuple(OtherSolution(a.T_H_E, inverse(a.T_P_A), a.ratio) for a in result.alternatives),
        notes=tuple(_notes(data, result)),
        pixel_sigma=result.noise.pixel,
        arm_sigma=result.noise.active,
        found=result.found,
        matrix=result.knowns.matrix,
        distortion=result.knowns.distortion,
        known=result.known,
        contributions=parts,
    )


def camera_and_target(T_P_A: Array) -> Array:
    """(12, 12): errors of T_P_A and T_H_E to those of the camera, which is T_H_E, and of the target, T_P_A's inverse.

    log((T_est^-1)^-1 T_true^-1) = -Ad(T_est) log(T_est^-1 T_true).
    """
    M = np.zeros((CELL, CELL))
    M[:6, 6:] = np.eye(6)
    M[6:, :6] = -adjoint(T_P_A)
    return M


def _notes(data: CaptureArrays, result: Refined) -> Iterator[str]:
    model = Model(data.turned(result.flipped).only(result.used), result.knowns, result.noise)
    fit = minimise(model, model.state(result.T_P_A, result.T_H_E))
    if not fit.converged:
        yield "the estimate has not converged"
    axes = model.arrival_poses(fit.state)[0][:, :3, 2]
    yield from refuse_one_axis(model.T_A_H, axes, result.noise.active, result.knowns.words)
    for other in result.alternatives:
        yield f"a second solution costs only {other.ratio:.2f} times as much"
    unseen = [known.name for known in result.known if not known.seen]
    if unseen:
        yield f"cannot be seen in the views: {', '.join(unseen)}"


def _uncertain(found: Sequence[Direction]) -> Iterator[str]:
    large = [d for d in found if d.name.startswith("translation") and d.sigma > _LARGE]
    if large:
        names = ", ".join(f"{d.name} by {1e3 * d.sigma:.1f} mm" for d in large)
        yield f"uncertain (1 sigma): {names}; views with the flange turned further would help"
    hidden = [d.name for d in found if not d.observable and d not in large]
    if hidden:
        yield f"not observable: {', '.join(hidden)}"
