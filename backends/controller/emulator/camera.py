"""The emulated cell's camera: a process of its own that draws what it would see, so that drawing delays no wire.

It runs with a lower priority and asks the emulator, over its own standard input and output, where the arms truly stood.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from dualcal_hal.clock import RealClock
from dualcal_hal.errors import DeviceError

if TYPE_CHECKING:
    from backends.controller.emulator.world import EmulatedWorld

PERIOD = 0.1
"""Seconds from one exposure to the next."""

_IDLE = 0.02  # s from one look whether anybody listens to the next
_KNOWN = 0.02  # s after which it is settled where the arms stood
_NICENESS = 10
_ENDS_WITHIN = 10.0  # s
_STARTS_WITHIN = 60.0  # s


class CameraProcess:
    """The emulator's end of the camera; ``failed`` is told if it ends by itself."""

    def __init__(
        self,
        cell: Path,
        overrides: Sequence[str],
        stream: tuple[str, str],
        world: EmulatedWorld,
        failed: Callable[[str], None],
    ) -> None:
        """``stream``: the endpoint to publish at, port 0 for any, and what the camera is called. DeviceError."""
        endpoint, camera = stream
        asked = {"cell": str(cell), "overrides": list(overrides), "endpoint": endpoint, "camera": camera}
        self._world, self._failed = world, failed
        self._closing = False
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, json.dumps({**asked, "begin": world.begin})],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests, self._answers = self._process.stdout, self._process.stdin
        self.endpoint = self._await_endpoint()
        self._thread = threading.Thread(target=self._answer, name="emulated camera", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it; any number of times."""
        if self._closing:
            return
        self._closing = True
        try:
            self._process.wait(0)
        except subprocess.TimeoutExpired:
            self._process.terminate()
            try:
                self._process.wait(_ENDS_WITHIN)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._thread.join()
        self._requests.close()
        self._answers.close()

    def _await_endpoint(self) -> str:
        late = threading.Timer(_STARTS_WITHIN, self._process.kill)
        late.start()
        line = self._requests.readline()
        late.cancel()
        if not line:
            self._process.wait()
            self._requests.close()
            self._answers.close()
            raise DeviceError("camera", "start its emulation", "it ended before it published", "see what it says above")
        return str(json.loads(line)["endpoint"])

    def _answer(self) -> None:
        """Tell it where the arms stood, as often as it asks."""
        arms = self._world.arms
        for line in self._requests:
            times = json.loads(line)["times"]
            with self._world.lock:
                stood = [{name: [a.tolist() for a in arm.angles(t)] for name, arm in arms.items()} for t in times]
                answer = {"angles": stood, "targets": {name: arm.target for name, arm in arms.items()}}
            try:
                self._answers.write(json.dumps(answer) + "\n")
                self._answers.flush()
            except OSError:
                break
        if not self._closing:
            self._failed("the process that emulates the camera has ended")


class _Drawing:
    """The camera's process: draws and publishes until its input closes."""

    def __init__(self, asked: dict[str, Any]) -> None:
        import cv2

        from backends.simulator.rendering import Renderer
        from backends.simulator.stepper import stepper_class
        from backends.simulator.truth import Truth
        from dualcal_hal.cellfile import load_cell

        cv2.setNumThreads(1)
        file = load_cell(Path(asked["cell"]), asked["overrides"])
        assert file.simulation is not None
        cell, simulation = file.cell, file.simulation
        self._active, self._passive = cell.active_name, cell.passive_name
        self._begin: float = asked["begin"]
        self._seed, self._noise = simulation.seed, simulation.noise
        self._exposure = simulation.errors.motion_blur.exposure
        self._truth = Truth(cell, simulation)
        target, camera = cell.target, cell.camera
        self._renderer = Renderer(
            target.board, target.margin, camera.intrinsics, simulation.noise.blur_px, simulation.errors
        )
        self._bodies = stepper_class(simulation.stepper)(cell, self._truth).scene
        self._scene = None
        if self._bodies is not None:
            from backends.simulator.scene import Scene

            self._scene = Scene(self._bodies, cell, self._renderer.rays)
        self._clock = RealClock()
        self._ended = threading.Event()
        self._answers: SimpleQueue[str] = SimpleQueue()
        threading.Thread(target=self._hear, name="answers", daemon=True).start()
        self._counted_at: tuple[float, ...] = ()
        self._count = 0

    def _hear(self) -> None:
        """Hand on what the emulator answers; an empty line once it has ended."""
        for line in sys.stdin:
            self._answers.put(line)
        self._ended.set()
        self._answers.put("")

    def run(self, endpoint: str, camera: str) -> None:
        """Publish a frame each period while anybody listens."""
        from backends.cameras.publisher import FramePublisher

        sequence = 0
        with FramePublisher(endpoint, camera) as publisher:
            _say({"endpoint": publisher.endpoint})
            due = self._clock.now()
            while not self._ended.is_set():
                now = self._clock.now()
                if now < due or not publisher.subscribed:
                    self._clock.wait(self._ended, now + _IDLE if now >= due else min(due, now + _IDLE))
                    continue
                due = max(due + PERIOD, now)
                image = self._expose(now)
                if image is None:
                    return
                sequence += 1
                publisher.publish(image, now, sequence, self._exposure)

    def _expose(self, begin: float) -> Any:
        """The image of an exposure that begins then; None if the emulator has ended."""
        import numpy as np

        from backends.simulator.camera import POSES, with_noise
        from backends.simulator.noise import generator

        times = np.linspace(begin, begin + self._exposure, POSES).tolist() if self._exposure else [begin]
        self._clock.wait(self._ended, times[-1] + _KNOWN)
        _say({"times": times})
        if not (line := self._answers.get()):
            return None
        answer = json.loads(line)
        poses = [self._T_E_T(t, angles) for t, angles in zip(times, answer["angles"], strict=True)]
        view = None
        if self._scene is not None and self._bodies is not None:
            for arm, (motors, _) in answer["angles"][0].items():
                self._bodies.put(arm, np.array(motors))
            view = self._scene.view(poses[0])
        targets = tuple(angle for arm in sorted(answer["targets"]) for angle in answer["targets"][arm])
        if targets != self._counted_at:
            self._counted_at, self._count = targets, 0
        noise = generator(self._seed, "camera", "frame", self._count, *targets)
        self._count += 1
        return with_noise(self._renderer.expose(poses, view), noise, self._noise.image_grey)

    def _T_E_T(self, when: float, angles: dict[str, list[list[float]]]) -> Any:
        import numpy as np

        q_a, q_p = (np.array(angles[arm][1]) for arm in (self._active, self._passive))
        return self._truth.T_E_T(q_a, q_p, when - self._begin)


def _say(document: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(document) + "\n")
    sys.stdout.flush()


def _main() -> int:
    import signal

    os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)  # behind the wires, whatever their priority is
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the emulator ends it
    asked = json.loads(sys.argv[1])
    from dualcal_hal.errors import DualcalError

    try:
        _Drawing(asked).run(asked["endpoint"], asked["camera"])
    except DualcalError as error:
        sys.stderr.write(f"dualcal emulate: camera: {error}\n")
        return 1
    except BrokenPipeError:
        pass
    return 0


if __name__ == "__main__":
    raise SystemExit(_main())
