"""An industrial camera by GenICam, through its vendor's GenTL producer."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, Field

from backends.cameras.backend import CAMERA, CameraBackend
from backends.cameras.driver import Driver
from backends.cameras.features import Features, translated
from backends.cameras.genicam_driver import PIXELS, Asking, GenicamDriver, OwnAcquisition, SoftwareTrigger
from dualcal_hal.config.files import BesideTheCellFile
from dualcal_hal.config.values import Number, Positive, Section
from dualcal_hal.errors import LinkLost, UnknownDevice
from dualcal_hal.findings import Finding
from dualcal_hal.registry import require_extra

if TYPE_CHECKING:
    from dualcal_hal.cellfile import CellFile

BUFFERS = 3
"""Frames that there is room for: one is asked for at a time."""

_ASKING: dict[str, Callable[[Any, Features], Asking]] = {"software": SoftwareTrigger, "acquisition": OwnAcquisition}


class GenicamOptions(Section):
    """A camera by GenICam."""

    cti: Annotated[tuple[BesideTheCellFile, ...], Field(min_length=1)]
    """GenTL producers, files of the camera's vendor (*.cti); relative to the cell file."""
    serial: str | None = None
    """The camera's serial number; needed where several are found."""
    id: str | None = None
    """The camera's id, as its producer gives it; another way to tell one of several."""
    trigger: Literal["software", "acquisition"] = "software"
    """How a frame is asked for: software has the camera take it by a trigger; acquisition begins an acquisition for it,
    for a camera that has no software trigger."""
    exposure_us: Positive | None = None
    """Exposure, us; the camera keeps its own where left out."""
    gain_db: Number | None = None
    """Gain, dB; the camera keeps its own where left out."""


class GenicamBackend(CameraBackend):
    """Opens one camera by harvesters."""

    Options: ClassVar[type[BaseModel]] = GenicamOptions

    def __init__(self, name: str, cell: CellFile) -> None:
        super().__init__(name, cell)
        require_extra(f"backends.{name}", "genicam", ("genicam.gentl", "harvesters.core"))

    def connect(self, timeout: float) -> Driver:
        options: GenicamOptions = self.options
        with ExitStack() as opening, translated(CAMERA, "open"):
            harvester = import_module("harvesters.core").Harvester()
            opening.callback(harvester.reset)
            for file in options.cti:
                if not file.is_file():
                    raise LinkLost(CAMERA, "open", f"{file}: there is no such producer", "name its file under cti")
                harvester.add_file(str(file))
            harvester.update()
            index = _chosen(harvester.device_info_list, options)
            model = _described(harvester.device_info_list[index])
            acquirer = harvester.create(index)
            asking, settings = set_up(acquirer, options)
            described = (Finding("camera", model), *settings)
            driver = GenicamDriver(CAMERA, self.clock, acquirer, asking, described, harvester.reset)
            acquirer.add_callback(acquirer.Events.INCOMPLETE_BUFFER, _callback(driver.told_incomplete))
            opening.pop_all()  # it is the driver's now
            return driver


def set_up(acquirer: Any, options: GenicamOptions) -> tuple[Asking, list[Finding]]:
    """Set the camera as the options ask, and say what it has then; CommandRefused for what it does not take."""
    features = Features(CAMERA, acquirer.remote_device.node_map)
    acquirer.num_buffers = BUFFERS
    features.choose("PixelFormat", PIXELS)
    if features.has("AcquisitionMode"):
        features.choose("AcquisitionMode", "Continuous")
    settings = [
        _number(features, "Exposure", "ExposureTime", options.exposure_us, "us"),
        _number(features, "Gain", "Gain", options.gain_db, "dB"),
    ]
    asking = _ASKING[options.trigger](acquirer, features)
    asking.prepare()
    return asking, settings


def _number(features: Features, what: str, feature: str, asked: float | None, unit: str) -> Finding:
    """Set it if it is asked for, and say what it is."""
    if asked is not None:
        if features.has(f"{what}Auto"):
            features.choose(f"{what}Auto", "Off")
        return Finding(what.lower(), f"{features.set_number(feature, asked, unit):g} {unit}, as set")
    has = features.number(feature)
    said = "the camera does not tell it" if has is None else f"{has:g} {unit}, the camera's own"
    return Finding(what.lower(), said, "note", f"set {what.lower()}: one that it chooses may change during a run")


def _chosen(found: list[Any], options: GenicamOptions) -> int:
    """Which of the cameras that were found is meant."""
    fits = [
        index
        for index, info in enumerate(found)
        if options.serial in (None, _told(info, "serial_number")) and options.id in (None, _told(info, "id_"))
    ]
    there = "; ".join(map(_described, found)) or "none"
    if not found:
        raise LinkLost(CAMERA, "open", "no camera is found", "check cable, power, network address and the producer")
    if len(fits) != 1:
        why = f"{'none' if not fits else 'more than one'} of those that are found fits: {there}"
        raise UnknownDevice(CAMERA, "open", why, "name its serial or id in the cell file")
    return fits[0]


def _described(info: Any) -> str:
    names = [_told(info, "vendor"), _told(info, "model"), f"serial {_told(info, 'serial_number')}"]
    return f"{' '.join(filter(None, names))}, id {_told(info, 'id_')}"


def _told(info: Any, what: str) -> str:
    """ "" where the producer does not know."""
    try:
        return str(getattr(info, what))
    except import_module("genicam.gentl").GenericException:
        return ""


def _callback(function: Callable[[], None]) -> Any:
    """As harvesters wants it."""
    base = import_module("harvesters.core").Callback
    return type("Told", (base,), {"emit": lambda self, context: function()})()
