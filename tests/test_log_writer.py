"""The writer: what is handed over is written, durable when it says so, and a failing disk is told, never waited for."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from dualcal_hal.camera import Frame
from dualcal_hal.cellfile import load_cell
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import LogNotWritten
from dualcal_hal.robot import Mode, Robot, RobotState, StopResult
from dualcal_hal.session import images
from dualcal_hal.session.images import encode_png
from dualcal_hal.session.log import Call, FrameRef, LogReader, LogWriter, Note, Picture, Reply, Worked, writer
from dualcal_hal.session.log.recording import LogRecording
from tests.cells import TINY
from tools.benchmarks.mutated_logs import STARTED

IMAGES = np.random.default_rng(1).integers(0, 256, (8, 40, 50), dtype=np.uint8)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log-0001.mcap"


def open_log(path, **options):
    return LogWriter(path, STARTED, arms=("left", "right"), **options)


def items(path):
    with LogReader(path) as reader:
        return list(reader.items()), reader.ending


def test_what_is_handed_over_comes_back_in_its_order(path):
    with open_log(path) as log:
        for number, image in enumerate(IMAGES):
            log.record(Call("camera", number, "grab", {}, float(number)))
            log.frame(Frame(image, number + 0.25, number))
            log.record(Reply("camera", number, FrameRef("camera", number, number + 0.25), number + 0.5))
    found, ending = items(path)
    assert ending.finished
    assert [type(item).__name__ for item in found] == ["Call", "Picture", "Reply"] * len(IMAGES)
    for number, picture in enumerate(item for item in found if isinstance(item, Picture)):
        assert picture.sequence == number
        assert np.array_equal(picture.decode(), IMAGES[number])


def test_what_is_synced_is_on_the_disk_whatever_comes_then(path, monkeypatch):
    synced = []
    fsync = os.fsync
    monkeypatch.setattr("os.fsync", lambda number: (fsync(number), synced.append(path.read_bytes())))
    with open_log(path) as log:
        log.record(Note("info", "first", 1.0))
        log.frame(Frame(IMAGES[0], 1.5, 0))
        log.sync()
        killed = path.with_name("killed.mcap")
        killed.write_bytes(synced[-1])
        log.record(Note("info", "second", 2.0))
    found, ending = items(killed)
    assert not ending.finished
    assert [type(item).__name__ for item in found] == ["Note", "Picture"]


def test_many_threads_may_write(path):
    def write(log, device):
        for index in range(50):
            log.record(Call(device, index, "read", {}, float(index)))

    with open_log(path) as log:
        threads = [threading.Thread(target=write, args=(log, name)) for name in ("left", "right", "camera")]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    found, _ = items(path)
    for name in ("left", "right", "camera"):
        assert [call.index for call in found if call.device == name] == list(range(50))


class Gate:
    """A disk that takes nothing until it is told to."""

    def __init__(self, monkeypatch):
        self.open = threading.Event()
        write = writer.FileWriter.write
        monkeypatch.setattr(
            writer.FileWriter, "write", lambda self_, *args: (self.open.wait(10), write(self_, *args))[1]
        )


def test_a_disk_that_is_behind_slows_the_run_and_drops_nothing(path, monkeypatch):
    gate = Gate(monkeypatch)
    monkeypatch.setattr(writer, "LARGEST_BACKLOG", 3 * IMAGES[0].nbytes)
    told = []
    with open_log(path, on_slow=told.append) as log:
        timer, wait_for_room = threading.Timer(0.3, gate.open.set), log._wait_for_room

        def begin_when_it_waits(size):
            if not log._has_room(size) and timer.ident is None:
                timer.start()
            wait_for_room(size)

        monkeypatch.setattr(log, "_wait_for_room", begin_when_it_waits)
        for number, image in enumerate(IMAGES):
            log.frame(Frame(image, float(number), number))
        timer.join()
        assert len(told) == 1, "it is told once, not for each frame"
        assert 0.1 <= told[0] <= log.slowed
    found, _ = items(path)
    assert [picture.sequence for picture in found] == list(range(len(IMAGES)))


def test_no_disk_stands_between_a_stop_and_the_next_arm(path, monkeypatch):
    """The disk takes nothing, the backlog is full, and another thread waits for it with a command of its own."""
    recording = LogRecording(path, load_cell(TINY), RealClock())
    gate = Gate(monkeypatch)
    monkeypatch.setattr(writer, "LARGEST_BACKLOG", 1)
    arms = [StandingArm(name) for name in ("left", "right")]
    left, right = map(recording.robot, arms)
    waiting = threading.Thread(target=left.read, args=(1.0,))
    stops = threading.Thread(target=lambda: [arm.stop("enough") for arm in (left, right)])
    with recording:
        left.read(1.0)
        waiting.start()
        waiting.join(0.2)
        behind = waiting.is_alive()
        stops.start()
        stops.join(5.0)
        stopped = [arm.stopped for arm in arms]
        gate.open.set()
        stops.join()
        waiting.join()
    assert behind
    assert stopped == ["enough", "enough"]
    calls = [(item.device, item.method) for item in items(path)[0] if isinstance(item, Call)]
    assert calls.count(("right", "stop")) == 1
    assert calls.count(("left", "read")) == 2


class StandingArm(Robot):
    joints = 6

    def __init__(self, name):
        self.name = name
        self.stopped = None

    def read(self, timeout):
        return RobotState((0.0,) * 6, (0.0,) * 6, Mode.READY, (), 0.0, 0)

    def stop(self, reason):
        self.stopped = reason
        return StopResult(True)

    def subscribe(self, function):
        return lambda: None

    def start(self, path):
        raise NotImplementedError

    enable = disable = reset_fault = start


def test_a_log_that_could_not_be_begun_leaves_no_file(path, monkeypatch):
    """Which a replay would have to make sense of."""

    def full(self):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer.FileWriter, "sync", full)
    with pytest.raises(LogNotWritten, match="No space left"):
        LogRecording(path, load_cell(TINY), RealClock())
    assert not path.exists()


def test_one_that_is_larger_than_the_backlog_is_taken_alone(path, monkeypatch):
    monkeypatch.setattr(writer, "LARGEST_BACKLOG", 10)
    with open_log(path) as log:
        log.frame(Frame(IMAGES[0], 0.0, 0))
        log.frame(Frame(IMAGES[1], 1.0, 1))
    assert len(items(path)[0]) == 2


@pytest.mark.parametrize("call", ["record", "sync", "frame"])
def test_a_full_disk_is_told_at_the_next_call_with_the_files_name(path, monkeypatch, call):
    def full(self, *args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    log = open_log(path)
    monkeypatch.setattr(writer.FileWriter, "write", full)
    with pytest.raises(LogNotWritten, match=r"log-0001\.mcap: the log cannot be written: No space left"):
        _write_on(log, call)
    with pytest.raises(LogNotWritten, match="No space left"):
        log.sync()
    log.close()


def _write_on(log, call):
    while True:
        if call == "frame":
            log.frame(Frame(IMAGES[0], 0.0, 0))
        else:
            log.record(Note("info", "x", 0.0))
        if call == "sync":
            log.sync()


def test_a_disk_that_fills_up_while_somebody_waits_lets_go_of_him(path, monkeypatch):
    begun = threading.Event()

    def fail_late(self, *args):
        begun.wait(10)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer.FileWriter, "write", fail_late)
    monkeypatch.setattr(writer, "LARGEST_BACKLOG", 1)
    log = open_log(path)
    log.frame(Frame(IMAGES[0], 0.0, 0))
    timer = threading.Timer(0.2, begun.set)
    timer.start()
    with pytest.raises(LogNotWritten):
        log.frame(Frame(IMAGES[1], 0.0, 1))
    timer.join()
    log.close()


def test_a_disk_that_fails_at_the_end_is_told_by_close(path, monkeypatch):
    log = open_log(path)
    monkeypatch.setattr("os.fsync", _fail_to_sync)
    with pytest.raises(LogNotWritten, match="Input/output error"):
        log.close()
    log.close()


def test_a_failure_that_no_call_came_upon_is_told_by_close(path, monkeypatch):
    monkeypatch.setattr(writer, "encode", lambda *_: 1 / 0)
    log = open_log(path)
    log.frame(Frame(IMAGES[0], 0.0, 0))
    log._thread.join()
    with pytest.raises(LogNotWritten, match="ZeroDivisionError"):
        log.close()


def _fail_to_sync(number):
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def test_a_thread_that_dies_of_something_else_hangs_nobody(path, monkeypatch):
    monkeypatch.setattr(writer, "encode", lambda *_: 1 / 0)
    log = open_log(path)
    log.frame(Frame(IMAGES[0], 0.0, 0))
    with pytest.raises(LogNotWritten, match="ZeroDivisionError"):
        log.sync()
    log.close()


def test_a_file_that_exists_is_not_touched(path):
    path.write_bytes(b"precious")
    with pytest.raises(LogNotWritten, match=r"log-0001\.mcap: .*File exists"):
        open_log(path)
    assert path.read_bytes() == b"precious"


def test_a_folder_that_is_not_there_is_told_at_once(tmp_path):
    with pytest.raises(LogNotWritten, match="No such file or directory"):
        open_log(tmp_path / "nowhere" / "log-0001.mcap")


def test_a_closed_log_takes_nothing(path):
    log = open_log(path)
    log.close()
    with pytest.raises(LogNotWritten, match="closed"):
        log.record(Note("info", "late", 0.0))
    with pytest.raises(LogNotWritten, match="closed"):
        log.sync()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((4, 4, 3), np.uint8),
        np.zeros((4, 4), np.float64),
        np.zeros((0, 4), np.uint8),
        np.zeros((1, 1 << 15), np.uint8),
    ],
)
def test_what_could_not_be_read_again_is_refused(path, image):
    with open_log(path) as log, pytest.raises(ValueError, match=r"a frame is|too large"):
        log.frame(Frame(image, 0.0, 0))


def test_a_record_too_large_to_be_read_is_refused(path, monkeypatch):
    monkeypatch.setattr(writer, "LONGEST_RECORD", 1000)
    with open_log(path) as log, pytest.raises(ValueError, match=r"Worked of .* too large"):
        log.record(Worked(0, "plan", None, "x" * 1000, 0.0))


@pytest.mark.parametrize("time", [float("nan"), float("inf"), -1e30, 1e30])
def test_a_device_without_a_sensible_time_does_not_end_the_log(path, time):
    with open_log(path) as log:
        log.joint_states("left", RobotState((0.1,), (0.0,), Mode.READY, (), time, 0))
        log.record(Reply("left", 0, RobotState((0.1,), (0.0,), Mode.READY, (), time, 0), 1.0))
    found, _ = items(path)
    assert str(found[1].value.time) == str(time)


def test_the_image_is_coded_as_the_sessions_images_are(path):
    with open_log(path) as log:
        log.frame(Frame(IMAGES[0], 0.0, 0))
    assert items(path)[0][0].data == encode_png(IMAGES[0])


def test_an_image_that_the_session_keeps_too_is_encoded_once(path, monkeypatch):
    """In whichever thread; for an image that may change meanwhile it is done anew."""
    encoded = []
    encode = images._encode_png
    monkeypatch.setattr(images, "_encode_png", lambda image: (encoded.append(image[0, 0]), encode(image))[1])
    fixed, other = IMAGES[0].copy(), IMAGES[1].copy()
    fixed.setflags(write=False)
    with open_log(path) as log:
        log.frame(Frame(fixed, 0.0, 0))
        assert encode_png(fixed) == encode(fixed)
        log.frame(Frame(other, 1.0, 1))
        assert encode_png(other) == encode(other)
    assert sorted(encoded) == sorted([fixed[0, 0], other[0, 0], other[0, 0]])
    assert [picture.data for picture in items(path)[0]] == [encode(fixed), encode(other)]
    assert id(fixed) in images._encoded
    place = id(fixed)
    del fixed
    assert place not in images._encoded, "it is not kept longer than its image"


def test_what_the_log_is_of_stands_at_its_beginning(path):
    with open_log(path, metadata={"cell": "tiny", "numpy": "2.4"}, clock_started=1 / 3) as log:
        log.metadata("more", {"a": "b"})
        log.attach("cell.yaml", "application/yaml", b"name: tiny\n", 1.0)
    with LogReader(path) as reader:
        about = reader.about()
        assert (about["format"], about["cell"], about["frames"]) == ("dualcal.log/1", "tiny", "png")
        assert float(about["clock_started_s"]) == 1 / 3
        assert reader.layout().arms == ("left", "right")
        assert reader.metadata()["more"] == {"a": "b"}
        assert [(kept.name, kept.data) for kept in reader.attachments()] == [("cell.yaml", b"name: tiny\n")]


_FILL = """
import resource, sys
import numpy as np
from pathlib import Path
from dualcal_hal.camera import Frame
from dualcal_hal.errors import LogNotWritten
from dualcal_hal.session.log import LogWriter
from tools.benchmarks.mutated_logs import STARTED
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
image = np.random.default_rng(1).integers(0, 256, (100, 100), dtype=np.uint8)
log = LogWriter(Path(sys.argv[1]), STARTED, arms=("left",))
try:
    for number in range(1000):
        log.frame(Frame(image, float(number), number))
        log.sync()
        print(number)
except LogNotWritten as error:
    print(error)
log.close()
"""


def test_what_was_synced_before_a_disk_took_no_more_is_there(path):
    """A real one, as far as the process can tell: it takes a part of a chunk and then nothing."""
    done = subprocess.run([sys.executable, "-c", _FILL, path], capture_output=True, text=True, check=True)
    *numbers, told = done.stdout.splitlines()
    assert told == f"{path}: the log cannot be written: File too large"
    found, ending = items(path)
    assert not ending.finished
    assert [picture.sequence for picture in found] == [int(number) for number in numbers] != []
