"""The one world that the simulated arms and camera share: the truth, and where everything is at a time."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from backends.simulator.arm import SimulatedArm
from backends.simulator.left import CellLeft
from backends.simulator.mechanics import unseen_error
from backends.simulator.noise import generator
from backends.simulator.stepper import Stepper, stepper_class
from backends.simulator.truth import Truth
from dualcal_hal.clock import Clock
from dualcal_hal.robot import Joints
from dualcal_hal.transforms import Array

if TYPE_CHECKING:
    from dualcal_hal.config import CellConfig, SimulationConfig


class World:
    """A cell as it truly is, in the time of ``clock``; both arms begin at home.

    Everything in it happens under ``lock`` and may be asked for from any thread; ``closed`` ends all waiting.
    """

    def __init__(self, cell: CellConfig, simulation: SimulationConfig, clock: Clock) -> None:
        self.clock = clock
        self.noise = simulation.noise
        self.lock = threading.RLock()
        self.closed = threading.Event()
        self._active, self._passive = cell.active_name, cell.passive_name
        self.truth = Truth(cell, simulation)
        self._seed = simulation.seed
        self.time_skew = simulation.errors.time_skew.delay_s
        self.stepper: Stepper = stepper_class(simulation.stepper)(cell, self.truth)
        self._samples: Counter[tuple[str, str]] = Counter()
        self.arms = {name: SimulatedArm(name, self) for name in sorted(cell.robots)}

    def T_E_T(self, when: float) -> Array:
        """(4, 4): the target in the camera at time ``when``, by the true transforms, chains and joint angles."""
        with self.lock:
            q_a, q_p = (self.arms[name].true_positions(when) for name in (self._active, self._passive))
        return self.truth.T_E_T(q_a, q_p, when)

    def joint_error(self, arm: str, target: Joints) -> Array:
        """(n,) rad that the encoders do not see, of an arm that was sent to ``target``: always the same."""
        return unseen_error(self._seed, arm, target, self.noise.joint)

    def sample_noise(self, device: str, stream: str) -> np.random.Generator:
        """The source of noise for the device's next sample of ``stream`` (call under the lock).

        Its key is the seed, the device, the stream, where all arms were sent, and the sample's number since
        the last of these targets changed.
        """
        number = self._samples[device, stream]
        self._samples[device, stream] += 1
        targets = (angle for arm in self.arms.values() for angle in arm.target)
        return generator(self._seed, device, stream, number, *targets)

    def target_changed(self) -> None:
        """An arm was sent elsewhere: samples are counted anew (call under the lock)."""
        self._samples.clear()

    def documents(self) -> Mapping[str, dict[str, Any]]:
        """What was measured in it, by file name."""
        with self.lock:
            return self.stepper.documents(self.clock.now())

    def left(self, frames: int) -> CellLeft:
        """How it stands now, both arms at rest, after so many frames."""
        with self.lock:
            samples: dict[str, dict[str, int]] = {}
            for (device, stream), count in self._samples.items():
                samples.setdefault(device, {})[stream] = count
            arms = {name: arm.left() for name, arm in self.arms.items()}
            return CellLeft(clock_s=self.clock.now(), arms=arms, samples=samples, frames=frames)

    def go_on_from(self, left: CellLeft) -> None:
        """Stand as a world that gave ``left``, whose time it is by the clock."""
        with self.lock:
            joints = {name: (arm.target_rad, np.array(arm.joints_rad)) for name, arm in left.arms.items()}
            self.stepper.stand(joints, self.clock.now())
            for name, arm in left.arms.items():
                self.arms[name].go_on_from(arm)
            counts = {(device, stream): n for device, of in left.samples.items() for stream, n in of.items()}
            self._samples = Counter(counts)

    def close(self) -> None:
        """End all motions and all waiting."""
        self.closed.set()
        for arm in self.arms.values():
            arm.halt("the simulator was closed")
        with self.lock:
            self.stepper.close()
