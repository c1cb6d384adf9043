"""A camera whose frames come over ZeroMQ, from ``dualcal serve-camera`` or an emulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Self

from pydantic import AfterValidator, BaseModel, Field, model_validator

from backends.cameras.backend import CAMERA, CameraBackend
from backends.cameras.curve import ClientKeys, host_of, is_loopback
from backends.cameras.driver import Driver
from dualcal_hal.config.files import BesideTheCellFile
from dualcal_hal.config.values import Section
from dualcal_hal.errors import UsageError
from dualcal_hal.registry import require_extra

if TYPE_CHECKING:
    from dualcal_hal.cellfile import CellFile

ZMQ_NEEDS = ("zmq", "msgspec")
"""Modules of the extra of that name."""


class CurveOptions(Section):
    """Keys, as ``zmq.auth.create_certificates`` writes them; files are relative to the cell file."""

    server_public_key_file: BesideTheCellFile
    """The public key (*.key) of the PC that the camera hangs on."""
    client_secret_key_file: BesideTheCellFile
    """This PC's own key (*.key_secret); its public part belongs among those that may listen."""


def _endpoint(value: str) -> str:
    host_of(value)
    return value


class ZmqOptions(Section):
    """Frames over ZeroMQ."""

    endpoint: Annotated[str, AfterValidator(_endpoint)]
    """Where they are served: tcp://HOST:PORT."""
    camera: Annotated[str, Field(min_length=1, max_length=64)] = CAMERA
    """What the sender calls the camera; images of another are refused."""
    curve: CurveOptions | None = None
    """Keys; needed where the endpoint is not on this machine."""

    @model_validator(mode="after")
    def _is_safe(self) -> Self:
        if self.curve is None and not is_loopback(self.endpoint):
            raise ValueError(f"{self.endpoint} is not on this machine: without curve anybody could send images")
        return self


class ZmqBackend(CameraBackend):
    """Listens to a FramePublisher."""

    Options: ClassVar[type[BaseModel]] = ZmqOptions

    def __init__(self, name: str, cell: CellFile) -> None:
        super().__init__(name, cell)
        require_extra(f"backends.{name}", "zmq", ZMQ_NEEDS)
        options: ZmqOptions = self.options
        self._endpoint, self._expected = options.endpoint, options.camera
        curve = options.curve
        self._keys = None if curve is None else ClientKeys(curve.server_public_key_file, curve.client_secret_key_file)

    def use_emulator(self, endpoints: Mapping[str, Any]) -> None:
        """endpoints: ``{"camera": {"endpoint": "tcp://127.0.0.1:PORT"}}``."""
        if self.is_open:
            raise UsageError(f"{self.name}: an emulator is named before it is opened")
        match endpoints:
            case {"camera": {"endpoint": str(endpoint)}} if is_loopback(endpoint):
                self._endpoint, self._keys = endpoint, None
                self.simulated = True
            case _:
                raise UsageError(f"{self.name}: an emulator's camera is on this machine, not {endpoints}")

    def connect(self, timeout: float) -> Driver:
        from backends.cameras.subscriber import Subscriber

        subscriber = Subscriber(self.camera(CAMERA).name, self.clock, self._endpoint, self._expected, self._keys)
        subscriber.serve()
        try:
            subscriber.await_first(timeout)
        except BaseException:
            subscriber.close()
            raise
        return subscriber
