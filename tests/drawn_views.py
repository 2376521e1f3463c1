"""A textured surface in a simulated cell, and what processing is given of it: records and a scan that are off.

Errors are drawn from the uncertainties that records and options state, as a cell of that quality would have them.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cells
import h5py
import numpy as np
import trimesh
from cells import CellFolder
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.calibration.record import Parameter, Record, pose_of, read_record, rows_of, seal_record, write_record

Floats = NDArray[np.float64]
RECORDS = cells.REPO / "configs/calibrations"
HAND_EYE_MM, HAND_EYE_DEG, FOCAL_PX, CENTRE_PX, K1 = 0.6, 0.12, 1.5, 1.0, 0.01
"""Standard uncertainties of the records."""
ARM_MM, ARM_DEG = 0.2, 0.03
"""Of the poses that the arm reports, from view to view."""
MESH_MM, MESH_DEG, SHAPE_MM, SCALE_MM = 0.1, 0.02, 0.15, 20.0
"""Of the scan."""
LENS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1")
FLANGE_FROM_CAMERA_MM = 120.0
TARGET_MM = [0, 0, 18]
VIEWS = {"top": (-90, 80), "left": (-150, 50), "right": (-30, 50)}
"""Azimuth and elevation, degrees."""
LAYERS = ((2.5, 0.25), (4.5, 0.2), (8.0, 0.2), (15.0, 0.2))
"""Period in mm, and texture."""


def waves() -> trimesh.Trimesh:
    """80 x 60 mm of a smooth surface, some 22 mm high, with edges of 1.3 mm."""
    x, y = np.meshgrid(np.linspace(-40, 40, 61), np.linspace(-30, 30, 46))
    z = 18 + 7 * np.sin(x / 11) * np.cos(y / 13) + 4 * np.sin(x / 23 + y / 9)
    corner = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (part.ravel() for part in (corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), faces, process=False)


def textured_cell(folder: Path, *, every: int = 120, views: Sequence[str] = tuple(VIEWS)) -> CellFolder:
    """The surface under every so many LEDs, from three sides, somewhat glossy."""
    cell = CellFolder(folder, speed=14.0)
    waves().export(folder / "waves.ply")
    cell.plan_data["object"]["mesh"] = str(folder / "waves.ply")
    cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
    cell.world_settings.update(
        white_at_us=8000,
        shading="pixel",
        interreflection=False,
        detail=[{"period_mm": p, "texture": t, "seed": n} for n, (p, t) in enumerate(LAYERS, start=1)],
        material={"diffuse": (0.45, 0.4, 0.35), "f0": (0.04,) * 3, "roughness": 0.35},
    )
    around = {**cells.TOP, "target_mm": TARGET_MM}
    directions = {name: VIEWS[name] for name in views}
    poses = [{**around, "name": n, "azimuth_deg": a, "elevation_deg": e} for n, (a, e) in directions.items()]
    cell.write(views=poses, lights={"kind": "every", "every": every}, darks_per_view=0)
    return cell


@dataclass(frozen=True)
class Drawn:
    """What processing is given, and the truth."""

    run: Path
    """A copy whose poses are off."""
    hand_eye: Path
    mesh: Path
    true_lens: dict[str, float]
    flange_from_camera: Floats


def draw(true_run: Path, folder: Path, seed: int) -> Drawn:
    """A run whose arm reports poses that are off, a hand-eye record for frames of 512 x 384, and a scan in the
    mesh's own frame."""
    random = np.random.default_rng(seed)
    run = shutil.copytree(true_run, folder / true_run.name)
    for path in sorted((run / "views").glob("*.h5")):
        _misreport(path, random.standard_normal(6) * np.repeat([ARM_MM, np.radians(ARM_DEG)], 3))
    focal_px = 35.0 * 335.0 / 300.0 / 0.044
    true_lens = dict(zip(LENS, (focal_px, focal_px, 255.5, 191.5, 0.0), strict=True))
    u_lens = dict(zip(LENS, (FOCAL_PX, FOCAL_PX, CENTRE_PX, CENTRE_PX, K1), strict=True))
    off = random.standard_normal(6) * np.repeat([HAND_EYE_MM, np.radians(HAND_EYE_DEG)], 3)
    true, given = np.eye(4), np.eye(4)
    true[2, 3] = FLANGE_FROM_CAMERA_MM
    given[:3, :3], given[:3, 3] = Rotation.from_rotvec(off[3:]).as_matrix(), true[:3, 3] + off[:3]
    lens = {name: true_lens[name] + u * random.standard_normal() for name, u in u_lens.items()}
    steps = {f"flange_from_camera.{name}_mm": HAND_EYE_MM for name in "xyz"}
    steps |= {f"flange_from_camera.r{name}_deg": HAND_EYE_DEG for name in "xyz"}
    parameters = [_parameter(name, value, u_lens[name]) for name, value in lens.items()]
    parameters += [_parameter(name, None if "deg" in name else 0.0, u) for name, u in steps.items()]
    old = read_record(RECORDS / "hand-eye.yaml")
    content: dict[str, Any] = {
        name: getattr(old, name) for name in Record.model_fields if name not in {"schema_version", "sha256"}
    }
    content |= {
        "parameters": tuple(parameters),
        "covariance": rows_of(np.diag([one.u**2 for one in parameters])),
        "transforms": {"flange_from_camera": pose_of(given)},
        "fixed": {},
    }
    write_record(folder / "hand-eye.yaml", seal_record(**content))
    wrong = waves()
    wrong.vertices = _scanned(np.asarray(wrong.vertices), np.asarray(wrong.vertex_normals), random)
    wrong.export(folder / "scan.ply")
    return Drawn(run, folder / "hand-eye.yaml", folder / "scan.ply", true_lens, true)


def _misreport(view: Path, step: Floats) -> None:
    """Move all poses of a view by a step (mm along the base's axes, rad about the flange's)."""
    with h5py.File(view, "r+") as file:
        poses = file["entry/instrument/robot/poses"]
        table = poses[()]
        used = table["base_from_flange"][:, 3, 3] == 1
        table["base_from_flange"][used, :3, 3] += step[:3]
        table["base_from_flange"][used, :3, :3] @= Rotation.from_rotvec(step[3:]).as_matrix()
        poses[...] = table


def _parameter(name: str, value: float | None, u: float) -> Parameter:
    return Parameter(name=name, value=value, u=u, degrees_of_freedom=1e6, dominated_by="drawn")


def _scanned(vertices_mm: Floats, normals: Floats, random: np.random.Generator) -> Floats:
    """Vertices moved along their normals by a smooth field (random waves, whose covariance is Gaussian with the
    field's scale), and all together."""
    waves_per_mm = random.standard_normal((400, 3)) / SCALE_MM
    phases = random.uniform(0, 2 * np.pi, 400)
    field = SHAPE_MM * np.sqrt(2 / 400) * np.cos(vertices_mm @ waves_per_mm.T + phases).sum(axis=1)
    turn = Rotation.from_rotvec(np.radians(MESH_DEG) * random.standard_normal(3)).as_matrix()
    moved = vertices_mm + field[:, None] * normals
    middle = moved.mean(axis=0)
    scanned: Floats = (moved - middle) @ turn.T + middle + MESH_MM * random.standard_normal(3)
    return scanned
