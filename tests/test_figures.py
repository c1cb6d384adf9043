"""Numbers as a person is told them."""

from __future__ import annotations

import pytest

from procedures.figures import chance, two_digits


@pytest.mark.parametrize(
    ("value", "said"), [(0.0333, "0.033"), (1.84, "1.8"), (9.96, "10"), (212.3, "210"), (123456.0, "120000"), (0, "0")]
)
def test_it_is_to_two_digits_and_never_in_powers_of_ten(value: float, said: str) -> None:
    assert two_digits(value) == said


@pytest.mark.parametrize(
    ("value", "said"), [(0.123, "0.12"), (1e-4, "0.0001"), (9.9e-5, "below 0.0001"), (0, "below 0.0001")]
)
def test_a_small_probability_is_told_as_small(value: float, said: str) -> None:
    assert chance(value) == said
