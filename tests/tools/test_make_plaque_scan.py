"""The showpiece's mesh is what its tool writes, and what a scanner would give: pitch, noise, holes."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from places import REPO

from sim.objects import plaque_relief

SCAN = REPO / "configs/objects/plaque.ply"
TOOL = runpy.run_path(str(REPO / "tools/make_plaque_scan.py"))


@pytest.fixture(scope="module")
def scan() -> Any:
    return trimesh.load_mesh(SCAN, process=False)


def test_the_committed_scan_is_what_the_tool_writes(tmp_path: Path) -> None:
    TOOL["main"](["--output", str(tmp_path / "plaque.ply")])
    assert (tmp_path / "plaque.ply").read_bytes() == SCAN.read_bytes()


def test_the_scan_is_smaller_than_5_mb_and_has_no_colours(scan: Any) -> None:
    assert SCAN.stat().st_size < 5e6
    assert scan.visual.kind is None


def test_triangles_are_0_3_mm_large(scan: Any) -> None:
    level = scan.vertices[scan.faces][:, :, 2].min(axis=1) > 1.0
    xy = scan.vertices[scan.faces[level]][:, :, :2]
    legs_mm = np.sort(np.linalg.norm(xy - np.roll(xy, 1, axis=1), axis=2), axis=1)
    assert np.median(legs_mm[:, 0]) == pytest.approx(0.26, abs=0.05)
    assert np.median(legs_mm[:, 1]) == pytest.approx(0.33, abs=0.05)
    assert np.percentile(legs_mm[:, 2], 99.0) < 0.65


def test_heights_have_noise_of_30_um_that_neighbours_share(scan: Any) -> None:
    top = scan.vertices[scan.vertices[:, 2] > 1.0]
    error_mm = top[:, 2] - plaque_relief.height_mm(top[:, 0], top[:, 1])
    # Coordinates are rounded to the micrometre, which on a steep wall is more than that in height.
    flat = np.abs(error_mm) < 0.2
    assert flat.mean() > 0.99
    assert 1e3 * error_mm[flat].std() == pytest.approx(30.0, abs=1.0)
    assert abs(1e3 * error_mm[flat].mean()) < 0.5
    row = np.lexsort((top[:, 0], np.round(top[:, 1] / 0.3)))
    ordered = error_mm[row]
    assert np.corrcoef(ordered[:-1], ordered[1:])[0, 1] > 0.7


def test_the_scan_has_a_few_holes_and_no_back(scan: Any) -> None:
    edges, count = np.unique(np.sort(scan.edges, axis=1), axis=0, return_counts=True)
    assert count.max() == 2
    rims = trimesh.graph.connected_components(edges[count == 1], min_len=3)
    assert len(rims) == len(TOOL["HOLES_MM"]) + 1
    low = [rim for rim in rims if scan.vertices[rim][:, 2].max() == 0.0]
    assert len(low) == 1
    sizes_mm = [np.ptp(scan.vertices[rim][:, :2], axis=0).max() for rim in rims if rim is not low[0]]
    assert min(sizes_mm) > 1.0
    assert max(sizes_mm) < 5.0


def test_what_is_finer_than_the_triangles_is_not_in_the_scan() -> None:
    """Strokes 0.06 mm deep are lost in noise and pitch."""
    points, _ = TOOL["scan"](0.6)
    band = points[(np.abs(points[:, 1] + 31.8) < 2.0) & (np.abs(points[:, 0]) < 45.0)]
    depth_mm = plaque_relief.FIELD_MM + 1.3 - band[:, 2]
    assert np.mean(depth_mm > 0.15) < 0.02
