"""Writes the demonstration object: a sculpted relief tile, 160 x 120 mm and 60 mm high, as a PLY mesh in mm.

    python tools/make_relief.py [--output configs/objects/relief.ply]

Object frame: z up, bottom at z = 0, origin below the middle. Seen from above with x to the right, an F is on the
left, three round bosses of three sizes are on the right, and stairs rise along the lower edge towards +x. So no
rotation and no mirror image looks the same. The mesh is closed. The same code gives the same bytes.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

WIDTH_MM, DEPTH_MM = 160.0, 120.0
COLUMNS, ROWS = 112, 84
PLATE_MM = 12.0
F_HEIGHT_MM, F_FLANK_MM = 36.0, 5.0
F_BARS_MM = ((-56.0, 8.0, 8.0, 42.0), (-34.0, 42.0, 30.0, 8.0), (-40.0, 10.0, 24.0, 8.0))
"""The strokes of the F: centre x, centre y, half width, half depth at the foot of the flanks."""
BOSSES_MM = ((22.0, 38.0, 12.0), (56.0, 30.0, 18.0), (38.0, -4.0, 14.0))
"""Bosses: centre x, centre y, radius of the hemisphere."""
PEDESTAL_MM = 30.0
"""Height of the shaft that raises the tallest boss to the full height of 60 mm."""
STAIRS = 4
STAIR_X_MM, STAIR_Y_MM, STAIR_LENGTH_MM, STAIR_RISE_MM = -40.0, -48.0, 24.0, 7.0
STAIR_HALF_DEPTH_MM, STAIR_FLANK_MM = 9.0, 3.0
DEFAULT_OUTPUT = Path(__file__).resolve().parents[1] / "configs" / "objects" / "relief.ply"

Heights = NDArray[np.float64]


def smooth_step(t: Heights) -> Heights:
    """Return 0 below 0, 1 above 1, and 3 t^2 - 2 t^3 between: flanks without creases."""
    t = np.clip(t, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def bar(x: Heights, y: Heights, place_mm: tuple[float, float, float, float], flank_mm: float) -> Heights:
    """Return 1 on a rectangle, falling to 0 over its flanks."""
    centre_x, centre_y, half_width, half_depth = place_mm
    inside_mm = np.minimum(half_width - np.abs(x - centre_x), half_depth - np.abs(y - centre_y))
    return smooth_step(inside_mm / flank_mm)


def height_mm(x: Heights, y: Heights) -> Heights:
    """Height of the relief above z = 0 at points of the tile, all in mm."""
    f_ridge = F_HEIGHT_MM * np.max([bar(x, y, place, F_FLANK_MM) for place in F_BARS_MM], axis=0)
    forms = [f_ridge]
    for index, (centre_x, centre_y, radius) in enumerate(BOSSES_MM):
        distance_squared = (x - centre_x) ** 2 + (y - centre_y) ** 2
        boss = np.sqrt(np.maximum(radius**2 - distance_squared, 0.0))
        if index == 1:
            boss += PEDESTAL_MM * smooth_step((radius + 3.0 - np.sqrt(distance_squared)) / 3.0)
        forms.append(boss)
    for stair in range(STAIRS):
        left_mm, right_mm = STAIR_X_MM + stair * STAIR_LENGTH_MM, STAIR_X_MM + STAIRS * STAIR_LENGTH_MM
        middle, half = (left_mm + right_mm) / 2, (right_mm - left_mm) / 2
        place = (middle, STAIR_Y_MM, half, STAIR_HALF_DEPTH_MM)
        forms.append((stair + 1) * STAIR_RISE_MM * bar(x, y, place, STAIR_FLANK_MM))
    heights: Heights = np.round(PLATE_MM + np.max(forms, axis=0), 3)
    return heights


def relief(columns: int = COLUMNS, rows: int = ROWS) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [n, 3] in mm and triangles [m, 3], counter-clockwise seen from outside, two for each cell of a
    grid."""
    xs = np.linspace(-WIDTH_MM / 2, WIDTH_MM / 2, columns + 1)
    ys = np.linspace(-DEPTH_MM / 2, DEPTH_MM / 2, rows + 1)
    x, y = np.meshgrid(xs, ys)
    top = np.stack([x, y, height_mm(x, y)], axis=-1).reshape(-1, 3)
    index = np.arange(len(top)).reshape(rows + 1, columns + 1)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))]

    # The rim, counter-clockwise seen from above. Below it there is a wall, closed by a fan around the middle.
    rim = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    foot = len(top) + np.arange(len(rim))
    middle = np.full(len(rim), len(top) + len(rim))
    next_rim, next_foot = np.roll(rim, -1), np.roll(foot, -1)
    wall_and_bottom = ((rim, foot, next_foot), (rim, next_foot, next_rim), (middle, next_foot, foot))
    faces += [np.stack(corners, axis=-1) for corners in wall_and_bottom]
    bottom = np.concatenate([top[rim] * [1.0, 1.0, 0.0], [[0.0, 0.0, 0.0]]])
    return np.concatenate([top, bottom]).astype("<f4"), np.concatenate(faces).astype("<i4")


def relief_ply(columns: int = COLUMNS, rows: int = ROWS) -> bytes:
    """The mesh as binary little-endian PLY."""
    vertices, triangles = relief(columns, rows)
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment relief tile, mm, z up, bottom at z = 0\n"
        f"element vertex {len(vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    records = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    records["count"], records["corners"] = 3, triangles
    return header.encode("ascii") + vertices.tobytes() + records.tobytes()


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="Write the demonstration object, a relief tile.")
    parser.add_argument("--output", type=Path, default=DEFAULT_OUTPUT)
    parser.parse_args(arguments).output.write_bytes(relief_ply())


if __name__ == "__main__":
    main()
