"""Scans of an E57 (ASTM E2807), in the standard's unit (metres), by pye57 (libE57Format)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from coupole.errors import ExtraMissing, InputError
from coupole.scan.mesh import Mesh, expect_finite
from coupole.scan.registration.scan_content import ScanContent, ScanSource

UNIT = "m"
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_COLOURS = ("colorRed", "colorGreen", "colorBlue")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


def e57_sources(path: Path) -> list[ScanSource]:
    """Return the scans of a file. Raises InputError, ExtraMissing."""
    with _open_e57(path) as file:
        count = file.scan_count
    if count == 0:
        raise InputError(f"{path}: expected scans; the file holds none (only pictures?)")
    return [ScanSource(path, path.name if k == 0 else f"{path.name}#{k + 1}", k) for k in range(count)]


def read_e57(source: ScanSource, *, colours: bool) -> ScanContent:
    """Read one scan, without the points that it marks as invalid. Raises InputError, ExtraMissing."""
    with _open_e57(source.path) as file:
        header = file.get_header(source.number)
        fields = header.point_fields
        kind = next((names for names in (_CARTESIAN, _SPHERICAL) if set(names) <= set(fields)), None)
        if kind is None:
            raise InputError(f"{source}: expected Cartesian or spherical points, found {', '.join(fields)}")
        has_colours = colours and set(_COLOURS) <= set(fields)
        marks = [name for name in (*_INVALID, "isColorInvalid") if name in fields]
        columns = _columns(file, header, [*kind, *marks, *(_COLOURS if has_colours else ())])
        places = np.stack([columns[name] for name in kind], axis=1)
        valid = np.all(
            [columns[name] == 0 for name in marks if name in _INVALID] or [np.ones(len(places), bool)], axis=0
        )
        srgba = _srgba(header, columns)[valid] if has_colours else None
        pose = _pose(source, header) if header.has_pose() else None
    points = (places if kind is _CARTESIAN else _cartesian(places))[valid].astype(np.float32)
    expect_finite(source.path, points, f"scan {source.number + 1}, point {{}}")
    return ScanContent(Mesh(points, np.zeros((0, 3), np.uint32)), srgba, pose)


@contextmanager
def _open_e57(path: Path) -> Iterator[Any]:
    try:
        import pye57
    except ImportError as error:
        raise ExtraMissing(f"{path}: E57 needs pye57: pip install 'coupole[registration]' ({error})") from error
    try:
        with pye57.E57(str(path)) as file:
            yield file
    except pye57.libe57.E57Exception as error:
        raise InputError(f"{path}: expected an E57 file (ASTM E2807); {str(error).splitlines()[0]}") from error


def _columns(file: Any, header: Any, names: list[str]) -> dict[str, NDArray[np.float64]]:
    from pye57 import libe57

    columns = {name: np.empty(header.point_count, np.float64) for name in names}
    buffers = libe57.VectorSourceDestBuffer()
    for name, values in columns.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, name, values, len(values), True, True))
    record_count = header.points.reader(buffers).read() if header.point_count else 0
    return {name: values[:record_count] for name, values in columns.items()}


def _srgba(header: Any, columns: dict[str, NDArray[np.float64]]) -> NDArray[np.uint8]:
    """[n, 4] colours, scaled by the limits that the file states; by default, the limits are 0 and 255."""
    levels = []
    for name in _COLOURS:
        low, high = 0.0, 255.0
        if header.node.isDefined("colorLimits"):
            limits = header.node["colorLimits"]
            low, high = (float(limits[f"{name}{end}"].value()) for end in ("Minimum", "Maximum"))
        levels.append(np.clip(np.round(255 * (columns[name] - low) / max(high - low, 1e-12)), 0, 255))
    there = columns["isColorInvalid"] == 0 if "isColorInvalid" in columns else np.ones(len(levels[0]), bool)
    return np.column_stack([*levels, 255 * there]).astype(np.uint8)


def _pose(source: ScanSource, header: Any) -> NDArray[np.float64]:
    pose_node, pose = header.node["pose"], np.eye(4)
    if pose_node.isDefined("rotation"):
        w, x, y, z = (float(pose_node["rotation"][name].value()) for name in "wxyz")
        if not 0.999 < w * w + x * x + y * y + z * z < 1.001:
            raise InputError(f"{source}: expected a quaternion of length 1 as its pose, found {w}, {x}, {y}, {z}")
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    if pose_node.isDefined("translation"):
        pose[:3, 3] = [float(pose_node["translation"][name].value()) for name in "xyz"]
    return pose


def _cartesian(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 3] coordinates from range, azimuth and elevation."""
    away, azimuth, elevation = places.T
    flat = away * np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), away * np.sin(elevation)], axis=1)
