"""A cell that is not simulated, as far as the program knows: its rig names real drivers and their addresses, no
world. At the other end of the wires is one nevertheless, which keeps its own account of the light that it gives.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cells
import numpy as np
import trimesh
from cells import CellFolder
from expected_pictures import transform_of
from text_cells import BOX, SOME

from coupole.calibration.record import Limit
from coupole.devices import Identity
from coupole.plan.cell import Cell, read_cell
from coupole.plan.registry import settings_class
from coupole.preflight.commissioned import (
    STEPS,
    Answer,
    StepResult,
    devices_of,
    empty_record,
    settings_of,
    write_commissioning,
)
from sim.world.client import World

HOME = {"kind": "joints", "name": "home", "joints_deg": [0, -170, 150, 0, -70, 0]}
"""Where the arm is when the world begins: nothing has to move."""


@contextmanager
def real_cell(folder: Path, *, text_box: bool = False, **plan: Any) -> Iterator[tuple[CellFolder, World]]:
    """A cell of real devices, with one view from where the arm is, and the world behind it, in real time."""
    cell = CellFolder(folder, speed=1.0, write_now=False)
    cell.rig_data["ledbox"]["settings"]["watchdog_s"] = 2.0
    cell.rig_data["motion"]["settle_dwell_s"] = 0.0
    if text_box:
        cell.rig_data["ledbox"] = copy.deepcopy(BOX)
        cell.rig_data["dome"]["leds"] = str(Path(cell.rig_data["dome"]["leds"]).parent / "text-dome.csv")
        cell.plan_data |= {"lights": SOME, "trigger": "software", "reshoot_limit": 1}
    cell.write(**{"views": [HOME], **plan})
    with cell.world() as world:
        for kind in ("ledbox", "camera", "robot"):
            device = cell.rig_data[kind]
            known = settings_class(device["driver"]).model_fields
            own = {name: value for name, value in world.endpoints[kind].items() if name in known}
            device["settings"] = {**device.get("settings", {}), **own}
        del cell.rig_data["world"]
        cell.write()
        told = cells.here("devices", "--rig", cell.rig, "--json").document
        fields = Identity.__dataclass_fields__
        devices = {
            kind: Identity(**{name: value for name, value in about.items() if name in fields})
            for kind, about in told.items()
        }
        commission(read_cell(cell.rig), devices)
        yield cell, world


def commission(cell: Cell, devices: Mapping[str, Identity], *, missed: str = "", no: str = "") -> None:
    """A record of every step with these devices, passed but for those that are named."""
    record = empty_record(cell)
    for step in STEPS:
        result = StepResult(
            step=step,
            person="an operator",
            ended=datetime.now(UTC),
            devices=devices_of(step, devices),
            settings=settings_of(cell, step),
            covers="everything",
            limits=(Limit(what="a figure", found=2.0 if step == missed else 1.0, limit=1.0, unit="deg"),),
            answers=(Answer(question="Seen?", yes=step != no),),
            remarks=(),
        )
        record = record.with_result(result)
    write_commissioning(cell, record)


def true_dose_lux_h(cell: CellFolder, world: World) -> np.ndarray:
    """[9] What the corners and the centre of the object's box have received by the world's own account: Lambert's
    law, from the dome's file, with nothing of Coupole's."""
    light = world.ask("light")
    points = _box_points(cell)
    rows = [line.split(",") for line in Path(cell.rig_data["dome"]["leds"]).read_text().splitlines()]
    table = {row[0]: np.array(row[2:], float) for row in rows if row[0].isdecimal()}
    lux_s = np.zeros(len(points))
    for led, seconds in light["leds_s"].items():
        position, normal, flux_lm = table[led][:3], table[led][3:6], table[led][6]
        away = (points - position) / 1000.0
        distance = np.linalg.norm(away, axis=1)
        lux_s += seconds * flux_lm / np.pi * np.clip(away @ normal / distance, 0, None) / distance**2
    lux_s += cell.rig_data["dome"]["panel_lux"] * sum(light["panels_s"].values())
    return np.asarray(lux_s / 3600)


def _box_points(cell: CellFolder) -> np.ndarray:
    """[9, 3] corners and centre of the object's box, mm in the base frame."""
    mesh = trimesh.load(cell.plan_data["object"]["mesh"], process=False, force="mesh")
    low, high = mesh.bounds
    corners = trimesh.bounds.corners([low, high])
    points = np.vstack([corners, (low + high) / 2])
    base_from_support = transform_of(cell.rig_data["support"]["base_from_support"])
    return np.asarray(points @ base_from_support[:3, :3].T + base_from_support[:3, 3])
