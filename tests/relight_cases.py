"""Result folders of runs whose materials are known, made without a run."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
import OpenEXR

from coupole.calibration.optics import Intrinsics
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.extraction.lamp_sight import REACHED
from coupole.reflectance.extraction.seen_surface import seen_surface
from coupole.reflectance.material_uncertainty import MaterialUncertainty
from coupole.reflectance.run_result import OBJECT, SCHEMA, RunResult
from coupole.reflectance.run_result_files import write_materials, write_object
from coupole.reflectance.triangle_fit import TriangleMaterials

BASE_FROM_SUPPORT = np.array(
    [[0.0, 1.0, 0.0, 500.0], [1.0, 0.0, 0.0, 20.0], [0.0, 0.0, -1.0, 300.0], [0, 0, 0, 1.0]]
)
"""As in cells whose arm hangs: z of the support is the base's -z."""
LENS = Intrinsics(1000.0, 1000.0, 78.0, 61.0, k1=-4.0, k2=20.0)
SIZE_PX = (160, 120)
LED = 7
LED_MM, LED_TARGET_MM = np.array([200.0, -150.0, 400.0]), np.zeros(3)
"""Support frame."""
FULL_SCALE = np.array([0.8, 0.5, 0.3])


@dataclass(frozen=True)
class Coat:
    """GGX of all triangles."""

    kd: tuple[float, float, float] = (0.2, 0.15, 0.1)
    ks: tuple[float, float, float] = (0.0, 0.0, 0.0)
    alpha: float = 0.3


GLOSSY = Coat((0.05, 0.04, 0.03), (0.4, 0.3, 0.2), 0.15)


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def moved(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def sheet(heights_mm: np.ndarray, side_mm: float) -> np.ndarray:
    """[triangles, 3, 3] of a grid [n, n] of heights, z up, about the origin."""
    line = np.linspace(-side_mm / 2, side_mm / 2, len(heights_mm))
    points = np.stack([*np.meshgrid(line, line), heights_mm], axis=-1)
    a, b, c, d = points[:-1, :-1], points[:-1, 1:], points[1:, 1:], points[1:, :-1]
    return np.concatenate([np.stack([a, b, c], 2).reshape(-1, 3, 3), np.stack([a, c, d], 2).reshape(-1, 3, 3)])


def waves(count: int = 60, side_mm: float = 60.0) -> np.ndarray:
    line = np.linspace(-side_mm / 2, side_mm / 2, count)
    x, y = np.meshgrid(line, line)
    return sheet(2.0 * np.sin(x / 4.0) * np.cos(y / 5.0) + 4.0 * np.exp(-(x**2 + y**2) / 30.0), side_mm)


def camera_pose(at_mm: np.ndarray, look_at_mm: np.ndarray) -> np.ndarray:
    """[4, 4] support_from_camera, z forward, y down."""
    forward = unit(look_at_mm - at_mm)
    right = unit(np.cross(forward, [0.02, 1.0, 0.1]))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = np.stack([right, np.cross(forward, right), forward], axis=1), at_mm
    return pose


def write_result(
    folder: Path,
    corners_mm: np.ndarray,
    coat: Coat | None = None,
    camera_mm: tuple[float, float, float] = (60.0, -120.0, 330.0),
    channels: slice = slice(0, 3),
    finer: int = 1,
) -> RunResult:
    """A folder with one view, `top`, of triangles [n, 3, 3] in the support frame; its pixels may be so many times
    as fine as `SIZE_PX` says."""
    coat = coat or Coat()
    corners = moved(BASE_FROM_SUPPORT, corners_mm)
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    for name in ("samples", "fits"):
        (folder / name).mkdir(parents=True)
    write_object(folder / OBJECT, corners, BASE_FROM_SUPPORT)
    pose = BASE_FROM_SUPPORT @ camera_pose(np.array(camera_mm), np.zeros(3))
    lens = replace(LENS, **{name: finer * getattr(LENS, name) for name in ("fx", "fy", "cx", "cy")})
    surface = seen_surface(PacketMesh(corners), normals, lens, pose, (finer * SIZE_PX[0], finer * SIZE_PX[1]))
    seen, mine = surface.places, surface.triangles
    led_mm = moved(BASE_FROM_SUPPORT, LED_MM)
    with h5py.File(folder / "samples/top.h5", "w") as file:
        file.attrs["view"] = "top"
        file["seen"], file["triangles"] = seen, mine
        file["centres_mm"], file["normals"] = corners.mean(axis=1)[mine], normals[mine]
        file["camera_mm"], file["leds"] = pose[:3, 3], np.array([LED])
        file["led_positions_mm"] = led_mm[None]
        file["led_normals"] = unit(moved(BASE_FROM_SUPPORT, LED_TARGET_MM) - led_mm)[None]
        file["full_scales"] = FULL_SCALE[None, channels]
        file["f"] = np.full((len(mine), 1, len(FULL_SCALE[channels])), np.nan, np.float32)
        write_sources(file, {})
    count = len(mine)
    same = [np.tile(values[channels], (count, 1)) for values in (coat.kd, coat.ks)]
    materials = TriangleMaterials(normals[mine], *same, np.full(count, coat.alpha), np.zeros(count))
    certain = MaterialUncertainty(np.zeros((count, 5, 5)), *np.zeros((2, *materials.kd.shape)))
    for name in ("ggx", "ggx_normal"):
        write_materials(folder / f"fits/{name}.h5", [materials], [certain], np.zeros(count), 0.0, mine)
    about = {
        "schema": SCHEMA,
        "software": {"coupole": "0.2.0"},
        "runs": {"waves": {}},
        "mae": {"ggx": 0.1, "ggx_normal": 0.2},
        "emission": "lambertian",
        "scan_noise_um": 30.0,
        "simulated": True,
    }
    (folder / "result.json").write_text(json.dumps(about))
    return RunResult(folder)


def write_sources(file: h5py.File, u: dict[str, float]) -> None:
    """Put uncertainties of samples into a view's file: relative `u_own`, `u_response`, `led_u_own` and
    `led_u_shared`, and `lateral_u_mm`, `led_u_mm`; 0 of those that are not named."""
    triangles, leds, channels = file["f"].shape
    file.attrs.update({name: u.get(name, 0.0) for name in ("lateral_u_mm", "led_u_mm")})
    shapes = {"u_own": file["f"].shape, "u_response": (triangles, channels)}
    shapes |= dict.fromkeys(("led_u_own", "led_u_shared"), (leds, channels))
    for name in ("codes", *shapes):
        file.pop(name, None)
    file["codes"] = np.full((triangles, leds), REACHED, np.uint8)
    for name, shape in shapes.items():
        file[name] = np.full(shape, u.get(name, 0.0))


def write_exr(path: Path, radiance: np.ndarray) -> Path:
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(radiance, np.float32)}).write(str(path))
    return path
