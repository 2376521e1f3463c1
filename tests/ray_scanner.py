"""A scanner made of rays alone: what stands in its way hides what is behind, materials swallow some rays.

Embree gives where a ray ends; noise is added along it. Nothing of the project is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RayScan:
    """Points [n, 3] in the scanner's own frame, whose origin it stands in, and where that frame is."""

    points_mm: Floats
    world_from_scan: Floats

    def write(self, path: Path) -> Path:
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(self.points_mm)}\n"
        head += "property float x\nproperty float y\nproperty float z\nend_header\n"
        path.write_bytes(head.encode() + self.points_mm.astype("<f4").tobytes())
        return path


class RayScanner:
    """Scans one object from anywhere."""

    def __init__(self, mesh: trimesh.Trimesh, *, noise_mm: float, seed: int) -> None:
        corners = np.asarray(mesh.triangles, np.float32)
        self._scene = EmbreeScene()
        self._mesh = TriangleMesh(self._scene, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
        self._noise_mm, self._rng = noise_mm, np.random.default_rng(seed)
        self._size_mm = float(mesh.scale)

    def scan(self, eye_mm: Floats, target_mm: Floats, field_deg: float, rays_across: int) -> RayScan:
        """From a place towards another, over a square field, in a frame that is turned at random."""
        forward = (target_mm - eye_mm) / np.linalg.norm(target_mm - eye_mm)
        right = np.cross(forward, [0.1, 0.2, 1.0])
        right /= np.linalg.norm(right)
        turned = np.stack([right, np.cross(forward, right), forward], axis=1)
        angles = np.radians(np.linspace(-field_deg / 2, field_deg / 2, rays_across))
        pan, tilt = (a.ravel() for a in np.meshgrid(angles, angles))
        ways = np.stack([np.sin(pan) * np.cos(tilt), np.sin(tilt), np.cos(pan) * np.cos(tilt)], axis=1) @ turned.T
        starts = np.tile(eye_mm, (len(ways), 1)).astype(np.float32)
        range_mm = np.asarray(self._scene.run(starts, ways.astype(np.float32), query="DISTANCE"), np.float64)
        kept = np.isfinite(range_mm) & (range_mm < 10 * self._size_mm)
        ends = eye_mm + ways * range_mm[:, None]
        kept &= self._rng.random(len(ways)) > self._swallowed(ends)
        range_mm = range_mm[kept] + self._rng.normal(0, self._noise_mm, int(kept.sum()))
        pose = np.eye(4)
        pose[:3, :3] = Rotation.random(random_state=self._rng).as_matrix()
        pose[:3, 3] = eye_mm
        return RayScan((ways[kept] * range_mm[:, None]) @ pose[:3, :3], pose)

    def _swallowed(self, points_mm: Floats) -> Floats:
        """Share of rays that do not come back: a third of the object is dark, some of it nearly black."""
        wave = np.sin(points_mm @ np.array([2.1, 1.3, 1.7]) * (12 / self._size_mm)) + 0.5 * np.sin(
            points_mm @ np.array([-1.1, 2.3, 0.9]) * (25 / self._size_mm)
        )
        return np.select([wave > 1.2, wave > 0.5], [0.9, 0.35], 0.02)


def tower(radius_mm: float, height_mm: float, statues: int, facets: int, seed: int) -> trimesh.Trimesh:
    """A round tower with a wavy wall and statues before it, no two alike."""
    rng = np.random.default_rng(seed)
    around = np.linspace(0, 2 * np.pi, facets, endpoint=False)
    up = np.linspace(-height_mm / 2, height_mm / 2, max(4, int(facets * height_mm / (2 * np.pi * radius_mm))))
    angle, z = (a.ravel() for a in np.meshgrid(around, up))
    waves = sum(
        rng.normal(0, 0.012 / order) * np.sin(int(order) * angle * 4 + rng.uniform(-9, 9) * z / height_mm + phase)
        for order, phase in zip(range(1, 12), rng.uniform(0, 6, 11), strict=True)
    )
    r = radius_mm * (1 + waves)
    vertices = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    row, column = (a.ravel() for a in np.meshgrid(np.arange(len(up) - 1), np.arange(facets), indexing="ij"))
    a, b = row * facets + column, row * facets + (column + 1) % facets
    faces = np.concatenate([np.stack([a, b, a + facets], 1), np.stack([b, b + facets, a + facets], 1)])
    parts = [trimesh.Trimesh(vertices, faces, process=False)]
    parts += [_statue(rng, radius_mm, height_mm, 2.5 * radius_mm / statues**0.5) for _ in range(statues)]
    whole: trimesh.Trimesh = trimesh.util.concatenate(parts)
    return whole


def _statue(rng: np.random.Generator, radius_mm: float, height_mm: float, statue_mm: float) -> trimesh.Trimesh:
    size_mm = rng.uniform(0.4, 1.2) * statue_mm
    if rng.random() < 0.5:
        body = trimesh.creation.icosphere(subdivisions=3, radius=size_mm)
        body.apply_scale(rng.uniform(0.5, 1.6, 3))
    else:
        body = trimesh.creation.box(rng.uniform(0.6, 2.2, 3) * size_mm)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    angle, away = rng.uniform(0, 2 * np.pi), radius_mm + rng.uniform(-0.2, 0.8) * size_mm
    pose[:3, 3] = away * np.cos(angle), away * np.sin(angle), rng.uniform(-0.48, 0.48) * height_mm
    body.apply_transform(pose)
    return body
