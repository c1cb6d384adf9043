"""Numbers as a person is told them."""

from __future__ import annotations


def two_digits(value: float) -> str:
    """To two significant digits, large ones in full: 0.033, 1.8, 210."""
    return f"{float(f'{value:.2g}'):.12g}"
