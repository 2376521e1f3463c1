"""A known object, the Stanford bunny, seen from several sides: its silhouette is where the mesh says it is.

The scan is not part of the repository; the tests run where it lies beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cells
import h5py
import numpy as np
import pytest
import trimesh
from cells import CellFolder
from expected_pictures import transform_of
from numpy.typing import NDArray
from places import SHARED_DATA

BUNNY = SHARED_DATA / "bunny/bun_zipper.ply"
SUPPORT_FROM_OBJECT = {"translation_mm": [16.8, 0.0, -33.0], "abc_deg": [0, 0, 90]}
"""The scan's y points up and its feet stand 33 mm above its origin; on the support z points up."""
VIEWS = {"above": (-110, 80), "left": (-130, 25), "front": (-90, 20), "right": (-50, 30)}
"""Azimuth and elevation, degrees."""
SIDES = ("left", "front", "right")
OBJECT_SHARE = 0.3
"""Of the brightest pixels of its colour: darker than this is the black support."""

pytestmark = pytest.mark.skipif(not BUNNY.exists(), reason="the bunny's scan lies not beside the repository")


@dataclass(frozen=True)
class Seen:
    """A view's silhouette in the frame, and where the mesh's vertices must be in it, pixels."""

    mask: NDArray[np.bool_]
    column: NDArray[np.float64]
    row: NDArray[np.float64]


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Seen]:
    cell = CellFolder(tmp_path_factory.mktemp("bunny"))
    target = {"kind": "look_at", "target_mm": [0, 0, 75], "distance_mm": 470}
    cell.write(
        object={
            "id": "bunny",
            "mesh": str(BUNNY),
            "mesh_unit": "m",
            "support_from_object": SUPPORT_FROM_OBJECT,
        },
        views=[{**target, "name": n, "azimuth_deg": a, "elevation_deg": e} for n, (a, e) in VIEWS.items()],
        lights={"kind": "panels", "panels": [1]},
    )
    ended = cell.acquire()
    assert ended.code == 0, ended.err
    frames = cells.stored(cell.run_folder)
    return {view: _seen(cell, cell.run_folder, frames[f"{view}/panel1/e0"]) for view in VIEWS}


def _seen(cell: CellFolder, run: Path, frame: cells.Stored) -> Seen:
    light = frame.pixels.astype(float) - cells.BLACK_DN
    for row in (0, 1):
        for column in (0, 1):
            light[row::2, column::2] /= np.quantile(light[row::2, column::2], 0.99)
    with h5py.File(run / "views/front.h5", "r") as file:
        facts = file["entry"].attrs
        base_from_support = facts["base_from_support"]
        lens = {key: float(facts[key]) for key in ("focal_length_mm", "focus_distance_mm", "pixel_pitch_um")}
    vertices = np.asarray(trimesh.load(BUNNY, process=False, force="mesh").vertices) * 1000
    base_from_object = base_from_support @ transform_of(SUPPORT_FROM_OBJECT)
    vertices = vertices @ base_from_object[:3, :3].T + base_from_object[:3, 3]
    camera_from_base = np.linalg.inv(frame.base_from_camera)
    x, y, z = camera_from_base[:3, :3] @ vertices.T + camera_from_base[:3, 3:]
    image_mm = 1 / (1 / lens["focal_length_mm"] - 1 / lens["focus_distance_mm"])
    focal_px = image_mm * 1e3 / lens["pixel_pitch_um"]
    height, width = frame.pixels.shape
    return Seen(light > OBJECT_SHARE, focal_px * x / z + (width - 1) / 2, focal_px * y / z + (height - 1) / 2)


@pytest.mark.parametrize("view", VIEWS)
def test_the_silhouettes_box_is_that_of_the_projected_mesh(seen: dict[str, Seen], view: str) -> None:
    rows, columns = np.nonzero(seen[view].mask)
    expected = [seen[view].column.min(), seen[view].column.max(), seen[view].row.min(), seen[view].row.max()]
    assert [columns.min(), columns.max(), rows.min(), rows.max()] == pytest.approx(expected, abs=3)


@pytest.mark.parametrize("view", VIEWS)
def test_the_silhouettes_centre_is_that_of_the_projected_mesh(seen: dict[str, Seen], view: str) -> None:
    covered = np.zeros(seen[view].mask.shape, bool)
    covered[np.rint(seen[view].row).astype(int), np.rint(seen[view].column).astype(int)] = True
    found = [where.mean() for where in np.nonzero(seen[view].mask)]
    assert found == pytest.approx([where.mean() for where in np.nonzero(covered)], abs=2)


@pytest.mark.parametrize("view", SIDES)
def test_the_ears_are_up_in_views_from_the_side(seen: dict[str, Seen], view: str) -> None:
    width_of_row = seen[view].mask.sum(axis=1)
    rows = np.flatnonzero(width_of_row)
    quarter = len(rows) // 4
    assert width_of_row[rows[:quarter]].mean() < 0.6 * width_of_row[rows[-2 * quarter : -quarter]].mean()
