"""Joints that are not what they are read as: sign, zero, order, coupling, scale."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import combinations, permutations

import numpy as np
from scipy.optimize import least_squares

from dualcal_hal.transforms import Array, vector_from_rotation
from procedures.commissioning.causes import (
    POSITION_SIGMA,
    ROTATION_SIGMA,
    Cause,
    Deviation,
    Kind,
    Poses,
    fitted,
    from_1,
    joints_in_words,
)

_TURN = np.deg2rad(np.arange(-180.0, 180.0, 5.0))
_FACTORS = np.linspace(-2.0, 2.0, 81)
_SCALES = np.linspace(-3.0, 3.0, 121)
_LARGEST_ORDER = 7
"""Joints up to which every order is tried, and not exchanges alone."""
_OFF = np.deg2rad(0.5)
"""Zero of a joint that is worth being named, where all are fitted at once."""

Change = Callable[[Array, Array], Array]
"""Joint angles (k, n) and numbers (m,) to joint angles (m, k, n)."""


def joint_causes(poses: Poses) -> Iterator[Cause]:
    """Each of them, fitted to the poses."""
    n = poses.chain.joints
    yield from _signs(poses)
    for joint in range(n):
        yield _zero(poses, joint)
        yield _sign_and_zero(poses, joint)
        yield _scale(poses, joint)
    yield _zeros(poses)
    for joint in range(n):
        for other in range(n):
            if joint != other:
                yield _coupling(poses, joint, other)
                yield _coupling_and_zero(poses, joint, other)
    yield from _orders(poses)


def shifted(joint: int, q: Array, by: Array) -> Array:
    """A :data:`Change`: the joint stands further by so much, rad."""
    return _with_joint(joint, q, q[:, joint] + by[:, None])


def scaled(joint: int, q: Array, by: Array) -> Array:
    """A :data:`Change`: the joint turns so many times as far."""
    return _with_joint(joint, q, q[:, joint] * by[:, None])


def taken_along(joint: int, other: int, q: Array, factor: Array) -> Array:
    """A :data:`Change`: so much of another joint's angle is added to the joint."""
    return _with_joint(joint, q, q[:, joint] + factor[:, None] * q[:, other])


def swapped(joint: int, other: int, q: Array) -> Array:
    """Joint angles (k, n) with two joints exchanged."""
    order = np.arange(q.shape[1])
    order[[joint, other]] = other, joint
    return np.asarray(q[:, order])


def _with_joint(joint: int, q: Array, angles: Array) -> Array:
    changed = np.repeat(q[None], len(angles), axis=0)
    changed[:, :, joint] = angles
    return changed


def _fit(poses: Poses, change: Change, grid: Array) -> tuple[float, Deviation]:
    return fitted(lambda x: poses.chain.forward(change(poses.joints, x)), poses.flange, grid)


def _signs(poses: Poses) -> Iterator[Cause]:
    """Of one joint, or of several at once."""
    n = poses.chain.joints
    for count in range(1, n + 1):
        for chosen in combinations(range(n), count):
            sign = np.ones(n)
            sign[list(chosen)] = -1.0
            yield Cause(
                Kind.SIGN,
                f"the sign of {joints_in_words(chosen)} is wrong: {'it turns' if count == 1 else 'they turn'} "
                "the other way",
                "change sign in the arm's joint_map (on CAN: in the drive's entry)",
                from_1(chosen),
                0,
                6.0 * (count - 1),
                poses.deviation(poses.joints * sign),
            )


def _zero(poses: Poses, joint: int) -> Cause:
    value, deviation = _fit(poses, partial(shifted, joint), _TURN)
    return Cause(
        Kind.ZERO,
        f"the zero of joint {joint + 1} is off: the joint stands {np.degrees(value):+.2f} deg further than is read",
        f"in the arm's joint_map change its offset_deg by {-np.degrees(value):+.2f}, or by {np.degrees(value):+.2f} "
        "where its sign is -1 (on CAN: the drive's offset_rad), or calibrate the controller's zero",
        (joint + 1,),
        1,
        0.0,
        deviation,
    )


def _sign_and_zero(poses: Poses, joint: int) -> Cause:
    def change(q: Array, by: Array) -> Array:
        return shifted(joint, scaled(joint, q, np.array([-1.0]))[0], by)

    value, deviation = _fit(poses, change, _TURN)
    return Cause(
        Kind.SIGN,
        f"the sign of joint {joint + 1} is wrong, and its zero off by {np.degrees(value):+.2f} deg",
        "change sign and offset in the arm's joint_map (on CAN: in the drive's entry)",
        (joint + 1,),
        1,
        10.0,
        deviation,
    )


def _scale(poses: Poses, joint: int) -> Cause:
    value, deviation = _fit(poses, partial(scaled, joint), _SCALES)
    return Cause(
        Kind.SCALE,
        f"joint {joint + 1} turns {value:.4g} times as far as is read",
        "check counts_per_rad of its drive, or the unit of the controller's joint",
        (joint + 1,),
        1,
        6.0,
        deviation,
    )


def _zeros(poses: Poses) -> Cause:
    """All at once, by least squares from where they are believed to be."""

    def residuals(offsets: Array) -> Array:
        ours = poses.chain.forward(poses.joints + offsets)
        turn = vector_from_rotation(poses.flange[:, :3, :3] @ np.swapaxes(ours[:, :3, :3], 1, 2))
        shift = poses.flange[:, :3, 3] - ours[:, :3, 3]
        return np.concatenate([(shift / POSITION_SIGMA).ravel(), (turn / ROTATION_SIGMA).ravel()])

    n = poses.chain.joints
    offsets = least_squares(residuals, np.zeros(n), max_nfev=50).x
    off = np.flatnonzero(np.abs(offsets) > _OFF).tolist()
    parts = ", ".join(f"joint {joint + 1} {np.degrees(offsets[joint]):+.2f} deg" for joint in off)
    return Cause(
        Kind.ZERO,
        f"the zeros of several joints are off, which stand further than is read: {parts}",
        "change their offset_deg in the arm's joint_map (on CAN: the drives' offset_rad)",
        from_1(off),
        n,
        10.0,
        poses.deviation(poses.joints + offsets),
    )


def _coupling(poses: Poses, joint: int, other: int) -> Cause:
    factor, deviation = _fit(poses, partial(taken_along, joint, other), _FACTORS)
    return _coupled(joint, other, factor, deviation, 1, "")


def _coupling_and_zero(poses: Poses, joint: int, other: int) -> Cause:
    """What is coupled are the controller's joints, whose zeros may be others than ours."""

    def change(factor: float, q: Array, by: Array) -> Array:
        return shifted(joint, taken_along(joint, other, q, np.array([factor]))[0], by)

    fits = {factor: _fit(poses, partial(change, factor), _TURN) for factor in (-1.0, 1.0)}
    factor = min(fits, key=lambda factor: float(fits[factor][1].chi2))
    value, deviation = fits[factor]
    return _coupled(joint, other, factor, deviation, 2, f" and {np.degrees(value):+.2f} deg")


def _coupled(joint: int, other: int, factor: float, deviation: Deviation, parameters: int, more: str) -> Cause:
    usual = (joint, other) == (2, 1) and abs(abs(factor) - 1.0) < 0.05
    entry = f"{{joint: {joint + 1}, from_joint: {other + 1}, factor: {-factor:.3g}}}"
    return Cause(
        Kind.COUPLING,
        f"joint {joint + 1} is coupled to joint {other + 1}: its angle as read lacks {factor:+.3g} times that of "
        f"joint {other + 1}{more}",
        f"add {entry} to coupling in the arm's joint_map, or correct the one that is there "
        "(where one of the two joints has sign -1 the factor is the opposite)",
        (joint + 1, other + 1),
        parameters,
        0.0 if usual else 10.0,
        deviation,
    )


def _orders(poses: Poses) -> Iterator[Cause]:
    """The best exchange of two joints, and the best of all other orders."""
    n = poses.chain.joints
    if n <= _LARGEST_ORDER:
        orders = np.array(list(permutations(range(n))))
    else:
        numbers = np.arange(n, dtype=float)[None]
        orders = np.array([swapped(i, j, numbers)[0] for i, j in combinations(range(n), 2)], dtype=int)
    others = np.sum(orders != np.arange(n), axis=1)
    deviation = poses.deviation(np.moveaxis(poses.joints[:, orders], 0, 1))
    for chosen in (np.flatnonzero(others == 2), np.flatnonzero(others > 2)):
        if len(chosen):
            best = int(chosen[np.argmin(deviation.chi2[chosen])])
            yield _order(orders[best], deviation[best])


def _order(read_as: Array, deviation: Deviation) -> Cause:
    """read_as (n,): which of the joints as read each joint is, counted from 0."""
    moved = np.flatnonzero(read_as != np.arange(len(read_as))).tolist()
    order = ", ".join(str(joint + 1) for joint in np.argsort(read_as))
    exchanged = len(moved) == 2
    return Cause(
        Kind.ORDER,
        f"{joints_in_words(moved)} {'are exchanged' if exchanged else 'are in another order'}",
        f"set order in the arm's joint_map to [{order}] if there is none; else exchange them there (on CAN: put the "
        "drives in the joints' order)",
        from_1(moved),
        0,
        4.0 if exchanged else 16.0,
        deviation,
    )
