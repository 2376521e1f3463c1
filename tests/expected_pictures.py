"""Which LED each frame of a small cell shows, reckoned here from the dome's file and the object's mesh. Nothing of
the simulator is used.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from cells import BLACK_DN, CellFolder, is_light, stored
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

PIXEL_STEP = 7
"""Of the object's pixels every so-manieth is looked at to tell LEDs apart, in frames of 128 columns."""
KEPT_VIEWS = 8
_kept: dict[tuple[object, ...], Expectation] = {}


def mislabelled(cell: CellFolder, run: Path) -> list[str]:
    """Shots whose picture is more like that of another LED than their own, and dark frames that are not dark."""
    wrong = []
    expectations: dict[str, Expectation] = {}
    for shot, frame in stored(run).items():
        view, light = shot.split("/")[:2]
        if not is_light(shot):
            wrong += [f"{shot} is not dark"] if abs(frame.pixels.mean() - BLACK_DN) > 2 else []
            continue
        if view not in expectations:
            expectations[view] = expectation(cell, frame.base_from_camera)
        led = expectations[view].led_of(frame.pixels)
        assert frame.record["led"] == int(light.removeprefix("led")), shot
        if led != frame.record["led"]:
            wrong.append(f"{shot} shows LED {led}")
    return wrong


def expectation(cell: CellFolder, base_from_camera: NDArray[np.float64]) -> Expectation:
    """What each LED makes of a view; kept for other runs of a like cell from the same place, to 20 um and 2e-5."""
    rig = cell.rig_data
    alike = json.dumps([rig[part] for part in ("support", "sensor", "lens")], default=str)
    files = tuple(Path(path).read_bytes() for path in (cell.plan_data["object"]["mesh"], rig["dome"]["leds"]))
    place = np.round(base_from_camera / [0.00002, 0.00002, 0.00002, 0.02]).astype(int).tobytes()
    key = (alike, *files, place)
    if key not in _kept:
        if len(_kept) >= KEPT_VIEWS:
            _kept.pop(next(iter(_kept)))
        _kept[key] = Expectation(cell, base_from_camera)
    return _kept[key]


class Expectation:
    """What each LED of the dome must make of one view, reckoned here: Lambert's law on the object's triangles that
    see the LED.

    Nothing of the simulator's is used; the pose is the measured one, the lens a pinhole.
    """

    def __init__(self, cell: CellFolder, base_from_camera: NDArray[np.float64]) -> None:
        mesh = trimesh.load(cell.plan_data["object"]["mesh"], process=False, force="mesh")
        base_from_support = transform_of(cell.rig_data["support"]["base_from_support"])
        corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)] @ base_from_support[:3, :3].T
        corners += base_from_support[:3, 3]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = corners.mean(axis=1)
        triangle = _triangle_of_pixel(cell, base_from_camera, corners, normals)
        step = PIXEL_STEP * max(1, cell.rig_data["sensor"]["width_px"] // 128) ** 2
        self._rows, self._columns = (places[::step] for places in np.nonzero(triangle >= 0))
        seen = triangle[self._rows, self._columns]
        self._cell = 2 * (self._rows % 2) + self._columns % 2
        table = np.loadtxt(
            cell.rig_data["dome"]["leds"], delimiter=",", comments="#", skiprows=_table_starts(cell)
        )
        self.leds = table[:, 0].astype(int)
        to_led = table[:, None, 2:5] - points[seen]
        distance = np.linalg.norm(to_led, axis=2)
        cos_object = np.einsum("lpk,pk->lp", to_led, normals[seen]) / distance
        cos_led = -np.einsum("lpk,lk->lp", to_led, table[:, 5:8]) / distance
        lit = table[:, 8:9] * np.clip(cos_object, 0, None) * np.clip(cos_led, 0, None) / distance**2
        rays = RayMeshIntersector(
            trimesh.Trimesh(corners.reshape(-1, 3), np.arange(corners.size // 3).reshape(-1, 3), process=False)
        )
        origins = np.broadcast_to(points[seen] + 1e-3 * normals[seen], to_led.shape)
        facing = np.flatnonzero(lit)
        hidden = rays.intersects_any(origins.reshape(-1, 3)[facing], to_led.reshape(-1, 3)[facing])
        lit.flat[facing[hidden]] = 0.0
        axis = base_from_camera[:3, 2]
        from_lens = points[seen] - base_from_camera[:3, 3]
        cos_lens = from_lens @ axis / np.linalg.norm(from_lens, axis=1)
        self._pictures = self._alike(lit * cos_lens**4)  # the lens darkens towards the corners

    def led_of(self, pixels: NDArray[np.uint16]) -> int:
        """The LED, of all in the dome, whose picture this frame is most like."""
        values = pixels[self._rows, self._columns].astype(float) - BLACK_DN
        return int(self.leds[np.argmax(self._pictures @ self._alike(values[None])[0])])

    def _alike(self, pictures: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pictures [n, pixels] without the colours of the Bayer filter, of unit norm."""
        for place in range(4):
            mine = self._cell == place
            pictures[:, mine] /= np.maximum(pictures[:, mine].mean(axis=1, keepdims=True), 1e-9)
        pictures = pictures - pictures.mean(axis=1, keepdims=True)
        return pictures / np.maximum(np.linalg.norm(pictures, axis=1, keepdims=True), 1e-9)


def _triangle_of_pixel(
    cell: CellFolder,
    base_from_camera: NDArray[np.float64],
    corners: NDArray[np.float64],
    normals: NDArray[np.float64],
) -> NDArray[np.int64]:
    """[height, width] the nearest triangle [n, 3, 3] that each pixel's centre sees, -1 for none. All triangles at
    once, pixel by pixel of the largest one's bounding box; those that turn their backs are left out."""
    height, width = cell.rig_data["sensor"]["height_px"], cell.rig_data["sensor"]["width_px"]
    facing = np.flatnonzero(np.einsum("nk,nk->n", base_from_camera[:3, 3] - corners[:, 0], normals) > 0)
    column, row, depth = (
        values.reshape(-1, 3) for values in project(cell, base_from_camera, corners[facing].reshape(-1, 3))
    )
    left, top = np.ceil(column.min(axis=1)).astype(int), np.ceil(row.min(axis=1)).astype(int)
    seen, nearest = np.full((height, width), -1), np.full((height, width), np.inf)
    for down in range(int(np.ptp(row, axis=1).max()) + 1):
        for right in range(int(np.ptp(column, axis=1).max()) + 1):
            x, y = left + right, top + down
            edges = [
                (column[:, k - 2] - x) * (row[:, k - 1] - y) - (column[:, k - 1] - x) * (row[:, k - 2] - y)
                for k in range(3)
            ]
            area = sum(edges)
            inside = np.all([edge * np.sign(area) >= 0 for edge in edges], axis=0) & (area != 0)
            hit = np.flatnonzero(inside & (x >= 0) & (x < width) & (y >= 0) & (y < height))
            share = np.stack([edge[hit] / area[hit] for edge in edges], axis=1)
            here_mm = 1 / (share / depth[hit]).sum(axis=1)
            far_first = np.argsort(-here_mm)
            hit, here_mm = hit[far_first], here_mm[far_first]
            hit, here_mm = hit[here_mm < nearest[y[hit], x[hit]]], here_mm[here_mm < nearest[y[hit], x[hit]]]
            nearest[y[hit], x[hit]], seen[y[hit], x[hit]] = here_mm, facing[hit]
    return seen


def _table_starts(cell: CellFolder) -> int:
    lines = Path(cell.rig_data["dome"]["leds"]).read_text().splitlines()
    return next(i for i, line in enumerate(lines) if line.startswith("id")) + 1


def transform_of(pose: dict[str, Any]) -> NDArray[np.float64]:
    """4x4 of a pose in a rig or plan: R = Rz(A) Ry(B) Rx(C)."""
    a, b, c = np.radians(pose.get("abc_deg", (0, 0, 0)))
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(c), -np.sin(c)], [0, np.sin(c), np.cos(c)]])
    matrix = np.eye(4)
    matrix[:3, :3] = about_z @ about_y @ about_x
    matrix[:3, 3] = pose.get("translation_mm", (0, 0, 0))
    return matrix


def project(
    cell: CellFolder, base_from_camera: NDArray[np.float64], points_base_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Column and row in pixels, and depth in mm, of points [n, 3]: a pinhole whose axis pierces the centre."""
    sensor, lens = cell.rig_data["sensor"], cell.rig_data["lens"]
    image_mm = 1 / (1 / lens["focal_length_mm"] - 1 / lens["focus_distance_mm"])
    in_camera = (points_base_mm - base_from_camera[:3, 3]) @ base_from_camera[:3, :3]
    scale = image_mm / (sensor["pixel_pitch_um"] * 1e-3) / in_camera[:, 2]
    column = in_camera[:, 0] * scale + (sensor["width_px"] - 1) / 2
    row = in_camera[:, 1] * scale + (sensor["height_px"] - 1) / 2
    return column, row, in_camera[:, 2]
