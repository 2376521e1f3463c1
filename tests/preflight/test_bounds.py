"""Figures that no cell has are refused with file, line and what was expected, before they take memory or time."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import cells
import numpy as np
import pytest
import trimesh
from cells import CellFolder
from places import REPO

from coupole.errors import InputError
from coupole.motion.bodies import link_corners
from coupole.plan.led_table import read_led_table
from coupole.scan.mesh_files import read_mesh

HEADER = "id,board,x_mm,y_mm,z_mm,nx,ny,nz,flux_lm\n"


def refused(cell: CellFolder, key: str, expected: str, file: str = "rig.yaml") -> None:
    ended = cells.here("check", cell.plan, "--json")
    assert ended.code == 2, ended.err
    (line,) = (line for line in ended.document["error"].splitlines() if key in line)
    assert f"{cell.folder / file}:" in line
    assert expected in line


@pytest.mark.parametrize(
    ("section", "value", "key", "expected"),
    [
        (
            "tool",
            [{"name": "camera", "from_mm": [0, 0, 20], "to_mm": [0, 0, 1e8], "radius_mm": 60}],
            "tool[0].to_mm[2]",
            "a number from -20000 to 20000, found 100000000",
        ),
        (
            "keep_out",
            [{"kind": "sphere", "name": "far", "center_mm": [0, 0, 1e8], "radius_mm": 60}],
            "keep_out[0].center_mm[2]",
            "a number from -20000 to 20000, found 100000000",
        ),
        (
            "keep_out",
            [{"kind": "box", "name": "flat", "min_mm": [0, 0, 0], "max_mm": [100, 100, 0]}],
            "keep_out[0]",
            "`min_mm` below `max_mm` on each axis",
        ),
        ("lens", {"focal_length_mm": 35, "f_number": 8, "focus_distance_mm": 30}, "lens", "longer than the focal"),
        (
            "sensor",
            {"width_px": 128, "height_px": 96, "pixel_pitch_um": 176.0, "black_dn": 4095},
            "sensor",
            "a black level below the highest value of 12 bits, 4095",
        ),
        ("led_limits", {"on_us": [2000, 1000]}, "led_limits", "the shortest on-time first"),
        ("link_meshes", "~nobody-at-all/x", "link_meshes", "home folder of a user of this machine"),
        ("arm", "a\0b", "arm", "text with a NUL character"),
        ("link_meshes", "x" * 300, "link_meshes", "each of its names of at most 255 bytes"),
    ],
)
def test_a_figure_of_a_rig_that_no_cell_has_is_refused_at_its_place(
    cell: CellFolder, section: str, value: Any, key: str, expected: str
) -> None:
    cell.rig_data[section] = value
    cell.write()
    refused(cell, key, expected)


@pytest.mark.parametrize(
    ("changes", "key", "expected"),
    [
        (
            {"repeats": 1000, "exposure": {"kind": "bracket", "exposures_us": list(range(1000, 1016))}},
            "repeats",
            "expected at most 5000000 frames in one plan",
        ),
        (
            {
                "views": [
                    {
                        **{"kind": "grid", "name": "g", "target_mm": [0, 0, 0], "distance_mm": 335},
                        "azimuths_deg": [n / 10 for n in range(100)],
                        "elevations_deg": [n / 2 for n in range(100)],
                    }
                ]
            },
            "views",
            "expected at most 2000 views in one plan, found 10000",
        ),
    ],
    ids=["frames", "views"],
)
def test_a_plan_too_large_to_be_planned_is_refused(
    cell: CellFolder, changes: dict[str, Any], key: str, expected: str
) -> None:
    cell.write(**changes)
    refused(cell, key, expected, "plan.yaml")


@pytest.mark.parametrize(
    ("line", "key", "expected"),
    [
        ("1,1e9,0,0,1000,0,0,-1,1800", "board", "an integer from 0 to 65535, found 1e+09"),
        ("1,0,0,0,1e8,0,0,-1,1800", "x_mm, y_mm, z_mm", "mm, at most 20000 on each axis"),
        ("1,0,0,0,1000,1e300,1e300,-1,1800", "nx, ny, nz", "a unit normal"),
        ("1,0,0,0,1000,0,0,-1,1e9", "flux_lm", "above 0 and at most 1e+06"),
        ("1,0,0,0,1000,0,0,-1,18\x0000", "", "could not convert string to float"),
    ],
)
def test_an_led_that_no_dome_has_is_refused_in_its_line(
    tmp_path: Path, line: str, key: str, expected: str
) -> None:
    path = tmp_path / "dome.csv"
    path.write_text(HEADER + "0,0,0,0,1000,0,0,-1,1800\n" + line + "\n2,0,0,0,1000,0,0,-1,1800\n")
    with pytest.raises(InputError) as caught:
        read_led_table(path)
    (problem,) = caught.value.problems
    assert (problem.line, problem.key) == (3, key)
    assert expected in problem.message


def test_an_open_quotation_mark_ends_with_its_line(tmp_path: Path) -> None:
    """csv would read on to the end of the file, and lines would be counted wrongly."""
    path = tmp_path / "dome.csv"
    path.write_text(HEADER + '0,0,0,0,1000,0,0,-1,"1800\n1,0,0,0,1000,0,0,-1,1800\n')
    assert read_led_table(path).ids.tolist() == [0, 1]


# -- meshes -----------------------------------------------------------------------------------------------------


def ply(tmp_path: Path, *header: str, data: bytes = b"") -> Path:
    path = tmp_path / "mesh.ply"
    path.write_bytes("\n".join(["ply", *header, "end_header", ""]).encode() + data)
    return path


XYZ = ("property float x", "property float y", "property float z")
LISTS = ("element face 1", "property list uchar int vertex_indices")


@pytest.mark.parametrize("form", ["binary_big_endian", "binary_little_endian", "ascii"])
@pytest.mark.parametrize("count", [10**6, 10**12, 10**19, 10**40])
def test_a_header_that_promises_more_than_the_file_holds_takes_no_memory(
    tmp_path: Path, form: str, count: int
) -> None:
    path = ply(tmp_path, f"format {form} 1.0", f"element vertex {count}", *XYZ, *LISTS, data=bytes(64))
    with pytest.raises(InputError, match=f"mesh.ply: expected {count} of `vertex`, as its header says"):
        read_mesh(path)


def test_a_big_endian_mesh_is_read_as_another_program_means_it(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [10, 0, 0], [0, 20, 5]], ">f4")
    data = corners.tobytes() + struct.pack(">Biii", 3, 0, 1, 2)
    path = ply(tmp_path, "format binary_big_endian 1.0", "element vertex 3", *XYZ, *LISTS, data=data)
    mesh, theirs = read_mesh(path), trimesh.load(path, process=False)
    assert np.array_equal(mesh.vertices, theirs.vertices)
    assert np.array_equal(mesh.triangles, theirs.faces)


def test_a_property_that_stands_twice_is_refused(tmp_path: Path) -> None:
    path = ply(tmp_path, "format binary_big_endian 1.0", "element vertex 1", *XYZ, XYZ[0], *LISTS, data=bytes(99))
    with pytest.raises(InputError, match=r"mesh\.ply: element `vertex` has `?.*x` twice"):
        read_mesh(path)


def test_coordinates_that_a_float32_cannot_hold_are_refused(tmp_path: Path) -> None:
    doubles = tuple(line.replace("float", "double") for line in XYZ)
    data = struct.pack("<ddd", 0.0, 1e300, 0.0)
    path = ply(
        tmp_path, "format binary_little_endian 1.0", "element vertex 1", *doubles, *LISTS, data=data + b"9" * 9
    )
    with pytest.raises(InputError, match=r"vertex 0: expected finite coordinates, found 0, inf, 0"):
        read_mesh(path)


def test_a_mesh_of_an_impossible_surface_is_refused_before_it_takes_memory(cell: CellFolder) -> None:
    random = np.random.default_rng(1)
    corners = random.uniform(-700, 700, (600, 3))
    corners[:, 2] += 700
    mesh = trimesh.Trimesh(corners, random.integers(0, 600, (3000, 3)), process=False)
    mesh.export(cell.folder / "thicket.ply")
    cell.write(object={"id": "thing", "mesh": "thicket.ply"})
    refused(cell, "object.mesh_unit", "expected the surface of one object", "plan.yaml")


def test_a_links_mesh_in_another_unit_is_refused(tmp_path: Path) -> None:
    trimesh.creation.box(extents=(8e4, 8e4, 8e4)).export(tmp_path / "base_link.stl")
    with pytest.raises(InputError, match=r"base_link\.stl: expected the mesh of link 0 in its own frame"):
        link_corners(tmp_path, 0)


def test_shipped_domes_and_arms_are_within_all_bounds() -> None:
    for path in (REPO / "configs/domes").glob("*.csv"):
        assert len(read_led_table(path).ids) > 10
