"""A plate that faces -y, 40 x 40 mm in 16 squares, left and right of x = 0 in two colours; and its hypotheses."""

from __future__ import annotations

from pathlib import Path

RED, BLUE = (255, 0, 0), (0, 0, 255)
SIDE_MM, SQUARES, PX = 40.0, 4, 16
RESTORATION = """\
schema_version: 1
name: plate
smooth: false
hypotheses:
  - name: light
    title: A light left half
    sources:
      - {says: It was light, reference: "A letter of 1300 about the façade, «very light»"}
    materials:
      left: {kind: diffuse, reflectance: {kind: constant, value: 0.5}}
      right: {kind: paint, pigment: {kind: shape, name: red_shape}}
  - name: dark
    title: A dark left half
    sources:
      - {says: It was dark, reference: An assumption}
    materials:
      left: {kind: diffuse, reflectance: {kind: constant, value: 0.2}}
      right: {kind: paint, pigment: {kind: shape, name: red_shape}}
views: {kind: cameras, cameras: [{name: front, position_mm: [0, -1000, 0], target_mm: [0, 0, 0],
  optics: {kind: field, degrees: 2}, width_px: 16, height_px: 16}]}
lights:
  - {kind: environment, luminance_cd_m2: 100, spectrum: {kind: illuminant, name: D65}}
bands: {step_nm: 40}
samples: 8
depth: 1
display: {white_cd_m2: 100}
"""
PARTS = """\
schema_version: 1
rules:
  - kind: vertex_colours
    colours: {left: "#ff0000", right: "#0000ff"}
"""


def grid() -> tuple[list[tuple[float, float, float]], list[tuple[int, int, int]]]:
    """Points, each square with its own four, and triangles that face -y."""
    points: list[tuple[float, float, float]] = []
    triangles: list[tuple[int, int, int]] = []
    step = SIDE_MM / SQUARES
    for row in range(SQUARES):
        for column in range(SQUARES):
            x, z, first = column * step - SIDE_MM / 2, row * step - SIDE_MM / 2, len(points)
            points += [(x, 0, z), (x + step, 0, z), (x + step, 0, z + step), (x, 0, z + step)]
            triangles += [(first, first + 1, first + 2), (first, first + 2, first + 3)]
    return points, triangles


def middles() -> list[float]:
    """x of the middle of each triangle."""
    points, triangles = grid()
    return [sum(points[corner][0] for corner in triangle) / 3 for triangle in triangles]


def plate_ply(path: Path) -> Path:
    """The plate as text, left half red, right half blue."""
    points, triangles = grid()
    head = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")]
    head += [f"element face {len(triangles)}", "property list uchar int vertex_indices", "end_header"]
    left = [(first // 4) % SQUARES < SQUARES / 2 for first in range(len(points))]
    rows = [
        " ".join(map(str, (*point, *(RED if is_left else BLUE))))
        for point, is_left in zip(points, left, strict=True)
    ]
    rows += [" ".join(map(str, (3, *triangle))) for triangle in triangles]
    path.write_text("\n".join(head + rows) + "\n")
    return path


def plate_obj(path: Path, picture: str) -> Path:
    """The plate with places in a picture: u with x, v with z."""
    points, triangles = grid()
    lines = [f"mtllib {path.stem}.mtl", "usemtl only"]
    lines += [f"v {x} {y} {z}" for x, y, z in points]
    lines += [f"vt {x / SIDE_MM + 0.5} {z / SIDE_MM + 0.5}" for x, _, z in points]
    lines += ["f " + " ".join(f"{corner + 1}/{corner + 1}" for corner in triangle) for triangle in triangles]
    path.write_text("\n".join(lines) + "\n")
    path.with_suffix(".mtl").write_text(f"newmtl only\nKd 1 1 1\nmap_Kd {picture}\n")
    return path
