"""The simulated arms as bodies with mass, moved by PyBullet."""

from backends.simulator.bullet.stepper import BulletStepper

__all__ = ["BulletStepper"]
