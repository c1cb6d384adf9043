"""Devices looked at as they stand: nothing is moved, nothing is switched on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from dualcal_hal.camera import Camera, Frame
from dualcal_hal.clock import Clock
from dualcal_hal.config import CellConfig, RobotConfig
from dualcal_hal.errors import DeviceError
from dualcal_hal.findings import Finding
from dualcal_hal.guard import CLOCK_SLACK, OLDEST_FEEDBACK, STANDSTILL
from dualcal_hal.robot import Mode, Robot, RobotState
from procedures.detection import Detector, Missed
from procedures.detection.exposure import BRIGHTEST, raise_light_problem
from procedures.detection.outcome import Refused

READ_TIMEOUT = 2.0
GRAB_TIMEOUT = 3.0
WATCHED_FOR = 2.0
"""Seconds of states and of frames that rates are taken from."""

_MOST_FRAMES = 20
_LATE_PERIODS = 3
"""Periods after which feedback is late, but not before OLDEST_FEEDBACK."""

_MODES: dict[Mode, Finding] = {
    Mode.READY: Finding("mode", "ready: it would carry out a motion"),
    Mode.DISABLED: Finding("mode", "its drives are off", "note", "switch them on: dualcal enable, or run --enable"),
    Mode.MANUAL: Finding("mode", "in manual mode", "problem", "turn its key to automatic, once nobody is in the cell"),
    Mode.EMERGENCY_STOP: Finding("mode", "stopped by its emergency stop", "problem", "release it at the controller"),
    Mode.FAULT: Finding("mode", "in fault", "problem", "see its faults; then: dualcal reset"),
    Mode.UNKNOWN: Finding(
        "mode",
        "its controller does not say whether it would move",
        "problem",
        "if it never does, say unknown_is_ready in the cell file",
    ),
}


def examine_robot(robot: Robot, config: RobotConfig, clock: Clock) -> list[Finding]:
    """All that can be seen of an open arm; a failure is a finding, and what comes after it is still looked at."""
    return _told_once(_robot(robot, config, clock))


def examine_camera(camera: Camera, cell: CellConfig, clock: Clock) -> list[Finding]:
    """All that can be seen of an open camera, and of the target by it."""
    return _told_once(_camera(camera, cell, clock))


_SEVERITY = {"good": 0, "note": 1, "problem": 2}


def _told_once(findings: Iterator[Finding]) -> list[Finding]:
    """Without what was told before, by the device itself, which knows more; unless it is worse than that."""
    told: dict[str, int] = {}
    kept = []
    for each in findings:
        severity = _SEVERITY[each.verdict]
        if severity > told.get(each.subject, -1):
            kept.append(each)
            told[each.subject] = severity
    return kept


def _robot(robot: Robot, config: RobotConfig, clock: Clock) -> Iterator[Finding]:
    try:
        begun = clock.now()
        state = robot.read(READ_TIMEOUT)
        handed_over = clock.now()
    except DeviceError as error:
        yield Finding("reachable", error.why, "problem", error.advice)
        yield from _own_findings(robot.findings)
        return
    yield Finding("reachable", f"yes, it answers within {1e3 * (handed_over - begun):.0f} ms")
    yield from _own_findings(robot.findings)
    yield from _condition(state)
    yield from _joints(state, config)
    yield _age("clock", "a state", handed_over - state.time)
    yield from _states(robot, clock)


def _own_findings(findings: Callable[[], list[Finding]]) -> Iterator[Finding]:
    try:
        yield from findings()
    except DeviceError as error:
        yield Finding("check", error.why, "problem", error.advice)


def _condition(state: RobotState) -> Iterator[Finding]:
    yield _MODES[state.mode]
    if state.mode is Mode.EMERGENCY_STOP:
        yield Finding("emergency stop", "pressed", "problem", "release it at the controller")
    elif state.mode is Mode.UNKNOWN:
        yield Finding("emergency stop", "not known", "note")
    else:
        yield Finding("emergency stop", "not pressed")
    if state.faults:
        yield Finding("faults", "; ".join(state.faults), "problem", "clear them; then: dualcal reset")
    else:
        yield Finding("faults", "none")


def _joints(state: RobotState, config: RobotConfig) -> Iterator[Finding]:
    q, n = np.array(state.positions), len(config.limits_deg)
    if len(q) != n or not np.all(np.isfinite(q)):
        advice = "check kinematics in the cell file and the joints of the controller"
        yield Finding("joints", f"{len(q)} angles where the cell file has {n} joints: {list(q)}", "problem", advice)
        return
    angles = " ".join(f"{angle:z.1f}" for angle in np.degrees(q))
    inside = np.degrees(np.minimum(q - config.lower, config.upper - q))
    least = int(np.argmin(inside - np.degrees(config.limit_margin)))
    said = f"{angles} deg; nearest to its limits is joint {least + 1}, {inside[least]:.1f} deg inside"
    beyond = np.flatnonzero(inside < 0)
    if len(beyond):
        names = ", ".join(f"joint {joint + 1} by {-inside[joint]:.1f} deg" for joint in beyond)
        advice = "jog it back; or its unit, zero or sign is wrong: dualcal doctor --flange"
        yield Finding("joints", f"{angles} deg; beyond its limits: {names}", "problem", advice)
    elif inside[least] < np.degrees(config.limit_margin[least]):
        yield Finding("joints", said, "note", "that is less than limit_margin_deg: jog it away before a run")
    else:
        yield Finding("joints", said)
    if max(map(abs, state.velocities)) > STANDSTILL:
        yield Finding("motion", "it moves", "note", "let it stand")


def _age(subject: str, what: str, age: float) -> Finding:
    """How old a state or frame was when it was handed over."""
    said = f"{what} is {1e3 * age:.0f} ms old when it is handed over"
    if age < -CLOCK_SLACK:
        said = f"{what} is {-1e3 * age:.0f} ms ahead of this computer's clock"
        return Finding(subject, said, "problem", "its times are of another clock: see the device's time settings")
    if age > OLDEST_FEEDBACK:
        advice = f"more than {1e3 * OLDEST_FEEDBACK:.0f} ms: check the link, and whose clock the times are of"
        return Finding(subject, said, "problem", advice)
    return Finding(subject, said)


def _states(robot: Robot, clock: Clock) -> Iterator[Finding]:
    """Rate and evenness of the states, and failures that are told meanwhile."""
    times: list[float] = []
    sequences: list[int] = []
    failures: list[DeviceError] = []

    def arrived(state: RobotState) -> None:
        times.append(state.time)
        sequences.append(state.sequence)

    endings = [robot.on_failure(failures.append), robot.subscribe(arrived)]
    try:
        clock.wait(threading.Event(), clock.now() + WATCHED_FOR)
    finally:
        for end in endings:
            end()
    yield _rate(times, sequences)
    for said in dict.fromkeys(failure.why for failure in failures):
        yield Finding("failure", said, "problem", "see the lines above")


def _rate(times: list[float], sequences: list[int]) -> Finding:
    if len(times) < 2:
        return Finding(
            "state rate", f"{len(times)} in {WATCHED_FOR:g} s", "problem", "check the link and its state port"
        )
    gaps = np.diff(times)
    usual, longest = float(np.median(gaps)), float(np.max(gaps))
    jitter = float(np.percentile(np.abs(gaps - usual), 95))
    missing = sequences[-1] - sequences[0] + 1 - len(sequences)
    said = f"{1 / np.mean(gaps):.1f} Hz, jitter {1e3 * jitter:.1f} ms, longest gap {1e3 * longest:.0f} ms"
    if missing > 0:
        said += f", {missing} lost on the way"
    late = max(OLDEST_FEEDBACK, _LATE_PERIODS * usual)
    if longest > late:
        advice = f"a motion is stopped after {1e3 * late:.0f} ms: check cables, switches and this computer's load"
        return Finding("state rate", said, "problem", advice)
    return Finding("state rate", said)


# Cameras


@dataclass(frozen=True)
class _Grabbed:
    frame: Frame
    asked: float
    handed_over: float


def _camera(camera: Camera, cell: CellConfig, clock: Clock) -> Iterator[Finding]:
    try:
        grabbed = [_grab(camera, clock)]
    except DeviceError as error:
        yield Finding("reachable", error.why, "problem", error.advice)
        yield from _own_findings(camera.findings)
        return
    first = grabbed[0]
    yield Finding("reachable", f"yes, a frame came within {1e3 * (first.handed_over - first.asked):.0f} ms")
    yield from _own_findings(camera.findings)
    try:
        while len(grabbed) < _MOST_FRAMES and clock.now() - first.asked < WATCHED_FOR:
            grabbed.append(_grab(camera, clock))
        yield _frame_rate(grabbed)
    except DeviceError as error:
        yield Finding("frames", f"after {len(grabbed)} frames: {error.why}", "problem", error.advice)
    latest = grabbed[-1]
    yield _exposed(latest)
    yield from _image(latest.frame, cell)


def _grab(camera: Camera, clock: Clock) -> _Grabbed:
    asked = clock.now()
    frame = camera.grab(asked, GRAB_TIMEOUT)
    return _Grabbed(frame, asked, clock.now())


def _frame_rate(grabbed: list[_Grabbed]) -> Finding:
    needed = [each.handed_over - each.asked for each in grabbed]
    mean, longest = float(np.mean(needed)), float(np.max(needed))
    if mean <= 0.0:  # in a time that is made by waiting
        return Finding("frames", f"{len(grabbed)} frames as soon as they were asked for")
    return Finding("frames", f"{1 / mean:.1f} frames a second on demand, the slowest after {1e3 * longest:.0f} ms")


def _exposed(grabbed: _Grabbed) -> Finding:
    before, age = grabbed.asked - grabbed.frame.time, grabbed.handed_over - grabbed.frame.time
    if before > CLOCK_SLACK or age < -CLOCK_SLACK:
        said = f"a frame is stamped {1e3 * age:.0f} ms before it came, which was asked for {1e3 * before:.0f} ms later"
        return Finding("clock", said, "problem", "its times are of another clock than this computer's")
    return Finding("clock", f"a frame is {1e3 * age:.0f} ms old when it is handed over, and was exposed when asked for")


def _image(frame: Frame, cell: CellConfig) -> Iterator[Finding]:
    size, wanted = frame.image.shape[::-1], cell.camera.size_px
    if size != wanted:
        said = f"{' x '.join(map(str, size))} px, and the intrinsics are of {wanted[0]} x {wanted[1]}"
        advice = "set the camera's size or binning, or calibrate it anew: run --procedure intrinsics"
        yield Finding("frame size", said, "problem", advice)
        return
    yield Finding("frame size", f"{size[0]} x {size[1]} px, as the intrinsics'")
    yield _light(frame)
    found = Detector(cell.target.board, wanted).detect(frame.image)
    if isinstance(found, Missed):
        advice = "if it should be in view from here, see to that"
        yield Finding("target", f"not seen: {found}", "note", advice)
        return
    seen, all_ = int(found.seen.sum()), len(found.corners)
    said = f"seen, {seen} of {all_} corners, blur {found.blur:.1f} px, contrast {found.contrast:.0f}"
    yield Finding("target", said)


def _light(frame: Frame) -> Finding:
    values = frame.image
    dark, bright = np.percentile(values, [5, 95])
    saturated = 100 * float(np.mean(values >= BRIGHTEST))
    said = f"grey levels {dark:.0f} to {bright:.0f}, {saturated:.0f} % saturated"
    try:
        raise_light_problem(values)
    except Refused as refused:
        return Finding("light", said, "problem", refused.missed.detail)
    return Finding("light", said)
