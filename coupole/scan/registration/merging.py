"""Merges registered scans into one mesh and into thinner clouds, block by block of space, with memory for only one
block.

Each scan is read once, thinned to the mesh's cells and written to the blocks that it touches. The surface is where
the signed distance passes through zero. This distance is the weighted mean over the points around (implicit moving
least squares: Kolluri, ACM Trans. Algorithms 4(2), 2008); marching cubes (scikit-image) find the surface. Blocks
share their outer corners, so that meshes of neighbouring blocks meet in the same vertices.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from coupole.errors import ExtraMissing, InputError
from coupole.scan.registration.extra import registration_libraries
from coupole.scan.registration.merged_colours import around, encode_srgb, linear_light
from coupole.scan.registration.prepared_scan import NEIGHBOURS, PreparedScan, vertex_normals
from coupole.scan.registration.scan_files import read_scan
from coupole.scan.registration.small_motions import moved_points
from coupole.scan.registration.viewpoint import Floats

Say = Callable[[str, int, int], None]
BLOCK_CELLS = 64
_REACH_CELLS = 3.0
"""Greatest distance, in cells, at which a point affects a corner."""
_KERNEL_CELLS = 1.0
_NEAR_CELLS, _COVERED_CELLS = 2.5, 1.3
"""Greatest distances, in cells, from the nearest point: of a corner with a distance, and of a triangle that is
kept."""
_MOST_NEIGHBOURS = 32
_STEEPEST = 0.2
"""Cosine of incidence below which points are left out, because the scanner smears them over rims."""
_RECORD = np.dtype([("point", "<f4", 3), ("normal", "<f4", 3), ("weight", "<f4"), ("light", "<f4", 4)])
"""Record of a point; `light` is that of `linear_light`."""
_COLOURS_HEAD = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
_FACE = np.dtype([("corners", "u1"), ("indices", "<u4", 3)])
_CHUNK = 2_000_000


@dataclass
class Merged:
    """Counts and sizes of the written files."""

    vertices: int = 0
    triangles: int = 0
    points: int = 0
    """Number of points that were read from all scans."""
    cell_mm: float = 0.0
    has_colours: bool = False
    """True if a scan had colours; mesh and clouds then have them too."""
    levels: dict[str, int] = field(default_factory=dict)
    """Number of points of each thinner cloud, by the name of its file."""


def default_cell_mm(scans: Sequence[PreparedScan]) -> float:
    """Return 1.5 times the spacing of the scans' points."""
    return 1.5 * float(np.median([scan.survey.spacing_mm for scan in scans]))


def merge(
    scans: Sequence[PreparedScan],
    common_from_scan: Sequence[Floats],
    unit: str,
    cell_mm: float,
    levels_mm: Sequence[float],
    folder: Path,
    say: Say,
) -> Merged:
    """Write `mesh.ply` and a cloud for each level that is coarser than the cells. Raises InputError,
    ExtraMissing."""
    blocks = folder / "blocks"
    blocks.mkdir()
    summary = Merged(cell_mm=cell_mm)
    for number, (scan, pose) in enumerate(zip(scans, common_from_scan, strict=True)):
        say("distributing points", number, len(scans))
        summary.points += scan.survey.count
        records = _records(scan, pose, unit, cell_mm)
        summary.has_colours |= bool(records["light"][:, 3].any())
        _distribute(records, cell_mm, blocks)
    say("distributing points", len(scans), len(scans))
    clouds = {
        f"points-{level:g}mm.ply": _Level(level, has_colours=summary.has_colours)
        for level in levels_mm
        if level > cell_mm
    }
    files = sorted(blocks.iterdir())
    with _MeshFile(folder, has_colours=summary.has_colours) as mesh:
        for number, path in enumerate(files):
            say("merging blocks", number, len(files))
            block = np.array([int(word) for word in path.stem.split("_")])
            records = np.fromfile(path, _RECORD)
            vertices, triangles = _surface(records, block, cell_mm)
            mesh.add(vertices, triangles, block, _shades(records, vertices, block, cell_mm))
            in_block = np.all(_block_of(records["point"], cell_mm) == block, axis=1)
            for level in clouds.values():
                level.add(records[in_block])
            path.unlink()
        say("merging blocks", len(files), len(files))
        summary.vertices, summary.triangles = mesh.write(folder / "mesh.ply", cell_mm)
    blocks.rmdir()
    for name, level in clouds.items():
        summary.levels[name] = level.write(folder / name)
    if summary.triangles == 0:
        raise InputError(f"no surface in cells of {cell_mm:g} mm: choose larger ones with --mesh-mm")
    return summary


def _records(scan: PreparedScan, pose: Floats, unit: str, cell_mm: float) -> NDArray[np.void]:
    """Yield a scan's points, one for each cell, in the common frame."""
    small_gicp, _ = registration_libraries()
    content = read_scan(scan.source, unit, colours=True)
    whole = content.mesh
    points_mm = whole.vertices.astype(np.float64)
    middle = points_mm.mean(axis=0)
    thin = small_gicp.voxelgrid_sampling(points_mm - middle, cell_mm)
    small_gicp.estimate_normals(thin, num_neighbors=min(NEIGHBOURS, len(thin.points())))
    points = np.ascontiguousarray(thin.points()[:, :3]) + middle
    normals = np.ascontiguousarray(thin.normals()[:, :3])
    stored_normals = vertex_normals(whole)
    if scan.viewpoint.stand != "none":
        outward = scan.viewpoint.towards(points)
    elif stored_normals is not None:
        outward = stored_normals[cKDTree(points_mm).query(points)[1]]
    else:
        raise InputError(
            f"{scan.source}: neither triangles nor a viewpoint show which side of its surface is outside; state "
            "the scanner's place with --seen-from, or leave out the mesh with --no-mesh"
        )
    incidence = np.sum(normals * outward, axis=1)
    normals *= np.where(incidence < 0, -1.0, 1.0)[:, None]
    keep = np.abs(incidence) > _STEEPEST
    records = np.empty(int(keep.sum()), _RECORD)
    records["point"] = moved_points(pose, points[keep])
    records["normal"] = normals[keep] @ pose[:3, :3].T
    records["weight"] = np.abs(incidence[keep])
    records["light"] = 0.0
    if content.srgba is not None:
        records["light"] = around(points_mm, linear_light(content.srgba), points[keep], cell_mm, cell_mm / 2)
        records["light"] /= np.maximum(records["light"][:, 3:], 1e-12)
    return records


def _block_of(points: NDArray[np.float32], cell_mm: float) -> NDArray[np.int64]:
    return np.floor(points.astype(np.float64) / (cell_mm * BLOCK_CELLS)).astype(np.int64)


def _distribute(records: NDArray[np.void], cell_mm: float, folder: Path) -> None:
    """Append records to the files of all blocks that they touch or nearly touch."""
    margin = _REACH_CELLS * cell_mm
    points = records["point"].astype(np.float64)
    low, high = (np.floor((points + d) / (cell_mm * BLOCK_CELLS)).astype(np.int64) for d in (-margin, margin))
    for choice in range(8):
        ends = np.stack([(high if choice >> axis & 1 else low)[:, axis] for axis in range(3)], axis=1)
        is_double = np.zeros(len(points), bool)
        for axis in range(3):
            if choice >> axis & 1:
                is_double |= high[:, axis] == low[:, axis]
        ends, block_records = ends[~is_double], records[~is_double]
        if not len(block_records):
            continue
        blocks, number = np.unique(ends, axis=0, return_inverse=True)
        order = np.argsort(number.reshape(-1), kind="stable")
        borders = np.searchsorted(number.reshape(-1)[order], np.arange(len(blocks) + 1))
        for k, block in enumerate(blocks):
            with (folder / "{}_{}_{}.bin".format(*block)).open("ab") as file:
                block_records[order[borders[k] : borders[k + 1]]].tofile(file)


def _surface(
    records: NDArray[np.void], block: NDArray[np.int64], cell_mm: float
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return vertices [n, 3], in cells from the block's first corner, and triangles [m, 3]."""
    try:
        from skimage import measure
    except ImportError as error:
        raise ExtraMissing(f"merging needs scikit-image: pip install 'coupole[registration]' ({error})") from error
    nothing = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)
    points = records["point"].astype(np.float64) / cell_mm - block * BLOCK_CELLS
    near = _corners_near(points)
    corners = np.argwhere(near)
    if not len(corners):
        return nothing
    tree = cKDTree(points)
    reach, nearest = tree.query(corners, min(_MOST_NEIGHBOURS, len(points)), distance_upper_bound=_REACH_CELLS)
    reach, nearest = reach.reshape(len(corners), -1), nearest.reshape(len(corners), -1)
    there = np.isfinite(reach)
    nearest = np.where(there, nearest, 0)
    weights = np.where(there, records["weight"][nearest] * np.exp(-((reach / _KERNEL_CELLS) ** 2)), 0.0)
    off = np.einsum("nka,nka->nk", corners[:, None] - points[nearest], records["normal"][nearest])
    is_known = (reach[:, 0] < _NEAR_CELLS) & (weights.sum(axis=1) > 0)
    field_values = np.full(near.shape, np.nan, np.float32)
    means = np.sum(weights * off, axis=1)[is_known] / weights.sum(axis=1)[is_known]
    field_values[tuple(corners[is_known].T)] = means
    valid = np.isfinite(field_values)
    cubes = ndimage.minimum_filter(valid.astype(np.uint8), 2, origin=-1)[:-1, :-1, :-1] > 0
    if not cubes.any() or not (np.nanmin(field_values) < 0 < np.nanmax(field_values)):
        return nothing
    filled_field = np.where(valid, field_values, np.float32(_REACH_CELLS))
    draw: Any = measure.marching_cubes
    vertices, triangles, _, _ = draw(filled_field, 0.0, gradient_direction="descent")
    inside = np.floor(vertices[triangles].astype(np.float64).mean(axis=1)).astype(np.int64)
    inside = np.clip(inside, 0, BLOCK_CELLS - 1)
    triangles = triangles[cubes[tuple(inside.T)]]
    middles = vertices[triangles].astype(np.float64).mean(axis=1)
    triangles = triangles[np.isfinite(tree.query(middles, distance_upper_bound=_COVERED_CELLS)[0])]
    used_rows, triangles = np.unique(triangles, return_inverse=True)
    return vertices[used_rows], triangles.reshape(-1, 3)


def _shades(
    records: NDArray[np.void], vertices: NDArray[np.float32], block: NDArray[np.int64], cell_mm: float
) -> NDArray[np.uint8]:
    """[n, 3] sRGB colours of vertices, which are in cells from a block's first corner."""
    if not len(vertices) or not records["light"][:, 3].any():
        return np.zeros((len(vertices), 3), np.uint8)
    lit = records[records["light"][:, 3] > 0]
    points = lit["point"].astype(np.float64) / cell_mm - block * BLOCK_CELLS
    light = lit["light"] * lit["weight"][:, None].astype(np.float64)
    return encode_srgb(around(points, light, vertices.astype(np.float64), _REACH_CELLS, _KERNEL_CELLS))


def _corners_near(points: Floats) -> NDArray[np.bool_]:
    """[65, 65, 65] corners of a block that have a point within three cells along each axis."""
    margin = 4
    count = BLOCK_CELLS + 1 + 2 * margin
    cells = np.round(points).astype(np.int64) + margin
    cells = cells[np.all((cells >= 0) & (cells < count), axis=1)]
    is_near = np.zeros((count,) * 3, bool)
    is_near[tuple(cells.T)] = True
    is_near = ndimage.maximum_filter(is_near, 7)
    return np.asarray(is_near[margin:-margin, margin:-margin, margin:-margin])


class _MeshFile:
    """A mesh that grows on the disk; vertices on the borders of blocks are welded at the end."""

    def __init__(self, folder: Path, *, has_colours: bool) -> None:
        self._coloured = has_colours
        self._shades: list[NDArray[np.uint8]] = []
        self._vertices_path, self._faces_path = folder / "vertices.part", folder / "faces.part"
        self._keys: list[NDArray[np.int64]] = []
        self._numbers: list[NDArray[np.int64]] = []
        self._count = self._triangles = 0

    def __enter__(self) -> _MeshFile:
        self._vertices, self._faces = self._vertices_path.open("wb"), self._faces_path.open("wb")
        return self

    def __exit__(self, *_: object) -> None:
        self._vertices.close()
        self._faces.close()
        self._vertices_path.unlink(missing_ok=True)
        self._faces_path.unlink(missing_ok=True)

    def add(
        self,
        vertices: NDArray[np.float32],
        triangles: NDArray[np.int64],
        block: NDArray[np.int64],
        shades: NDArray[np.uint8],
    ) -> None:
        """Add vertices in cells from the first corner of a block, triangles of them, and colours [n, 3]."""
        if not len(triangles):
            return
        whole = np.round(vertices)
        rim = np.flatnonzero(np.any((np.abs(vertices - whole) < 1e-6) & (whole % BLOCK_CELLS == 0), axis=1))
        self._keys.append(_edge_keys(vertices[rim], block))
        self._numbers.append(self._count + rim)
        (vertices.astype(np.float64) + block * BLOCK_CELLS).tofile(self._vertices)
        if self._coloured:
            self._shades.append(shades)
        (triangles + self._count).astype("<i8").tofile(self._faces)
        self._count += len(vertices)
        self._triangles += len(triangles)

    def write(self, path: Path, cell_mm: float) -> tuple[int, int]:
        """Write the mesh; return the numbers of its vertices and triangles."""
        self._vertices.flush()
        self._faces.flush()
        stands_for = np.arange(self._count, dtype=np.int64)
        if self._keys:
            numbers = np.concatenate(self._numbers)
            _, first, back = np.unique(np.concatenate(self._keys), axis=0, return_index=True, return_inverse=True)
            stands_for[numbers] = numbers[first[back.reshape(-1)]]
        keep = stands_for == np.arange(self._count)
        new_numbers = (np.cumsum(keep) - 1)[stands_for]
        every = np.concatenate(self._shades or [np.zeros((0, 3), np.uint8)])
        with path.open("wb") as file:
            file.write(
                (
                    "ply\nformat binary_little_endian 1.0\ncomment mm\n"
                    f"element vertex {int(keep.sum())}\nproperty float x\nproperty float y\nproperty float z\n"
                    f"{_COLOURS_HEAD if self._coloured else ''}"
                    f"element face {self._triangles}\nproperty list uchar uint vertex_indices\nend_header\n"
                ).encode()
            )
            for first_row in range(0, self._count, _CHUNK):
                part = np.fromfile(self._vertices_path, "<f8", 3 * _CHUNK, offset=24 * first_row).reshape(-1, 3)
                keep_part = keep[first_row : first_row + _CHUNK]
                shades = every[first_row : first_row + _CHUNK][keep_part] if self._coloured else None
                _write_points(file, part[keep_part] * cell_mm, shades)
            for first_row in range(0, self._triangles, _CHUNK):
                corners = np.fromfile(self._faces_path, "<i8", 3 * _CHUNK, offset=24 * first_row).reshape(-1, 3)
                faces = np.empty(len(corners), _FACE)
                faces["corners"], faces["indices"] = 3, new_numbers[corners]
                faces.tofile(file)
            file.flush()
            os.fsync(file.fileno())
        return int(keep.sum()), self._triangles


def _write_points(file: BinaryIO, points: Floats, shades: NDArray[np.uint8] | None) -> None:
    if shades is None:
        points.astype("<f4").tofile(file)
        return
    rows = np.empty(len(points), [("point", "<f4", 3), ("shade", "u1", 3)])
    rows["point"], rows["shade"] = points, shades
    rows.tofile(file)


def _edge_keys(vertices: NDArray[np.float32], block: NDArray[np.int64]) -> NDArray[np.int64]:
    """[n, 4] keys of vertices, each of which lies on an edge of the grid: the edge's first corner, and its
    direction."""
    off = np.abs(vertices - np.round(vertices))
    along = np.argmax(off, axis=1)
    corner = np.round(vertices).astype(np.int64)
    rows = np.arange(len(vertices))
    corner[rows, along] = np.floor(vertices[rows, along]).astype(np.int64)
    along = np.where(off[rows, along] < 1e-6, 3, along)
    return np.concatenate([corner + block * BLOCK_CELLS, along[:, None]], axis=1)


class _Level:
    """A cloud with one point for each cell of a grid: the mean of the cell's points."""

    def __init__(self, pitch_mm: float, *, has_colours: bool) -> None:
        self._coloured = has_colours
        self._pitch_mm = pitch_mm
        self._keys: list[NDArray[np.int64]] = []
        self._sums: list[Floats] = []

    def add(self, records: NDArray[np.void]) -> None:
        cells = np.floor(records["point"].astype(np.float64) / self._pitch_mm).astype(np.int64)
        keys, number = np.unique(cells, axis=0, return_inverse=True)
        columns = np.concatenate([records["point"], np.ones((len(records), 1)), records["light"]], axis=1)
        self._keys.append(keys)
        self._sums.append(np.stack([np.bincount(number.reshape(-1), c, len(keys)) for c in columns.T], axis=1))

    def write(self, path: Path) -> int:
        keys, number = np.unique(np.concatenate(self._keys), axis=0, return_inverse=True)
        sums = np.concatenate(self._sums)
        whole: Floats = np.stack([np.bincount(number.reshape(-1), c, len(keys)) for c in sums.T], axis=1).astype(
            np.float64
        )
        points = whole[:, :3] / whole[:, 3:4]
        with path.open("wb") as file:
            file.write(
                (
                    "ply\nformat binary_little_endian 1.0\ncomment mm\n"
                    f"element vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
                    f"{_COLOURS_HEAD if self._coloured else ''}end_header\n"
                ).encode()
            )
            _write_points(file, points, encode_srgb(whole[:, 4:]) if self._coloured else None)
        return len(points)
