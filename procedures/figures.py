"""Numbers as a person is told them."""

from __future__ import annotations

_TOLD = 1e-4  # a smaller probability is told as below it


def two_digits(value: float) -> str:
    """To two significant digits, large ones in full: 0.033, 1.8, 210."""
    return f"{float(f'{value:.2g}'):.12g}"


def chance(probability: float) -> str:
    """A probability; one that is too small to matter how small is told as such."""
    return f"{probability:.2g}" if probability >= _TOLD else f"below {_TOLD:g}"
