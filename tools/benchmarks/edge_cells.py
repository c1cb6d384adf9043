"""Random cells at the edge of the stated error: arms of public tables, bases wrong by all that the cell file allows.

Arms rest where somebody would have jogged them for this: clear of themselves, and of each other whatever that error.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from dualcal_hal.config import CellDocument
from dualcal_hal.geometry import BETWEEN_SAMPLES
from dualcal_hal.transforms import Array, rotation_from_vector, transform, vector_from_rotation
from procedures.planning.model import CellModel

BASE_ERROR = 0.12, np.deg2rad(12.0)
"""m and rad; as ``nominal.uncertainty`` says."""

CAMERA_ERROR = 0.01, np.deg2rad(5.6)
"""m and rad of the nominal hand-eye transform."""

DISTANCES = 0.9, 1.5
"""m between the bases."""

_HOMES_TRIED = 200
_HOME_SPREAD = np.deg2rad([20.0, 20.0, 20.0, 60.0, 60.0, 60.0])
_PAPERS_HOME = (0, 0, 100, 0, 30, 0)  # deg, drawn back so far that no error of the bases lets the arms touch
_PAPER = Path(__file__).parents[2] / "cells" / "paper.yaml"


@dataclass(frozen=True)
class ArmTable:
    """An arm as its maker's data sheet has it: rows theta, d, a, alpha in deg and mm; limits in deg; radii in mm.

    ``reach``: mm from the shoulder to the wrist.
    """

    rows: tuple[tuple[float, float, float, float], ...]
    limits: tuple[tuple[float, float], ...]
    home: tuple[float, ...]
    radii: tuple[float, ...]
    reach: float


UR5E = ArmTable(
    rows=(
        (0, 162.5, 0, 90),
        (0, 0, -425, 0),
        (0, 0, -392.2, 0),
        (0, 133.3, 0, 90),
        (0, 99.7, 0, -90),
        (0, 99.6, 0, 0),
    ),
    limits=((-360, 360), (-360, 360), (-180, 180), (-360, 360), (-360, 360), (-360, 360)),
    home=(180, -120, 130, -30, -90, 0),
    radii=(60, 55, 50, 45, 45, 45),
    reach=850,
)
"""Universal Robots UR5e."""

IRB120 = ArmTable(
    rows=(
        (0, 290, 0, -90),
        (-90, 0, 270, 0),
        (0, 0, 70, -90),
        (0, 302, 0, 90),
        (0, 0, 0, -90),
        (180, 72, 0, 0),
    ),
    limits=((-165, 165), (-110, 110), (-110, 70), (-160, 160), (-120, 120), (-400, 400)),
    home=(0, -20, 20, 0, 60, 0),
    radii=(60, 60, 60, 45, 45, 45),
    reach=580,
)
"""ABB IRB 120."""

KR6 = ArmTable(
    rows=(
        (0, 400, 25, -90),
        (-90, 0, 455, 0),
        (0, 0, 35, -90),
        (0, 420, 0, 90),
        (0, 0, 0, -90),
        (180, 80, 0, 0),
    ),
    limits=((-170, 170), (-100, 135), (-120, 66), (-185, 185), (-120, 120), (-350, 350)),
    home=(0, -30, 20, 0, 60, 0),
    radii=(75, 65, 60, 50, 50, 50),
    reach=901,
)
"""KUKA KR 6 R900."""

ARMS = {"ur5e": UR5E, "irb120": IRB120, "kr6": KR6}


def edge_cell(number: int, *, stepper: str, arms: str | None = None) -> str:
    """The cell file (JSON, which is YAML) of random cell ``number``; ``arms``: "paper" keeps the paper's."""
    rng = np.random.default_rng([number, 2])
    cell: dict[str, Any] = _plain(YAML(typ="safe").load(_PAPER))
    cell["name"] = f"edge-{number}"
    reach = [900.0, 900.0]
    for robot in cell["robots"].values():
        robot["home_deg"] = list(_PAPERS_HOME)
    if arms != "paper":
        for i, robot in enumerate(("left", "right")):
            table = list(ARMS.values())[int(rng.integers(len(ARMS)))]
            reach[i] = table.reach
            cell["robots"][robot].update(_robot(table))
    # Farther apart than this the arms share too little of their reach for constraints of half a metre.
    farthest = min(DISTANCES[1], 0.65e-3 * sum(reach) + 0.4)
    distance = rng.uniform(DISTANCES[0], farthest)
    away = rng.uniform(-np.pi / 9, np.pi / 9)
    position = distance * np.array([np.cos(away), np.sin(away), 0.0]) + [0.0, 0.0, rng.uniform(-0.1, 0.1)]
    nominal = transform(rotation_from_vector([0.0, 0.0, np.pi + away + rng.uniform(-0.3, 0.3)]), position)
    camera = _camera_beside_the_wrist(rng)
    cell["nominal"] = {
        "uncertainty": {"translation_mm": BASE_ERROR[0] * 1e3, "rotation_deg": float(np.rad2deg(BASE_ERROR[1]))},
        "active_base_in_passive_base": _written(nominal),
        "camera_in_active_flange": _written(camera),
    }
    cell["procedure"]["seed"] = cell["simulation"]["seed"] = number
    cell["simulation"]["stepper"] = stepper
    cell["simulation"]["truth"] = {
        "active_base_in_passive_base": _written(nominal @ _error(rng, *BASE_ERROR)),
        "camera_in_active_flange": _written(camera @ _error(rng, *CAMERA_ERROR)),
    }
    _choose_homes(cell, rng)
    return json.dumps(cell, indent=1)


def _choose_homes(cell: dict[str, Any], rng: np.random.Generator) -> None:
    """Homes near the tables', the first tried that a run could leave; the tables' own where none will do."""
    config = CellDocument.model_validate(cell).cell
    model = CellModel(config)
    tables = [np.array(arm.home) for arm in (model.active, model.passive)]
    spread = np.zeros(len(tables[0]))
    for _ in range(_HOMES_TRIED):
        q_a, q_p = (home + spread * rng.uniform(-1, 1, len(home)) for home in tables)
        if model.geometry.clearance([q_a], [q_p], model.nominal.placement)[0] >= model.margin + BETWEEN_SAMPLES:
            for name, q in ((config.active_name, q_a), (config.passive_name, q_p)):
                cell["robots"][name]["home_deg"] = np.rad2deg(q).tolist()
            return
        spread = _HOME_SPREAD


def _camera_beside_the_wrist(rng: np.random.Generator) -> Array:
    """A random T_H_E (4, 4) with the housing clear of the last link, looking along the flange."""
    around, outwards = rng.uniform(-np.pi, np.pi), rng.uniform(0.085, 0.100)
    position = [outwards * np.cos(around), outwards * np.sin(around), rng.uniform(0.02, 0.06)]
    return transform(rotation_from_vector([0.0, 0.0, rng.uniform(-np.pi, np.pi)]), position)


def _robot(table: ArmTable) -> dict[str, Any]:
    keys = ("theta_deg", "d_mm", "a_mm", "alpha_deg")
    return {
        "kinematics": {"dh": [dict(zip(keys, row, strict=True)) for row in table.rows]},
        "limits_deg": [list(limits) for limits in table.limits],
        "home_deg": list(table.home),
        "link_radius_mm": list(table.radii),
    }


def _error(rng: np.random.Generator, translation: float, rotation: float) -> Array:
    """(4, 4): exactly this much, in random directions."""
    return transform(rotation_from_vector(rotation * _direction(rng)), translation * _direction(rng))


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def _written(T: Array) -> dict[str, list[float]]:
    rotation = np.rad2deg(vector_from_rotation(T[:3, :3]))
    return {"translation_mm": (T[:3, 3] * 1e3).tolist(), "rotation_vector_deg": rotation.tolist()}


def _plain(value: Any) -> Any:
    return json.loads(json.dumps(value))
