"""Photographs of stickers on a bumpy thing, from a camera on an arm: made without any code of the product."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from bright_squares import BLACK_DN, covered, raw
from scipy.spatial.transform import Rotation
from synthesis import Array, TrueLens, frame

from coupole.calibration.grey_image import Picture
from coupole.calibration.optics import NAMES, Intrinsics
from coupole.calibration.posed_camera import CameraPrior
from coupole.calibration.poses import kuka_poses
from coupole.calibration.sources import About, Source, Sources

SIZE_PX = (512, 384)
LENS = TrueLens((870.0, 870.5), (256.3, 191.6), (-0.05, 0.02, 2e-4, -3e-4, 0.0))
FREE = NAMES[:8]
LENS_U = np.array([0.02, 0.02, 0.04, 0.04, 1e-4, 1e-3, 1e-5, 1e-5])
HAND_EYE_MM, HAND_EYE_DEG = 0.02, 0.002


@dataclass(frozen=True)
class Scene:
    """What a run and a scan would say, and the truth."""

    sources: Sources
    prior: CameraPrior
    names: tuple[str, ...]
    targets_mm: Array
    base_from_mesh: Array


def scene(seed: int, *, stickers: int = 14, views: int = 8, missing: int = 0) -> Scene:
    """Stickers of 6 mm in 10 mm, whose table has an error of 30 um; the last `missing` of the table are gone."""
    random = np.random.default_rng(seed)
    places, normals = _places(random, stickers)
    base_from_mesh = frame(
        np.array([200.0, 0.0, 1400.0]), Rotation.random(random_state=seed).as_rotvec(degrees=True)
    )
    flange_from_camera = frame(np.array([31.0, -42.0, 118.0]), np.array([4.0, -3.0, 60.0]))
    images, flanges = [], []
    for number in range(views):
        mesh_from_camera = _eye(random, 360.0 * number / views)
        camera_from_mesh = np.linalg.inv(mesh_from_camera)
        picture = _picture(camera_from_mesh, places[: stickers - missing], normals)
        image = Picture(raw(picture, random) - float(BLACK_DN), "GBRG", 4031.0)
        images.append(Source(f"v{number}", lambda image=image: image))  # type: ignore[misc]
        flange = base_from_mesh @ mesh_from_camera @ np.linalg.inv(flange_from_camera)
        off = frame(random.normal(0, 0.03, 3), random.normal(0, 0.003, 3))
        said = flange.copy()
        said[:3, 3] += off[:3, 3]
        said[:3, :3] = flange[:3, :3] @ off[:3, :3]
        flanges.append(said)
    sources = Sources(
        tuple(images), kuka_poses(np.array(flanges)), About(is_simulated=True), (("run/run.json", "0" * 64),)
    )
    known = places + random.normal(0, 0.03, places.shape)
    names = tuple(f"T{row}" for row in range(stickers))
    return Scene(sources, _records(random, flange_from_camera), names, known, base_from_mesh)


def write_scan(folder: Path, made: Scene) -> Path:
    """A folder as `coupole scan` leaves it."""
    import trimesh

    folder.mkdir(parents=True)
    rows = [f"{n},{x:.6f},{y:.6f},{z:.6f}" for n, (x, y, z) in zip(made.names, made.targets_mm, strict=True)]
    (folder / "targets.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    trimesh.creation.box((150.0, 110.0, 10.0)).export(folder / "mesh.ply")
    return folder


def _places(random: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Places on a bump, at least 14 mm apart, and the normals there."""
    places: list[Array] = []
    while len(places) < count:
        x, y = random.uniform(-65, 65), random.uniform(-45, 45)
        place = np.array([x, y, 20.0 - (x**2 + y**2) / 300])
        if all(np.linalg.norm(place - other) > 14 for other in places):
            places.append(place)
    at = np.array(places)
    normals = np.column_stack([at[:, 0] / 150, at[:, 1] / 150, np.ones(count)])
    return at, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _eye(random: np.random.Generator, azimuth_deg: float) -> Array:
    """`mesh_from_camera`: from above at a slant, towards the middle."""
    turn = Rotation.from_euler(
        "ZYZ", [azimuth_deg, random.uniform(15, 40), random.uniform(-180, 180)], degrees=True
    )
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix() @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = -pose[:3, 2] * random.uniform(330, 400) + random.normal(0, 5, 3)
    return pose


def _picture(camera_from_mesh: Array, places: Array, normals: Array) -> Array:
    shape = SIZE_PX[::-1]
    image = np.full(shape, 0.2)
    for place, normal in zip(places, normals[: len(places)], strict=True):
        x = np.cross(normal, [0.3, -0.5, 0.81])
        x /= np.linalg.norm(x)
        angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)[:, None]
        rim = np.cos(angle) * x + np.sin(angle) * np.cross(normal, x)
        border, disk = (
            covered(shape, LENS.see((place + r * rim) @ camera_from_mesh[:3, :3].T + camera_from_mesh[:3, 3]))
            for r in (5.0, 3.0)
        )
        image = image * (1 - border) + 0.02 * (border - disk) + 0.7 * disk
    return image


def _records(random: np.random.Generator, flange_from_camera: Array) -> CameraPrior:
    sigma = np.concatenate([LENS_U, np.full(3, HAND_EYE_MM), np.radians(np.full(3, HAND_EYE_DEG))])
    off = sigma * random.normal(size=len(sigma))
    values = dict(zip(NAMES, LENS.vector(), strict=True))
    values |= {name: values[name] + off[i] for i, name in enumerate(FREE)}
    hand_eye = flange_from_camera.copy()
    hand_eye[:3, 3] += off[8:11]
    hand_eye[:3, :3] = hand_eye[:3, :3] @ Rotation.from_rotvec(off[11:]).as_matrix()
    return CameraPrior(Intrinsics(**values), FREE, hand_eye, np.diag(sigma**2))
