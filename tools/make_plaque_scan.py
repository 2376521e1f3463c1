"""Writes the showpiece's mesh as a laser scanner would: triangles of 0.3 mm, noise, holes, nothing of the colours.

    python tools/make_plaque_scan.py [--output configs/objects/plaque.ply]

The true surface is `sim.objects.plaque`. Points of a jittered grid are measured along z with noise of 30 um.
Neighbours share most of the noise, as after a scanner has merged its sweeps. The sheet is triangulated by
Delaunay. It has holes where the black lacquer reflects like a mirror, and where curls and fringe hide the ground.
Walls go down to the support; there is no back. The same code gives the same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim.objects.plaque_relief import PLAQUE_MM, height_mm

PITCH_MM = 0.3
"""Mean distance of neighbouring points in x and y."""
JITTER = 0.22
"""Greatest shift of a point from its node, in pitches."""
NOISE_UM = 30.0
"""Standard deviation of a height."""
SHARED, SHARED_OVER_MM = 0.95, 0.6
"""Share of the noise that neighbours have in common, and standard deviation, mm, of the filter that correlates
it."""
HOLES_MM = (
    (-44.6, 17.5, 1.3), (-38.2, -6.4, 1.0), (-41.0, -20.6, 1.6), (-47.3, 28.4, 0.8), (-9.3, 15.8, 0.7),
    (10.8, 18.2, 0.8), (12.6, 8.9, 0.9), (39.3, -25.2, 1.1),
)  # fmt: skip
"""Middle and radius of each hole: in lacquer, between curls, under the fringe."""
SEED = 7
DEFAULT_OUTPUT = Path(__file__).resolve().parents[1] / "configs" / "objects" / "plaque.ply"


def scan(pitch_mm: float = PITCH_MM) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [n, 3] in mm and triangles [m, 3], counter-clockwise seen from outside."""
    random = np.random.default_rng(SEED)
    x, y = _grid(random, pitch_mm)
    z = height_mm(x, y) + _noise_mm(random, x.shape, pitch_mm)
    sheet = np.stack([x, y, z], axis=-1)
    faces = _triangles(sheet.reshape(-1, 3))
    faces = faces[~_in_hole(sheet.reshape(-1, 3)[faces].mean(axis=1))]
    index = np.arange(x.size).reshape(x.shape)
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    foot = x.size + np.arange(len(rim))
    next_rim, next_foot = np.roll(rim, -1), np.roll(foot, -1)
    walls = [np.stack(corners, axis=-1) for corners in ((rim, foot, next_foot), (rim, next_foot, next_rim))]
    points = np.concatenate([sheet.reshape(-1, 3), sheet.reshape(-1, 3)[rim] * [1.0, 1.0, 0.0]])
    return _without_loose_points(np.round(points, 3), np.concatenate([faces, *walls]))


def scan_ply(pitch_mm: float = PITCH_MM) -> bytes:
    """The mesh as binary little-endian PLY."""
    vertices, triangles = scan(pitch_mm)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment simulated scan of a plaque, mm, z up, back at z = 0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, triangles
    return header.encode("ascii") + vertices.tobytes() + records.tobytes()


def _grid(random: np.random.Generator, pitch_mm: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places [rows, columns] of a jittered grid whose border lies on the plaque's edges."""
    columns, rows = (round(length_mm / pitch_mm) for length_mm in PLAQUE_MM)
    half_x, half_y = 0.5 * PLAQUE_MM[0], 0.5 * PLAQUE_MM[1]
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns + 1), np.linspace(-half_y, half_y, rows + 1))
    shift_mm = random.uniform(-JITTER * pitch_mm, JITTER * pitch_mm, (2, *x.shape))
    x[:, 1:-1] += shift_mm[0][:, 1:-1]
    y[1:-1] += shift_mm[1][1:-1]
    return x, y


def _noise_mm(random: np.random.Generator, shape: tuple[int, ...], pitch_mm: float) -> NDArray[np.float64]:
    """Errors [rows, columns] of heights, of standard deviation `NOISE_UM`."""
    from scipy.ndimage import gaussian_filter

    alone, common = random.standard_normal((2, *shape))
    common = gaussian_filter(common, SHARED_OVER_MM / pitch_mm, mode="wrap")
    common /= common.std()
    noise_mm = 1e-3 * NOISE_UM * (np.sqrt(SHARED) * common + np.sqrt(1.0 - SHARED) * alone)
    return np.asarray(noise_mm)


def _triangles(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangles [m, 3] of points by Delaunay in x and y, counter-clockwise seen from above."""
    from scipy.spatial import Delaunay

    faces: NDArray[np.int64] = Delaunay(points[:, :2]).simplices.astype(np.int64)
    a, b, c = (points[faces[:, k], :2] for k in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    faces[area < 0.0] = faces[area < 0.0][:, ::-1]
    return np.asarray(faces[np.abs(area) > 1e-9])


def _in_hole(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """True at places [n, 3] in a hole; holes have ragged edges."""
    inside = np.zeros(len(places), bool)
    for centre_x, centre_y, radius_mm in HOLES_MM:
        to_x, to_y = places[:, 0] - centre_x, places[:, 1] - centre_y
        angle = np.arctan2(to_y, to_x)
        ragged_mm = radius_mm * (1.0 + 0.25 * np.sin(3.0 * angle + centre_x) + 0.12 * np.sin(7.0 * angle))
        inside |= np.hypot(to_x, to_y) < ragged_mm
    return inside


def _without_loose_points(
    points: NDArray[np.float64], faces: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the mesh without points that belong to no triangle."""
    in_use, new_numbers = np.unique(faces, return_inverse=True)
    return points[in_use].astype("<f4"), new_numbers.reshape(-1, 3).astype("<i4")


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Write the scan of the showpiece.")
    parser.add_argument("--output", type=Path, default=DEFAULT_OUTPUT)
    parser.parse_args(arguments).output.write_bytes(scan_ply())


if __name__ == "__main__":
    main()
