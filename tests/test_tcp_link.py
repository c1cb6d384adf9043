"""An arm over simple message, against small controllers that are not ours: its reports, courses, stops and failures."""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from backends.controller.joint_map import JointMap
from backends.controller.link import ArmLink, ArmReport, Transfer
from backends.controller.options import TcpLink
from backends.controller.robot import ControlledRobot
from backends.controller.tcp import links, port
from backends.controller.tcp.transport import Connection
from dualcal_hal.errors import (
    CommandRefused,
    DeviceError,
    DeviceTimeout,
    LinkLost,
    MotionFailed,
    MotionStopped,
    NotOpen,
    UsageError,
)
from dualcal_hal.limits import JointLimits
from dualcal_hal.robot import JointPath, Mode
from tests.tcp_servers import (
    CLOCK,
    JOINTS,
    PATIENCE,
    Received,
    SmallServer,
    abb,
    course,
    fanuc,
    moto_reply,
    motoman,
    rep,
    rep_with_an_echo,
    rep_with_body,
)

TOP_SPEED = (2.0,) * JOINTS
Answer = Callable[[SmallServer, Received], bytes | None]

ANSWERS: dict[str, Answer] = {"rep": rep, "abb": abb, "fanuc": fanuc, "motoman": motoman}


@pytest.fixture(autouse=True)
def _soon_observed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rate and jitter may be those of a moment, where a test is about something else."""
    monkeypatch.setattr("backends.controller.tcp.feedback._OBSERVED", 0.1)


@pytest.fixture(autouse=True)
def _late_is_later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both ends share a machine here that may have much else to do; test_tcp_freshness.py has the real limits."""
    monkeypatch.setattr("backends.controller.tcp.state.LATE_AT_LEAST", 0.5)
    for limit in ("state.LOST_AFTER", "feedback.LOST_AFTER", "session._REPORT_WITHIN"):
        monkeypatch.setattr(f"backends.controller.tcp.{limit}", PATIENCE)
    monkeypatch.setattr("backends.controller.tcp.dialects.Dialect.acknowledges_within", PATIENCE)


@pytest.fixture
def given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not come is given up soon, where a test is about that."""
    monkeypatch.setattr("backends.controller.tcp.state.LOST_AFTER", 1.0)
    monkeypatch.setattr("backends.controller.tcp.dialects.Dialect.acknowledges_within", 1.0)


def soon(seconds: float = PATIENCE) -> float:
    return CLOCK.now() + seconds


def pause(seconds: float) -> None:
    CLOCK.wait(threading.Event(), soon(seconds))


@contextmanager
def controller(dialect: str, answer: Answer | None = None, **ways: Any) -> Iterator[SmallServer]:
    server = SmallServer(answer or ANSWERS[dialect], **({"feedback": dialect == "motoman"} | ways))
    try:
        yield server
    finally:
        server.close()


def link_to(server: SmallServer, dialect: str, **options: Any) -> ArmLink:
    arm = {"host": "127.0.0.1", "motion_port": server.motion_port, "state_port": server.state_port}
    given = TcpLink.model_validate({"dialect": dialect, "arms": {"left": arm}, **options})
    return links(given, {"left": JOINTS}, CLOCK, {"left": TOP_SPEED})["left"]


@contextmanager
def opened(server: SmallServer, dialect: str, **options: Any) -> Iterator[ArmLink]:
    link = link_to(server, dialect, **options)
    link.open(soon())
    try:
        yield link
    finally:
        link.close()


@contextmanager
def arm(dialect: str, answer: Answer | None = None, **ways: Any) -> Iterator[tuple[ArmLink, SmallServer]]:
    """An open link to a small controller."""
    with controller(dialect, answer, **ways) as server, opened(server, dialect) as link:
        yield link, server


def ended(transfer: Transfer) -> Transfer:
    end = threading.Event()
    transfer.on_end(end.set)
    assert end.wait(PATIENCE)
    return transfer


class Told:
    """Failures as they are told."""

    def __init__(self, link: ArmLink) -> None:
        self.errors: list[DeviceError] = []
        self._news = threading.Condition()
        link.on_failure(self._take)

    def _take(self, error: DeviceError) -> None:
        with self._news:
            self.errors.append(error)
            self._news.notify_all()

    def first(self, kind: type[DeviceError]) -> DeviceError:
        with self._news:
            assert self._news.wait_for(lambda: self.of(kind), PATIENCE), self.errors
            return self.of(kind)[0]

    def of(self, kind: type[DeviceError]) -> list[DeviceError]:
        return [error for error in self.errors if type(error) is kind]


def newer(link: ArmLink) -> ArmReport:
    return link.report_after(CLOCK.now(), soon())


def newest(link: ArmLink) -> ArmReport:
    """The one that there is."""
    return link.report_after(0.0, soon())


def shows(link: ArmLink, positions: Sequence[float]) -> None:
    """Wait until the arm is reported there: a state may be on its way that was made before it was."""
    _until(lambda: newer(link).positions == pytest.approx(positions, abs=1e-6))


# -- opening --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("order", "real", "words"),
    [
        (">", "f", "big-endian, 32-bit reals (f32)"),
        ("<", "f", "little-endian, 32-bit reals (f32)"),
        ("<", "d", "little-endian, 64-bit reals (f64)"),
        (">", "d", "big-endian, 64-bit reals (f64)"),
    ],
)
@pytest.mark.parametrize("feedback", [False, True], ids=["position", "feedback"])
def test_how_a_server_writes_is_judged_and_said(order: str, real: str, words: str, feedback: bool) -> None:
    with controller("rep", order=order, real=real, feedback=feedback) as server, opened(server, "rep") as link:
        assert [f.said for f in link.findings() if f.subject == "byte order"] == [words]
        assert newer(link).positions == pytest.approx([0.1 * joint for joint in range(JOINTS)])
        assert ended(link.send(course(0.1))).complete
        shows(link, [0.1 * joint + 0.1 for joint in range(JOINTS)])


@pytest.mark.parametrize(
    ("options", "said"),
    [({"byte_order": "little"}, "byte_order: little"), ({"real": "f64"}, "real: f64")],
    ids=["byte order", "real"],
)
def test_a_server_that_writes_otherwise_than_the_cell_file_says_is_not_opened(
    options: dict[str, str], said: str
) -> None:
    with (
        controller("rep") as server,
        pytest.raises(DeviceError, match=rf"left: .* writes big-endian, 32-bit reals \(f32\).*{said}"),
    ):
        link_to(server, "rep", **options).open(soon())


def test_a_status_that_comes_first_tells_the_byte_order_and_the_joints_the_reals() -> None:
    def status_first(data: bytes) -> Iterator[bytes]:
        yield data[-44:] + data[:-44]

    with controller("rep", real="d", order="<", state_chunks=status_first) as server, opened(server, "rep") as link:
        assert [f.said for f in link.findings() if f.subject == "byte order"] == ["little-endian, 64-bit reals (f64)"]
        assert newer(link).mode is Mode.READY


def test_a_state_port_that_is_silent_is_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.state.LOST_AFTER", 0.3)
    with controller("rep") as server:
        server.quiet.set()
        with pytest.raises(LinkLost, match=r"was reached, and sent nothing for 0\.3 s"):
            link_to(server, "rep").open(soon())


def test_a_state_port_that_is_none_is_not_opened() -> None:
    web = b"HTTP/1.1 400 Bad Request\r\n"
    with (
        controller("rep", state_chunks=lambda data: iter([web])) as server,
        pytest.raises(LinkLost, match="is this the state port"),
    ):
        link_to(server, "rep").open(soon())


@pytest.mark.usefixtures("given_up")
def test_a_state_port_that_tells_no_joints_is_not_opened() -> None:
    with (
        controller("rep", state_chunks=lambda data: iter([data[-44:]])) as server,
        pytest.raises(LinkLost, match="no feedback"),
    ):
        link_to(server, "rep").open(soon())


def test_a_controller_that_is_off_is_not_opened() -> None:
    with controller("rep") as server:
        pass
    with pytest.raises(LinkLost, match=r"left: connect: .* Connection refused"):
        link_to(server, "rep").open(soon())


def test_a_motion_port_that_is_closed_leaves_nothing_open() -> None:
    with controller("rep") as server, controller("rep") as other:
        other.close()
        server.motion_port, own = other.motion_port, server.motion_port
        link = link_to(server, "rep")
        with pytest.raises(LinkLost, match=f":{other.motion_port}: Connection refused"):
            link.open(soon())
        server.motion_port = own
        with pytest.raises(NotOpen):
            link.report_after(0.0, soon())


def test_a_link_is_opened_once_and_again_after_it_was_closed() -> None:
    with controller("rep") as server:
        link = link_to(server, "rep")
        link.close()
        for _ in range(2):
            link.open(soon())
            with pytest.raises(UsageError):
                link.open(soon())
            newer(link)
            link.close()
            link.close()


def test_a_link_that_is_not_open_does_nothing() -> None:
    with controller("motoman") as server:
        link = link_to(server, "motoman")
        calls: list[Callable[[], object]] = [
            lambda: link.report_after(0.0, soon()),
            lambda: link.send(course(0.1)),
            lambda: link.stop("test"),
            lambda: link.enable(1.0),
            lambda: link.disable(1.0),
            lambda: link.reset_fault(1.0),
        ]
        for call in calls:
            with pytest.raises(NotOpen):
                call()
        assert server.received == []


# -- reports --------------------------------------------------------------------------------------------------------


def test_reports_are_of_the_arm_s_joints_and_their_number_grows() -> None:
    with arm("rep") as (link, _):
        reports: list[ArmReport] = []
        enough = threading.Event()

        def take(report: ArmReport) -> None:
            reports.append(report)
            if len(reports) >= 10:
                enough.set()

        end = link.subscribe(take)
        assert enough.wait(PATIENCE)
        end()
        numbers = [report.sequence for report in reports]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert all(first.time <= second.time for first, second in pairwise(reports))
        assert reports[0].velocities is None, "a JOINT_POSITION tells none"
        assert {len(report.positions) for report in reports} == {JOINTS}


def test_velocities_are_told_where_the_controller_tells_them() -> None:
    with arm("rep", feedback=True) as (link, _):
        assert newer(link).velocities == (0.0,) * JOINTS


@pytest.mark.parametrize("size", [1, 7, 61])
def test_states_are_read_however_the_network_cuts_them(size: int) -> None:
    def cut(data: bytes) -> Iterator[bytes]:
        return (data[place : place + size] for place in range(0, len(data), size))

    with arm("rep", state_chunks=cut) as (link, _):
        assert newer(link).positions == pytest.approx([0.1 * joint for joint in range(JOINTS)])


def test_states_are_read_however_the_network_joins_them() -> None:
    with arm("rep", state_chunks=lambda data: iter([data * 20])) as (link, server):
        server.wait_for(lambda: server.states >= 3)
        _until(lambda: newest(link).sequence == 20 * server.states)


def test_a_subscriber_that_fails_is_told_of_and_the_others_go_on() -> None:
    with arm("rep") as (link, _):
        told = Told(link)

        def fail(report: ArmReport) -> None:
            raise ZeroDivisionError

        link.subscribe(fail)
        assert "ZeroDivisionError" in str(told.first(DeviceError))
        newer(link)
        assert len(told.of(DeviceError)) == 1


@pytest.mark.parametrize(
    ("change", "mode", "faults"),
    [
        ({}, Mode.READY, ()),
        ({"e_stopped": 1}, Mode.EMERGENCY_STOP, ()),
        ({"in_error": 1, "error_code": 4107}, Mode.FAULT, ("error 4107 of the controller",)),
        ({"in_error": 1, "error_code": -1}, Mode.FAULT, ("an error of the controller, which tells no code",)),
        ({"mode": 1}, Mode.MANUAL, ()),
        ({"drives_powered": 0}, Mode.DISABLED, ()),
        ({"motion_possible": 0}, Mode.DISABLED, ()),
        ({"drives_powered": -1}, Mode.UNKNOWN, ()),
        ({"e_stopped": -1}, Mode.UNKNOWN, ()),
        ({"in_error": -1}, Mode.UNKNOWN, ()),
        ({"mode": -1}, Mode.UNKNOWN, ()),
        ({"mode": 3}, Mode.UNKNOWN, ()),
        ({"motion_possible": -1}, Mode.UNKNOWN, ()),
        ({"motion_possible": 7}, Mode.UNKNOWN, ()),
    ],
    ids=str,
)
def test_an_arm_is_ready_only_if_the_controller_says_all_of_it(
    change: dict[str, int], mode: Mode, faults: tuple[str, ...]
) -> None:
    with controller("rep") as server:
        server.status = replace(server.status, **change)
        with opened(server, "rep") as link:
            report = newer(link)
            assert (report.mode, report.faults) == (mode, faults)
            if mode is not Mode.READY:
                with pytest.raises(CommandRefused):
                    link.send(course(0.1))
                assert server.sequences() == []
        with opened(server, "rep", unknown_is_ready=True) as link:
            assert newer(link).mode is (Mode.READY if mode is Mode.UNKNOWN else mode)


def test_a_controller_that_sends_no_status_is_not_ready() -> None:
    with controller("rep", tells_status=False) as server:
        with opened(server, "rep") as link:
            assert (newer(link).mode, newer(link).in_motion) == (Mode.UNKNOWN, None)
        with opened(server, "rep", unknown_is_ready=True) as link:
            assert newer(link).mode is Mode.READY


@pytest.mark.parametrize("unknown_is_ready", [False, True])
def test_a_status_that_comes_no_more_says_nothing_any_more(
    unknown_is_ready: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("backends.controller.tcp.feedback.LOST_AFTER", 0.3)
    with controller("rep") as server, opened(server, "rep", unknown_is_ready=unknown_is_ready) as link:
        _until(lambda: newer(link).mode is Mode.READY)
        server.tells_status = False
        server.tells_anew()
        _until(lambda: newer(link).mode is not Mode.READY)
        assert newer(link).mode is Mode.UNKNOWN


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"e_stopped": 1}, "emergency stop"),
        ({"in_error": 1, "error_code": 1234}, "error 1234"),
        ({"mode": 1}, "manual mode"),
        ({"drives_powered": 0}, "drives are off"),
        ({"motion_possible": 0}, "motion is not possible"),
    ],
    ids=str,
)
def test_a_controller_that_is_not_ready_any_more_tells_at_once_why(change: dict[str, int], said: str) -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        server.status = replace(server.status, **change)
        error = told.first(DeviceError)
        assert error.device == "left"
        assert said in str(error)
        newer(link), newer(link)
        assert told.of(DeviceError) == [error]


def test_a_second_error_is_told_too() -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        server.status = replace(server.status, in_error=1, error_code=1)
        told.first(DeviceError)
        server.status = replace(server.status, error_code=2)
        _until(lambda: len(told.of(DeviceError)) > 1)
        newer(link), newer(link)
        whys = [error.why for error in told.of(DeviceError)]
        assert whys == ["error 1 of the controller", "error 2 of the controller"]


# -- what each dialect is sent --------------------------------------------------------------------------------------


def points(server: SmallServer) -> list[tuple[int, list[float], float, float]]:
    """Sequence number, joints, velocity and duration of each JOINT_TRAJ_PT."""
    told = []
    for message in server.of(11):
        number, *ten, velocity, duration = struct.unpack(f"{server.order}i12{server.real}", message.body)
        assert ten[JOINTS:] == [0.0] * (10 - JOINTS)
        assert message.comm == 2
        told.append((number, ten[:JOINTS], velocity, duration))
    return told


STREAMS = [("rep", rep), ("rep", rep_with_body), ("rep", rep_with_an_echo), ("fanuc", fanuc)]


@pytest.mark.parametrize(("dialect", "answer"), STREAMS)
def test_a_stream_is_short_segments_numbered_from_zero(dialect: str, answer: Answer) -> None:
    way = course(0.3, -0.1)
    with arm(dialect, answer) as (link, server):
        assert ended(link.send(way)).complete
        sent = points(server)
    assert [number for number, *_ in sent] == list(range(len(sent)))
    # A stop may wait behind two of them.
    assert max(duration for *_, duration in sent) <= 0.15 + 1e-6
    assert sum(duration for *_, duration in sent) == pytest.approx(way.duration, abs=1e-5)
    begin = 0.0
    position = list(way.start)
    for _, joints, velocity, duration in sent:
        begin += duration
        assert joints == pytest.approx(way.sample(begin)[0].tolist(), abs=1e-5)
        # The fraction of what the arm can, not of what this path allows.
        fastest = max(abs(b - a) for a, b in zip(position, joints, strict=True)) / duration
        assert velocity == pytest.approx(max(fastest / 2.0, 1e-3), abs=1e-4)
        position = joints
    assert any(joints == pytest.approx(way.waypoints[0], abs=1e-6) for _, joints, *_ in sent)
    assert sent[-1][1] == pytest.approx(way.waypoints[-1], abs=1e-6)


def test_a_slow_path_is_sent_with_small_fractions() -> None:
    with arm("rep") as (link, server):
        assert ended(link.send(course(0.05, speed=0.1))).complete
        assert 0.04 < max(velocity for *_, velocity, _ in points(server)) <= 0.05 + 1e-6


def test_a_download_is_the_start_and_the_waypoints_and_nothing_between() -> None:
    way = course(0.3, -0.1, 0.2)
    with arm("abb") as (link, server):
        transfer = link.send(way)
        sent = points(server)  # it returns when all was taken
        assert ended(transfer).complete
    assert [number for number, *_ in sent] == [-1, 1, 2, -3]
    for (_, joints, *_), expected in zip(sent, (way.start, *way.waypoints), strict=True):
        assert joints == pytest.approx(expected, abs=1e-6)
    arrivals = (0.0, *way.arrivals)
    durations = [b - a for a, b in pairwise(arrivals)]
    assert [duration for *_, duration in sent[1:]] == pytest.approx(durations, abs=1e-5)


@pytest.mark.parametrize("room", [None, 2, 5, 100])
def test_a_download_that_the_controller_has_no_room_for_is_refused_before_a_byte(room: int | None) -> None:
    fits = (room or 200) - 1
    with controller("abb") as server:
        with opened(server, "abb", **({"max_points": room} if room else {})) as link:
            wave = [0.001 * (number % 2 + 1) for number in range(fits + 1)]
            with pytest.raises(CommandRefused, match=f"{fits + 2} points"):
                link.send(course(*wave))
            assert server.received == []
            assert ended(link.send(course(*wave[:fits]))).complete
        numbers = [number for number in server.sequences() if number != -4]
        assert len(numbers) == fits + 1


def test_a_motoman_is_sent_the_start_first_and_points_with_time_position_and_velocity() -> None:
    way = course(0.3, -0.1)
    with arm("motoman") as (link, server):
        assert ended(link.send(way)).complete
        received = list(server.received)
    assert received[0].id == 2001
    assert [received[0].integer(place) for place in range(3)] == [0, 0, 200121]
    assert {message.id for message in received[1:]} == {14}
    before = -1.0
    for sequence, message in enumerate(received[1:]):
        group, number, valid, time, *reals = struct.unpack(">3i31f", message.body)
        assert (group, number, valid) == (0, sequence, 7)
        position, velocity = way.sample(time) if sequence else (way.start, (0.0,) * JOINTS)
        assert reals[:JOINTS] == pytest.approx(list(position), abs=1e-5)
        assert reals[10 : 10 + JOINTS] == pytest.approx(list(velocity), abs=1e-4)
        assert 0 < time - before <= 1.1
        assert time - before <= 0.1 + 1e-5 or sequence == 0
        before = time
    assert before == pytest.approx(way.duration, abs=1e-5)
    assert struct.unpack(">3i31f", received[1].body)[3] == 0.0


@pytest.mark.parametrize("dialect", ANSWERS)
def test_a_course_that_ends_where_it_begins_is_sent_too(dialect: str) -> None:
    with arm(dialect) as (link, server):
        assert ended(link.send(course(0.0))).complete
        assert len(server.of(14 if dialect == "motoman" else 11)) >= 1
        for *_, velocity, duration in points(server):
            assert 0 < velocity <= 1
            assert duration > 0


@pytest.mark.parametrize("dialect", ANSWERS)
def test_one_course_follows_another(dialect: str) -> None:
    with arm(dialect) as (link, server):
        for offset in (0.1, -0.1):
            way = course(offset, start=server.positions[0])
            assert ended(link.send(way)).complete
            shows(link, way.waypoints[-1])


@pytest.mark.parametrize("dialect", ["abb", "fanuc", "motoman"])
def test_a_motion_port_gets_nothing_but_motion_messages(dialect: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.motion.PING_EVERY", 0.05)
    with arm(dialect) as (link, server):
        pause(0.3)
        assert server.received == []
        assert ended(link.send(course(0.1))).complete
        link.stop("test")
        pause(0.3)
        assert {message.id for message in server.received} <= ({14, 2001} if dialect == "motoman" else {11})


def test_a_server_that_keeps_the_rep_is_asked_when_idle_whether_it_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.motion.PING_EVERY", 0.05)
    with arm("rep") as (link, server):
        server.wait_for(lambda: len(server.of(1)) >= 2)
        assert {message.body for message in server.of(1)} == {bytes(40)}
        assert ended(link.send(course(0.1))).complete


# -- replies that are late, wrong, or never come --------------------------------------------------------------------


def unanswered(when: Callable[[Received], bool], otherwise: Answer) -> Answer:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        reply = otherwise(server, message)
        return None if when(message) else reply

    return answer


@pytest.mark.usefixtures("given_up")
def test_a_point_that_is_not_answered_fails_the_course_and_has_the_arm_stop() -> None:
    with arm("rep", unanswered(lambda m: m.id == 11 and m.integer(0) == 2, rep)) as (link, server):
        told = Told(link)
        transfer = ended(link.send(course(0.5)))
        assert isinstance(transfer.error, DeviceTimeout)
        assert "left" in str(transfer.error)
        server.wait_for(lambda: server.sequences()[-1] == -4)
        assert server.sequences() == [0, 1, 2, -4]
        # Nobody knows which reply is whose: it goes on with a new connection.
        told.first(LinkLost)
        _until(lambda: ended(link.send(course(0.0))).complete)


@pytest.mark.usefixtures("given_up")
def test_a_first_point_that_is_not_answered_is_told_to_who_sent_it() -> None:
    with arm("rep", unanswered(lambda m: m.id == 11 and m.integer(0) == 0, rep)) as (link, server):
        with pytest.raises(DeviceTimeout, match="sent no reply in time"):
            link.send(course(0.5))
        server.wait_for(lambda: server.sequences()[-1] == -4)


@pytest.mark.usefixtures("given_up")
def test_a_motion_port_that_answers_no_more_is_lost_and_connected_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.motion.PING_EVERY", 0.05)
    silent = threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        return None if silent.is_set() else rep(server, message)

    with arm("rep", answer) as (link, server):
        told = Told(link)
        silent.set()
        assert "does not answer" in str(told.first(LinkLost))
        silent.clear()
        before = len(server.received)
        server.wait_for(lambda: len(server.received) > before)
        newer(link)
        assert ended(link.send(course(0.1))).complete


@pytest.mark.usefixtures("given_up")
def test_a_late_reply_is_not_taken_for_the_next_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.motion._LATE", PATIENCE)
    late, given_up = threading.Event(), threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id == 11 and message.integer(0) == 1 and not late.is_set():
            late.set()
            given_up.wait(PATIENCE)
        return rep(server, message)

    with arm("rep", answer) as (link, server):
        transfer = ended(link.send(course(0.5)))
        assert isinstance(transfer.error, DeviceTimeout)
        given_up.set()
        server.wait_for(lambda: -4 in server.sequences())
        way = course(-0.2, start=server.positions[0])
        assert ended(link.send(way)).complete
        shows(link, way.waypoints[-1])


def test_messages_that_answer_nothing_are_ignored() -> None:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        reply = rep(server, message)
        assert reply is not None
        unasked = server.packet(10, 3, 1, "i10r", 5, *[0.0] * 10) + server.packet(2017, 1, 0, "10i", *[0] * 10)
        return unasked + reply

    with arm("rep", answer) as (link, _):
        assert ended(link.send(course(0.3))).complete


def refusing(number: int, otherwise: Answer, refusal: Answer) -> Answer:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        place = 1 if message.id == 14 else 0
        if message.id in (11, 14) and message.integer(place) == number:
            return refusal(server, message)
        return otherwise(server, message)

    return answer


def test_a_refused_first_point_is_a_refused_command() -> None:
    with (
        arm("rep", refusing(0, rep, lambda s, m: s.packet(11, 3, 2))) as (link, _),
        pytest.raises(CommandRefused, match=r"left: move: the controller refused message 1 of \d+"),
    ):
        link.send(course(0.3))


@pytest.mark.parametrize("number", [0, 1])
def test_a_refusal_is_told_with_what_status_says_next(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.session._EXPLAINED_WITHIN", PATIENCE)

    def refuse(server: SmallServer, message: Received) -> bytes:
        server.status = replace(server.status, in_error=1, error_code=34252)
        return server.packet(11, 3, 2)

    with arm("rep", refusing(number, rep, refuse)) as (link, _):
        try:
            error: BaseException | None = ended(link.send(course(0.5))).error
        except CommandRefused as refused:
            error = refused
        assert isinstance(error, CommandRefused)
        assert error.__notes__ == ["left: error 34252 of the controller"]


@pytest.mark.parametrize("dialect", ["rep", "fanuc"])
def test_a_refused_point_on_the_way_fails_the_course_and_has_the_arm_stop(dialect: str) -> None:
    def refuse(server: SmallServer, message: Received) -> bytes:
        return server.packet(11 if dialect == "rep" else 10, 3, 2, "10r", *[0.0] * 10)

    with arm(dialect, refusing(2, ANSWERS[dialect], refuse)) as (link, server):
        transfer = ended(link.send(course(0.5)))
        assert isinstance(transfer.error, CommandRefused)
        server.wait_for(lambda: server.sequences()[-1] == -4)
        assert server.sequences() == [0, 1, 2, -4]


def test_a_refusal_within_a_download_is_a_refused_command() -> None:
    with arm("abb", refusing(1, abb, lambda s, m: s.packet(11, 3, 2))) as (link, server):
        with pytest.raises(CommandRefused, match="message 2 of 3"):
            link.send(course(0.3, 0.1))
        server.wait_for(lambda: server.sequences()[-1] == -4)
        assert -3 not in server.sequences()


def test_a_point_that_a_fanuc_finds_out_of_reach_after_it_was_taken_is_told() -> None:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        reply = fanuc(server, message)
        server.memory["count"] = server.memory.get("count", 0) + 1
        if server.memory["count"] == server.memory.get("bad"):
            assert reply is not None
            return reply + server.packet(10, 3, 2, "i10r", message.integer(0), *[0.0] * 10)
        return reply

    with arm("fanuc", answer) as (link, server):
        ended(link.send(course(0.1)))
        server.memory.update(bad=len(server.received), count=0)
        told = Told(link)
        link.send(course(-0.1, start=server.positions[0]))
        assert "refused what it had taken" in str(told.first(MotionFailed))


def test_a_fanuc_s_reply_to_another_point_is_none_to_this_one() -> None:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.integer(0) != 1:
            return fanuc(server, message)
        stale = server.packet(10, 3, 1, "i10r", 0, *[0.0] * 10)
        server.memory["stale"] = True
        return stale + (fanuc(server, message) or b"")

    with arm("fanuc", answer) as (link, server):
        assert ended(link.send(course(0.3))).complete
        assert server.memory["stale"]


@pytest.mark.parametrize(
    ("result", "subcode", "said"),
    [
        (2, 0, "it failed"),
        (3, 3011, "start is not where the arm stands"),
        (4, 0, "the controller has an alarm"),
        (5, 5006, "servos are off"),
        (6, 0, "programming interface failed"),
        (9, 77, "result 9, code 77"),
    ],
)
def test_a_motoman_s_verdict_is_told_in_words_though_its_header_says_success(
    result: int, subcode: int, said: str
) -> None:
    with arm("motoman", refusing(0, motoman, lambda s, m: moto_reply(s, m, result, subcode))) as (link, server):
        with pytest.raises(CommandRefused, match=said) as refused:
            link.send(course(0.3))
        assert f"result {result}, code {subcode}" in str(refused.value)
        server.wait_for(lambda: server.received[-1].id == 2001 and server.received[-1].integer(2) == 200111)


def test_a_motoman_that_is_busy_is_sent_the_same_point_again() -> None:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id == 14:
            number = message.integer(1)
            tries = server.memory[number] = server.memory.get(number, 0) + 1
            if number % 2 and tries < 3:
                return moto_reply(server, message, 1)
        return motoman(server, message)

    with arm("motoman", answer) as (link, server):
        assert ended(link.send(course(0.2))).complete
        numbers = server.sequences(1)
        assert numbers == [number for number in range(numbers[-1] + 1) for _ in range(3 if number % 2 else 1)]


def test_a_motoman_that_stays_busy_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.handover._BUSY_FOR", 0.3)
    with arm("motoman", refusing(1, motoman, lambda s, m: moto_reply(s, m, 1))) as (link, server):
        transfer = ended(link.send(course(0.2)))
        assert isinstance(transfer.error, DeviceTimeout)
        assert "busy with message 3" in str(transfer.error)
        server.wait_for(lambda: server.received[-1].id == 2001)


# -- stops ----------------------------------------------------------------------------------------------------------


def is_stop(dialect: str, message: Received) -> bool:
    if dialect == "motoman":
        return message.id == 2001 and message.integer(2) == 200111
    return message.id == 11 and message.integer(0) == -4


@pytest.mark.parametrize("dialect", ANSWERS)
def test_a_stop_is_sent_also_where_nothing_moves(dialect: str) -> None:
    with arm(dialect) as (link, server):
        link.stop("test")
        server.wait_for(lambda: len(server.asked) > 0)
        assert [is_stop(dialect, message) for message in server.asked] == [True]
        link.stop("again")
        server.wait_for(lambda: len(server.asked) > 1)


@pytest.mark.parametrize("dialect", ["rep", "fanuc", "motoman"])
def test_after_a_stop_no_point_is_sent_any_more(dialect: str) -> None:
    reached, stopped = threading.Event(), threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id in (11, 14) and message.integer(1 if message.id == 14 else 0) == 3:
            reached.set()
            stopped.wait(PATIENCE)
        return ANSWERS[dialect](server, message)

    with arm(dialect, answer) as (link, server):
        transfer = link.send(course(1.0))
        assert reached.wait(PATIENCE)
        link.stop("enough")
        stopped.set()
        error = ended(transfer).error
        assert isinstance(error, MotionStopped)
        assert "enough" in str(error)
        server.wait_for(lambda: is_stop(dialect, server.asked[-1]))
        pause(0.2)
        assert is_stop(dialect, server.asked[-1])


def test_a_stop_does_not_wait_for_a_reply_that_does_not_come() -> None:
    with arm("rep", unanswered(lambda m: m.id == 11 and m.integer(0) == 1, rep)) as (link, server):
        transfer = link.send(course(1.0))
        server.wait_for(lambda: 1 in server.sequences())
        link.stop("now")
        server.wait_for(lambda: server.sequences()[-1] == -4)
        assert isinstance(ended(transfer).error, MotionStopped)
        assert server.sequences() == [0, 1, -4]


def test_a_stop_behind_a_fanuc_s_point_is_on_the_wire_before_that_has_ended() -> None:
    executing, may_end = threading.Event(), threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.integer(0) == 2:
            executing.set()
            may_end.wait(PATIENCE)
        return fanuc(server, message)

    with arm("fanuc", answer) as (link, server):
        transfer = link.send(course(1.0))
        assert executing.wait(PATIENCE)
        link.stop("now")  # returns though the server does not read
        assert isinstance(ended(transfer).error, MotionStopped)
        may_end.set()
        server.wait_for(lambda: server.sequences()[-1] == -4)
        assert server.sequences() == [0, 1, 2, -4]


def test_after_a_command_an_arm_moves_until_a_newer_status_says_otherwise() -> None:
    with arm("rep") as (link, server):
        assert newer(link).in_motion is False
        server.tells_status = False
        server.tells_anew()
        newer(link)  # whatever STATUS was under way has come
        sent = CLOCK.now()
        link.stop("test")
        assert link.report_after(sent, soon()).in_motion is True
        server.tells_status = True
        while newer(link).in_motion:
            pass
        assert newer(link).in_motion is False


@pytest.mark.parametrize("said", [0, 1, -1])
def test_what_a_controller_says_of_motion_is_reported(said: int) -> None:
    with arm("rep") as (link, server):
        server.status = replace(server.status, in_motion=said)
        server.tells_anew()
        newer(link)  # and the STATUS that comes with it
        assert newer(link).in_motion is {0: False, 1: True, -1: None}[said]


def test_one_course_at_a_time() -> None:
    gate = threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id == 11 and message.integer(0) == 1:
            gate.wait(PATIENCE)
        return rep(server, message)

    with arm("rep", answer) as (link, _):
        transfer = link.send(course(0.5))
        with pytest.raises(CommandRefused, match="another course"):
            link.send(course(0.5))
        gate.set()
        assert ended(transfer).complete


def test_a_fault_on_the_way_ends_the_course() -> None:
    gone_on = threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id == 11 and message.integer(0) == 2:
            server.status = replace(server.status, e_stopped=1)
            gone_on.wait(PATIENCE)
        return rep(server, message)

    with arm("rep", answer) as (link, server):
        error = ended(link.send(course(1.0))).error
        assert "emergency stop" in str(error)
        gone_on.set()
        server.wait_for(lambda: server.sequences()[-1] == -4)


@pytest.mark.parametrize("dialect", ANSWERS)
def test_closing_a_link_stops_what_is_under_way(dialect: str) -> None:
    with controller(dialect) as server:
        server.status = replace(server.status, in_motion=1)
        link = link_to(server, dialect)
        link.open(soon())
        link.send(course(0.5))
        link.close()
        server.wait_for(lambda: is_stop(dialect, server.asked[-1]))


def test_closing_a_link_that_has_moved_nothing_sends_nothing() -> None:
    with controller("abb") as server:
        link = link_to(server, "abb")
        link.open(soon())
        link.close()
        pause(0.05)
        assert server.received == []


def test_closing_wakes_who_waits_for_a_report() -> None:
    with controller("rep") as server:
        link = link_to(server, "rep")
        link.open(soon())
        outcome: list[DeviceError] = []

        def wait() -> None:
            try:
                link.report_after(soon(1000), soon(60))
            except DeviceError as error:
                outcome.append(error)

        thread = threading.Thread(target=wait)
        thread.start()
        pause(0.05)
        link.close()
        thread.join(PATIENCE)
        assert [type(error) for error in outcome] == [NotOpen]


# -- links that break -----------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("given_up")
def test_feedback_that_stops_is_late_first_and_then_the_link_is_lost() -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        _until(lambda: "Hz" in rate(link))  # before that nothing is late
        server.quiet.set()
        assert "ms old" in str(told.first(DeviceTimeout))
        with pytest.raises((DeviceTimeout, LinkLost)):
            link.send(course(0.1))
        assert "no feedback" in str(told.first(LinkLost))
        with pytest.raises(LinkLost):
            link.report_after(CLOCK.now(), soon())
        with pytest.raises(LinkLost):
            link.send(course(0.1))
        assert [m for m in server.sequences() if m >= 0] == []
        # The stop goes by the port that still stands.
        link.stop("lost")
        server.wait_for(lambda: -4 in server.sequences())


@pytest.mark.parametrize("period", [0.1, 0.004])
def test_feedback_is_all_taken_at_10_hz_and_at_250_hz(period: float) -> None:
    with arm("rep", period=period, feedback=True) as (link, server):
        told = Told(link)
        server.wait_for(lambda: server.states >= 0.5 / period)
        _until(lambda: newest(link).sequence == server.states)
        assert not told.of(LinkLost)


def test_a_late_report_is_waited_for_no_longer_than_asked() -> None:
    with arm("rep", period=0.3) as (link, _), pytest.raises(DeviceTimeout, match="told no joint angles in time"):
        link.report_after(CLOCK.now() + 60, soon(0.1))


def test_a_broken_state_port_is_told_connected_anew_and_read_anew() -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        before = newer(link)
        server.cut("state_port")
        assert "closed the connection" in str(told.first(LinkLost))
        report = _again(link)
        assert report.sequence > before.sequence
        while report.mode is not Mode.READY:
            report = newer(link)
        assert ended(link.send(course(0.1))).complete
        assert len(told.of(LinkLost)) == 1


def test_a_broken_motion_port_is_told_and_connected_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    anew, connect = threading.Event(), Connection.connect

    def connect_then(self: Connection, deadline: float) -> None:
        anew.wait(PATIENCE)
        connect(self, soon())

    with arm("rep") as (link, server):
        told = Told(link)
        monkeypatch.setattr(Connection, "connect", connect_then)
        server.cut("motion_port")
        told.first(LinkLost)
        with pytest.raises(LinkLost):
            link.stop("test")
        newer(link)  # the state port stands
        anew.set()
        _until(lambda: ended(link.send(course(0.1))).complete)


def test_a_server_that_is_started_anew_between_moves_is_asked_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.motion.PING_EVERY", 0.2)
    with arm("rep") as (link, server):
        told = Told(link)
        assert ended(link.send(course(0.1))).complete
        server.close()
        told.first(LinkLost)
        server.received.clear()
        server.start()
        _again(link)
        server.wait_for(lambda: len(server.of(1)) >= 1)
        assert {message.id for message in server.received} == {1}
        _until(lambda: newer(link).mode is Mode.READY)
        assert ended(link.send(course(0.1))).complete


def test_a_server_that_is_started_anew_within_a_move_is_asked_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("backends.controller.tcp.motion.PING_EVERY", 0.2)
    reached = threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id == 11 and message.integer(0) == 3:
            reached.set()
            server.closing.wait(PATIENCE)
        return rep(server, message)

    with arm("rep", answer) as (link, server):
        told = Told(link)
        transfer = link.send(course(1.0))
        assert reached.wait(PATIENCE)
        server.close()
        assert isinstance(ended(transfer).error, LinkLost)
        told.first(LinkLost)
        server.received.clear()
        server.start()
        _again(link)
        server.wait_for(lambda: len(server.of(1)) >= 1)
        assert {message.id for message in server.received} == {1}


def test_a_server_that_stays_away_is_tried_less_and_less_often(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (port.FIRST_BACK_OFF, port.LONGEST_BACK_OFF) == (0.25, 5.0)
    monkeypatch.setattr(port, "FIRST_BACK_OFF", 0.05)
    monkeypatch.setattr(port, "LONGEST_BACK_OFF", 0.2)
    tried, enough, connect = [], threading.Event(), Connection.connect

    def counted(self: Connection, deadline: float) -> None:
        if self.address.port == state_port:
            tried.append(CLOCK.now())
            if len(tried) == 5:
                enough.set()
        connect(self, deadline)

    with controller("rep") as server, opened(server, "rep"):
        state_port = server.state_port
        monkeypatch.setattr(Connection, "connect", counted)
        begin = CLOCK.now()
        server.close()
        assert enough.wait(PATIENCE)
    waits = [after - before for before, after in pairwise([begin, *tried[:5]])]
    assert all(wait >= least for wait, least in zip(waits, (0.05, 0.1, 0.2, 0.2, 0.2), strict=True)), waits


@pytest.mark.parametrize("dialect", ANSWERS)
def test_a_motion_begins_where_the_newest_feedback_has_the_arm(dialect: str) -> None:
    here, limits = (
        [0.2, -0.3, 0.4, 0.0, 0.1, 0.5],
        JointLimits(*(side * np.full(JOINTS, 3.0) for side in (-1, 1, 1, 1))),
    )
    with arm(dialect) as (link, server):
        robot = ControlledRobot("left", limits, JointMap(None, JOINTS), CLOCK)
        robot.attach(link)
        server.positions[0] = list(here)
        shows(link, here)
        goal = tuple(angle + 0.1 for angle in here)
        robot.start(JointPath((goal,), (0.5,) * JOINTS, (2.0,) * JOINTS)).wait(PATIENCE)
        place = 16 if dialect == "motoman" else 4
        first = struct.unpack_from(">10f", server.of(14 if dialect == "motoman" else 11)[0].body, place)[:JOINTS]
        robot.detach()
    # A stream without a time for its start begins with the end of its first piece, of at most 0.15 s.
    assert first == pytest.approx(here, abs=0.5 * 0.15 if dialect in ("rep", "fanuc") else 1e-6)


def test_a_motion_port_is_not_connected_anew_before_the_state_is_known() -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        server.close()
        told.first(LinkLost)
        server.received.clear()
        server.quiet.set()
        server.start()
        pause(0.6)
        with pytest.raises(LinkLost):
            link.send(course(0.1))
        with pytest.raises(LinkLost):
            link.stop("test")
        assert server.received == []
        server.quiet.clear()
        _until(lambda: ended(link.send(course(0.1))).complete)


def test_a_watcher_that_fails_keeps_nobody_from_being_told(caplog: pytest.LogCaptureFixture) -> None:
    def fail(error: DeviceError) -> None:
        raise ZeroDivisionError

    with arm("rep") as (link, server):
        link.on_failure(fail)
        told = Told(link)
        server.cut("state_port")
        told.first(LinkLost)
        _again(link)
    assert "ZeroDivisionError" in caplog.text


def test_a_server_that_comes_back_with_another_byte_order_is_read_as_it_is() -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        server.close()
        told.first(LinkLost)
        server.order, server.real = "<", "d"
        server.start()
        assert _again(link).positions == pytest.approx([0.1 * joint for joint in range(JOINTS)])
        _until(lambda: ended(link.send(course(0.1))).complete)


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"\xff" * 16,
        lambda data: struct.pack(">4i", 60, 10, 1, 0) + bytes(48),
        lambda data: struct.pack(">4ii10f", 56, 10, 1, 0, 0, *[float("nan")] * 10),
        lambda data: struct.pack(">4i", 40, 13, 3, 1) + bytes(20),
    ],
    ids=["no length", "wrong length", "no numbers", "header"],
)
def test_damaged_states_break_the_link_and_are_never_reported(damage: Callable[[bytes], bytes]) -> None:
    damaged = threading.Event()

    def chunks(data: bytes) -> Iterator[bytes]:
        if damaged.is_set():
            damaged.clear()
            yield damage(data)
        yield data

    with arm("rep", state_chunks=chunks) as (link, _):
        told = Told(link)
        damaged.set()
        assert "no message" in str(told.first(LinkLost)) or "closed" in str(told.first(LinkLost))
        assert _again(link).positions == pytest.approx([0.1 * joint for joint in range(JOINTS)])


def test_damaged_replies_break_the_link() -> None:
    with arm("rep", refusing(1, rep, lambda s, m: b"\xff" * 16)) as (link, _):
        transfer = ended(link.send(course(0.5)))
        assert isinstance(transfer.error, LinkLost)
        assert "no message" in str(transfer.error)


def _again(link: ArmLink) -> ArmReport:
    """A report after the link was lost."""
    reports: list[ArmReport] = []
    _until(lambda: bool(reports.append(newer(link)) or reports))
    return reports[-1]


def _until(succeeds: Callable[[], bool]) -> None:
    deadline = soon()
    while CLOCK.now() < deadline:
        with suppress(DeviceError):
            if succeeds():
                return
        pause(0.02)
    pytest.fail("it did not come to be")


# -- the operator's commands ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dialect", ["rep", "abb", "fanuc"])
def test_servers_without_switches_leave_drives_and_faults_to_the_pendant(dialect: str) -> None:
    with arm(dialect) as (link, server):
        for command in (link.enable, link.disable, link.reset_fault):
            with pytest.raises(CommandRefused, match="at the pendant"):
                command(1.0)
        assert server.asked == []


def commands(server: SmallServer) -> list[int]:
    return [message.integer(2) for message in server.of(2001)]


def test_a_motoman_s_drives_are_switched() -> None:
    with arm("motoman") as (link, server):
        link.disable(PATIENCE)
        assert commands(server) == [200113]
        assert newer(link).mode is Mode.DISABLED
        link.enable(PATIENCE)
        assert commands(server) == [200113, 200112, 200121]
        assert newer(link).mode is Mode.READY


def test_a_motoman_s_fault_is_acknowledged_and_its_drives_stay_as_they_are() -> None:
    with controller("motoman") as server:
        server.status = replace(server.status, in_error=1, error_code=4107, drives_powered=0)
        with opened(server, "motoman") as link:
            with pytest.raises(CommandRefused, match="error 4107"):
                link.enable(PATIENCE)
            assert server.received == [], "enabling does not acknowledge a fault"
            link.reset_fault(PATIENCE)
            assert commands(server) == [200114]
            assert newer(link).mode is Mode.DISABLED


def test_a_command_that_a_motoman_does_not_take_is_refused() -> None:
    def answer(server: SmallServer, message: Received) -> bytes | None:
        return moto_reply(server, message, 5, 5003)

    with arm("motoman", answer) as (link, _), pytest.raises(CommandRefused, match="emergency stop"):
        link.enable(PATIENCE)


def test_a_command_that_a_motoman_takes_and_does_not_carry_out_is_told() -> None:
    with arm("motoman", moto_reply) as (link, _), pytest.raises(DeviceTimeout, match="does not show it"):
        link.disable(1.0)


def test_a_course_does_not_switch_drives_on() -> None:
    with controller("motoman") as server:
        server.status = replace(server.status, drives_powered=0)
        with opened(server, "motoman") as link, pytest.raises(CommandRefused, match="drives are off"):
            link.send(course(0.1))
        assert server.received == []


# -- arms that share a controller -----------------------------------------------------------------------------------


@contextmanager
def two_arms(answer: Answer = motoman) -> Iterator[tuple[dict[str, ArmLink], SmallServer]]:
    with controller("motoman", answer, groups=(0, 1)) as server:
        server.positions[1] = [1.0] * JOINTS
        ports = {"host": "127.0.0.1", "motion_port": server.motion_port, "state_port": server.state_port}
        arms = {"left": {**ports, "group": 0}, "right": {**ports, "group": 1}}
        given = TcpLink.model_validate({"dialect": "motoman", "arms": arms})
        both = links(given, dict.fromkeys(arms, JOINTS), CLOCK, dict.fromkeys(arms, TOP_SPEED))
        try:
            for link in both.values():
                link.open(soon())
            yield both, server
        finally:
            for link in both.values():
                link.close()


def test_arms_that_share_ports_are_told_apart_by_their_group() -> None:
    with two_arms() as (both, server):
        assert newer(both["right"]).positions == pytest.approx([1.0] * JOINTS)
        assert newer(both["left"]).positions == pytest.approx([0.1 * joint for joint in range(JOINTS)])
        way = course(0.2, start=[1.0] * JOINTS)
        assert ended(both["right"].send(way)).complete
        assert {message.integer(0) for message in server.received} == {1}
        shows(both["right"], way.waypoints[-1])
        assert newer(both["left"]).positions == pytest.approx([0.1 * joint for joint in range(JOINTS)])


def test_arms_that_share_ports_move_at_once() -> None:
    with two_arms() as (both, server):
        first = both["left"].send(course(0.3))
        second = both["right"].send(course(0.2, start=[1.0] * JOINTS))
        assert ended(first).complete
        assert ended(second).complete
        assert server.positions[0][0] == pytest.approx(0.3)
        assert server.positions[1][0] == pytest.approx(1.2)


def test_a_stop_of_one_is_a_stop_of_all_that_share_the_controller() -> None:
    reached, stopped = threading.Event(), threading.Event()

    def answer(server: SmallServer, message: Received) -> bytes | None:
        if message.id == 14 and message.integer(1) == 3:
            reached.set()
            stopped.wait(PATIENCE)
        return motoman(server, message)

    with two_arms(answer) as (both, _):
        told = Told(both["right"])
        transfer = both["right"].send(course(1.0, start=[1.0] * JOINTS))
        assert reached.wait(PATIENCE)
        both["left"].stop("the operator")
        stopped.set()
        assert isinstance(ended(transfer).error, MotionStopped)
        assert told.first(MotionStopped).device == "right"


def test_a_lost_link_names_each_arm_that_shares_it() -> None:
    with two_arms() as (both, server):
        told = {name: Told(link) for name, link in both.items()}
        server.cut()
        for name in both:
            assert told[name].first(LinkLost).device == name


def test_one_of_two_arms_may_be_closed() -> None:
    with two_arms() as (both, _):
        both["left"].close()
        assert ended(both["right"].send(course(0.2, start=[1.0] * JOINTS))).complete


# -- findings -------------------------------------------------------------------------------------------------------


def rate(link: ArmLink) -> str:
    return next(finding.said for finding in link.findings() if finding.subject == "state rate")


def test_findings_of_an_arm_that_is_ready_are_all_good() -> None:
    with arm("rep") as (link, _):
        _until(lambda: "Hz" in rate(link))
        found = {finding.subject: finding for finding in link.findings()}
        assert {finding.verdict for finding in found.values()} == {"good"}
        assert found["mode"].said == "ready"
        assert "Hz, jitter" in found["state rate"].said
        assert {"state port", "motion port", "byte order", "drives", "emergency stop", "faults"} <= set(found)


@pytest.mark.parametrize(
    ("change", "subject", "said"),
    [
        ({"e_stopped": 1}, "emergency stop", "active"),
        ({"drives_powered": 0}, "drives", "off"),
        ({"mode": 1}, "operating mode", "manual"),
        ({"in_error": 1, "error_code": 77}, "faults", "error 77 of the controller"),
        ({"motion_possible": -1}, "mode", "the controller does not tell: motion"),
    ],
    ids=str,
)
def test_findings_say_what_keeps_an_arm_from_moving(change: dict[str, int], subject: str, said: str) -> None:
    with controller("rep") as server:
        server.status = replace(server.status, **change)
        with opened(server, "rep") as link:
            found = {finding.subject: finding for finding in link.findings()}
            assert said in found[subject].said
            assert found[subject].verdict == "problem"
            assert found["mode"].verdict == "problem"
            assert server.sequences() == []


def test_findings_of_a_lost_link_say_so() -> None:
    with arm("rep") as (link, server):
        told = Told(link)
        server.close()
        told.first(LinkLost)
        found = {finding.subject: finding for finding in link.findings()}
        assert "problem" in (found["state port"].verdict, found["motion port"].verdict)
