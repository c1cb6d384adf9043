"""A course on its way to the controller: point by point, each once the last was taken."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress

from backends.controller.link import Transfer
from backends.controller.tcp.codec import Message
from backends.controller.tcp.dialects import Dialect, Verdict
from backends.controller.tcp.motion import MotionPort, Request
from dualcal_hal.clock import Clock
from dualcal_hal.errors import CommandRefused, DeviceError, DeviceTimeout, MotionStopped

_BUSY_PAUSE = 0.02  # s before the same point is sent again
_BUSY_FOR = 10.0  # s that a controller may be busy with one


class HandOver:
    """One arm's, on a thread of its own. ``taken(time)`` is told whenever the controller has taken something.

    needed: how many messages have to be taken before the arm moves. Where it fails on the way, for another reason
    than a stop, it has the arm stop, and then ``explain`` may add to the error what is known.
    """

    def __init__(
        self,
        arm: str,
        group: int,
        messages: Sequence[Message],
        needed: int,
        port: MotionPort,
        dialect: Dialect,
        clock: Clock,
        taken: Callable[[float], None],
        explain: Callable[[DeviceError], None],
    ) -> None:
        self.transfer = Transfer()
        self.running = True
        self._arm, self._group = arm, group
        self._port, self._dialect, self._clock = port, dialect, clock
        self._packets = [(message, port.packet(arm, message)) for message in messages]
        self._needed = needed
        self._taken = taken
        self._explain = explain
        self._lock = threading.Lock()
        self._halted = threading.Event()
        self._error: DeviceError | None = None
        self._request: Request | None = None
        self._accepted = False
        self._ended_or_accepted = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"hand over to {arm}", daemon=True)

    def begin(self) -> None:
        """Returns once all that is needed was taken; raises the error that it failed by before that."""
        self._thread.start()
        self._clock.wait(self._ended_or_accepted, None)
        if not self._accepted and self.transfer.error is not None:
            raise self.transfer.error

    def halt(self, error: DeviceError) -> None:
        """Nothing of it is sent any more after this call; its transfer fails by ``error``."""
        with self._lock:
            if self._error is None:
                self._error = error
            request = self._request
        self._halted.set()
        if request is not None:
            self._port.cancel(request, error)

    def join(self) -> None:
        """Wait for the end of its thread."""
        if self._thread.ident is not None and self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        error: DeviceError | None = None
        try:
            for number, (message, packet) in enumerate(self._packets, 1):
                self._hand(message, packet, number)
                if number == self._needed:
                    self._accepted = True
                    self._ended_or_accepted.set()
        except DeviceError as failed:
            error = failed
        except Exception as failed:  # noqa: BLE001 - whoever waits for the course would wait for ever
            error = DeviceError(self._arm, "move", f"this program failed: {failed!r}", "report it")
            error.__cause__ = failed
        self.running = False
        if error is None:
            self.transfer.completed()
        else:
            if not isinstance(error, MotionStopped):
                with suppress(DeviceError):  # the failure itself is told
                    self._port.stop(self._arm, self._dialect.stop(self._group))
                self._explain(error)
            self.transfer.failed(error)
        self._ended_or_accepted.set()

    def _hand(self, message: Message, packet: bytes, number: int) -> None:
        give_up = self._clock.now() + _BUSY_FOR
        while True:
            judged = self._dialect.judge(self._port.reply(self._ask(message, packet)))
            if judged.verdict is Verdict.TAKEN:
                self._taken(self._clock.now())
                return
            which = f"message {number} of {len(self._packets)}"
            if judged.verdict is Verdict.REFUSED:
                advice = "see the controller's messages"
                raise CommandRefused(self._arm, "move", f"the controller refused {which}: {judged.why}", advice)
            if self._clock.now() >= give_up:
                why = f"the controller was busy with {which} for {_BUSY_FOR:g} s"
                raise DeviceTimeout(self._arm, "move", why, "see whether the arm moves")
            self._clock.wait(self._halted, self._clock.now() + _BUSY_PAUSE)

    def _ask(self, message: Message, packet: bytes) -> Request:
        with self._lock:
            if self._error is not None:
                raise self._error
            self._request = request = self._port.request(self._arm, message, packet, self._dialect.acknowledges_within)
        return request
