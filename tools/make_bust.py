"""Makes configs/restorations/bust.ply: a crowned bust whose parts are marked by colours, for an example of
restoration.

`python tools/make_bust.py [--cell-mm 2.8] [--out FILE]`. It portrays nobody: it is a union of rounded bodies,
whose common surface is found by marching cubes (Lorensen and Cline 1987). Lengths are mm; z is up, and the face
looks to -y.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
LOW_MM, HIGH_MM = np.array([-176.0, -128.0, -4.0]), np.array([176.0, 118.0, 424.0])
COLOURS = {
    "pedestal": "808080",
    "mantle": "2040c0",
    "tunic": "c04020",
    "border": "e0c020",
    "skin": "f0c0a0",
    "lips": "d05060",
    "eyes": "ffffff",
    "hair": "a07020",
    "crown": "ffd000",
}
Field = NDArray[np.float32]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cell-mm", type=float, default=2.8)
    parser.add_argument("--out", type=Path, default=ROOT / "configs/restorations/bust.ply")
    options = parser.parse_args()
    points_mm, triangles = surface(options.cell_mm)
    distances = np.stack(list(bodies(points_mm.astype(np.float32)).values()))
    codes = np.array([list(bytes.fromhex(code)) for code in COLOURS.values()], np.uint8)
    mesh = trimesh.Trimesh(points_mm, triangles, vertex_colors=codes[distances.argmin(axis=0)], process=False)
    mesh.export(options.out)
    print(f"{options.out}: {len(triangles)} triangles, {options.out.stat().st_size / 1e6:.1f} MB")


def whole(places: Field) -> Field:
    """Distances in mm of places [..., 3] from the bust's surface, negative inside."""
    parts = bodies(places)
    head = _smooth_union(parts["skin"], parts["lips"], 2.5)
    head = _smooth_union(head, parts["eyes"], 1.0)
    head = _smooth_union(head, parts["hair"], 4.0)
    robe = _smooth_union(_smooth_union(parts["tunic"], parts["mantle"], 5.0), parts["border"], 2.0)
    with_crown = _smooth_union(_smooth_union(head, robe, 6.0), parts["crown"], 1.5)
    return _smooth_union(with_crown, parts["pedestal"], 3.0)


def surface(
    cell_mm: float, body: Callable[[Field], Field] = whole
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices [n, 3] and triangles [m, 3] of a body, outwards counter-clockwise."""
    from skimage import measure

    marching_cubes: Any = measure.marching_cubes  # this library has no types
    corners_mm = zip(LOW_MM.tolist(), HIGH_MM.tolist(), strict=True)
    axes = [np.arange(low, high, cell_mm, dtype=np.float32) for low, high in corners_mm]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    points, faces, _, _ = marching_cubes(body(grid), 0.0, spacing=(cell_mm,) * 3, gradient_direction="descent")
    return points.astype(float) + LOW_MM, faces.astype(np.int64)


def bodies(p: Field) -> dict[str, Field]:
    """Distances in mm of places [..., 3] from each part's surface, negative inside, by the names of `COLOURS`."""
    x, y, z = np.moveaxis(p, -1, 0)
    side = np.stack([np.abs(x), y, z], axis=-1)
    turn = np.arctan2(y - 5.0, x)
    return {
        "pedestal": _pedestal(x, y, z),
        "mantle": _mantle(x, y, z, turn),
        "tunic": np.maximum(ellipsoid(p, (0, 2, 122), (98, 64, 98)), 46.0 - z)
        + 1.5 * np.cos(24.0 * turn) * _ramp(z, 215, 150),
        "border": _border(p, turn),
        "skin": _skin(p, side),
        "lips": _lips(p, side),
        "eyes": ellipsoid(side, (23, -66.5, 316), (12.5, 12.5, 10.0)),
        "hair": _hair(p, side),
        "crown": _crown(x, y, z),
    }


def _pedestal(x: Field, y: Field, z: Field) -> Field:
    across = np.sqrt((x / 1.35) ** 2 + (y - 5.0) ** 2)
    profile = 78.0 - 9.0 * _ramp(z, 12, 20) + 7.0 * _ramp(z, 34, 44)
    return np.asarray(np.maximum(across - profile, np.abs(z - 24.0) - 24.0))


def _mantle(x: Field, y: Field, z: Field, turn: Field) -> Field:
    """Return a mantle over the shoulders, open in front, in folds that deepen downwards."""
    down = _ramp(z, 225, 60)
    folds = 6.5 * down * np.sin(13.0 * turn + 0.03 * z) + 3.0 * down * np.sin(29.0 * turn + 1.3 - 0.05 * z)
    side = np.stack([np.abs(x), y, z], axis=-1)
    chest = ellipsoid(side, (0, 8, 105), (128, 76, 92))
    body = _smooth_union(chest, _segment(side, (18, 12, 186), (106, 14, 146), 36.0, 40.0), 30.0) + folds
    edge = np.abs(x) - (26.0 + 0.42 * np.maximum(200.0 - z, 0.0) + 4.0 * np.sin(0.09 * z))
    open_mantle = smooth_difference(body, np.maximum(edge, y + 20.0), 7.0)
    return np.asarray(np.maximum(open_mantle, 46.0 - z))


def _border(p: Field, turn: Field) -> Field:
    x, y, z = np.moveaxis(p, -1, 0)
    ring = np.sqrt((np.sqrt((x / 1.12) ** 2 + (y + 4.0) ** 2) - 57.0) ** 2 + ((z - 213.0 + 0.18 * -y) * 0.75) ** 2)
    return np.asarray(ring - 6.5 - 0.9 * np.cos(30.0 * turn))


def _skin(p: Field, side: Field) -> Field:
    skull = ellipsoid(p, (0, -8, 322), (58, 68, 70))
    jaw = ellipsoid(p, (0, -30, 283), (43, 45, 50))
    head = _smooth_union(skull, jaw, 22.0)
    head = _smooth_union(head, ellipsoid(side, (28, -56, 291), (19, 18, 20)), 12.0)
    head = _smooth_union(head, ellipsoid(p, (0, -68, 246), (15, 11, 12)), 10.0)
    head = smooth_difference(head, ellipsoid(side, (24, -84, 318), (15, 11, 10)), 8.0)
    brow = _segment(side, (9, -77, 333), (40, -62, 331), 5.0, 4.0)
    head = _smooth_union(head, brow, 9.0)
    nose = _segment(p, (0, -74, 329), (0, -87, 293), 4.5, 6.8)
    wings = ellipsoid(side, (7.5, -78, 289), (6, 7.5, 5.5))
    head = _smooth_union(_smooth_union(head, nose, 8.0), wings, 4.0)
    lids = np.maximum(ellipsoid(side, (23, -66.5, 316), (15.5, 14.6, 12.2)), 318.5 - p[..., 2])
    lower = np.maximum(ellipsoid(side, (23, -66.5, 316), (14.6, 13.6, 11.4)), p[..., 2] - 310.5)
    head = _smooth_union(_smooth_union(head, lids, 3.0), lower, 3.0)
    neck = _segment(p, (0, 4, 185), (0, -8, 280), 44.0, 40.0)
    return _smooth_union(head, neck, 12.0)


def _lips(p: Field, side: Field) -> Field:
    upper = _smooth_union(
        _segment(side, (4, -76.5, 272.5), (17, -68.5, 268), 4.2, 2.2),
        ellipsoid(p, (0, -77, 271), (5, 4, 3.2)),
        3.0,
    )
    lower = _segment(side, (0, -75.5, 264.5), (14, -69, 266.5), 4.6, 2.4)
    return _smooth_union(upper, lower, 1.0)


def _hair(p: Field, side: Field) -> Field:
    """A cap without the face, and locks that fall to the shoulders."""
    x, y, z = np.moveaxis(p, -1, 0)
    strands = 1.9 * np.sin(0.55 * np.abs(x) + 0.16 * z + 3.0 * np.sin(0.045 * z))
    cap = ellipsoid(p, (0, 2, 322), (69, 76, 76)) + strands
    cap = smooth_difference(cap, ellipsoid(p, (0, -84, 298), (50, 62, 62)), 6.0)
    wave = np.sin(0.105 * z)
    shifted_side = side - np.stack([5.0 * wave, 7.0 * np.cos(0.105 * z), 0.0 * z], axis=-1)
    lock = _segment(shifted_side, (60, -14, 330), (74, -2, 232), 17.0, 19.0)
    curl = ellipsoid(side, (78, -8, 222), (22, 22, 19))
    lock = _smooth_union(lock, curl, 10.0) + 2.3 * np.sin(0.5 * np.abs(x) - 0.42 * y + 0.3 * z)
    back = _segment(p, (0, 48, 320), (0, 58, 215), 44.0, 48.0) + strands
    return _smooth_union(_smooth_union(cap, lock, 7.0), back, 12.0)


def _crown(x: Field, y: Field, z: Field) -> Field:
    """A band with a rim, and eight leaves above it."""
    turn = np.arctan2(y - 1.0, x)
    across = np.sqrt((x / 0.93) ** 2 + (y - 1.0) ** 2)
    wall = np.abs(across - 79.0) - 3.0
    beads = 1.6 * np.cos(16.0 * turn) * _ramp(np.abs(z - 361.0), 4.0, 2.0)
    band = np.maximum(wall - beads, np.abs(z - 361.0) - 10.0)
    rims = np.minimum(np.hypot(across - 79.0, z - 351.0) - 4.6, np.hypot(across - 79.0, z - 371.0) - 4.2)
    along = 79.0 * (np.mod(turn + np.pi / 8.0 + np.pi / 2.0, np.pi / 4.0) - np.pi / 8.0)
    stem = np.abs(along) - 4.5
    leaf = np.minimum(np.hypot(along, (z - 392.0) * 0.62) - 8.5, np.hypot(np.abs(along) - 11.5, z - 386.0) - 6.5)
    leaves = np.maximum(np.minimum(np.maximum(stem, np.abs(z - 380.0) - 12.0), leaf), np.abs(across - 80.0) - 3.4)
    return np.asarray(np.minimum(np.minimum(band, rims), leaves))


# -- distances and how they are joined ------------------------------------------------------------------------


def ellipsoid(p: Field, middle: tuple[float, float, float], radii: tuple[float, float, float]) -> Field:
    """Ellipsoid; near its surface the value is a distance (Quilez, Distance functions)."""
    way = (p - np.array(middle, np.float32)) / np.array(radii, np.float32)
    share = np.linalg.norm(way, axis=-1)
    slope = np.linalg.norm(way / np.array(radii, np.float32), axis=-1)
    return np.asarray(share * (share - 1.0) / np.maximum(slope, 1e-6))


def _segment(
    p: Field, start: tuple[float, float, float], end: tuple[float, float, float], first: float, last: float
) -> Field:
    """A round body from one place to another, whose radius goes from `first` to `last`."""
    a, way = np.array(start, np.float32), np.subtract(end, start).astype(np.float32)
    share = np.clip((p - a) @ way / (way @ way), 0.0, 1.0)
    return np.asarray(np.linalg.norm(p - a - share[..., None] * way, axis=-1) - first - share * (last - first))


def _smooth_union(a: Field, b: Field, round_mm: float) -> Field:
    """Return the union of both bodies, with a fillet of about `round_mm` between them (Quilez' smooth minimum)."""
    share = np.clip(0.5 + 0.5 * (b - a) / round_mm, 0.0, 1.0)
    return np.asarray(b + share * (a - b) - round_mm * share * (1.0 - share))


def smooth_difference(a: Field, b: Field, round_mm: float) -> Field:
    """Return the part of `a` that is not in `b`, with a rounded edge."""
    return -_smooth_union(-a, b, round_mm)


def _ramp(t: Field, start: float, end: float) -> Field:
    """Return 0 below `start`, 1 above `end`, and 3 s^2 - 2 s^3 between."""
    share = np.clip((t - start) / (end - start), 0.0, 1.0)
    return np.asarray(share * share * (3.0 - 2.0 * share))


if __name__ == "__main__":
    main()
