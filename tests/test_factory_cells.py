"""The paper's cell over real wires: the same cell, reached otherwise."""

from __future__ import annotations

import pytest
from ruamel.yaml import YAML

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
