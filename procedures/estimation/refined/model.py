"""The measurement model, linearised: pixels to a capture's pose, to an arrival's pose, to the cell.

All that a capture says passes through the pose of the camera in the passive base, T_P_E, which is the same for all
captures of an arrival. So each capture's corners become six by six information on it, from which the errors of the
passive arm are marginalised; their sum over an arrival is information on its T_P_E, from which the errors of the
active arm are marginalised; what is left is information on the cell. Time and memory are linear in captures.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dualcal_hal.transforms import Array, Mask, apply, inverse, skew
from procedures.estimation.projection import project, project_with_jacobian
from procedures.estimation.refined.data import CaptureArrays, Indices, Knowns, Noise
from procedures.estimation.refined.motion import adjoint, in_flange, moved

CELL = 12
"""Unknowns of the cell: motions of T_P_A, then of T_H_E."""

# Tangent of the angle off the optical axis, some 84 deg, beyond which no lens of this distortion has an image: a point
# there counts as behind the camera. Nearer to the camera's plane the distortion's powers of the tangent, and with them
# the information of a corner, outgrow what can be computed with.
_WIDEST = 10.0


@dataclass(frozen=True)
class State:
    """T_P_A, T_H_E (4, 4); errors of the arms in units of their sigma: active (a, na) of the arrivals, passive
    (k, np) of the captures.
    """

    T_P_A: Array
    T_H_E: Array
    active: Array
    passive: Array


@dataclass(frozen=True)
class Linearised:
    """At a state: cost, a sum of squares in units of sigma; normal (12, 12) and gradient (12,) of the cell with all
    errors of the arms marginalised.

    Normals (., 6, 6) and gradients (., 6) are on T_P_E: pixel, of each capture from its pixels alone; capture, with the
    passive arm marginalised; arrival, their sum over one; pose, with the active arm marginalised too. squares (k,): of
    pixels in units of sigma. towards_cell (a, 6, 12): how the cell moves T_P_E; towards_active (a, 6, na) and
    towards_passive (k, 6, np): how the arms do, by a sigma; gains and steps: how their errors follow (marginalised).
    """

    cost: float
    normal: Array
    gradient: Array
    squares: Array
    pixel_normal: Array
    pixel_gradient: Array
    capture_normal: Array
    capture_gradient: Array
    arrival_normal: Array
    arrival_gradient: Array
    pose_normal: Array
    pose_gradient: Array
    towards_cell: Array
    towards_active: Array
    towards_passive: Array
    passive_gain: Array
    passive_step: Array
    active_gain: Array
    active_step: Array


@dataclass(frozen=True)
class Sight:
    """What corners say of T_P_E, passive arm as it is: squares (b,), their sum in units of sigma; normal (b, 6, 6),
    gradient (b, 6); towards_passive (b, 6, np): how T_P_E would have to move for a sigma of the passive arm. residuals
    (b, 2n), in units of sigma, and their jacobian (b, 2n, 6).
    """

    squares: Array
    residuals: Array
    jacobian: Array
    normal: Array
    gradient: Array
    towards_passive: Array


class Model:
    """Captures and knowns as arrays that no state changes. Arrivals are numbered in the order of their first capture;
    an arrival's reading is the median of its captures'. freedom (k,): numbers measured in each capture.
    """

    def __init__(self, data: CaptureArrays, knowns: Knowns, noise: Noise) -> None:
        self.knowns, self.noise = knowns, noise
        labels, first, arrival = np.unique(data.arrivals, return_index=True, return_inverse=True)
        rank = np.argsort(np.argsort(first))
        self.labels = labels[np.argsort(first)]
        self.arrival: Indices = rank[arrival.ravel()]
        self.active = arrival_readings(data.active, self.arrival, len(labels))
        self.T_A_H = knowns.active.forward(self.active)
        self.T_P_F = knowns.passive.forward(data.passive)
        self.J_active = in_flange(knowns.active.jacobian(self.active), self.T_A_H)
        self.J_passive = in_flange(knowns.passive.jacobian(data.passive), self.T_P_F)
        self.seen: Mask = np.asarray(np.isfinite(data.pixels).all(axis=-1))
        self.pixels = np.where(self.seen[..., None], data.pixels, 0.0)
        self.weights = data.weights
        self.freedom = np.asarray(2.0 * self.seen.sum(axis=1))
        if self.weights is not None:
            self.freedom = np.minimum(self.freedom, np.linalg.matrix_rank(self.weights, hermitian=True))

    @property
    def arrivals(self) -> int:
        return len(self.T_A_H)

    @property
    def captures(self) -> int:
        return len(self.pixels)

    @property
    def measurements(self) -> int:
        """Numbers measured: two for each corner, six for a pose of the board."""
        return int(self.freedom.sum())

    def state(self, T_P_A: Array, T_H_E: Array) -> State:
        """With both arms exactly where they were read."""
        active, passive = self.J_active.shape[-1], self.J_passive.shape[-1]
        return State(T_P_A, T_H_E, np.zeros((self.arrivals, active)), np.zeros((self.captures, passive)))

    def cost(self, state: State) -> float:
        """Sum of squares in units of sigma; infinite if a corner that was seen is where no camera sees it."""
        squares = float(np.sum(self.residuals(state) ** 2) + np.sum(state.active**2) + np.sum(state.passive**2))
        return squares if np.isfinite(squares) else np.inf

    def residuals(self, state: State) -> Array:
        """(k, n, 2) of the pixels in units of sigma, 0 for a corner that was not seen."""
        in_camera = self._in_front(self._target_in_camera(state)[1])
        return self._whitened(project(in_camera, self.knowns.matrix, self.knowns.distortion))

    def linearised(self, state: State) -> Linearised:
        T_E_P, T_E_T = self._target_in_camera(state)
        sight = self.sight(T_E_T)
        L, g, P = sight.normal, sight.gradient, sight.towards_passive
        W, gw, passive_gain, passive_step = marginalised(L, g, P, state.passive)
        arrival_normal, arrival_gradient = self._summed(W), self._summed(gw)

        G, A = self._moves(state, T_E_P)
        pose_normal, pose_gradient, active_gain, active_step = marginalised(
            arrival_normal, arrival_gradient, A, state.active
        )
        G_T = np.swapaxes(G, 1, 2)
        return Linearised(
            cost=float(sight.squares.sum() + np.sum(state.active**2) + np.sum(state.passive**2)),
            normal=np.sum(G_T @ pose_normal @ G, axis=0),
            gradient=np.sum((G_T @ pose_gradient[..., None])[..., 0], axis=0),
            squares=sight.squares,
            pixel_normal=L,
            pixel_gradient=g,
            capture_normal=W,
            capture_gradient=gw,
            arrival_normal=arrival_normal,
            arrival_gradient=arrival_gradient,
            pose_normal=pose_normal,
            pose_gradient=pose_gradient,
            towards_cell=G,
            towards_active=A,
            towards_passive=P,
            passive_gain=passive_gain,
            passive_step=passive_step,
            active_gain=active_gain,
            active_step=active_step,
        )

    def sight(self, T_E_T: Array, which: Indices | None = None, flipped: Mask | None = None) -> Sight:
        """Of boards T_E_T (b, 4, 4) where captures ``which`` (b,) saw theirs, all of them in order if None; the corners
        of the captures where ``flipped`` (b,) is True are listed from the other end.
        """
        pixels, seen, J_passive = self.pixels, self.seen, self.J_passive
        if which is not None:
            pixels, seen, J_passive = pixels[which], seen[which], J_passive[which]
        if flipped is not None:
            pixels = np.where(flipped[:, None, None], pixels[:, ::-1], pixels)
            seen = np.where(flipped[:, None], seen[:, ::-1], seen)
        in_camera = self._in_front(T_E_T)
        found, J_pixel = project_with_jacobian(in_camera, self.knowns.matrix, self.knowns.distortion)
        # A motion (v, w) of T_P_E moves a point's coordinates p in the camera by -v + p x w.
        J = np.concatenate([-J_pixel, J_pixel @ skew(in_camera)], axis=-1)
        J = (np.where(seen[..., None, None], J, 0.0) / self.noise.pixel).reshape(len(T_E_T), -1, 6)
        r = (np.where(seen[..., None], found - pixels, 0.0) / self.noise.pixel).reshape(len(T_E_T), -1)
        if self.weights is not None:
            weights = self.weights if which is None else self.weights[which]
            J, r = weights @ J, (weights @ r[..., None])[..., 0]
        J_T = np.swapaxes(J, 1, 2)
        # From the target on its flange to the camera: the passive arm moves T_P_E the other way.
        T_E_F = T_E_T @ inverse(self.knowns.T_F_T)
        return Sight(
            squares=np.sum(r**2, axis=1),
            residuals=r,
            jacobian=J,
            normal=J_T @ J,
            gradient=(J_T @ r[..., None])[..., 0],
            towards_passive=-self.noise.passive * adjoint(T_E_F) @ J_passive,
        )

    def jacobian(self, state: State) -> Array:
        """(k, 2n, 6): of the residuals in units of sigma, by motions of T_P_E."""
        return self.sight(self._target_in_camera(state)[1]).jacobian

    def arrival_poses(self, state: State) -> tuple[Array, Array, Array]:
        """T_P_E of the arrivals (a, 4, 4), and how the cell (a, 6, 12) and a sigma of the active arm (a, 6, na) move
        them.
        """
        T_E_P, _ = self._target_in_camera(state)
        return inverse(T_E_P), *self._moves(state, T_E_P)

    def stepped(self, state: State, at: Linearised, step: Array) -> State:
        """The state after the cell has moved by ``step`` (12,), with the arms' errors where they then fit best."""
        pose = at.towards_cell @ step
        active_step = at.active_step - (at.active_gain @ pose[..., None])[..., 0]
        pose = pose + (at.towards_active @ active_step[..., None])[..., 0]
        passive_step = at.passive_step - (at.passive_gain @ pose[self.arrival][..., None])[..., 0]
        return State(
            T_P_A=moved(state.T_P_A, step[:6]),
            T_H_E=moved(state.T_H_E, step[6:]),
            active=state.active + active_step,
            passive=state.passive + passive_step,
        )

    def _moves(self, state: State, T_E_P: Array) -> tuple[Array, Array]:
        G = np.empty((self.arrivals, 6, CELL))
        G[:, :, :6] = adjoint(T_E_P @ state.T_P_A)
        G[:, :, 6:] = np.eye(6)
        return G, self.noise.active * adjoint(inverse(state.T_H_E)) @ self.J_active

    def _target_in_camera(self, state: State) -> tuple[Array, Array]:
        """T_E_P of the arrivals (a, 4, 4), T_E_T of the captures (k, 4, 4)."""
        active = self.noise.active * (self.J_active @ state.active[..., None])[..., 0]
        passive = self.noise.passive * (self.J_passive @ state.passive[..., None])[..., 0]
        T_E_P = inverse(state.T_P_A @ moved(self.T_A_H, active) @ state.T_H_E)
        return T_E_P, T_E_P[self.arrival] @ moved(self.T_P_F, passive) @ self.knowns.T_F_T

    def _in_front(self, T_E_T: Array) -> Array:
        """(b, n, 3): corners of boards T_E_T (b, 4, 4) in the camera, NaN for those that no lens shows."""
        corners = apply(T_E_T, self.knowns.corners)
        shown = np.linalg.norm(corners[..., :2], axis=-1) < _WIDEST * corners[..., 2]
        return np.where(shown[..., None], corners, np.nan)

    def _whitened(self, pixels: Array) -> Array:
        r = np.where(self.seen[..., None], pixels - self.pixels, 0.0) / self.noise.pixel
        if self.weights is None:
            return r
        return np.asarray((self.weights @ r.reshape(self.captures, -1, 1)).reshape(r.shape))

    def _summed(self, per_capture: Array) -> Array:
        total = np.zeros((self.arrivals, *per_capture.shape[1:]))
        np.add.at(total, self.arrival, per_capture)
        return total


def arrival_readings(active: Array, arrival: Indices, arrivals: int) -> Array:
    """(a, na): the median of the active joints (k, na) over the captures of each arrival; arrival (k,) from 0."""
    if np.bincount(arrival, minlength=arrivals).max(initial=0) <= 1:
        return active[np.argsort(arrival)]
    return np.stack([np.median(active[arrival == a], axis=0) for a in range(arrivals)])


def marginalised(normal: Array, gradient: Array, towards: Array, errors: Array) -> tuple[Array, Array, Array, Array]:
    """Information (b, 6, 6) and gradient (b, 6) on a pose without the errors (b, n), of unit sigma, that move it by
    ``towards`` (b, 6, n); and how the errors follow: by ``step - gain @ motion of the pose``.
    """
    towards_T = np.swapaxes(towards, 1, 2)
    seen = towards_T @ normal
    inner = np.eye(towards.shape[-1]) + seen @ towards
    own = (towards_T @ gradient[..., None])[..., 0] + errors
    solved = np.linalg.solve(inner, np.concatenate([seen, own[..., None]], axis=-1))
    gain, step = solved[..., :6], -solved[..., 6]
    seen_T = np.swapaxes(seen, 1, 2)
    left = normal - seen_T @ gain
    return (left + np.swapaxes(left, 1, 2)) / 2, gradient + (seen_T @ step[..., None])[..., 0], gain, step
