"""Live progress of a run: a bar for each use on a terminal, plain lines elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from procedures.events import BeliefRefined, LookTaken, PlanReady, PointDone, counted
from procedures.intrinsics.procedure import ViewTaken


class Lines:
    """One line for each event."""

    def __init__(self, console: Console) -> None:
        self._console = console

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Nothing is in the way of a question between lines."""
        yield

    def __call__(self, event: object) -> None:
        self._console.print(str(event), highlight=False, soft_wrap=True)


class Bars:
    """Bars for looks and points, with the latest point beside them."""

    def __init__(self, console: Console) -> None:
        self._bars = Progress(
            TextColumn("{task.description:<12}", markup=False, table_column=Column(no_wrap=True, min_width=12)),
            BarColumn(bar_width=12),
            MofNCompleteColumn(table_column=Column(no_wrap=True, min_width=5)),
            TimeElapsedColumn(table_column=Column(no_wrap=True, min_width=7)),
            TextColumn(
                "{task.fields[latest]}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)
            ),
            console=console,
            expand=True,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):  # the terminal may be gone
            self._bars.stop()

    @contextmanager
    def paused(self) -> Iterator[None]:
        """The bars are taken off the screen while this lasts."""
        self._bars.stop()
        yield
        self._bars.start()

    def __call__(self, event: object) -> None:
        match event:
            case LookTaken():
                self._advance("first look", event.count, "found" if event.found else event.reason)
            case PlanReady(plan):
                for constraint in plan.constraints:
                    self._task(constraint.use, sum(len(c.positions) for c in plan.of(constraint.use)))
            case PointDone():
                offset = "" if event.offset_px is None else f" {max(map(abs, event.offset_px)):.3f} px"
                where = f"{event.constraint} position {event.position + 1}/{event.positions}"
                text = f"{where}: {event.outcome}, {counted(event.frames, 'picture')}{offset}"
                self._advance(event.use, 0, text, by=1 if event.captured else 0)
            case ViewTaken():
                self._advance("views", event.count, "found" if event.found else event.reason)
            case BeliefRefined():
                pass  # on a terminal the bars say enough
            case _:
                self._bars.console.print(str(event), highlight=False)

    def _task(self, name: str, total: int) -> TaskID:
        if name not in self._tasks:
            self._tasks[name] = self._bars.add_task(name, total=total, latest="")
        return self._tasks[name]

    def _advance(self, name: str, total: int, latest: str, by: int = 1) -> None:
        self._bars.update(self._task(name, total), total=total or None, advance=by, latest=latest)


def progress(console: Console) -> Lines | Bars:
    """What suits the console."""
    return Bars(console) if console.is_terminal else Lines(console)
