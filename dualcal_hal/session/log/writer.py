"""The log as it is written: by one thread, in bounded memory, and durable on demand."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from mcap.writer import CompressionType, Writer

from dualcal_hal.camera import Frame, Intrinsics
from dualcal_hal.errors import LogNotWritten
from dualcal_hal.robot import RobotState
from dualcal_hal.session.images import ImageFormat, encode, require_bearable
from dualcal_hal.session.log import foxglove
from dualcal_hal.session.log.layout import (
    LARGEST_RECORD,
    LOG_TOPIC,
    METADATA_NAME,
    PROFILE,
    RECORD_TOPICS,
    TRANSFORMS_TOPIC,
    Layout,
    annotations_topic,
    calibration_topic,
    image_topic,
    joint_states_topic,
)
from dualcal_hal.session.log.records import LONGEST_RECORD, Note, Record, to_json
from dualcal_hal.transforms import Array

LARGEST_BACKLOG = 1 << 26
"""Bytes that may wait to be written; then whoever brings more waits."""

WORTH_WAKING = 1 << 16
"""Bytes that wait from which on the thread writes them at once: to wake it for each record costs a run more than the
writing does."""

LONGEST_REST = 0.1
"""Seconds after which it writes what there is."""

SLOW = 0.1
"""Seconds of one wait from which on it is told that the log slows the run."""

TELL_AGAIN = 10.0
"""Seconds after which it may be told again."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_SEQUENCES = 1 << 32
_LATEST = (1 << 62) - 1


@dataclass(frozen=True)
class _Job:
    """Something for the thread to do, and how many bytes it keeps in memory until then."""

    run: Callable[[], None]
    size: int


class FileWriter:
    """The channels of a layout in an MCAP file, in one thread. Errors are the disk's own."""

    def __init__(self, file: IO[bytes], layout: Layout) -> None:
        self._writer = Writer(file, compression=CompressionType.NONE, enable_data_crcs=True)
        self._writer.start(PROFILE, "dualcal")
        self._numbers: dict[str, int] = {}
        self._counts: dict[str, int] = {}
        self._file = file
        self._newest = 0
        schemas: dict[str, int] = {}
        for channel in layout.channels():
            if channel.schema not in schemas:
                encoding = "jsonschema" if channel.encoding == "json" else channel.encoding
                schemas[channel.schema] = self._writer.register_schema(channel.schema, encoding, channel.schema_data())
            number = self._writer.register_channel(channel.topic, channel.encoding, schemas[channel.schema])
            self._numbers[channel.topic] = number

    def write(self, topic: str, when: int, data: bytes, sequence: int | None = None) -> None:
        """A message; log time never goes back. Without a sequence of its own it gets the count of its topic."""
        if sequence is None:
            sequence = self._counts.get(topic, 0)
            self._counts[topic] = sequence + 1
        self._newest = max(self._newest, when)
        self._writer.add_message(self._numbers[topic], self._newest, data, when, sequence % _SEQUENCES)

    def write_metadata(self, name: str, content: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(content))

    def write_attachment(self, name: str, media_type: str, data: bytes, when: int) -> None:
        self._writer.add_attachment(when, when, name, media_type, data)

    def sync(self) -> None:
        """Close the chunk and have all on the disk."""
        self._writer.flush()
        os.fsync(self._file.fileno())

    def finish(self) -> None:
        """Write summary and footer, and have all on the disk."""
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())


class LogWriter:
    """A segment of a run's log, written by a thread of its own. Any thread may call it.

    Nothing is dropped: who brings more than the disk takes waits, and ``on_slow`` is called, by whoever waited and
    at most every 10 s, with the seconds waited in all. What is told of arms that may be moving never waits, so that no
    disk stands between a stop and an arm; of that there is little between two calls that wait. When the disk fails, the
    next call raises LogNotWritten and so does every later one.

    Times are seconds of the clock; ``clock_started`` is what it showed at ``started`` (UTC).
    """

    def __init__(
        self,
        path: Path,
        started: datetime,
        *,
        arms: Iterable[str],
        camera: str = "camera",
        frames: ImageFormat = "png",
        clock_started: float = 0.0,
        metadata: Mapping[str, str] | None = None,
        on_slow: Callable[[float], None] | None = None,
    ) -> None:
        self.path = path
        self.slowed = 0.0
        self._frames = frames
        self._camera = camera
        since = started - _EPOCH
        self._started = (since.days * 86400 + since.seconds) * 10**9 + since.microseconds * 1000
        self._clock_started = clock_started
        self._on_slow = on_slow
        self._told: float | None = None
        self._jobs: deque[_Job] = deque()
        self._waiting = 0
        self._due = False
        self._change = threading.Condition()
        self._failure: BaseException | None = None
        self._failure_told = False
        self._closing = False
        layout = Layout(tuple(arms), camera)
        about = {
            "format": PROFILE,
            "devices": layout.to_text(),
            "started": started.isoformat(),
            "clock_started_s": repr(float(clock_started)),
            "frames": frames,
            **(metadata or {}),
        }
        self._file = _create(path)
        try:
            self._writer = FileWriter(self._file, layout)
            self._writer.write_metadata(METADATA_NAME, about)
            self._file.flush()
            _sync_folder(path.parent)
        except OSError as error:
            self._release(error)
            path.unlink(missing_ok=True)  # nothing is in it
            raise self._not_written(error) from error
        self._thread = threading.Thread(target=self._serve, name="log writer", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # What is written. It blocks while the disk is behind, unless it says otherwise, and raises LogNotWritten once the
    # disk has failed.

    def await_room(self) -> None:
        """Return when what waits to be written is less than the backlog's bound."""
        begun = time.perf_counter()
        with self._change:
            self._wait_for_room(0)
        self._raise_failure()
        self._tell_if_slow(time.perf_counter() - begun)

    def record(self, record: Record, *, wait: bool = True) -> None:
        """A record; a Note is shown to viewers too. ValueError for one that JSON cannot hold or that is too large."""
        data = to_json(record)
        if len(data) > LONGEST_RECORD:
            raise ValueError(f"a {type(record).__name__} of {len(data)} bytes is too large for the log")
        self._message(RECORD_TOPICS[type(record)], record.time, data, wait=wait)
        if isinstance(record, Note):
            line = foxglove.log(record.level, record.text, self._nanoseconds(record.time))
            self._message(LOG_TOPIC, record.time, line.SerializeToString())

    def frame(self, frame: Frame) -> None:
        """A frame of the camera, encoded by the thread. Its image must not be changed afterwards."""
        if frame.image.ndim != 2 or frame.image.dtype != "uint8":
            raise ValueError("a frame is a grey image of bytes")
        require_bearable(*frame.image.shape[::-1])
        when = self._nanoseconds(frame.time)

        def write() -> None:
            data = encode(frame.image, self._frames)
            message = foxglove.compressed_image(self._camera, data, self._frames, when)
            self._writer.write(image_topic(self._camera), when, message.SerializeToString(), frame.sequence)

        self._put(_Job(write, frame.image.nbytes))

    def joint_states(self, arm: str, state: RobotState) -> None:
        """What an arm reports, for viewers and tables; never waits."""
        message = foxglove.joint_states(arm, state, self._nanoseconds(state.time))
        self._message(joint_states_topic(arm), state.time, message.SerializeToString(), state.sequence, wait=False)

    def calibration(self, intrinsics: Intrinsics, when: float) -> None:
        """The camera's intrinsics, for viewers."""
        message = foxglove.camera_calibration(self._camera, intrinsics, self._nanoseconds(when))
        self._message(calibration_topic(self._camera), when, message.SerializeToString())

    def annotations(self, axis: Iterable[float], feature: Iterable[float] | None, when: float) -> None:
        """Where (px) the optical axis is and the feature was seen in the frame exposed at ``when``, for viewers."""
        message = foxglove.image_annotations(axis, feature, self._nanoseconds(when))
        self._message(annotations_topic(self._camera), when, message.SerializeToString())

    def transforms(self, transforms: Iterable[tuple[str, str, Array]], when: float) -> None:
        """(parent, child, T) as they are at ``when``, for viewers."""
        message = foxglove.frame_transforms(transforms, self._nanoseconds(when))
        self._message(TRANSFORMS_TOPIC, when, message.SerializeToString())

    def metadata(self, name: str, content: Mapping[str, str]) -> None:
        """Texts by name, such as versions."""
        self._put(_Job(lambda: self._writer.write_metadata(name, content), sum(map(len, content.values()))))

    def attach(self, name: str, media_type: str, data: bytes, when: float) -> None:
        """A file kept in the log, such as ``cell.yaml``."""
        _require_size(name, data)
        stamp = self._nanoseconds(when)
        self._put(_Job(lambda: self._writer.write_attachment(name, media_type, data, stamp), len(data)))

    def sync(self) -> None:
        """Return when all that was handed over is on the disk, and readable there whatever happens then."""
        done = threading.Event()

        def write() -> None:
            self._writer.sync()
            done.set()

        self._put(_Job(write, 0))
        with self._change:
            self._wake()
            self._change.wait_for(lambda: done.is_set() or self._failure is not None)
        self._raise_failure()

    def close(self) -> None:
        """Write what is left and finish the file. Any number of times; raises LogNotWritten if nobody was told yet."""
        with self._change:
            if self._closing:
                return
            self._closing = True
            self._change.notify_all()
        self._thread.join()
        if not self._failure_told:
            self._raise_failure()

    # Between the threads

    def _message(self, topic: str, when: float, data: bytes, sequence: int | None = None, *, wait: bool = True) -> None:
        _require_size(topic, data)
        stamp = self._nanoseconds(when)
        self._put(_Job(lambda: self._writer.write(topic, stamp, data, sequence), len(data)), wait=wait)

    def _nanoseconds(self, clock: float) -> int:
        since = clock - self._clock_started
        if not math.isfinite(since):
            # A device that reports no time is shown at the beginning; what it reported is in the records.
            return self._started
        return min(max(0, self._started + round(since * 1e9)), _LATEST)

    def _put(self, job: _Job, *, wait: bool = True) -> None:
        begun = time.perf_counter()
        with self._change:
            if wait:
                self._wait_for_room(job.size)
            if self._failure is None:
                if self._closing:
                    raise LogNotWritten(f"{self.path}: the log is closed")
                self._jobs.append(job)
                self._waiting += job.size
                if self._waiting >= WORTH_WAKING:
                    self._wake()
        self._raise_failure()
        self._tell_if_slow(time.perf_counter() - begun)

    def _wait_for_room(self, size: int) -> None:
        if not self._has_room(size):
            self._wake()
            self._change.wait_for(lambda: self._has_room(size))

    def _wake(self) -> None:
        """Have the thread write what there is."""
        if not self._due:
            self._due = True
            self._change.notify_all()

    def _has_room(self, size: int) -> bool:
        if self._failure is not None or self._closing:
            return True
        return self._waiting == 0 or self._waiting + size <= LARGEST_BACKLOG

    def _tell_if_slow(self, waited: float) -> None:
        if waited < SLOW:
            return
        now = time.perf_counter()
        with self._change:
            self.slowed += waited
            tell = self._told is None or now - self._told >= TELL_AGAIN
            if tell:
                self._told = now
        if tell and self._on_slow is not None:
            self._on_slow(self.slowed)

    def _raise_failure(self) -> None:
        if self._failure is not None:
            self._failure_told = True
            raise self._not_written(self._failure) from self._failure

    def _not_written(self, error: BaseException) -> LogNotWritten:
        why = error.strerror if isinstance(error, OSError) and error.strerror else f"{type(error).__name__}: {error}"
        return LogNotWritten(f"{self.path}: the log cannot be written: {why}")

    # The thread

    def _serve(self) -> None:
        failure: BaseException | None = None
        try:
            while jobs := self._next():
                for job in jobs:
                    job.run()
                    self._finished(job)
            self._writer.finish()
        except BaseException as error:  # noqa: BLE001 - told to the next caller; a thread that died silently would hang it
            failure = error
        self._release(failure)

    def _next(self) -> list[_Job]:
        """All that waits, in its order; nothing once it is over."""
        with self._change:
            while True:
                self._change.wait_for(lambda: self._due or self._closing, LONGEST_REST)
                self._due = False
                if self._jobs or self._closing:
                    jobs = list(self._jobs)
                    self._jobs.clear()
                    return jobs

    def _finished(self, job: _Job) -> None:
        with self._change:
            self._waiting -= job.size
            self._change.notify_all()

    def _release(self, failure: BaseException | None) -> None:
        """Close the file, and let everybody know who waits."""
        try:
            self._file.close()
        except OSError as error:
            failure = failure or error
        with self._change:
            self._failure = failure
            self._jobs.clear()
            self._waiting = 0
            self._change.notify_all()


def _create(path: Path) -> IO[bytes]:
    try:
        return path.open("xb")
    except OSError as error:
        raise LogNotWritten(f"{path}: the log cannot be written: {error.strerror}") from error


def _sync_folder(folder: Path) -> None:
    """Make a new file's name as durable as what will be synced into it."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _require_size(name: str, data: Any) -> None:
    if len(data) > LARGEST_RECORD - (1 << 16):
        raise ValueError(f"{name}: {len(data)} bytes are too many for the log")
