"""`coupole scan`: what an operator does with the scanner's export."""

from __future__ import annotations

import json
from pathlib import Path

import cells
import numpy as np
import pytest
import trimesh
from PIL import Image


@pytest.fixture
def exported(tmp_path: Path) -> Path:
    """A folder with a mesh in metres and its targets in mm."""
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    sphere.export(tmp_path / "object.stl")
    points = 1000 * sphere.vertices[::100]
    (tmp_path / "targets.txt").write_text("# [mm]\n" + "\n".join(" ".join(f"{v:.4f}" for v in p) for p in points))
    return tmp_path


def test_a_scan_becomes_a_mesh_in_mm_its_targets_its_facts_and_a_picture(exported: Path) -> None:
    out = exported / "scan"
    ended = cells.here(
        "scan",
        exported / "object.stl",
        "--targets",
        exported / "targets.txt",
        "--unit",
        "m",
        "--out",
        out,
        "--json",
    )
    assert ended.code == 0, ended.err
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert len(mesh.faces) == 1280
    assert np.allclose(np.linalg.norm(mesh.vertices, axis=1), 40.0, atol=1e-4)
    assert json.loads((out / "scan.json").read_text()) == ended.document
    assert ended.document["targets"] == 7
    assert sum(ended.document["target_distances"]["pairs"]) == 21
    assert (out / "targets.csv").read_text().startswith("name,x_mm,y_mm,z_mm\n1,")
    with Image.open(out / "scan.png") as picture:
        red = np.asarray(picture.convert("RGB")).astype(int)
    assert ((red[..., 0] > 180) & (red[..., 1] < 80)).sum() > 50


def test_what_was_read_in_is_read_in_again(exported: Path) -> None:
    first, second = exported / "first", exported / "second"
    assert cells.here("scan", exported / "object.stl", "--unit", "m", "--out", first).code == 0
    assert cells.here("scan", first / "mesh.ply", "--out", second).code == 0
    assert (first / "mesh.ply").read_bytes() == (second / "mesh.ply").read_bytes()


def test_nothing_is_written_of_a_file_that_is_refused(exported: Path) -> None:
    ended = cells.here("scan", exported / "object.stl", "--out", exported / "scan")
    assert ended.code == 2
    assert "give its unit with --unit" in ended.err
    assert sorted(path.name for path in exported.iterdir()) == ["object.stl", "targets.txt"]


def test_a_folder_that_exists_is_not_written_into(exported: Path) -> None:
    ended = cells.here("scan", exported / "object.stl", "--unit", "m", "--out", exported)
    assert ended.code == 2
    assert "exists already" in ended.err


def test_an_unknown_unit_is_refused(exported: Path) -> None:
    ended = cells.here("scan", exported / "object.stl", "--unit", "ft", "--out", exported / "scan")
    assert ended.code == 2
    assert "--unit ft: expected one of mm, cm, m, um, in" in ended.err
