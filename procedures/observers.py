"""Those who watch a run. They can neither slow nor fail it."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Self

Observer = Callable[[object], None]

_log = logging.getLogger(__name__)

PATIENCE = 2.0
"""Seconds that the end of a run waits for observers to catch up; then they are left behind."""

_LONGEST_BACKLOG = 1000
_END = object()


class Observers:
    """Hands events to observers on a thread of its own; what they cannot keep up with is dropped and counted."""

    def __init__(self, *observers: Observer) -> None:
        self._observers = list(observers)
        self._events: queue.Queue[object] = queue.Queue(_LONGEST_BACKLOG)
        self._thread = threading.Thread(target=self._serve, name="observers", daemon=True)
        self.dropped = 0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(queue.Full):
            self._events.put(_END, timeout=PATIENCE)
        self._thread.join(PATIENCE)

    def tell(self, event: object) -> None:
        """Never blocks."""
        try:
            self._events.put_nowait(event)
        except queue.Full:
            self.dropped += 1

    def _serve(self) -> None:
        while (event := self._events.get()) is not _END:
            for observer in list(self._observers):
                try:
                    observer(event)
                except Exception:
                    logging.getLogger(__name__).exception("an observer failed and is taken off")
                    self._observers.remove(observer)
