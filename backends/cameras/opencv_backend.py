"""A camera that OpenCV opens: a Video4Linux device, an RTSP or HTTP stream, or a folder of images."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, ClassVar, Self

from pydantic import BaseModel, Field, model_validator

from backends.cameras.backend import CAMERA, CameraBackend
from backends.cameras.capture import CaptureStream, Connection
from backends.cameras.driver import Driver
from backends.cameras.folder import Folder
from backends.cameras.video import open_device, open_url
from dualcal_hal.config.files import BesideTheCellFile
from dualcal_hal.config.values import Natural, NotNegative, Positive, Section


class OpencvOptions(Section):
    """One of `device`, `url`, `folder`."""

    device: Natural | Annotated[str, Field(pattern=r"^/dev/")] | None = None
    """Video4Linux device: its number, or a path such as /dev/v4l/by-id/...."""
    url: Annotated[str, Field(pattern=r"^(rtsp|rtsps|http|https)://")] | None = None
    """RTSP or HTTP stream."""
    folder: BesideTheCellFile | None = None
    """Folder of images, served one after another, to try things out; relative to the cell file."""
    latency_ms: Positive | None = None
    """The longest that a frame of the url is under way, from the beginning of its exposure, ms: it carries no time.
    Film a running clock, and be generous."""
    exposure_ms: Positive | None = None
    """Exposure of the device, ms; it keeps its own where left out."""
    gain: NotNegative | None = None
    """Gain of the device, in its driver's unit; it keeps its own where left out."""

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if sum(source is not None for source in (self.device, self.url, self.folder)) != 1:
            raise ValueError("must have one of device, url, folder")
        if (self.url is None) != (self.latency_ms is None):
            raise ValueError("latency_ms belongs to a url, which needs it: nothing else tells how old its frames are")
        if self.device is None and (self.exposure_ms is not None or self.gain is not None):
            raise ValueError("exposure_ms and gain are set at a device, not at a url or folder")
        return self


class OpencvBackend(CameraBackend):
    """Opens what the options name, by OpenCV."""

    Options: ClassVar[type[BaseModel]] = OpencvOptions

    def connect(self, timeout: float) -> Driver:
        options: OpencvOptions = self.options
        if options.folder is not None:
            return Folder(CAMERA, self.clock, options.folder)
        stream = CaptureStream(CAMERA, self.clock, self._connection(options, timeout))
        stream.serve()
        try:
            stream.take(-math.inf, self.clock.now() + timeout)
        except BaseException:
            stream.close()
            raise
        return stream

    def _connection(self, options: OpencvOptions, timeout: float) -> Callable[[], Connection]:
        if options.url is not None and options.latency_ms is not None:
            return partial(open_url, options.url, options.latency_ms / 1e3, timeout)
        assert options.device is not None
        exposure = None if options.exposure_ms is None else options.exposure_ms / 1e3
        size = self.cell.cell.camera.intrinsics.size
        return partial(open_device, options.device, size, exposure, options.gain)
