"""A backend owns what its devices share: a simulated world, a bus, a controller, a recording."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from dualcal_hal.camera import Camera
from dualcal_hal.clock import Clock
from dualcal_hal.errors import UsageError
from dualcal_hal.robot import Robot

if TYPE_CHECKING:
    from pydantic import BaseModel

    from dualcal_hal.cellfile import CellFile


@dataclass(frozen=True)
class Answer:
    """What came of a piece of work in a recorded run.

    result: gives it as plain JSON, or raises the error that it ended in; images_are_exact: whether the images that
    are played back are the very same, so that what was worked out from them can be worked out anew; place: where it
    is recorded.
    """

    result: Callable[[], Any]
    images_are_exact: bool
    place: str = "the log"


class Backend(ABC):
    """One instance for each name under ``backends`` in the cell file.

    time: "drives" if it makes time (a simulator, a replay), "real" if it lives in it.
    simulated: whether no real device stands behind it.
    repeats_targets: whether an arm that stands where it was sent before has the very pose that it had then, also
    after the program was begun anew; a real arm may have been moved meanwhile.
    Options: the pydantic model of its entry under ``backends``.
    """

    time: ClassVar[Literal["drives", "real"]]
    simulated: bool
    repeats_targets: ClassVar[bool] = False
    Options: ClassVar[type[BaseModel]]

    def __init__(self, name: str, cell: CellFile) -> None:
        self.name = name
        self.cell = cell

    @property
    @abstractmethod
    def clock(self) -> Clock:
        """The clock its devices' times are of."""

    @abstractmethod
    def open(self, timeout: float) -> None:
        """Make its devices usable, or raise and leave nothing open. Opening an open one is an error."""

    def open_alone(self, device: str, timeout: float) -> None:
        """As :meth:`open`, for one arm or camera alone where the others can be left out; else for all."""
        self.open(timeout)

    @abstractmethod
    def close(self) -> None:
        """Stop and release everything; any number of times, also after a failed open."""

    @abstractmethod
    def robot(self, name: str) -> Robot:
        """The arm of that name in the cell file; UnknownDevice if it has none."""

    @abstractmethod
    def camera(self, name: str) -> Camera:
        """The camera of that name; UnknownDevice if it has none."""

    def use_emulator(self, endpoints: Mapping[str, Any]) -> None:
        """Reach its devices at an emulator that was started for this run: it is simulated from here on; before opening.

        endpoints: what the emulator said of this backend. UsageError where it is none that can be emulated.
        """
        raise UsageError(f"{self.name}: a backend of this type has no emulator")

    def answer(self, what: str, asked: Any) -> Answer | None:
        """What came of that piece of work in the run that is played back; None where none is.

        what, asked: as the work was recorded, plain JSON. Raises ReplayMismatch if the recorded run worked out
        something else there, and LogEnded.
        """
        return None

    def procedure_ended(self) -> None:
        """The procedure has come to its good end, and asks nothing more; called while it is open.

        Raises ReplayMismatch where a recorded run went on.
        """
        return  # devices expect nothing

    def documents(self) -> Mapping[str, dict[str, Any]]:
        """JSON documents that are to be kept beside the run, by file name; asked for while it is open."""
        return {}

    def left(self) -> dict[str, Any]:
        """What it needs to go on from here in another process, as plain JSON; asked for while it is open.

        Nothing for devices, which know themselves where they stand.
        """
        return {}

    def go_on_from(self, state: Mapping[str, Any]) -> None:
        """Have it be as it was when :meth:`left` gave ``state``, once it is opened; called before that.

        FormatError for a state that is none of this cell's.
        """
        return  # devices are where they are
