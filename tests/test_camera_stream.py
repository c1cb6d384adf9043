"""A camera over ZeroMQ: its frames are those asked for, its sender's and nobody else's."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

zmq = pytest.importorskip("zmq", reason="the zmq camera is an extra: pip install 'dualcal[zmq]'")

from zmq.auth import create_certificates  # noqa: E402 - what it needs may be missing

from backends.cameras import subscriber  # noqa: E402
from backends.cameras.curve import ServerKeys  # noqa: E402
from backends.cameras.publisher import FramePublisher  # noqa: E402
from backends.cameras.whose_clock import ClockId  # noqa: E402
from backends.cameras.zmq_backend import ZmqBackend  # noqa: E402
from dualcal_hal import registry  # noqa: E402
from dualcal_hal.cellfile import standing_alone  # noqa: E402
from dualcal_hal.errors import (  # noqa: E402
    CellFileError,
    CommandRefused,
    DeviceTimeout,
    DualcalError,
    FrameRefused,
    LinkLost,
    NotOpen,
    UnknownDevice,
    UsageError,
)
from tests.camera_cells import CLOCK, SIZE, Sender, camera_cell, picture  # noqa: E402

LOOPBACK = "tcp://127.0.0.1:0"
NOBODY = "tcp://127.0.0.1:1"
AMPLE = 20.0

publisher = partial(FramePublisher, LOOPBACK, "camera")


def stream(endpoint: str, options: str = "") -> ZmqBackend:
    return ZmqBackend("lens", camera_cell(f"{{type: zmq, endpoint: '{endpoint}'{options}}}"))


@contextmanager
def opened(backend: ZmqBackend) -> Iterator[ZmqBackend]:
    backend.open(AMPLE)
    try:
        yield backend
    finally:
        backend.close()


@pytest.fixture
def sender() -> Iterator[Sender]:
    with Sender(publisher) as sending:
        yield sending


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """The sender's clock is not this one's."""
    monkeypatch.setattr(subscriber, "own_clock", lambda: ClockId("elsewhere", "another boot"))


@contextmanager
def raw_publisher() -> Iterator[tuple[Any, str]]:
    """A socket that may send whatever it is told to, once somebody listens."""
    context = zmq.Context()
    with context, context.socket(zmq.XPUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(LOOPBACK)
        yield socket, socket.getsockopt_string(zmq.LAST_ENDPOINT)


def sending(socket: Any, message: Callable[[int], list[bytes]]) -> tuple[threading.Thread, threading.Event]:
    ended = threading.Event()

    def send() -> None:
        number = 0
        while not ended.wait(0.01):
            number += 1
            socket.send_multipart(message(number))

    thread = threading.Thread(target=send)
    thread.start()
    return thread, ended


# Opening and closing


def test_it_opens_closes_and_opens_again(sender: Sender) -> None:
    backend = stream(sender.endpoint)
    backend.close()
    before = set(threading.enumerate())
    for _ in range(2):
        backend.open(AMPLE)
        with pytest.raises(UsageError, match="open already"):
            backend.open(AMPLE)
        backend.camera("camera").grab(0.0, AMPLE)
        backend.close()
        backend.close()
        assert set(threading.enumerate()) == before
        with pytest.raises(NotOpen):
            backend.camera("camera").grab(0.0, AMPLE)


def test_where_nobody_serves_it_cannot_be_opened_and_is_not_open() -> None:
    backend = stream(NOBODY)
    with pytest.raises(LinkLost, match="nobody serves there"):
        backend.open(0.3)
    with pytest.raises(NotOpen):
        backend.camera("camera").grab(0.0, 1.0)
    backend.close()


def test_where_somebody_serves_and_sends_nothing_opening_takes_no_longer_than_it_may() -> None:
    with FramePublisher(LOOPBACK, "camera") as silent, pytest.raises(DeviceTimeout, match="no frame came"):
        stream(silent.endpoint).open(1.0)


def test_it_has_one_camera_and_no_arm(sender: Sender) -> None:
    backend = stream(sender.endpoint)
    with pytest.raises(UnknownDevice, match="third"):
        backend.camera("third")
    with pytest.raises(UnknownDevice, match="left"):
        backend.robot("left")


# Frames


def test_frames_are_the_senders_with_its_numbers_and_its_times(sender: Sender) -> None:
    with opened(stream(sender.endpoint)) as backend:
        frames = [backend.camera("camera").grab(CLOCK.now(), AMPLE) for _ in range(5)]
    for frame in frames:
        np.testing.assert_array_equal(frame.image, picture(frame.sequence))
        assert frame.time == sender.exposed[frame.sequence]
        assert not frame.image.flags.writeable
    numbers = [frame.sequence for frame in frames]
    assert numbers == sorted(set(numbers))


def test_a_frame_is_exposed_when_it_was_asked_for_or_later(sender: Sender) -> None:
    with opened(stream(sender.endpoint)) as backend:
        for wait in (0.0, 0.1, 0.0):
            not_before = CLOCK.now() + wait
            frame = backend.camera("camera").grab(not_before, AMPLE)
            assert not_before <= frame.time <= CLOCK.now()


def test_frames_that_are_long_under_way_are_not_taken_for_new_ones() -> None:
    with Sender(publisher, delay=0.1) as late, opened(stream(late.endpoint)) as backend:
        for _ in range(2):
            not_before = CLOCK.now()
            assert backend.camera("camera").grab(not_before, AMPLE).time >= not_before


@pytest.mark.usefixtures("elsewhere")
@pytest.mark.parametrize("delay", [0.0, 0.1])
def test_of_another_machines_clock_a_frame_is_new_only_once_that_is_proven(delay: float) -> None:
    with Sender(publisher, delay=delay) as far, opened(stream(far.endpoint)) as backend:
        for _ in range(3):
            not_before = CLOCK.now()
            frame = backend.camera("camera").grab(not_before, AMPLE)
            assert not_before <= frame.time <= far.exposed[frame.sequence] <= CLOCK.now()


@pytest.mark.usefixtures("elsewhere")
def test_a_sender_that_never_tells_when_it_heard_of_a_mark_proves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.cameras.publisher.is_mark", lambda topic: False)
    with (
        Sender(publisher) as deaf,
        opened(stream(deaf.endpoint)) as backend,
        pytest.raises(DeviceTimeout, match="for none of them it is proven"),
    ):
        backend.camera("camera").grab(CLOCK.now(), 1.0)


def test_a_frame_that_cannot_come_in_time_is_a_timeout(sender: Sender) -> None:
    with opened(stream(sender.endpoint)) as backend:
        with pytest.raises(DeviceTimeout):
            backend.camera("camera").grab(CLOCK.now() + 5.0, 0.1)
        backend.camera("camera").grab(CLOCK.now(), AMPLE)


@pytest.mark.parametrize("not_before", [math.nan, math.inf])
def test_a_time_that_is_none_is_refused(sender: Sender, not_before: float) -> None:
    with opened(stream(sender.endpoint)) as backend, pytest.raises(CommandRefused):
        backend.camera("camera").grab(not_before, AMPLE)


def test_closing_ends_a_wait_for_a_frame(sender: Sender) -> None:
    backend = stream(sender.endpoint)
    backend.open(AMPLE)
    errors: list[DualcalError] = []

    def wait() -> None:
        try:
            backend.camera("camera").grab(CLOCK.now() + 60.0, 60.0)
        except DualcalError as error:
            errors.append(error)

    thread = threading.Thread(target=wait)
    thread.start()
    CLOCK.wait(threading.Event(), CLOCK.now() + 0.1)
    backend.close()
    thread.join(AMPLE)
    assert [type(error) for error in errors] == [NotOpen]


def test_frames_of_another_size_than_the_intrinsics_are_refused_by_both_sizes() -> None:
    with Sender(publisher, size=(640, 480)) as large, opened(stream(large.endpoint)) as backend:
        with pytest.raises(FrameRefused, match=r"640 x 480 px.*512 x 384"):
            backend.camera("camera").grab(CLOCK.now(), AMPLE)
        problems = [finding for finding in backend.camera("camera").findings() if finding.verdict == "problem"]
        assert [finding.subject for finding in problems] == ["frame size"]


def test_another_cameras_image_is_refused_by_both_names(sender: Sender) -> None:
    with pytest.raises(FrameRefused, match="'camera', not of 'lens of cell 2'"):
        stream(sender.endpoint, ", camera: lens of cell 2").open(AMPLE)


def test_what_is_no_frame_is_refused_and_a_frame_after_it_is_taken() -> None:
    with raw_publisher() as (socket, endpoint):
        thread, ended = sending(socket, lambda number: [b"\x00garbage", bytes(100)])
        with pytest.raises(FrameRefused, match="no frame: its header cannot be read"):
            stream(endpoint).open(AMPLE)
        ended.set()
        thread.join()


def test_a_message_of_many_parts_is_refused() -> None:
    with raw_publisher() as (socket, endpoint):
        thread, ended = sending(socket, lambda number: [b"part"] * 1000)
        with pytest.raises(FrameRefused, match="parts"):
            stream(endpoint).open(AMPLE)
        ended.set()
        thread.join()


def test_an_image_that_is_stamped_later_than_it_came_is_refused() -> None:
    def early() -> FramePublisher:
        made = publisher()
        publish = made.publish
        made.publish = lambda image, exposed, number, exposure: publish(image, exposed + 60.0, number, exposure)  # type: ignore[method-assign,misc,assignment]
        return made

    with Sender(early) as sender, pytest.raises(FrameRefused, match="later than it came"):
        stream(sender.endpoint).open(AMPLE)


# The link


def test_a_sender_that_ends_is_a_lost_link_at_once_and_one_that_begins_again_is_heard() -> None:
    with Sender(publisher) as first:
        backend = stream(first.endpoint)
        backend.open(AMPLE)
        before = backend.camera("camera").grab(CLOCK.now(), AMPLE)
        first.end()
        with pytest.raises(LinkLost, match="connection was lost"):
            backend.camera("camera").grab(CLOCK.now(), AMPLE)
    with Sender(partial(FramePublisher, first.endpoint, "camera")):
        deadline = CLOCK.now() + AMPLE
        frame = None
        while frame is None and CLOCK.now() < deadline:
            try:
                frame = backend.camera("camera").grab(CLOCK.now(), AMPLE)
            except LinkLost:
                CLOCK.wait(threading.Event(), CLOCK.now() + 0.05)
        backend.close()
    assert frame is not None
    assert frame.sequence > before.sequence


def test_what_an_operator_is_told_of_it(sender: Sender) -> None:
    with opened(stream(sender.endpoint)) as backend:
        said = {finding.subject: finding.said for finding in backend.camera("camera").findings()}
    assert "this machine's own clock" in said["clock"]
    assert said["exposure"] == "4.00 ms"
    assert "frames a second" in said["camera rate"]
    assert said["frame size"].startswith("512 x 384 px")


@pytest.mark.usefixtures("elsewhere")
def test_of_a_clock_that_is_another_an_operator_is_told_how_far_off_it_may_be(sender: Sender) -> None:
    with opened(stream(sender.endpoint)) as backend:
        backend.camera("camera").grab(CLOCK.now(), AMPLE)
        said = {finding.subject: finding.said for finding in backend.camera("camera").findings()}
    assert "behind this one's" in said["clock"]


# Who listens


def test_a_publisher_knows_whether_anybody_listens() -> None:
    def becomes(made: FramePublisher, subscribed: bool) -> bool:
        deadline = CLOCK.now() + AMPLE
        while made.subscribed is not subscribed and CLOCK.now() < deadline:
            CLOCK.wait(threading.Event(), CLOCK.now() + 0.01)
        return made.subscribed is subscribed

    with FramePublisher(LOOPBACK, "camera") as made, zmq.Context() as context:
        assert not made.subscribed
        with context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.LINGER, 0)
            socket.connect(made.endpoint)
            socket.subscribe(b"")
            assert becomes(made, subscribed=True)
        assert becomes(made, subscribed=False)


def test_the_endpoint_is_the_one_that_was_found_free() -> None:
    with FramePublisher(LOOPBACK, "camera") as made:
        assert made.endpoint.startswith("tcp://127.0.0.1:")
        assert int(made.endpoint.rpartition(":")[2]) > 0
        with pytest.raises(UsageError, match="cannot be served"):
            FramePublisher(made.endpoint, "camera")


def test_a_listener_that_is_slow_keeps_nobody_waiting_and_costs_no_memory() -> None:
    image = picture(1, (2048, 2048))
    with FramePublisher(LOOPBACK, "camera") as made, zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.LINGER, 0)
        socket.setsockopt(zmq.RCVHWM, 1)
        socket.connect(made.endpoint)
        socket.subscribe(b"")
        while not made.subscribed:
            CLOCK.wait(threading.Event(), CLOCK.now() + 0.01)
        begun = CLOCK.now()
        for number in range(200):
            made.publish(image, CLOCK.now(), number)
        assert CLOCK.now() - begun < AMPLE


# Keys


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Of a server, of a client that may listen, and of one that may not."""
    for name in ("server", "friend", "stranger"):
        create_certificates(tmp_path, name)
    allowed = tmp_path / "allowed"
    allowed.mkdir()
    (tmp_path / "friend.key").rename(allowed / "friend.key")
    return tmp_path


def guarded(keys: Path) -> FramePublisher:
    return FramePublisher(LOOPBACK, "camera", ServerKeys(keys / "server.key_secret", keys / "allowed"))


def curve(keys: Path, client: str, server: str = "server") -> str:
    return (
        f", curve: {{server_public_key_file: {keys}/{server}.key, client_secret_key_file: {keys}/{client}.key_secret}}"
    )


def test_who_is_among_those_allowed_may_listen(keys: Path) -> None:
    with Sender(lambda: guarded(keys)) as sender, opened(stream(sender.endpoint, curve(keys, "friend"))) as backend:
        assert backend.camera("camera").grab(CLOCK.now(), AMPLE).image.shape == SIZE[::-1]


def test_a_key_that_is_not_among_those_allowed_is_not_let_in(keys: Path) -> None:
    with Sender(lambda: guarded(keys)) as sender, pytest.raises(LinkLost, match="does not let this key in"):
        stream(sender.endpoint, curve(keys, "stranger")).open(5.0)


def test_nobody_listens_without_a_key_where_keys_are_asked_for(keys: Path) -> None:
    with Sender(lambda: guarded(keys)) as sender, pytest.raises(LinkLost):
        stream(sender.endpoint).open(5.0)


def test_another_server_than_the_one_whose_key_is_known_is_not_listened_to(keys: Path) -> None:
    with Sender(lambda: guarded(keys)) as sender, pytest.raises(LinkLost):
        stream(sender.endpoint, curve(keys, "friend", server="stranger")).open(5.0)
    with Sender(publisher) as open_to_all, pytest.raises(LinkLost):
        stream(open_to_all.endpoint, curve(keys, "friend")).open(5.0)


@pytest.mark.parametrize("endpoint", ["tcp://*:0", "tcp://0.0.0.0:0", "tcp://192.0.2.1:5555", "tcp://eth0:5555"])
def test_beyond_this_machine_nothing_is_served_without_keys(endpoint: str) -> None:
    with pytest.raises(UsageError, match="others than this machine's"):
        FramePublisher(endpoint, "camera")


@pytest.mark.parametrize(
    "endpoint", ["ipc:///tmp/x", "tcp://127.0.0.1", "tcp://127.0.0.1:0;192.0.2.1:5555", "tcp://127.0.0.1:99999", "x"]
)
def test_what_is_no_endpoint_is_none(endpoint: str) -> None:
    with pytest.raises(UsageError, match="no endpoint"):
        FramePublisher(endpoint, "camera")
    with pytest.raises(CellFileError, match="no endpoint"):
        stream(endpoint)


def test_a_server_without_anybody_allowed_or_without_its_key_is_refused(keys: Path, tmp_path: Path) -> None:
    nobody = tmp_path / "nobody"
    nobody.mkdir()
    with pytest.raises(UsageError, match="holds no public key"):
        FramePublisher(LOOPBACK, "camera", ServerKeys(keys / "server.key_secret", nobody))
    with pytest.raises(UsageError, match="has no secret key"):
        FramePublisher(LOOPBACK, "camera", ServerKeys(keys / "server.key", keys / "allowed"))
    with pytest.raises(UsageError, match="no key can be read"):
        FramePublisher(LOOPBACK, "camera", ServerKeys(keys / "none", keys / "allowed"))


def test_key_files_that_cannot_be_read_are_told_when_it_is_opened(keys: Path) -> None:
    with pytest.raises(UsageError, match="no key can be read"):
        stream(NOBODY, curve(keys, "none")).open(1.0)


# The cell file


def test_a_cell_file_without_keys_names_no_other_machine() -> None:
    with pytest.raises(CellFileError, match="without curve anybody could send images"):
        stream("tcp://camera-pc:5555")


def test_options_that_are_unknown_are_refused() -> None:
    with pytest.raises(CellFileError, match="fps"):
        stream(NOBODY, ", fps: 3")


def test_key_files_are_found_from_a_session_too() -> None:
    cell = camera_cell(
        "{type: zmq, endpoint: 'tcp://camera-pc:5555', "
        "curve: {server_public_key_file: a.key, client_secret_key_file: keys/b.key_secret}}"
    )
    options = cell.cell.backends["lens"].checked
    text, _ = standing_alone(cell)
    for file in (options.curve.server_public_key_file, options.curve.client_secret_key_file):  # type: ignore[attr-defined]
        assert file.is_absolute()
        assert str(file) in text


def test_what_is_not_installed_is_a_problem_of_the_cell_file(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(module: str) -> None:
        raise ImportError(f"No module named '{module}'")

    cell = camera_cell(f"{{type: zmq, endpoint: '{NOBODY}'}}")
    monkeypatch.setattr(registry, "import_module", missing)
    with pytest.raises(CellFileError, match=r"backends\.lens: .*pip install 'dualcal\[zmq\]'"):
        ZmqBackend("lens", cell)


# The emulator


def test_at_an_emulator_it_is_simulated_and_listens_there(sender: Sender) -> None:
    backend = stream(NOBODY)
    assert not backend.simulated
    backend.use_emulator({"camera": {"endpoint": sender.endpoint}})
    assert backend.simulated
    with opened(backend):
        backend.camera("camera").grab(CLOCK.now(), AMPLE)
        with pytest.raises(UsageError, match="before it is opened"):
            backend.use_emulator({"camera": {"endpoint": sender.endpoint}})


@pytest.mark.parametrize(
    "endpoints", [{}, {"camera": {}}, {"camera": {"endpoint": 5}}, {"camera": {"endpoint": "tcp://192.0.2.1:5555"}}]
)
def test_an_emulator_is_on_this_machine(endpoints: dict[str, Any]) -> None:
    backend = stream(NOBODY)
    with pytest.raises(UsageError, match="emulator"):
        backend.use_emulator(endpoints)
    assert not backend.simulated
