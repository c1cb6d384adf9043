"""What a device has to say of itself to an operator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One line of a check, in the operator's words.

    subject: what was looked at, such as ``byte order``; said: what was found; verdict: ``problem`` keeps a cell from
    being used; advice: what to do about it.
    """

    subject: str
    said: str
    verdict: Literal["good", "note", "problem"] = "good"
    advice: str = ""
