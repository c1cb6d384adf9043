"""When a master began to stop an arm, by what it sends the drives: cyclic targets have no word for it."""

from __future__ import annotations

from collections.abc import Sequence

_RESTS = 3
"""SYNCs with the same targets after which they rest: a master that waits for a late answer holds them for one."""

_LED, _OF = 0x0F, 0x010F
"""What a controlword says that has the drive follow, and the bits that count: halt is one of them."""


class Braking:
    """Looks at what the drives of one arm are told from SYNC to SYNC."""

    def __init__(self) -> None:
        self._before: Sequence[tuple[int, int] | None] = ()
        self._step = 0
        self._rests = 0
        self._slower_since: float | None = None

    def look(self, now: float, told: Sequence[tuple[int, int] | None]) -> float | None:
        """``told``: controlword and target of each drive, None of one that hears nothing. Since when they are being
        stopped, once that can be said.

        That is when one is to follow no more, or, once the targets rest, when they began to come slower and slower.
        """
        before, self._before = self._before, told
        pairs = [(was, word) for was, word in zip(before, told, strict=bool(before)) if was and word]
        if any(was & _OF == _LED != word & _OF for (was, _), (word, _) in pairs):
            return now
        step = max((abs(target - was) for (_, was), (_, target) in pairs), default=0)
        if step == 0:
            self._rests += 1
        elif step >= self._step:
            self._rests, self._slower_since = 0, None
        if step < self._step and self._slower_since is None:
            self._slower_since = now
        self._step = step
        return self._slower_since if self._rests == _RESTS else None
