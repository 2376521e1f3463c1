"""Tables of targets: every way of writing them that can be meant, and none that can be meant in two ways."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from coupole.errors import InputError
from coupole.scan.scanner_export import read_scan
from coupole.scan.targets import Targets, read_targets

POINTS = [[1.5, -2.25, 3.0], [10.0, 20.5, -30.125]]


def read(tmp_path: Path, text: str) -> Targets:
    path = tmp_path / "targets.txt"
    path.write_text(text, encoding="utf-8")
    return read_targets(path)


@pytest.mark.parametrize(
    "text",
    [
        "1.5 -2.25 3.0\n10.0 20.5 -30.125\n",
        "1.5\t-2.25\t3\n10\t20.5\t-30.125\n",
        "1.5,-2.25,3.0\n10.0,20.5,-30.125\n",
        "1.5, -2.25, 3.0\n10.0, 20.5, -30.125\n",
        "1.5;-2.25;3.0\n10.0;20.5;-30.125\n",
        "1,5;-2,25;3,0\n10,0;20,5;-30,125\n",
        "1,5\t-2,25\t3,0\n10,0\t20,5\t-30,125\n",
        "1,5 -2,25 3,0\n10,0 20,5 -30,125\n",
        "# VXelements\n\n// remark\nX Y Z\n1.5 -2.25 3.0\n\n10.0 20.5 -30.125\n",
        "T1 1.5 -2.25 3.0\nT2 10.0 20.5 -30.125\n",
        "name;x [mm];y [mm];z [mm]\n1;1,5;-2,25;3\n2;10;20,5;-30,125\n",
        "1.5 -2.25 3.0 0 0 1\n10.0 20.5 -30.125 0.6 0 0.8\n",
        "a 1.5e0 -2.25 3 0 0 1\nb 1e1 20.5 -30.125 0.6 0 0.8\n",
    ],
)
def test_columns_may_be_parted_and_headed_in_many_ways(tmp_path: Path, text: str) -> None:
    assert read(tmp_path, text).centers.tolist() == POINTS


@given(st.lists(st.tuples(*[st.integers(-999_999, 999_999)] * 3), min_size=1, max_size=20))
def test_what_is_written_with_semicolons_is_read_back(points: list[tuple[int, int, int]]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        text = "\n".join(";".join(f"{value / 1000:.3f}".replace(".", ",") for value in point) for point in points)
        found = read(Path(folder), text)
    assert np.allclose(found.centers, np.array(points) / 1000, rtol=0, atol=1e-9)


def test_names_and_normals_are_kept(tmp_path: Path) -> None:
    found = read(tmp_path, "a 1 2 3 0 0 1\nb 4 5 6 0.6 0 0.8\n")
    assert found.names == ("a", "b")
    assert found.normals is not None
    assert np.allclose(found.normals, [[0, 0, 1], [0.6, 0, 0.8]])


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("# in mm", "mm"),
        ("X [m] Y [m] Z [m]", "m"),
        ("# unit: in", "in"),
        ("# targets in the scanner's frame", ""),
    ],
)
def test_the_unit_that_the_table_names_is_found(tmp_path: Path, heading: str, unit: str) -> None:
    assert read(tmp_path, f"{heading}\n1 2 3\n").unit == unit


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a line for each target; there is none"),
        ("1 2 3\n1 2\n", ":2: expected 3 columns as in line 1, found 2"),
        ("1 2 3\n4 x 6\n", ":2: expected a number in column 2, found `x`"),
        ("1 2 3\n4 nan 6\n", ":2: expected a number in column 2, found `nan`"),
        ("1 2\n", ":1: expected columns 3 (x y z)"),
        ("a 1 2 3\na 4 5 6\n", ":2: target `a` is in lines 1 and 2"),
        ("1 2 3 0 0 2\n", ":1: expected a normal of length 1"),
        ("1,5,2,25,3,75\n", ":1: `1,5,2,25,3,75` could be 6 whole numbers or 3 with decimal commas"),
        ("# x in mm\n# y in inches\n1 2 3\n", ":2: mixed units: in and mm"),
    ],
)
def test_what_is_wrong_or_ambiguous_is_refused_at_its_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("targets", "message"),
    [
        (
            "0.01 0 0\n0 0.02 0\n0 0 0.03\n",
            r"mixed units\? The targets lie within 0\.0374 mm, the mesh of m\.ply is 138\.6",
        ),
        ("10 0 0\n0 2000 0\n", r"target 2 is 1960 mm away from the mesh of m\.ply, which is 138\.6 mm"),
    ],
)
def test_targets_of_another_unit_or_place_than_the_mesh_are_refused(
    tmp_path: Path, targets: str, message: str
) -> None:
    trimesh.creation.icosphere(subdivisions=2, radius=40.0).export(tmp_path / "m.ply")
    (tmp_path / "t.txt").write_text(targets)
    with pytest.raises(InputError, match=message):
        read_scan(tmp_path / "m.ply", tmp_path / "t.txt")


def test_a_unit_that_contradicts_the_tables_own_is_refused(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=2, radius=40.0).export(tmp_path / "m.ply")
    (tmp_path / "t.txt").write_text("# mm\n1 2 3\n")
    with pytest.raises(InputError, match="the unit in the table is mm, the unit of --targets-unit is m"):
        read_scan(tmp_path / "m.ply", tmp_path / "t.txt", targets_unit="m")
