"""Emulated controllers' servers have the ways of the real ones, each dialect its own."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from backends.controller.emulator.faults import FaultSchedule
from backends.controller.emulator.tcp.paths import Cubic, Pieces, RunOn, TimedStream, corners
from backends.controller.emulator.tcp.stations import SimpleMessageServers
from dualcal_hal.clock import RealClock
from dualcal_hal.errors import UsageError
from tests.simple_message_client import ARMS, Client, serving, tcp_cell

PING, JOINT_POSITION, POINT, STATUS, FULL_POINT, FEEDBACK = 1, 10, 11, 13, 14, 15
CONTROL, ANSWER = 2001, 2002
START_DOWNLOAD, END, STOP = -1, -3, -4
AWAY = np.array([0.1, -0.05, 0.05, 0.1, 0.05, -0.15])
NEAR = 1e-4  # rad: an encoder's step, its noise and f32 are less


def is_moving(status: tuple[int, ...]) -> bool:
    return status[4] == 1


# How all of them are


@pytest.mark.parametrize(
    ("link", "order", "real", "kind", "size"),
    [
        ("dialect: rep", "<", "f", FEEDBACK, 132),
        ("dialect: rep, real: f64", "<", "d", FEEDBACK, 256),
        ("dialect: rep, byte_order: big", ">", "f", FEEDBACK, 132),
        ("dialect: abb", "<", "f", JOINT_POSITION, 44),
        ("dialect: fanuc", ">", "f", JOINT_POSITION, 44),
        ("dialect: motoman", ">", "f", FEEDBACK, 132),
    ],
)
def test_states_come_in_the_byte_order_and_size_of_the_controller(
    link: str, order: str, real: str, kind: int, size: int
) -> None:
    with serving(link, order=order, real=real) as rig:
        client = rig.client()
        got, comm, code, body = client.receive(client.state)
        assert (got, comm, code, len(body)) == (kind, 1, 0, size)
        skipped = 4 if kind == JOINT_POSITION else 8 + (8 if real == "d" else 4)
        joints = np.frombuffer(body, f"{order}{'f8' if real == 'd' else 'f4'}", 10, skipped)
        assert joints[:6] == pytest.approx(rig.cell.cell.active.home, abs=NEAR)
        assert not joints[6:].any()
        assert client.next_status() == (1, 0, 0, 0, 0, 2, 0 if "motoman" in link else 1)


def test_joints_are_the_controllers_own() -> None:
    arms = (
        "{left: {host: 127.0.0.1, motion_port: 1, state_port: 2, joint_map: {order: [2, 1, 3, 4, 5, 6], "
        "sign: [1, -1, 1, 1, 1, 1], coupling: [{joint: 3, from_joint: 2, factor: 1}]}}, "
        "right: {host: 127.0.0.1, motion_port: 3, state_port: 4}}"
    )
    with serving("dialect: rep", arms=arms) as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        sent = np.array([home[1] + 0.1, -home[0], home[2] - home[0] - 0.1, *home[3:]])
        assert client.ask(POINT, client.point(0, sent, duration=0.3))[2] == 1
        assert rig.settled() == pytest.approx(home + np.array([0.0, 0.1, -0.1, 0.0, 0.0, 0.0]), abs=NEAR)
        kind, _, _, body = (later := rig.client()).receive(later.state)
        assert kind == FEEDBACK
        assert client.unpack("6f", body[12:36]) == pytest.approx(sent, abs=NEAR)


def test_a_controller_that_does_not_tell_its_mode_says_unknown() -> None:
    with serving("dialect: abb, unknown_is_ready: true") as rig:
        assert rig.client().next_status() == (1, 0, 0, 0, 0, -1, -1)


def test_many_may_listen_but_one_may_move() -> None:
    with serving() as rig:
        first, second = rig.client(), rig.client()
        assert second.ask(PING, bytes(40))[0] == PING
        assert first.motion.recv(1) == b""  # the newer took its place
        assert first.next_status() == second.next_status()


def test_only_this_machine_is_served() -> None:
    file = tcp_cell("dialect: rep", ARMS.replace("127.0.0.1", "192.168.1.5"))
    tcp = file.cell.backends["cell"].checked.link.tcp
    schedule = FaultSchedule([], RealClock(), lambda line: None)
    with pytest.raises(UsageError, match=r"192\.168\.1\.5.*--free-ports"):
        SimpleMessageServers(tcp, file.cell, {}, schedule, free_ports=False)


# rep


def stream(client: Client, places: list[np.ndarray], duration: float = 0.2) -> None:
    """All at once: an arm rests where the next point is late."""
    for sequence, place in enumerate(places):
        client.send(POINT, client.point(sequence, place, duration=duration))
    assert [client.receive()[2] for _ in places] == [1] * len(places)


def test_rep_goes_by_the_points_that_it_is_sent() -> None:
    with serving() as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        stream(client, [home + share * AWAY for share in (0.25, 0.75, 1.0)])
        assert client.status_with(is_moving)
        assert rig.settled() == pytest.approx(home + AWAY, abs=NEAR)
        client.status_with(lambda status: not is_moving(status))
        assert rig.left.motions == 1


def test_rep_takes_a_velocity_where_there_is_no_duration() -> None:
    with serving() as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        assert client.ask(POINT, client.point(0, home + AWAY, velocity=0.5))[2] == 1
        assert rig.settled() == pytest.approx(home + AWAY, abs=NEAR)


def test_rep_replies_with_and_without_a_body() -> None:
    with serving() as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        replies = [client.ask(POINT, client.point(n, home, duration=0.1)) for n in range(2)]
        assert [(kind, comm, code) for kind, comm, code, _ in replies] == [(POINT, 3, 1)] * 2
        assert sorted(len(body) for *_, body in replies) == [0, 40]


def test_rep_answers_a_ping_and_refuses_what_it_does_not_know() -> None:
    with serving() as rig:
        client = rig.client()
        assert client.ask(PING, bytes(40)) == (PING, 3, 1, bytes(40))
        assert client.ask(4711, b"") == (4711, 3, 2, b"")
        client.send(4712, b"", comm=1)  # a topic is ignored
        assert client.ask(PING, bytes(40))[0] == PING


def test_rep_puts_messages_together_from_their_pieces() -> None:
    with serving() as rig:
        client = rig.client()
        ping = client.pack("4i", 52, PING, 2, 0) + bytes(40)
        for byte in ping[:20]:
            client.motion.sendall(bytes([byte]))
        client.motion.sendall(ping[20:] + ping)
        assert [client.receive()[0] for _ in range(2)] == [PING, PING]


def test_rep_aborts_at_a_point_out_of_order() -> None:
    with serving() as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        stream(client, [home + AWAY], duration=2.0)
        client.status_with(is_moving)
        assert client.ask(POINT, client.point(5, home, duration=1.0))[2] == 2
        stands = rig.settled()
        assert np.max(np.abs(stands - home - AWAY)) > NEAR


@pytest.mark.parametrize("wrong", ["beyond a limit", "too fast", "no duration and no velocity", "not a number"])
def test_rep_refuses_what_cannot_be(wrong: str) -> None:
    with serving() as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        body = {
            "beyond a limit": client.point(0, home + np.array([4.0, 0, 0, 0, 0, 0]), duration=5.0),
            "too fast": client.point(0, home + AWAY, duration=0.01),
            "no duration and no velocity": client.point(0, home + AWAY, velocity=0.0),
            "not a number": client.point(0, home + np.nan, duration=1.0),
        }[wrong]
        assert client.ask(POINT, body)[2] == 2
        assert rig.left.motions == 0


@pytest.mark.parametrize("how", ["by a stop", "by the loss of its client"])
def test_rep_stops(how: str) -> None:
    with serving() as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        stream(client, [home + 3 * AWAY], duration=3.0)
        client.status_with(is_moving)
        if how == "by a stop":
            assert client.ask(POINT, client.point(STOP, []))[2] == 1
        else:
            client.motion.close()
        client.status_with(lambda status: not is_moving(status))
        assert np.max(np.abs(rig.settled() - home - 3 * AWAY)) > 0.01


def test_a_stop_is_answered_where_nothing_moves() -> None:
    with serving() as rig:
        client = rig.client()
        assert client.ask(POINT, client.point(STOP, []))[2] == 1


# abb


def test_abb_moves_at_the_end_of_a_download_by_its_first_and_last_point_too() -> None:
    with serving("dialect: abb") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        for sequence, share in ((START_DOWNLOAD, 0.0), (1, 0.5)):
            assert client.ask(POINT, client.point(sequence, home + share * AWAY)) == (POINT, 3, 1, b"")
        for _ in range(3):
            assert not is_moving(client.next_status())
        assert rig.left.motions == 0
        client.ask(POINT, client.point(END, home + AWAY))
        assert rig.settled() == pytest.approx(home + AWAY, abs=NEAR)


def test_abb_answers_requests_only() -> None:
    with serving("dialect: abb") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.send(POINT, client.point(START_DOWNLOAD, home), comm=1)
        client.next_status()  # one message at a time
        assert client.ask(POINT, client.point(1, home + AWAY))[:3] == (POINT, 3, 1)
        client.motion.settimeout(0.1)
        with pytest.raises(TimeoutError):
            client.motion.recv(1)


@pytest.mark.parametrize(("link", "room"), [("dialect: abb", 200), ("dialect: abb, max_points: 100", 100)])
def test_abb_loses_points_that_it_has_no_room_for_and_says_nothing(link: str, room: int) -> None:
    with serving(link) as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        last = room + 4
        for n in range(last + 1):
            sequence = START_DOWNLOAD if n == 0 else END if n == last else n
            assert client.ask(POINT, client.point(sequence, home + n / last * AWAY))[2] == 1
        assert rig.settled() == pytest.approx(home + (room - 1) / last * AWAY, abs=NEAR)


def test_abb_stops_at_once() -> None:
    with serving("dialect: abb, controller_speed_confirmed: {mm_s: 20}") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.ask(POINT, client.point(START_DOWNLOAD, home))
        client.ask(POINT, client.point(END, home + 5 * AWAY))
        client.status_with(is_moving)
        assert client.ask(POINT, client.point(STOP, []))[2] == 1
        client.status_with(lambda status: not is_moving(status))
        assert np.max(np.abs(rig.settled() - home - 5 * AWAY)) > 0.1


def test_abb_goes_on_when_its_client_is_lost() -> None:
    with serving("dialect: abb") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        client.ask(POINT, client.point(START_DOWNLOAD, home))
        client.ask(POINT, client.point(END, home + AWAY))
        client.motion.close()
        assert rig.settled() == pytest.approx(home + AWAY, abs=NEAR)


@pytest.mark.parametrize("kind", [PING, FULL_POINT])
def test_abb_has_an_error_after_anything_but_a_point(kind: int) -> None:
    with serving("dialect: abb") as rig:
        client = rig.client()
        client.send(kind, bytes(40))
        assert client.motion.recv(1) == b""
        status = client.status_with(lambda status: status[3] == 1)
        assert status[2] != 0
        assert status[6] == 0


def test_abb_does_not_wait_for_the_rest_of_a_message() -> None:
    with serving("dialect: abb") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        message = client.pack("4i", 64, POINT, 2, 0) + client.point(START_DOWNLOAD, home)
        client.motion.sendall(message + message)
        assert [client.receive()[:3] for _ in range(2)] == [(POINT, 3, 1)] * 2
        client.motion.sendall(message[:30])
        assert client.motion.recv(1) == b""
        assert client.status_with(lambda status: status[3] == 1)


def test_abb_tells_its_state_ten_times_a_second() -> None:
    with serving("dialect: abb") as rig:
        begin = rig.world.clock.now()
        client = rig.client()
        for _ in range(6):
            client.next_status()
        assert rig.world.clock.now() - begin > 0.3


@pytest.mark.parametrize("dialect", ["abb", "fanuc"])
def test_controllers_go_at_the_speed_that_is_set_at_them(dialect: str) -> None:
    link = f"dialect: {dialect}, byte_order: little, controller_speed_confirmed: {{mm_s: 50}}"
    with serving(link) as rig:
        client, home, chain = rig.client(), rig.cell.cell.active.home, rig.cell.cell.active.chain
        goal = home + np.array([0.1, 0, 0, 0, 0, 0])
        if dialect == "abb":
            client.ask(POINT, client.point(START_DOWNLOAD, home))
            client.ask(POINT, client.point(END, goal, velocity=1.0, duration=0.1))
        else:
            client.ask(POINT, client.point(0, goal, velocity=1.0, duration=0.1))
        fastest, before = 0.0, rig.left.read()
        rig.wait(lambda: rig.left.motions)
        while rig.left.in_motion:
            now = rig.left.read()
            if now.time - before.time > 0.03:
                way = chain.forward(now.positions)[:3, 3] - chain.forward(before.positions)[:3, 3]
                fastest, before = max(fastest, float(np.linalg.norm(way) / (now.time - before.time))), now
        assert 0.02 < fastest < 0.06


# fanuc


def test_fanuc_acknowledges_by_a_joint_position_with_the_number_before_it_moves() -> None:
    with serving("dialect: fanuc", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        kind, comm, code, body = client.ask(POINT, client.point(0, home + AWAY))
        assert (kind, comm, code, len(body)) == (JOINT_POSITION, 3, 1, 44)
        assert client.unpack("i", body[:4]) == (0,)
        client.ask(POINT, client.point(1, home + 2 * AWAY))
        assert rig.settled() == pytest.approx(home + 2 * AWAY, abs=NEAR)
        assert rig.left.motions == 1


def test_fanuc_never_acknowledges_start_and_end() -> None:
    with serving("dialect: fanuc", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        for special in (-1, -2, -3):
            client.send(POINT, client.point(special, home + AWAY))
            client.next_status()  # one message at a time
        client.motion.settimeout(0.1)
        with pytest.raises(TimeoutError):
            client.motion.recv(1)
        assert rig.left.motions == 0


def test_at_fanuc_a_stop_waits_behind_a_point() -> None:
    with serving("dialect: fanuc, controller_speed_confirmed: {mm_s: 60}", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        for sequence in range(2):
            client.ask(POINT, client.point(sequence, home + (sequence + 1) * AWAY))
        begin = rig.world.clock.now()
        kind, _, code, body = client.ask(POINT, client.point(STOP, []))
        assert (kind, code) == (JOINT_POSITION, 1)
        assert client.unpack("i", body[:4]) == (STOP,)
        assert rig.world.clock.now() - begin > 0.3  # until the first was left behind
        stands = rig.settled()
        assert np.max(np.abs(stands - home)) > 0.9 * np.max(np.abs(AWAY))
        assert np.max(np.abs(stands - home - 2 * AWAY)) > NEAR


def test_fanuc_takes_one_message_after_the_other() -> None:
    with serving("dialect: fanuc", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        messages = [client.pack("4i", 64, POINT, 2, 0) + client.point(n, home + n * AWAY) for n in (0, 1, STOP)]
        client.motion.sendall(b"".join(messages))
        numbers = [client.unpack("i", client.receive()[3][:4])[0] for _ in range(3)]
        assert numbers == [0, 1, STOP]


def test_fanuc_puts_its_client_out_for_a_point_that_it_cannot_reach() -> None:
    with serving("dialect: fanuc", order=">") as rig:
        client = rig.client()
        assert client.ask(POINT, client.point(0, [9.0] * 6))[2] == 1
        assert client.receive()[2] == 2
        assert client.motion.recv(1) == b""


def test_fanuc_takes_a_ping_for_what_it_is_not() -> None:
    with serving("dialect: fanuc", order=">") as rig:
        client = rig.client()
        client.send(PING, bytes(40))
        assert client.motion.recv(1) == b""


# motoman


def control(client: Client, command: int, group: int = 0) -> tuple[int, int]:
    kind, comm, code, body = client.ask(CONTROL, client.command(command, group))
    assert (kind, comm, code, len(body)) == (ANSWER, 3, 1, 60)
    answered, _, which, result, subcode = client.unpack("5i", body[:20])
    assert (answered, which) == (group, command)
    return result, subcode


def send_point(client: Client, *point: object, **of: int) -> tuple[int, int]:
    kind, comm, code, body = client.ask(FULL_POINT, client.full_point(*point, **of))  # type: ignore[arg-type]
    assert (kind, comm, code) == (ANSWER, 3, 1)
    _, _, which, result, subcode = client.unpack("5i", body[:20])
    assert which == FULL_POINT
    return result, subcode


START_TRAJECTORY_MODE, STOP_MOTION, START_SERVOS, STOP_SERVOS, RESET_ALARM = 200121, 200111, 200112, 200113, 200114
OK, BUSY, INVALID, NOT_READY = 0, 1, 3, 5


def test_motoman_takes_no_point_before_its_trajectory_mode_is_started() -> None:
    with serving("dialect: motoman", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        assert client.next_status()[6] == 0
        assert send_point(client, 0, 0.0, home) == (NOT_READY, 5008)
        assert control(client, START_TRAJECTORY_MODE) == (OK, 0)
        assert client.status_with(lambda status: status[6] == 1)
        assert send_point(client, 0, 0.0, home) == (OK, 0)


def test_motoman_goes_through_points_at_their_times() -> None:
    with serving("dialect: motoman", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        control(client, START_TRAJECTORY_MODE)
        send_point(client, 0, 0.0, home)
        for sequence, (time, share, speed) in enumerate([(0.6, 0.5, 1.25), (1.2, 1.0, 0.0)], start=1):
            while (answer := send_point(client, sequence, time, home + share * AWAY, speed * AWAY)) == (BUSY, 0):
                pass
            assert answer == (OK, 0)
        assert rig.settled() == pytest.approx(home + AWAY, abs=NEAR)
        assert rig.left.motions == 1


def test_motoman_is_busy_until_it_has_room_and_takes_the_same_point_then() -> None:
    with serving("dialect: motoman", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        control(client, START_TRAJECTORY_MODE)
        answers, begin = [], rig.world.clock.now()
        send_point(client, 0, 0.0, home)
        for sequence in range(1, 5):
            while (answer := send_point(client, sequence, 0.5 * sequence, home + 0.1 * sequence * AWAY)) == (BUSY, 0):
                answers.append(answer)
            assert answer == (OK, 0)
        assert answers
        assert rig.world.clock.now() - begin > 0.6  # the third lasts until 1.5 s, and there is room for 0.8 s
        assert rig.settled() == pytest.approx(home + 0.4 * AWAY, abs=NEAR)


@pytest.mark.parametrize(
    ("point", "of", "subcode"),
    [
        ((0, 0.0, "away"), {}, 3011),
        ((0, 0.0, "home"), {"valid": 3}, 3015),
        ((0, 0.0, "home"), {"group": 2}, 3004),
        ((-1, 0.0, "home"), {}, 3005),
        ((0, 0.0, "home", (9.0,) * 6), {}, 3013),
    ],
)
def test_motoman_says_what_is_wrong_with_a_point(point: tuple[object, ...], of: dict[str, int], subcode: int) -> None:
    with serving("dialect: motoman", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        control(client, START_TRAJECTORY_MODE)
        places = {"home": home, "away": home + 31 / 76_800}
        sequence, time, place, *rest = point
        assert send_point(client, sequence, time, places[str(place)], *rest, **of) == (INVALID, subcode)
        assert rig.left.motions == 0


def test_motoman_stops_and_stands() -> None:
    with serving("dialect: motoman", order=">") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        control(client, START_TRAJECTORY_MODE)
        send_point(client, 0, 0.0, home)
        send_point(client, 1, 3.0, home + 3 * AWAY)
        client.status_with(is_moving)
        assert control(client, STOP_MOTION) == (OK, 0)
        client.status_with(lambda status: not is_moving(status))
        assert np.max(np.abs(rig.settled() - home - 3 * AWAY)) > 0.01
        assert send_point(client, 2, 4.0, home)[0] == INVALID


def test_motoman_switches_its_servos_and_acknowledges_alarms() -> None:
    with serving("dialect: motoman", order=">", fault="drive-fault:left@point:1") as rig:
        client, home = rig.client(), rig.cell.cell.active.home
        control(client, START_TRAJECTORY_MODE)
        send_point(client, 0, 0.0, home)
        client.status_with(lambda status: status[0] == 0 and status[3] == 1)
        assert send_point(client, 1, 1.0, home) == (NOT_READY, 5001)
        assert control(client, RESET_ALARM) == (OK, 0)
        assert client.status_with(lambda status: status[3] == 0)[0] == 0
        assert control(client, START_SERVOS) == (OK, 0)
        assert client.status_with(lambda status: status[0] == 1)
        assert control(client, STOP_SERVOS) == (OK, 0)
        assert client.status_with(lambda status: status[0] == 0)


def test_motoman_answers_a_ping_and_takes_its_body_for_another_message() -> None:
    with serving("dialect: motoman", order=">") as rig:
        client = rig.client()
        client.send(PING, bytes(40))
        assert client.receive()[:3] == (PING, 3, 1)
        kind, _, _, body = client.receive()
        assert kind == ANSWER
        assert client.unpack("5i", body[:20])[3:] == (INVALID, 3003)


def test_motoman_does_not_wait_for_the_rest_of_a_message() -> None:
    with serving("dialect: motoman", order=">") as rig:
        client = rig.client()
        message = client.pack("4i", 64, CONTROL, 2, 0) + client.command(STOP_MOTION)
        client.motion.sendall(message + message + message[:30])
        answers = [client.unpack("5i", client.receive()[3][:20]) for _ in range(3)]
        assert [answer[2:] for answer in answers] == [(STOP_MOTION, OK, 0)] * 2 + [(0, INVALID, 3001)]


def test_motoman_has_two_arms_at_one_port() -> None:
    arms = (
        "{left: {host: 127.0.0.1, motion_port: 1, state_port: 2, group: 0}, "
        "right: {host: 127.0.0.1, motion_port: 1, state_port: 2, group: 1}}"
    )
    with serving("dialect: motoman", arms=arms, order=">") as rig:
        assert rig.servers.endpoints["left"] == rig.servers.endpoints["right"]
        client, home = rig.client(), rig.cell.cell.passive.home
        groups = {client.unpack("i", body[:4])[0] for kind, _, _, body in _states(client, 6) if kind == FEEDBACK}
        assert groups == {0, 1}
        control(client, START_TRAJECTORY_MODE, group=1)
        assert send_point(client, 0, 0.0, home, group=1) == (OK, 0)
        send_point(client, 1, 0.5, home + AWAY, group=1)
        right = rig.world.arms["right"]
        rig.wait(lambda: right.motions and not right.in_motion)
        assert right.read().positions == pytest.approx(home + AWAY, abs=NEAR)
        assert rig.left.motions == 0


def _states(client: Client, count: int) -> list[tuple[int, int, int, bytes]]:
    return [client.receive(client.state) for _ in range(count)]


# What they make of the points


def samples(path: TimedStream | RunOn | Pieces, end: float) -> np.ndarray:
    return np.array([path.sample(t)[0] for t in np.arange(0.0, end, 0.002)])


def test_points_with_durations_are_gone_through_evenly_and_with_a_rest_at_a_corner() -> None:
    start, corner, goal = np.zeros(2), np.array([1.0, 0.0]), np.array([1.0, 1.0])
    path = TimedStream(start, 0.1)
    for share in (0.25, 0.5, 0.75, 1.0):
        path.add(share * corner, 0.25, 0.0)
    for share in (0.5, 1.0):
        path.add(corner + share * (goal - corner), 0.5, 0.0)
    q = samples(path, 3.0)
    assert path.end == pytest.approx(2.1)
    assert np.min(np.maximum(np.abs(q[:, 1]), np.abs(1.0 - q[:, 0]))) == 0.0
    assert np.all((np.abs(q[:, 1]) < 1e-12) | (np.abs(q[:, 0] - 1.0) < 1e-12))  # no corner is cut
    assert path.sample(1.1)[1] == pytest.approx([0.0, 0.0])
    assert q[-1] == pytest.approx(goal)
    assert np.max(np.abs(np.diff(q, n=2, axis=0))) / 0.002**2 < 16.0  # rad/s^2: without a jerk between points


def test_a_stream_that_dries_up_comes_to_rest_and_goes_on_later() -> None:
    path = TimedStream(np.zeros(1), 0.05)
    path.add(np.array([1.0]), 1.0, 0.0)
    assert path.sample(1.05)[0] == pytest.approx([1.0])
    assert path.end == pytest.approx(1.05)
    path.add(np.array([2.0]), 1.0, 5.0)
    assert path.sample(5.04)[0] == pytest.approx([1.0])
    assert path.sample(6.05)[0] == pytest.approx([2.0])


def test_a_controller_runs_on_where_the_next_point_is_straight_ahead() -> None:
    speed, acceleration = np.array([1.0, 1.0]), np.array([2.0, 2.0])
    path = RunOn(np.zeros(2), speed, acceleration)
    assert path.add(np.array([1.0, 0.0]), 0.0, speed) == pytest.approx(0.0, abs=1e-9)
    left = path.add(np.array([2.0, 0.0]), 0.1, speed)
    assert path.sample(left)[0] == pytest.approx([1.0, 0.0], abs=1e-9)
    assert path.sample(left)[1] == pytest.approx([1.0, 0.0], abs=1e-9)  # at full speed
    path.add(np.array([2.0, 1.0]), 0.2, speed)
    q = samples(path, path.end + 0.1)
    v = np.diff(q, axis=0) / 0.002
    assert np.all(np.abs(v) <= speed + 1e-6)
    assert np.all((np.abs(q[:, 1]) < 1e-12) | (np.abs(q[:, 0] - 2.0) < 1e-12))
    assert q[-1] == pytest.approx([2.0, 1.0])


def test_a_cubic_keeps_places_and_velocities() -> None:
    cubic = Cubic(1.0, 3.0, np.array([0.0]), np.array([1.0]), np.array([0.3]), np.array([-0.2]))
    for t, q, v in ((1.0, 0.0, 0.3), (3.0, 1.0, -0.2)):
        assert cubic.sample(t)[0] == pytest.approx([q])
        assert cubic.sample(t)[1] == pytest.approx([v])
    steps = [cubic.sample(t)[0][0] for t in np.linspace(1.0, 3.0, 2001)]
    assert max(abs(after - before) for before, after in pairwise(steps)) < 1e-3


def test_corners_are_what_is_left_of_a_straight_way() -> None:
    points = [np.array(p, dtype=float) for p in ([0, 0], [1, 0], [2, 0], [2, 1], [2, 1], [2, 2])]
    assert [list(corner) for corner in corners(np.zeros(2), points)] == [[2, 0], [2, 2]]
