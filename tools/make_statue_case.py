"""Makes configs/examples/statue: a simulated case for the tutorial docs/tutorial/a-statue.md, with its truth.

`python tools/make_statue_case.py [--out FOLDER] [--seed N]` makes the case. With `--pictures WALKED` it only
copies the pictures of the tutorial, from a folder in which the tutorial's commands were run.

The object is the bust of `make_bust.py`, weathered: it is eroded, a leaf of the crown is lost, and a flake of the
mantle that was still there in 1998 is lost. Scans are rays (Embree) to its surface, with noise; spectra are made
by `statue_spectra.py`. The same seed gives the same files. Lengths are mm; z is up in the frame of the site, and
the face looks to -y.
"""

from __future__ import annotations

import argparse
import base64
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

import statue_spectra
from make_bust import Field, bodies, ellipsoid, smooth_difference, surface, whole

ROOT = Path(__file__).resolve().parents[1]
PART_OF_BODY = {
    "pedestal": "stone",
    "mantle": "mantle",
    "tunic": "tunic",
    "border": "gilding",
    "skin": "flesh",
    "lips": "flesh",
    "eyes": "flesh",
    "hair": "hair",
    "crown": "gilding",
}
PARTS = ("stone", "mantle", "tunic", "gilding", "flesh", "hair")
NOISE_MM = 0.1
"""Standard deviation of a scanned point along its ray."""
FINE_MM, CAST_MM, PAINTED_MM = 1.6, 5.0, 8.0
"""Cells of the scanned surface, of the cast of 1998, and of the mesh whose parts were painted."""
FLAKE = ((-97.0, -47.0, 118.0), (24.0, 13.0, 30.0))
"""Middle and radii of the ellipsoid that the mantle lost after 1998."""
STANDS = ((0, 12), (45, 25), (90, 10), (135, 28), (180, 12), (225, 26), (270, 10), (315, 24))
"""Azimuth (from -y towards +x) and height of the scanner's positions around the bust, degrees."""
DISTANCE_MM = 1100.0
MIDDLE_MM = np.array([0.0, 0.0, 205.0])
TRUE_POINTS = 12_000
SPACING_MM = 2.0
"""Distance between neighbouring rays at the bust."""
TARGETS_MM = {
    "A": (-260.0, -190.0, 15.0),
    "B": (260.0, -190.0, 90.0),
    "C": (270.0, 200.0, 15.0),
    "D": (-270.0, 200.0, 90.0),
    "E": (0.0, -300.0, 40.0),
    "F": (0.0, 300.0, 140.0),
    "G": (-330.0, 0.0, 200.0),
    "H": (330.0, 0.0, 200.0),
}
U_TARGET_MM, U_CONTROL_MM = 0.15, 0.3
Points = NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "configs/examples/statue")
    parser.add_argument("--seed", type=int, default=37)
    parser.add_argument("--pictures", type=Path, help="folder of the tutorial's case, after its steps")
    options = parser.parse_args()
    if options.pictures:
        _take_pictures(options.pictures)
        return
    for name in ("scans", "earlier", "truth", "spectra", "stone", "films", "library"):
        shutil.rmtree(options.out / name, ignore_errors=True)
        (options.out / name).mkdir(parents=True)
    random = np.random.default_rng(options.seed)
    today, in_1998 = weathered_body(options.seed, has_flake=False), weathered_body(options.seed, has_flake=True)
    vertices_mm, triangles = surface(FINE_MM, today)
    _scan(trimesh.Trimesh(vertices_mm, triangles, process=False), options.out, random)
    _write_cast(in_1998, options.out / "earlier/cast-1998.ply", random)
    some = random.choice(len(vertices_mm), TRUE_POINTS, replace=False)
    _write_points(options.out / "truth/surface.ply", vertices_mm[some], "true surface, mm, frame of the site")
    _write_painted(today, options.out / "parts.json")
    shutil.copyfile(ROOT / "configs/scenes/spectra/limestone.csv", options.out / "stone/limestone.csv")
    statue_spectra.write_all(options.out, random)
    size = sum(path.stat().st_size for path in options.out.rglob("*") if path.is_file())
    print(f"{options.out}: {size / 1e6:.2f} MB")


def weathered_body(seed: int, *, has_flake: bool) -> Callable[[Field], Field]:
    """Return the bust after centuries; with `has_flake` as it was in 1998, before its mantle lost the flake."""
    random = np.random.default_rng(seed + 1)
    waves = random.normal(size=(24, 3)) * (2.0 * np.pi / random.uniform(18.0, 90.0, (24, 1))) / np.sqrt(3.0)
    phases = random.uniform(0.0, 2.0 * np.pi, 24)

    def body(places: Field) -> Field:
        field = whole(places)
        for wave, phase in zip(waves.astype(np.float32), phases, strict=True):
            field = field + np.float32(0.35) * np.sin(places @ wave + np.float32(phase))
        field = smooth_difference(field, ellipsoid(places, (-58.0, -58.0, 392.0), (26.0, 26.0, 21.0)), 2.0)
        field = smooth_difference(field, ellipsoid(places, (96.0, -38.0, 30.0), (20.0, 24.0, 18.0)), 2.0)
        if not has_flake:
            field = smooth_difference(field, ellipsoid(places, *FLAKE), 1.5)
        return np.asarray(field, np.float32)

    return body


# -- scans ----------------------------------------------------------------------------------------------------


def _scan(mesh: trimesh.Trimesh, out: Path, random: np.random.Generator) -> None:
    """Write scans in their own frames, a table of the targets in them, and a table of the targets on the site."""
    sightings, poses = ["scan,name,x,y,z,u_mm"], {}
    for number, (azimuth_deg, height_deg) in enumerate(STANDS, 1):
        name = f"scan-{number}.ply"
        site_from_scan = _stand(azimuth_deg, height_deg, random)
        points_mm = _scanned_points(mesh, site_from_scan, random)
        _write_points(out / "scans" / name, points_mm, "simulated range scan, mm, from the origin")
        poses[name] = site_from_scan.round(6).tolist()
        for target, place_mm in TARGETS_MM.items():
            towards = site_from_scan[:2, 3] @ np.array(place_mm)[:2]
            if towards > -0.25 * DISTANCE_MM * np.linalg.norm(place_mm[:2]):
                seen_mm = (np.array(place_mm) - site_from_scan[:3, 3]) @ site_from_scan[:3, :3]
                seen_mm = seen_mm + random.normal(0.0, U_TARGET_MM, 3)
                sightings.append(f"{name},{target},{','.join(f'{value:.3f}' for value in seen_mm)},{U_TARGET_MM}")
    (out / "scans/targets.csv").write_text("\n".join(sightings) + "\n", encoding="utf-8")
    control = ["name,x,y,z,u_mm"]
    for target, place_mm in TARGETS_MM.items():
        known_mm = np.array(place_mm) + random.normal(0.0, U_CONTROL_MM, 3)
        control.append(f"{target},{','.join(f'{value:.2f}' for value in known_mm)},{U_CONTROL_MM}")
    (out / "scans/control.csv").write_text("\n".join(control) + "\n", encoding="utf-8")
    (out / "truth/poses.json").write_text(json.dumps({"site_from_scan": poses}) + "\n", encoding="utf-8")


def _stand(azimuth_deg: float, height_deg: float, random: np.random.Generator) -> Points:
    """Return the 4x4 pose of a scanner that looks along its -z at the bust, with a random rotation about this
    axis."""
    azimuth, height = np.radians([azimuth_deg + random.uniform(-5, 5), height_deg + random.uniform(-3, 3)])
    back = np.array([np.sin(azimuth) * np.cos(height), -np.cos(azimuth) * np.cos(height), np.sin(height)])
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(back, right), back], axis=1)
    roll = random.uniform(-0.5, 0.5)
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.array(
        [[np.cos(roll), -np.sin(roll), 0.0], [np.sin(roll), np.cos(roll), 0.0], [0.0, 0.0, 1.0]]
    )
    pose[:3, 3] = MIDDLE_MM + DISTANCE_MM * back
    return pose


def _scanned_points(mesh: trimesh.Trimesh, site_from_scan: Points, random: np.random.Generator) -> Points:
    """Return [n, 3] in the scanner's frame; places seen at more than 75 degrees from their normal give no
    points."""
    reach = np.arange(-330.0, 330.0, SPACING_MM) / DISTANCE_MM
    x, y = np.meshgrid(reach, reach)
    rays = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)], axis=1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    directions = rays @ site_from_scan[:3, :3].T
    origins = np.tile(site_from_scan[:3, 3], (len(rays), 1))
    places, ray, triangle = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    facing = -np.einsum("ij,ij->i", mesh.face_normals[triangle], directions[ray])
    keep = facing > np.cos(np.radians(75.0))
    ranges = np.linalg.norm(places[keep] - origins[0], axis=1) + random.normal(0.0, NOISE_MM, int(keep.sum()))
    order = np.argsort(ray[keep])
    return np.asarray((rays[ray[keep]] * ranges[:, None])[order])


# -- meshes ---------------------------------------------------------------------------------------------------


def _write_points(path: Path, points_mm: Points, comment: str) -> None:
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex {len(points_mm)}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    path.write_bytes(head.encode() + points_mm.astype("<f4").tobytes())


def _write_mesh(path: Path, vertices_mm: Points, triangles: NDArray[np.int64], comment: str) -> None:
    head = (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex {len(vertices_mm)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face {len(triangles)}\nproperty list uchar ushort vertex_indices\nend_header\n"
    )
    faces = np.empty(len(triangles), [("corners", "u1"), ("indices", "<u2", 3)])
    faces["corners"], faces["indices"] = 3, triangles
    path.write_bytes(head.encode() + vertices_mm.astype("<f4").tobytes() + faces.tobytes())


def _write_cast(body: Callable[[Field], Field], path: Path, random: np.random.Generator) -> None:
    """Write a cast of 1998, scanned by another person in another frame."""
    vertices_mm, triangles = surface(CAST_MM, body)
    turn = trimesh.transformations.rotation_matrix(np.radians(35.0), [0.3, 0.2, 1.0])[:3, :3]
    noisy_mm = vertices_mm + random.normal(0.0, NOISE_MM, vertices_mm.shape)
    _write_mesh(path, noisy_mm @ turn.T + [40.0, 15.0, -120.0], triangles, "simulated cast of 1998, mm")


def part_of(places_mm: Points) -> NDArray[np.int64]:
    """Return rows of `PARTS` [n] for places [n, 3] on the surface."""
    distances = bodies(places_mm.astype(np.float32))
    nearest = np.stack(list(distances.values())).argmin(axis=0)
    rows = np.array([PARTS.index(PART_OF_BODY[name]) for name in distances])
    return np.asarray(rows[nearest])


def _write_painted(body: Callable[[Field], Field], path: Path) -> None:
    """Write the file that the page of `coupole restore pick` saves when all parts are painted."""
    vertices_mm, triangles = surface(PAINTED_MM, body)
    rows = part_of(vertices_mm[triangles].mean(axis=1))
    arrays = {"vertices_mm": (vertices_mm, "<f4"), "triangles": (triangles, "<u4"), "parts": (rows + 1, "u1")}
    document = {"schema_version": 1, "kind": "picked parts", "names": list(PARTS)} | {
        key: base64.b64encode(values.astype(kind).tobytes()).decode() for key, (values, kind) in arrays.items()
    }
    path.write_text(json.dumps(document) + "\n", encoding="utf-8")


def _take_pictures(case: Path) -> None:
    for lights in ("day", "candles"):
        path = ROOT / f"docs/pictures/statue-{lights}.png"
        shutil.copyfile(case / lights / "side-by-side-front.png", path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
