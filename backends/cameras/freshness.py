"""From what moment on a frame's exposure may have begun, at the earliest: all that a driver can prove.

A frame answers a request for one exposed at ``not_before`` or later only if that earliest moment is no earlier. That
it arrived later proves nothing: it may have been under way for long. Each rule here gives a moment that the exposure
cannot have begun before, in seconds of this process's clock; -inf where nothing is proven yet.

- *By trigger*: the exposure begins after the trigger was sent (genicam, folders of images). The moment is that of
  sending, as long as no frame of an earlier trigger can be taken for this one's.
- *By time stamp*, where the sender's clock is this process's own (:mod:`backends.cameras.whose_clock`): the stamp.
- *By marks* (:class:`SenderClock`), where a sender has another clock, and listens.
- *By frames in flight* (:class:`FramesInFlight`), where frames carry no time, but only so many of them can be begun
  and not have arrived.
- *By latency* (:class:`LargestLatency`), where not even that is known.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

LARGEST_DRIFT = 1e-3
"""By how much two clocks may differ in rate: quartzes by 1e-4 each, and NTP slews a clock by up to 5e-4."""


class FramesInFlight:
    """For frames that arrive in the order of their exposure, of which at most ``most`` are begun and not arrived.

    When the exposure of frame k began, it and its predecessors that had not arrived were ``most`` at the most; so
    frame k - most had arrived, or was lost. Among the frames that did arrive, the one ``most`` before frame k is that
    one or an older one, and had arrived, too: its arrival is no later than the beginning of frame k's exposure. Frames
    that are lost make this earlier than need be, never later. With ``most`` = 1, a camera that begins nothing before
    its last frame has been handed over, it is the arrival of the frame before.

    Frames that wait in a queue are in flight until they are taken out, so arrival is when they are, by a thread that
    does nothing else.
    """

    def __init__(self, most: int) -> None:
        self._arrivals: deque[float] = deque(maxlen=most)

    def arrived(self, now: float) -> float:
        """The earliest moment at which the exposure of the frame that arrives now can have begun."""
        full = len(self._arrivals) == self._arrivals.maxlen
        earliest = self._arrivals[0] if full else -math.inf
        self._arrivals.append(now)
        return earliest


@dataclass(frozen=True)
class LargestLatency:
    """For frames that arrive at most ``seconds`` after their exposure began, by an operator's word."""

    seconds: float

    def arrived(self, now: float) -> float:
        """The earliest moment at which the exposure of the frame that arrives now can have begun."""
        return now - self.seconds


@dataclass(frozen=True)
class _Mark:
    sent: float  # own clock
    heard: float  # sender's clock


class SenderClock:
    """What a sender's clock shows, held against one's own by marks.

    A mark that was sent at ``l`` of the own clock was heard at ``s`` of the sender's, and that is no earlier. So what
    the sender exposed at ``e`` of its clock began at ``l + (e - s)`` or later, less what both clocks may drift apart
    between. Each mark gives such a bound; the latest of them holds. How long the mark took to be heard makes the bound
    earlier than need be, never later: a slow line costs frames, not the proof. From the other side a frame that arrived
    at ``a`` was exposed before that, which tells how far off the clock may be the other way.
    """

    def __init__(self) -> None:
        self._marks: deque[_Mark] = deque(maxlen=8)
        self._least_delay = math.inf

    def heard(self, sent: float, heard: float) -> None:
        """A mark that was sent at ``sent`` of the own clock was heard at ``heard`` of the sender's."""
        self._marks.append(_Mark(sent, heard))

    def arrived(self, exposed: float, now: float) -> float:
        """The earliest moment of the own clock at which the exposure can have begun; -inf before a mark was heard."""
        self._least_delay = min(self._least_delay, now - exposed)
        bounds = (m.sent + exposed - m.heard - LARGEST_DRIFT * abs(exposed - m.heard) for m in self._marks)
        return min(max(bounds, default=-math.inf), now)

    @property
    def behind(self) -> tuple[float, float]:
        """Between which two numbers of seconds the sender's clock is behind the own one; infinite where not known."""
        marks = tuple(self._marks)  # asked for by another thread than the one that hears of marks
        return max((m.sent - m.heard for m in marks), default=-math.inf), self._least_delay
