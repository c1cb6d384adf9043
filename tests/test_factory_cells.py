"""The paper's cell over real wires: the same cell, reached otherwise."""

from __future__ import annotations

import importlib

import pytest
from ruamel.yaml import YAML

from backends.controller import ControllerBackend
from backends.controller.emulator.process import Emulator
from dualcal_hal import registry
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import CellFileError
from tests.cells import PAPER

DEVICES = {("backends",), ("camera", "backend"), ("robots", "left", "backend"), ("robots", "right", "backend")}
SPEEDS = {("robots", arm, key) for arm in ("left", "right") for key in ("speed_deg_s", "acceleration_deg_s2")}


def document(name):
    return YAML(typ="safe").load(PAPER.with_name(f"{name}.yaml").read_text())


def differences(a, b, where=()):
    """The places at which two documents differ, as deep as they lie."""
    if not (isinstance(a, dict) and isinstance(b, dict)) or where == ("backends",):
        return set() if a == b else {where}
    keys = a.keys() | b.keys()
    return set().union(*(differences(a.get(key), b.get(key), (*where, key)) for key in keys))


@pytest.mark.parametrize("name", ["paper-tcp", "paper-can"])
def test_over_real_wires_the_papers_cell_differs_in_its_devices_alone(name):
    assert differences(document("paper"), document(name)) == DEVICES


@pytest.mark.parametrize("name", ["paper-tcp", "paper-can"])
def test_fast_cells_have_arms_five_times_faster_and_nothing_else(name):
    slow, fast = document(name), document(f"{name}-fast")
    assert differences(slow, fast) == SPEEDS
    for _, arm, key in SPEEDS:
        assert fast["robots"][arm][key] == [5 * value for value in slow["robots"][arm][key]]


@pytest.fixture
def without(monkeypatch):
    """As if a module were not installed."""

    def arrange(module):
        def missing(name):
            if name == module:
                raise ImportError(f"No module named '{name}'")
            return importlib.import_module(name)

        monkeypatch.setattr(registry, "import_module", missing)

    return arrange


def test_what_drives_on_can_need_and_is_not_installed_is_a_problem_of_the_cell_file(without):
    without("canopen")
    with pytest.raises(CellFileError, match=r"backends\.cell\.link\.can: needs canopen.*pip install 'dualcal\[can\]'"):
        ControllerBackend("cell", load_cell(PAPER.with_name("paper-can.yaml")))


@pytest.mark.parametrize(
    ("name", "module", "where"),
    [("paper-can", "canopen", r"backends\.cell\.link\.can"), ("paper-tcp", "zmq", r"backends\.eye")],
)
def test_what_an_emulator_needs_and_is_not_installed_is_too(without, name, module, where):
    without(module)
    with pytest.raises(CellFileError, match=f"{where}: needs {module}"):
        Emulator(PAPER.with_name(f"{name}.yaml"), free_ports=True, say=print, failed=print)
