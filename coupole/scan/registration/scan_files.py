"""Scans as files: meshes or clouds of points, read one at a time and checked before they are registered."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, reason
from coupole.scan.mesh import Mesh
from coupole.scan.mesh_bytes import MeshFile
from coupole.scan.mesh_files import read_mesh
from coupole.scan.mesh_ply import read_ply
from coupole.scan.registration import e57_scans
from coupole.scan.registration.scan_content import ScanContent, ScanSource
from coupole.scan.registration.text_scans import (
    HEADED_SUFFIXES,
    TEXT_SUFFIXES,
    headed_sources,
    read_headed,
    read_plain,
)
from coupole.scan.scanner_export import MM_PER_UNIT

SUFFIXES = (".ply", ".stl", ".obj", ".e57", *HEADED_SUFFIXES, *TEXT_SUFFIXES)
LEAST_POINTS = 200
"""Least number of points of a scan; a shape cannot be recognized from fewer."""
_HEADER_BYTES = 65536
PLAUSIBLE_SIZE_MM = (2.0, 1e6)
"""Smallest and largest diagonal of a scan's bounding box: from a coin to a cathedral."""


def sources_of(paths: Sequence[Path]) -> list[ScanSource]:
    """Return the scans of files. A PTX, PTS or E57 may contain several. If two files have the same name, their
    scans are named by paths. Raises InputError with the place of the error, ExtraMissing."""
    sources: list[ScanSource] = []
    for path in paths:
        suffix = path.suffix.lower()
        if suffix not in SUFFIXES:
            raise InputError(f"{path}: expected a scan with the ending {', '.join(SUFFIXES)}")
        if not path.is_file():
            raise InputError(f"{path}: expected a scan; there is no such file")
        if path.stat().st_size == 0:
            raise InputError(f"{path}: expected a scan; the file is empty")
        if suffix in HEADED_SUFFIXES:
            sources += headed_sources(path)
        elif suffix == ".e57":
            sources += e57_scans.e57_sources(path)
        else:
            sources.append(ScanSource(path, path.name))
    if len({source.name for source in sources}) == len(sources):
        return sources
    return [
        replace(scan_source, name=str(scan_source.path) + scan_source.name[len(scan_source.path.name) :])
        for scan_source in sources
    ]


def read_scan(source: ScanSource, unit: str, *, colours: bool = False) -> ScanContent:
    """Read a scan in mm; an E57 is always in metres, whatever the `unit`. Raises InputError with the place of the
    error, ExtraMissing."""
    suffix = source.path.suffix.lower()
    if suffix == ".e57":
        content, unit = e57_scans.read_e57(source, colours=colours), e57_scans.UNIT
    elif suffix in HEADED_SUFFIXES:
        content = read_headed(source)
    elif suffix in TEXT_SUFFIXES:
        content = read_plain(source.path)
    elif suffix == ".ply":
        mesh = read_ply(MeshFile(source.path))
        content = ScanContent(mesh, _ply_colours(source.path, len(mesh.vertices)) if colours else None)
    else:
        content = ScanContent(read_mesh(source.path))
    if len(content.mesh.vertices) < LEAST_POINTS:
        raise InputError(f"{source}: expected {LEAST_POINTS} points or more, found {len(content.mesh.vertices)}")
    mesh = Mesh(content.mesh.vertices * np.float32(MM_PER_UNIT[unit]), content.mesh.triangles)
    _expect_plausible(source, mesh, unit)
    pose = content.stated_pose
    if pose is not None:
        pose = pose.copy()
        pose[:3, 3] *= MM_PER_UNIT[unit]
    return ScanContent(mesh, content.srgba, pose)


def _ply_colours(path: Path, count: int) -> NDArray[np.uint8] | None:
    """[n, 4] colours from `red`, `green` and `blue` of a PLY's vertices, 8 bits; None without them."""
    with path.open("rb") as file:
        head = file.read(_HEADER_BYTES).split(b"end_header")[0]
    if b" red" not in head or b" blue" not in head:
        return None
    import trimesh

    geometry: Any = trimesh.load(path, process=False)
    colours = getattr(geometry, "colors", None)
    if colours is None:
        colours = geometry.visual.vertex_colors
    colours = np.asarray(colours)
    if len(colours) != count or colours.dtype != np.uint8:
        raise InputError(f"{path}: expected colours of {count} vertices, 8 bit; found {len(colours)}")
    return np.column_stack([colours[:, :3], np.full(count, 255, np.uint8)])


def _expect_plausible(source: ScanSource, mesh: Mesh, unit: str) -> None:
    size_mm = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0).astype(np.float64)))
    low_mm, high_mm = PLAUSIBLE_SIZE_MM
    if low_mm <= size_mm <= high_mm:
        return
    fitting = [u for u, mm in MM_PER_UNIT.items() if low_mm <= size_mm / MM_PER_UNIT[unit] * mm <= high_mm]
    hint = f": is it in {' or '.join(fitting)}? Give its unit with --unit" if fitting and size_mm > 0 else ""
    raise InputError(
        f"{source}: the scan is {size_mm:.3g} mm in size if it is in {unit}; expected {low_mm:g} to {high_mm:g} mm"
        f"{hint}"
    )


def expect_different(paths: Sequence[Path]) -> None:
    """Raise InputError if two files have the same bytes, or if a file is named twice."""
    path_of: dict[str, Path] = {}
    for path in paths:
        try:
            with path.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
        except OSError as error:
            raise InputError(f"{path}: expected a scan; {reason(error)}") from error
        if digest in path_of:
            again = "is named twice" if path_of[digest] == path else f"holds the same bytes as {path_of[digest]}"
            raise InputError(f"{path}: {again}; name each scan once")
        path_of[digest] = path
