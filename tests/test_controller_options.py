"""The options of a controller: exact, and what is wrong is told by its place in the cell file."""

from __future__ import annotations

import pytest

from backends.controller import ControllerBackend
from dualcal_hal.cellfile import load_cell
from dualcal_hal.errors import CellFileError
from tests.cells import PAPER

CAN, TCP = PAPER.with_name("paper-can.yaml"), PAPER.with_name("paper-tcp.yaml")
LINK = "backends.cell.link"


def refused(path, *settings):
    with pytest.raises(CellFileError) as told:
        load_cell(path, [f"{LINK}.{setting}" for setting in settings], meshes=False)
    return str(told.value)


def test_a_misspelt_key_is_told_by_line_and_column(tmp_path):
    written = tmp_path / "cell.yaml"
    written.write_text(CAN.read_text().replace("sync_period_ms:", "sync_perod_ms:"))
    with pytest.raises(CellFileError, match=rf":\d+:\d+: {LINK}.can.sync_perod_ms: unknown key"):
        load_cell(written, meshes=False)


@pytest.mark.parametrize(
    ("path", "setting", "words"),
    [
        (CAN, "can.sync_perod_ms=5", "can.sync_perod_ms: unknown key"),
        (CAN, "can.arms.left.drives.0.nod=1", "can.arms.left.drives.0.nod: unknown key"),
        (CAN, "can.mode=cylic", "can.mode: must be 'cyclic' or 'profile'"),
        (CAN, "can.sync_period_ms=1", "can.sync_period_ms: must be at least 2"),
        (CAN, "can.arms.left.drives.0.node=128", "can.arms.left.drives.0.node: must be at most 127"),
        (CAN, "can.arms.left.drives.0.sign=0", "can.arms.left.drives.0.sign: must be -1 or 1"),
        (CAN, "can.arms.left.drives.0.counts_per_rad=0", "counts_per_rad: must be greater than 0"),
        (CAN, "can.arms.left.drives.0.node=2", "a node id stands there twice"),
        (CAN, "can.arms.left.joint_map={sign: [1, 1, 1, 1, 1, 1]}", "sign and offset_rad belong to each drive on CAN"),
        (CAN, "can.bitrate=500000", "bitrate is no option of socketcand: it is set where socketcand runs"),
        (CAN, "tcp={dialect: rep, arms: {}}", "must be one of tcp and can"),
        (TCP, "tcp.byte_ordr=big", "tcp.byte_ordr: unknown key"),
        (TCP, "tcp.dialect=abc", "tcp.dialect: must be 'rep', 'abb', 'fanuc' or 'motoman'"),
        (TCP, "tcp.arms.left.group=0", "only motoman's messages carry a group"),
        (TCP, "tcp.max_points=100", "max_points is abb's"),
        (TCP, "tcp.corridor_mm=5", "corridor_mm is for dialects that ignore velocity"),
        (TCP, "tcp.controller_speed_confirmed={mm_s: 100}", "controller_speed_confirmed is for dialects that ignore"),
    ],
)
def test_what_is_wrong_is_told_by_its_place(path, setting, words):
    told = refused(path, setting)
    assert f"--set {LINK}.{setting.partition('=')[0]}" in told
    assert words in told


def test_two_arms_need_a_bus_each():
    channel = "127.0.0.1:29536/left"
    settings = [f"can.arms.{arm}.channel={channel}" for arm in ("left", "right")]
    assert "share channel" in refused(CAN, *settings)


def test_the_bus_of_an_emulator_has_no_bit_rate():
    settings = ["can.interface=slcan", "can.bitrate=500000"]
    file = load_cell(CAN, [f"{LINK}.{setting}" for setting in settings], meshes=False)
    arms = {arm: {"channel": f"127.0.0.1:1/{arm}"} for arm in ("left", "right")}
    backend = ControllerBackend("cell", file)
    backend.use_emulator({"can": {"interface": "socketcand", "arms": arms}})
    assert backend.simulated
