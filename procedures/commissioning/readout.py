"""A flange's pose as controllers show it on their pendants."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dualcal_hal.transforms import Array, rotation_from_quaternion, rotation_from_vector, transform

_LENGTH_TOLERANCE = 0.01
"""By which the length of a quaternion may differ from 1, for pendants show few digits."""


def _from_vector(numbers: Array) -> Array:
    return rotation_from_vector(np.radians(numbers))


def _from_fixed_xyz(numbers: Array) -> Array:
    x, y, z = np.radians(numbers)
    return np.asarray(
        rotation_from_vector([0, 0, z]) @ rotation_from_vector([0, y, 0]) @ rotation_from_vector([x, 0, 0])
    )


def _from_moving_zyx(numbers: Array) -> Array:
    return _from_fixed_xyz(numbers[::-1])


def _from_wxyz(numbers: Array) -> Array:
    length = float(np.linalg.norm(numbers))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise ValueError(f"a quaternion has length 1, and this one {length:.3f}")
    return rotation_from_quaternion([*numbers[1:], numbers[0]])


Form = tuple[tuple[str, ...], Callable[[Array], Array]]

FORMS: dict[str, Form] = {
    "rotation-vector": (("vx", "vy", "vz"), _from_vector),
    "abb": (("q1", "q2", "q3", "q4"), _from_wxyz),
    "fanuc": (("W", "P", "R"), _from_fixed_xyz),
    "kuka": (("A", "B", "C"), _from_moving_zyx),
    "motoman": (("Rx", "Ry", "Rz"), _from_fixed_xyz),
}
"""What a pendant shows of an orientation, by name: its numbers in their order, degrees except q1 to q4, and what they
mean. rotation-vector: axis times angle. abb: quaternion, its scalar first. fanuc, motoman: turns about the fixed x, y
and z. kuka: turns about z, the new y and the new x."""


def numbers_of(form: str) -> tuple[str, ...]:
    """The names of all that is to be typed: x, y, z in mm, then the orientation's."""
    return ("x", "y", "z", *FORMS[form][0])


def pose_of(form: str, numbers: Sequence[float]) -> Array:
    """(4, 4), m, of the numbers that :func:`numbers_of` names; ValueError for numbers that are no pose."""
    names, rotation = FORMS[form]
    if len(numbers) != 3 + len(names):
        raise ValueError(f"{len(numbers)} numbers where {' '.join(numbers_of(form))} are needed")
    values = np.array(numbers, dtype=float)
    if not np.all(np.isfinite(values)):
        raise ValueError("a number is not finite")
    return transform(rotation(values[3:]), values[:3] / 1000)
