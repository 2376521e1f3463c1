"""A hand-held laser scanner that scans a thing of the world. It exports files in its own frame, with noise.

The files contain nothing else of the world. `scanner_from_thing` gives the true position of the scanner's frame,
for tests of a calibration.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation

from coupole.appearance.shapes.triangles import Array, weld_corners
from coupole.errors import InputError, StorageError
from coupole.geometry import Transform
from sim.scene.things import Sample, Thing

MESH, TARGETS = "scan.stl", "targets.txt"
ACCURACY_MM = 0.03
"""Standard deviation of each coordinate (HandyScan 700: 30 um)."""
_STL_TRIANGLE = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_FAR_MM = 400.0
"""Range of the thing's position in the scanner's frame, whose origin is where the scanner was switched on."""


def scanner_from_thing(seed: int) -> Transform:
    """Pose of the thing in the scanner's frame: random position and orientation."""
    random = np.random.default_rng([seed, 1])
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=random).as_matrix()
    pose[:3, 3] = random.uniform(-_FAR_MM, _FAR_MM, 3)
    return pose


def export_scan(
    thing: Mapping[str, Any], folder: Path, *, seed: int = 1, accuracy_mm: float = ACCURACY_MM
) -> tuple[Path, Path]:
    """Scan a thing of `world.settings.things` that carries stickers; writes mesh and table, returns their paths.

    The mesh is a binary STL with attribute bytes; the table has name, centre and normal of each sticker that the
    thing carried when it was scanned. Raises InputError for a thing without stickers, StorageError.
    """
    try:
        sample: Thing = TypeAdapter(Thing).validate_python(dict(thing))
    except ValidationError as error:
        raise InputError(f"scanner: expected a thing of the simulated world: {error}") from error
    if not isinstance(sample, Sample) or sample.stickers is None:
        raise InputError(
            f"scanner: expected a thing with `stickers`, found {thing}; without stickers a scan has no targets"
        )
    random = np.random.default_rng([seed, 2])
    frame = scanner_from_thing(seed)
    bare = sample.bare()
    points, faces = weld_corners(bare.corners_mm)
    points = points @ frame[:3, :3].T + frame[:3, 3] + random.normal(0.0, accuracy_mm, points.shape)
    poses = frame @ sample.stickers.poses_when_scanned(bare)
    poses = poses[random.permutation(len(poses))]
    centres_mm = poses[:, :3, 3] + random.normal(0.0, accuracy_mm, (len(poses), 3))
    mesh, targets = folder / MESH, folder / TARGETS
    try:
        folder.mkdir(parents=True, exist_ok=True)
        mesh.write_bytes(_stl(points[faces]))
        targets.write_text(_table(centres_mm, poses[:, :3, 2]), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: cannot write the scan: {error.strerror}. Free its disk.") from error
    return mesh, targets


def _stl(corners_mm: Array) -> bytes:
    """Binary STL; the attribute bytes carry no information for other programs, as with VXelements."""
    triangles = np.zeros(len(corners_mm), _STL_TRIANGLE)
    cross = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    length = np.linalg.norm(cross, axis=1, keepdims=True)
    triangles["normal"] = np.divide(cross, length, out=np.zeros_like(cross), where=length > 0)
    triangles["corners"] = corners_mm
    triangles["attribute"] = np.arange(len(corners_mm)) % 7
    return b"VXelements".ljust(80) + np.uint32(len(triangles)).tobytes() + triangles.tobytes()


def _table(centres_mm: Array, normals: Array) -> str:
    lines = ["Name\tX (mm)\tY (mm)\tZ (mm)\tNX\tNY\tNZ"]
    for number, row in enumerate(np.concatenate([centres_mm, normals], axis=1), start=1):
        lines.append("\t".join([f"T{number}", *(f"{value:.6f}" for value in row)]))
    return "\n".join(lines) + "\n"
