"""``dualcal serve-camera``."""

from __future__ import annotations

import math
import sys
import threading
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import typer

from backends.cameras.curve import ServerKeys
from backends.cameras.publisher import FramePublisher
from dualcal_hal.backend import Backend
from dualcal_hal.camera import Camera, Frame
from dualcal_hal.cell import CAMERA_NAME, OPEN_TIMEOUT
from dualcal_hal.cellfile import load_cell
from dualcal_hal.clock import Clock, RealClock
from dualcal_hal.errors import DeviceTimeout, FrameRefused, LinkLost, UsageError
from dualcal_hal.registry import backend_class
from tools.cli.exits import signals_deferred
from tools.cli.terminal import plain

GRAB_TIMEOUT = 2.0
"""s that a frame may take before that is told."""

_LOOK = 0.02  # s between two looks whether anybody listens
_FIRST_REPORT, _REPORT = 3.0, 60.0  # s after which the rate is told


@dataclass(frozen=True)
class ServeOptions:
    """What the command line says; ``rate``: frames a second at most."""

    cell: Path
    overrides: tuple[str, ...]
    bind: str
    backend: str | None
    name: str
    rate: float
    key: Path | None
    allow: Path | None


def serve_camera(options: ServeOptions) -> None:
    """Publish the frames of a camera until a signal ends it, which is Interrupted."""
    backend = _backend(options)
    keys = _keys(options)
    with signals_deferred() as signals, FramePublisher(options.bind, options.name, keys) as publisher:
        ended = threading.Event()
        signals.pass_on_to(lambda reason: ended.set())
        with closing(backend):
            backend.open(OPEN_TIMEOUT)
            _say(f"serving '{options.name}' at {publisher.endpoint}")
            _Service(backend.camera(CAMERA_NAME), publisher, options.rate, ended).run()


def _backend(options: ServeOptions) -> Backend:
    file = load_cell(options.cell, options.overrides, meshes=False)
    entries = file.cell.backends
    name = options.backend or file.cell.camera.backend
    if name not in entries:
        raise UsageError(f"no backend '{name}' in {options.cell}; there are: {', '.join(entries)}")
    kind = backend_class(entries[name].type)
    if kind.time == "drives":
        raise UsageError(
            f"backend '{name}' ({entries[name].type}) makes its own time, so its frames cannot be served in ours: "
            "dualcal emulate serves a simulated camera"
        )
    return kind(name, file)


def _keys(options: ServeOptions) -> ServerKeys | None:
    if options.key is None and options.allow is None:
        return None
    if options.key is None or options.allow is None:
        raise UsageError("--key and --allow belong together: the server's key, and the keys of those who may listen")
    return ServerKeys(options.key, options.allow)


class _Service:
    """Grabs only while anybody listens, and tells when that changes, and how many frames a second there are."""

    def __init__(self, camera: Camera, publisher: FramePublisher, rate: float, ended: threading.Event) -> None:
        self._camera, self._publisher, self._ended = camera, publisher, ended
        self._clock: Clock = RealClock()
        self._period = 1.0 / rate
        self._frames = 0
        self._newer_than = -math.inf
        self._trouble = ""

    def run(self) -> None:
        """Until it is ended."""
        while not self._ended.is_set():
            if not self._publisher.subscribed:
                self._clock.wait(self._ended, self._clock.now() + _LOOK)
                continue
            _say("somebody listens")
            self._serve_listeners()
            if not self._ended.is_set():
                _say("nobody listens any more")

    def _serve_listeners(self) -> None:
        since, counted = self._clock.now(), self._frames
        report = since + _FIRST_REPORT
        while not self._ended.is_set() and self._publisher.subscribed:
            begun = self._clock.now()
            frame = self._next()
            if frame is not None:
                self._publish(frame)
            if (now := self._clock.now()) >= report:
                _say(f"{(self._frames - counted) / (now - since):.1f} frames a second")
                since, counted, report = now, self._frames, now + _REPORT
            self._clock.wait(self._ended, begun + self._period)

    def _next(self) -> Frame | None:
        """A frame newer than the last; None where there is none, which is told once."""
        newer = max(math.nextafter(self._newer_than, math.inf), 0.0)
        try:
            frame = self._camera.grab(newer, GRAB_TIMEOUT)
        except (DeviceTimeout, FrameRefused, LinkLost) as error:  # a lost one may come back
            if str(error) != self._trouble:
                self._trouble = str(error)
                _say(f"no frame: {self._trouble}", error=True)
            return None
        self._trouble = ""
        return frame

    def _publish(self, frame: Frame) -> None:
        self._newer_than = frame.time
        self._frames += 1
        self._publisher.publish(frame.image, frame.time, self._frames)


def _say(line: str, *, error: bool = False) -> None:
    """At once, also where a script reads it."""
    typer.echo(plain(line), err=error)
    (sys.stderr if error else sys.stdout).flush()
