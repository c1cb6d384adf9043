"""The recording as a backend."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, ValidationInfo, field_validator

from backends.replay.comparison import difference
from backends.replay.devices import ReplayedCamera, ReplayedRobot
from backends.replay.timeline import RecordedClock, Timeline, ended
from dualcal_hal.backend import Answer, Backend
from dualcal_hal.config.fixtures import FOLDER
from dualcal_hal.errors import WORK, CellFileError, NotOpen, Problem, ReplayMismatch, UnknownDevice, UsageError
from dualcal_hal.session.log import Call, Worked
from dualcal_hal.session.log.attempts import begun_segments

if TYPE_CHECKING:
    from dualcal_hal.cellfile import CellFile

CAMERA = "camera"


class ReplayOptions(BaseModel):
    """What is played back."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    session: Path
    """A session's folder, or one file of its log; relative to the cell file."""

    @field_validator("session")
    @classmethod
    def _beside_the_cell_file(cls, value: Path, info: ValidationInfo) -> Path:
        return Path((info.context or {}).get(FOLDER, "")).joinpath(value).absolute()


class ReplayBackend(Backend):
    """Plays back a whole cell; CellFileError if a device of the cell is another backend's, LogMissing where there is
    nothing to be played back.

    Opening it plays the recording from its beginning; its time goes on.
    """

    time: ClassVar[Literal["drives", "real"]] = "drives"
    simulated = True
    Options: ClassVar[type[BaseModel]] = ReplayOptions

    def __init__(self, name: str, cell: CellFile) -> None:
        super().__init__(name, cell)
        options = cell.cell.backends[name].checked
        assert isinstance(options, ReplayOptions)
        self._session = options.session
        _require_whole_cell(name, cell)
        begun_segments(self._session)  # refused now, before anything is begun
        self._clock = RecordedClock()
        self._timeline: Timeline | None = None
        self._robots = {
            arm: ReplayedRobot(arm, config.chain.joints, self._clock, self._opened)
            for arm, config in cell.cell.arms.items()
        }
        self._camera = ReplayedCamera(CAMERA, self._opened)

    @property
    def clock(self) -> RecordedClock:
        return self._clock

    def open(self, timeout: float) -> None:
        if self._timeline is not None:
            raise UsageError(f"{self.name}: open: it is open already; close it first")
        self._timeline = Timeline(begun_segments(self._session), self._clock)

    def close(self) -> None:
        timeline, self._timeline = self._timeline, None
        if timeline is not None:
            timeline.close()

    def robot(self, name: str) -> ReplayedRobot:
        if name not in self._robots:
            raise UnknownDevice(name, "find the arm", f"'{self.name}' has {', '.join(sorted(self._robots))}")
        return self._robots[name]

    def camera(self, name: str) -> ReplayedCamera:
        if name != CAMERA:
            raise UnknownDevice(name, "find the camera", f"'{self.name}' has {CAMERA}")
        return self._camera

    def answer(self, what: str, asked: Any) -> Answer:
        timeline = self._opened(WORK, what)
        recorded = timeline.next_work()
        if recorded is None:
            raise ended(WORK, what)
        work, images_are_exact = recorded
        if work.what != what:
            raise ReplayMismatch.at(WORK, work.index, work.what, what, "something else is worked out")
        differs = difference(work.asked, asked)
        if differs is not None:
            raise ReplayMismatch.at(WORK, work.index, work.asked, asked, f"{what}: {differs}")
        timeline.take_work()
        return Answer(lambda: _result(work), images_are_exact, f"{self._session}: work {work.index}")

    def procedure_ended(self) -> None:
        """ReplayMismatch for the first command or piece of work that the recorded run went on with."""
        missing = self._opened(self.name, "end").not_asked()
        if isinstance(missing, Call):
            raise ReplayMismatch.at(missing.device, missing.index, missing.method, "nothing more", "it is not asked")
        if missing is not None:
            raise ReplayMismatch.at(WORK, missing.index, missing.what, "nothing more", "it is not worked out")

    def left(self) -> dict[str, Any]:
        """That something was played back."""
        return {"played_back": str(self._session)}

    def go_on_from(self, state: Mapping[str, Any]) -> None:
        """UsageError: a recording is played from its beginning, and that takes no arm's time."""
        raise UsageError(
            f"{self.name}: what was played back from {self._session} cannot be gone on with: "
            f"run it anew from its beginning, or dualcal replay {self._session}"
        )

    def _opened(self, device: str, attempted: str) -> Timeline:
        if self._timeline is None:
            raise NotOpen(device, attempted, f"backend '{self.name}' is not open", "open it first")
        return self._timeline


def _result(work: Worked) -> Any:
    if work.error is not None:
        raise work.error.error()
    return work.result


def _require_whole_cell(name: str, cell: CellFile) -> None:
    devices = {f"robots.{arm}.backend": config.backend for arm, config in cell.cell.arms.items()}
    devices["camera.backend"] = cell.cell.camera.backend
    problems = [
        Problem(where, f"is '{backend}': the replay '{name}' makes its own time and plays back the whole cell")
        for where, backend in devices.items()
        if backend != name
    ]
    if problems:
        raise CellFileError(problems)
