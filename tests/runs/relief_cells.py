"""A glossy relief in a cell for which the shipped records hold, for tests of its reflectance."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import cells
import h5py
import numpy as np
import trimesh
from cells import CellFolder

sys.path.insert(0, str(cells.REPO / "tools"))

from coupole.reflectance.run_ablation import Variant
from drawn_records import draw_records

RECORDS = cells.REPO / "configs/calibrations"
DIFFUSE, F0, ROUGHNESS = (0.5, 0.35, 0.2), (0.05, 0.05, 0.05), 0.3
SIDE = {**cells.TOP, "name": "side", "azimuth_deg": -60, "elevation_deg": 55}


def shipped_cell(folder: Path, relief: Path = cells.RELIEF, **world: Any) -> CellFolder:
    """A cell with the camera of `sim.yaml`, for which the records hold, and a quarter of its relief: a high dome
    with lower ones around it."""
    cell = CellFolder(folder, speed=10.0)
    mesh = trimesh.load(relief, process=False)
    x, y, _ = mesh.triangles_center.T
    mesh.update_faces((x > 10) & (y > -20))
    mesh.remove_unreferenced_vertices()
    mesh.export(folder / "relief.ply")
    cell.plan_data["object"]["mesh"] = str(folder / "relief.ply")
    shipped = {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
    cell.rig_data["sensor"] |= shipped
    cell.world_settings.update(white_at_us=8000, **world)
    cell.write(views=[cells.TOP, SIDE], lights={"kind": "every", "every": 24}, darks_per_view=2)
    return cell


Made = tuple[CellFolder, Path, dict[str, Any]]
"""A cell with its run, the result's folder, and what the command said."""


def glossy_result(folder: Path) -> Made:
    """Acquire a run of the glossy relief, and make its result."""
    material = {"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS}
    cell = shipped_cell(folder, material=material)
    assert cell.acquire().code == 0
    out = cell.folder / "result"
    ended = cells.here("reflectance", cell.run_folder, "--calibrations", RECORDS, "--out", out, "--json")
    assert ended.code == 0, ended.err
    return cell, out, ended.document


def walter(normals: np.ndarray, light: np.ndarray, view: np.ndarray) -> np.ndarray:
    """[..., 3] reflectance of the relief: Walter et al. 2007, Smith's G of each direction, Schlick's F."""
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    nl, nv, nh = (np.sum(normals * v, axis=-1) for v in (light, view, half))
    vh = np.sum(view * half, axis=-1)
    a2 = ROUGHNESS**2

    def masked(cosine: np.ndarray) -> np.ndarray:
        return 2 / (1 + np.sqrt(1 + a2 * (1 / cosine**2 - 1)))

    d = a2 / (np.pi * (nh**2 * (a2 - 1) + 1) ** 2)
    fresnel = np.array(F0) + (1 - np.array(F0)) * (1 - vh[..., None]) ** 5
    lobe = (d * masked(nl) * masked(nv) / (4 * nl * nv))[..., None] * fresnel
    result: np.ndarray = np.array(DIFFUSE) / np.pi + lobe
    return result


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


DETAIL = ({"period_mm": 2.4, "texture": 0.8}, {"period_mm": 6.0, "slope_deg": 6.0})
"""Waves of paint and of bumps that the mesh, with triangles of 1 mm, does not have."""


def detailed_result(folder: Path) -> Made:
    """Acquire a run of the relief with `DETAIL`, and make its result with texels, with records that are exact."""
    material = {"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS}
    cell = shipped_cell(folder, material=material, shading="pixel", detail=list(DETAIL))
    assert cell.acquire().code == 0
    out, records = cell.folder / "result", cell.folder / "records"
    draw_records(records, None)
    ended = cells.here(
        "reflectance", cell.run_folder, "--calibrations", records, "--out", out, "--texels", "auto", "--json"
    )
    assert ended.code == 0, ended.err
    return cell, out, ended.document


FEWER = {
    "share of the LEDs": [(1.0, Variant()), (0.5, Variant(led_step=2))],
    "most incidence, degrees": [(89, Variant()), (60, Variant(most_incidence_deg=60))],
}
"""Settings of `ablate --texels` with a value for texels under 41 LEDs."""


def ablated(made: Made, folder: Path, *settings: str) -> tuple[Path, dict[str, Any]]:
    """A copy of a result after `ablate --texels` with some settings of `FEWER`, and what the command said."""
    fewer = {setting: FEWER[setting] for setting in settings}
    out = Path(shutil.copytree(made[1], folder / "ablated"))
    arguments = (made[0].run_folder, "--calibrations", made[0].folder / "records", "--texels", "--json")
    with mock.patch("coupole.reflectance.texels.texel_ablation.FEWER_SAMPLES", fewer):
        ended = cells.here("reflectance", "ablate", out, *arguments)
    assert ended.code == 0, ended.err
    return out, ended.document


def frame_share(cell: CellFolder, view: str, led: int) -> np.ndarray:
    """[h, w] the frame of an LED, in shares of the camera's range."""
    with h5py.File(cell.run_folder / f"views/{view}.h5") as file:
        number = int(np.flatnonzero(file["entry/instrument/detector/frames"]["led"] == led)[0])
        raw = file["entry/instrument/detector/data"][number].astype(float)
    with h5py.File(RECORDS / "flat-field.h5") as file:
        share: np.ndarray = (raw - cells.BLACK_DN) / (4095 - cells.BLACK_DN) / file["g"][()]
    return share
