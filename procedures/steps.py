"""What a procedure may ask of the engine. A procedure is a generator of these steps that gets replies sent in.

The lower-case functions are the typed way to ask: ``states = yield from read()``.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Protocol, Self, TypeVar

from dualcal_hal.camera import Frame, Image
from dualcal_hal.geometry import CellGeometry, Placement
from dualcal_hal.robot import Joints, RobotState
from dualcal_hal.session.journal import StepKey
from dualcal_hal.transforms import Array

T = TypeVar("T")
Procedure = Generator[Any, Any, T]


class Record(Protocol):
    """A result that survives in the journal: plain JSON, with units in the names."""

    def to_record(self) -> dict[str, Any]:
        """The result as JSON."""
        ...

    @classmethod
    def from_record(cls, record: dict[str, Any]) -> Self:
        """The same result again, to the last bit; ValueError for anything else."""
        ...


R = TypeVar("R", bound=Record)


@dataclass(frozen=True)
class ArmReading:
    """What an arm reports, and the target it was last sent to in this run.

    None before the first, and where a run goes on and the arm does not stand where it was left.
    """

    state: RobotState
    commanded: Joints | None


@dataclass(frozen=True)
class Readings:
    active: ArmReading
    passive: ArmReading


@dataclass(frozen=True, eq=False)
class Sighting:
    """A frame with both arms' joint angles (rad), the mean of what was read before and after the exposure.

    active_arrival: a number of its own for each time that the active arm arrives anew in the run.
    """

    frame: Frame
    active: Joints
    passive: Joints
    active_arrival: int


@dataclass(frozen=True)
class Read:
    """Read both arms."""


@dataclass(frozen=True)
class Move:
    """Move one arm straight in joint space through ``waypoints`` (rad) and wait until it has settled."""

    arm: str
    waypoints: tuple[Joints, ...]


@dataclass(frozen=True)
class Look:
    """Read both arms, take a frame exposed from now on, read both again."""


@dataclass(frozen=True, eq=False)
class Believe:
    """From here on the guard judges clearance with the arms' bases placed so and their shapes these.

    T_H_E: (4, 4) the camera on its flange, for viewers.
    """

    placement: Placement
    geometry: CellGeometry
    T_H_E: Array


@dataclass(frozen=True, eq=False)
class KeepImage:
    """Store an image of the session durably, under a name like ``calibration/00/0``."""

    name: str
    image: Image


@dataclass(frozen=True, eq=False)
class KeepDocument:
    """Store a JSON document of the session durably, such as ``plan.json``."""

    file_name: str
    document: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Tell:
    """Hand an event to the observers."""

    event: object


@dataclass(frozen=True, eq=False)
class Confirm:
    """Have the operator agree to what comes next, on a cell where that is asked for; NotConfirmed is thrown in if not.

    body: gives what the operator is shown; it is run only where somebody looks at it.
    """

    body: Callable[[], Procedure[object]]


@dataclass(frozen=True, eq=False)
class Task:
    """A part of the procedure whose result is journalled under ``key`` when it is finished.

    In a run that goes on from a journal, a finished key is answered from there by ``read``, which raises ValueError for
    what is no result of this cell's, and the body is not run.
    """

    key: StepKey
    body: Callable[[], Procedure[Any]]
    read: Callable[[dict[str, Any]], Record]


@dataclass(frozen=True, eq=False)
class Work:
    """Something to work out that takes no device. It is recorded, and a replay answers it from the recording.

    what, asked: what is to be worked out, and for what, as plain JSON; write, read: the result as plain JSON and back,
    with ValueError for what is none.
    of_image: worked out from an image, so a replay that has the very same image works it out anew.
    """

    what: str
    asked: Any
    body: Callable[[], Any]
    write: Callable[[Any], Any]
    read: Callable[[Any], Any]
    of_image: bool = False


@dataclass(frozen=True)
class Mark:
    """Show viewers where (px) the feature was seen in the frame exposed at ``time``, if it was."""

    time: float
    feature: tuple[float, float] | None


def read() -> Procedure[Readings]:
    """What both arms report now."""
    reply: Readings = yield Read()
    return reply


def move(arm: str, *waypoints: Joints) -> Procedure[RobotState]:
    """Move an arm through ``waypoints`` (rad) to the last of them; the state in which it has settled."""
    reply: RobotState = yield Move(arm, waypoints)
    return reply


def look() -> Procedure[Sighting]:
    """A picture and where both arms stood; ArmMoved is thrown in if they did not stand."""
    reply: Sighting = yield Look()
    return reply


def tell(event: object) -> Procedure[None]:
    """Hand an event to the observers."""
    yield Tell(event)


def work(
    what: str,
    asked: Any,
    body: Callable[[], T],
    write: Callable[[T], Any],
    read: Callable[[Any], T],
    *,
    of_image: bool = False,
) -> Procedure[T]:
    """What ``body`` returns, or what it returned when the run was recorded that is replayed."""
    reply: T = yield Work(what, asked, body, write, read, of_image)
    return reply


def task(key: StepKey, body: Callable[[], Procedure[R]], read: Callable[[dict[str, Any]], R]) -> Procedure[R]:
    """The result of ``body``, or the one that the journal has for ``key``."""
    reply: R = yield Task(key, body, read)
    return reply
