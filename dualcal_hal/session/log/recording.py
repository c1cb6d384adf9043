"""What is recorded of a run: at the border of the devices, and what the engine does with them."""

from __future__ import annotations

import platform
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

from dualcal_hal.camera import Camera, Frame
from dualcal_hal.cellfile import CellFile
from dualcal_hal.clock import Clock, utc_now
from dualcal_hal.errors import DeviceError, DualcalError, LogNotWritten
from dualcal_hal.findings import Finding
from dualcal_hal.robot import JointPath, Joints, Motion, Robot, RobotState, StopResult
from dualcal_hal.session.files import document_bytes
from dualcal_hal.session.journal import StepKey
from dualcal_hal.session.log.records import (
    Arrived,
    Call,
    FrameRef,
    Level,
    MotionEnded,
    Note,
    Record,
    RecordedError,
    Reply,
    RunEnded,
    StepBegun,
    StepFinished,
    Value,
    Worked,
)
from dualcal_hal.session.log.writer import LogWriter
from dualcal_hal.transforms import Array

T = TypeVar("T")

_PACKAGES = ("dualcal", "numpy", "scipy", "opencv-python-headless", "coal", "pybullet", "mcap", "protobuf")


class Recording:
    """What is told of a run, and kept nowhere: that is what ``--no-log`` asks for."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def robot(self, robot: Robot) -> Robot:
        """The same arm, with all that passes recorded."""
        return robot

    def camera(self, camera: Camera) -> Camera:
        """The same camera, with all that passes recorded."""
        return camera

    def watch(self, robot: Robot) -> None:
        """Keep the states that come from an open arm, for viewers, until :meth:`leave`."""

    def leave(self) -> None:
        """Ask nothing more of the devices: they are about to be closed."""

    def step_begun(self, key: StepKey) -> None:
        """A step of the procedure begins."""

    def step_finished(self, key: StepKey) -> None:
        """A step has a result; all that was recorded of it is on the disk when this returns."""

    def worked(self, what: str, asked: Any, result: Any, error: DualcalError | None = None) -> None:
        """Something was worked out without a device, or ended in an error; ``asked`` and ``result`` are plain JSON."""

    def note(self, text: str, level: Level = "info") -> None:
        """A line for a person."""

    def document(self, name: str, document: Mapping[str, Any]) -> None:
        """A JSON document of the session."""

    def belief(self, T_P_A: Array, T_H_E: Array) -> None:
        """Where the active base and the camera are believed to be (4, 4), for viewers."""

    def stands(self, time: float, joints: Mapping[str, Joints]) -> None:
        """Where the arms stand (rad) at a time, for viewers."""

    def mark(self, time: float, feature: tuple[float, float] | None) -> None:
        """Where (px) the feature was seen in the frame exposed at a time, for viewers."""


class LogRecording(Recording):
    """A recording into one file of a session's log.

    Whatever cannot be written ends the run by LogNotWritten, except a stop, which is sent in any case.
    """

    def __init__(self, path: Path, file: CellFile, clock: Clock) -> None:
        """Begins the file; LogNotWritten if that is not possible."""
        self._clock = clock
        self._cell = file.cell
        self._axis = tuple(map(float, file.cell.camera.intrinsics.principal_point))
        self._worked = 0
        self._leaving: list[Callable[[], None]] = []
        self._calls: dict[str, int] = {}
        self._lock = threading.Lock()
        started = clock.now()
        self._log = LogWriter(
            path,
            utc_now(),
            arms=(file.cell.active_name, file.cell.passive_name),
            frames=file.cell.session.frames,
            clock_started=started,
            metadata={"cell_sha256": file.sha256},
            on_slow=self._tell_slow,
        )
        try:
            self._log.metadata("versions", _versions())
            self._log.attach("cell.yaml", "application/yaml", file.text.encode(), started)
            self._log.calibration(file.cell.camera.intrinsics, started)
            self._log.sync()
        except BaseException:
            with suppress(LogNotWritten):  # the first failure is the one to tell
                self._log.close()
            path.unlink(missing_ok=True)  # nothing of the run is in it
            raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.leave()
        if error is None:
            self.record(RunEnded(None, self.now()))
            self._log.close()
            return
        try:
            self.note(f"{type(error).__name__}: {error}", "error")
            self.record(RunEnded(RecordedError.of(error), self.now()))
            self._log.close()
        except LogNotWritten as second:
            if second is not error:
                error.add_note(str(second))

    def robot(self, robot: Robot) -> Robot:
        return _RecordedRobot(robot, self)

    def watch(self, robot: Robot) -> None:
        def show(state: RobotState) -> None:
            with suppress(LogNotWritten):  # told by the next command; the device's thread is not the place
                self._log.joint_states(robot.name, state)

        self._leaving.append(robot.subscribe(show))

    def camera(self, camera: Camera) -> Camera:
        return _RecordedCamera(camera, self)

    def leave(self) -> None:
        while self._leaving:
            self._leaving.pop()()

    def step_begun(self, key: StepKey) -> None:
        self.record(StepBegun(key, self.now()))

    def step_finished(self, key: StepKey) -> None:
        self.record(StepFinished(key, self.now()))
        self._log.sync()

    def worked(self, what: str, asked: Any, result: Any, error: DualcalError | None = None) -> None:
        failure = None if error is None else RecordedError.of(error)
        self.record(Worked(self._worked, what, asked, result, self.now(), failure))
        self._worked += 1

    def note(self, text: str, level: Level = "info") -> None:
        self.record(Note(level, text, self.now()))

    def document(self, name: str, document: Mapping[str, Any]) -> None:
        self._log.attach(name, "application/json", document_bytes(document), self.now())

    def belief(self, T_P_A: Array, T_H_E: Array) -> None:
        active, passive = self._cell.active_name, self._cell.passive_name
        mount = self._cell.passive.target_mount_transform
        known = [
            (f"{passive}_base", f"{active}_base", T_P_A),
            (f"{active}_flange", "camera", T_H_E),
            (f"{passive}_flange", "target", mount),
        ]
        self._log.transforms(known, self.now())

    def stands(self, time: float, joints: Mapping[str, Joints]) -> None:
        flanges = [
            (f"{arm}_base", f"{arm}_flange", self._cell.robots[arm].chain.forward(q)) for arm, q in joints.items()
        ]
        self._log.transforms(flanges, time)

    def mark(self, time: float, feature: tuple[float, float] | None) -> None:
        self._log.annotations(self._axis, feature, time)

    # What the devices' wrappers need

    def now(self) -> float:
        """Seconds of the clock."""
        return self._clock.now()

    def record(self, record: Record, *, wait: bool = True) -> None:
        """Any record; LogNotWritten. With arms that may be moving there is no waiting for the disk."""
        self._log.record(record, wait=wait)

    def frame(self, frame: Frame) -> None:
        """A camera's frame, before the reply that refers to it."""
        self._log.frame(frame)

    def call(self, device: str, method: str, arguments: Mapping[str, Value], time: float, *, wait: bool = True) -> int:
        """Record a call; its index. Here, before anything is sent, a run waits for a disk that is behind."""
        if wait:
            self._log.await_room()
        with self._lock:  # held for no longer than it takes to queue, as stops need it too
            index = self._calls.get(device, 0)
            self._calls[device] = index + 1
            self.record(Call(device, index, method, arguments, time), wait=False)
        return index

    def _tell_slow(self, seconds: float) -> None:
        self.note(f"the disk is slower than the run: it has waited {seconds:.1f} s for its log so far", "warning")


class _RecordedRobot(Robot):
    def __init__(self, robot: Robot, recording: LogRecording) -> None:
        self.name = robot.name
        self._robot = robot
        self._recording = recording

    @property
    def joints(self) -> int:
        return self._robot.joints

    def read(self, timeout: float) -> RobotState:
        return _asked(self._recording, self.name, "read", {"timeout_s": timeout}, lambda: self._robot.read(timeout))

    def subscribe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        recording, name = self._recording, self.name
        index = recording.call(name, "subscribe", {}, recording.now())

        def arrived(state: RobotState) -> None:
            with suppress(LogNotWritten):  # told by the next command; the device's thread is not the place
                recording.record(Arrived(name, index, state, recording.now()), wait=False)
            function(state)

        return _answered(recording, name, index, lambda: self._robot.subscribe(arrived), lambda _: None)

    def observe(self, function: Callable[[RobotState], None]) -> Callable[[], None]:
        return self._robot.observe(function)

    def on_failure(self, function: Callable[[DeviceError], None]) -> Callable[[], None]:
        """Not recorded: what comes of it is, a stop or an error."""
        return self._robot.on_failure(function)

    @property
    def keeps_speed(self) -> bool:
        return self._robot.keeps_speed

    @property
    def confirmed_speed(self) -> float | None:
        return self._robot.confirmed_speed

    def findings(self) -> list[Finding]:
        return self._robot.findings()

    def start(self, path: JointPath) -> Motion:
        recording, name = self._recording, self.name
        index = recording.call(name, "start", {"path": path}, recording.now())
        motion = _answered(recording, name, index, lambda: self._robot.start(path), lambda _: None)

        def ended() -> None:
            error = None if motion.error is None else RecordedError.of(motion.error)
            with suppress(LogNotWritten):  # told by the next command; the device's thread is not the place
                ended = MotionEnded(name, index, motion.state, motion.final, recording.now(), error)
                recording.record(ended, wait=False)

        motion.on_end(ended)
        return motion

    def stop(self, reason: str) -> StopResult:
        """Sent first and recorded afterwards, without waiting: no disk delays or prevents it, or the next."""
        recording, asked = self._recording, self._recording.now()
        error: BaseException | None = None
        result: StopResult | None = None
        try:
            result = self._robot.stop(reason)
            return result
        except Exception as raised:
            error = raised
            raise
        finally:
            with suppress(LogNotWritten):  # told by the next command; the stop itself is done
                index = recording.call(self.name, "stop", {"reason": reason}, asked, wait=False)
                failure = None if error is None else RecordedError.of(error)
                recording.record(Reply(self.name, index, result, recording.now(), failure), wait=False)

    def enable(self, timeout: float) -> None:
        self._switch("enable", timeout, self._robot.enable)

    def disable(self, timeout: float) -> None:
        self._switch("disable", timeout, self._robot.disable)

    def reset_fault(self, timeout: float) -> None:
        self._switch("reset_fault", timeout, self._robot.reset_fault)

    def _switch(self, method: str, timeout: float, function: Callable[[float], None]) -> None:
        _asked(self._recording, self.name, method, {"timeout_s": timeout}, lambda: function(timeout))


class _RecordedCamera(Camera):
    def __init__(self, camera: Camera, recording: LogRecording) -> None:
        self.name = camera.name
        self._camera = camera
        self._recording = recording

    def findings(self) -> list[Finding]:
        return self._camera.findings()

    def grab(self, not_before: float, timeout: float) -> Frame:
        recording = self._recording

        def written(frame: Frame) -> FrameRef:
            recording.frame(frame)
            return FrameRef(self.name, frame.sequence, frame.time)

        asked = {"not_before_s": not_before, "timeout_s": timeout}
        index = recording.call(self.name, "grab", asked, recording.now())
        frame: Frame = _answered(recording, self.name, index, lambda: self._camera.grab(not_before, timeout), written)
        return frame


def _asked(
    recording: LogRecording, device: str, method: str, arguments: Mapping[str, Value], function: Callable[[], T]
) -> T:
    """What the device answers as it is, recorded with the call."""
    index = recording.call(device, method, arguments, recording.now())
    value: T = _answered(recording, device, index, function, lambda value: value)
    return value


def _answered(
    recording: LogRecording, device: str, index: int, function: Callable[[], T], written: Callable[[T], Any]
) -> T:
    """What the device answers, recorded as ``written`` says, or as the error that it raised."""
    try:
        value = function()
    except Exception as error:
        try:
            recording.record(Reply(device, index, None, recording.now(), RecordedError.of(error)), wait=False)
        except LogNotWritten as second:
            error.add_note(str(second))
        raise
    recording.record(Reply(device, index, written(value), recording.now()), wait=False)
    return value


def _versions() -> dict[str, str]:
    """Of all that has a share in the numbers."""
    versions = {"python": platform.python_version(), "machine": f"{platform.system()} {platform.machine()}"}
    for package in _PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    return versions
