"""Backends by name, imported only when a cell file names them."""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import entry_points

from dualcal_hal.backend import Backend
from dualcal_hal.errors import CellFileError, Problem, UsageError

ENTRY_POINT_GROUP = "dualcal.backends"

_BUILT_IN = {
    "controller": "backends.controller:ControllerBackend",
    "genicam": "backends.cameras.genicam_backend:GenicamBackend",
    "opencv": "backends.cameras.opencv_backend:OpencvBackend",
    "replay": "backends.replay:ReplayBackend",
    "simulator": "backends.simulator:SimulatorBackend",
    "zmq": "backends.cameras.zmq_backend:ZmqBackend",
}


def backend_names() -> list[str]:
    """All names a cell file may use, sorted."""
    return sorted(_locations())


def backend_class(name: str) -> type[Backend]:
    """The class behind a name; UsageError names those there are."""
    location = _locations().get(name)
    if location is None:
        raise UsageError(f"unknown backend '{name}'; there are: {', '.join(backend_names())}")
    module, _, attribute = location.partition(":")
    found = getattr(import_module(module), attribute)
    if not (isinstance(found, type) and issubclass(found, Backend)):
        raise UsageError(f"backend '{name}': {location} is no Backend")
    return found


def is_simulated(name: str) -> bool:
    """Whether no real device stands behind a backend; one that is not installed here is taken for one of real ones."""
    try:
        return backend_class(name).simulated
    except (UsageError, ImportError):
        return False


def require_extra(place: str, extra: str, modules: tuple[str, ...]) -> None:
    """CellFileError if what a ``place`` of the cell file needs is not installed: refused before anything is begun."""
    for module in modules:
        try:
            import_module(module)
        except ImportError as error:
            what = f"needs {module}, which cannot be imported ({error}): pip install 'dualcal[{extra}]'"
            raise CellFileError([Problem(place, what)]) from error


def _locations() -> dict[str, str]:
    extensions = {entry.name: entry.value for entry in entry_points(group=ENTRY_POINT_GROUP)}
    return {**extensions, **_BUILT_IN}
