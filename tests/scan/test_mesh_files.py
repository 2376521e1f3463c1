"""Meshes: the same triangles whatever the format, and each broken file refused with its place."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from places import SHARED_DATA

from coupole.errors import InputError
from coupole.scan import mesh_text
from coupole.scan.mesh import Mesh
from coupole.scan.mesh_defects import find_defects
from coupole.scan.mesh_files import read_mesh
from coupole.scan.scanner_export import read_scan

BUNNY = SHARED_DATA / "bunny/bun_zipper.ply"
SPHERE = trimesh.creation.icosphere(subdivisions=3, radius=40.0)
FORMATS = {
    "binary.ply": {"file_type": "ply"},
    "ascii.ply": {"file_type": "ply", "encoding": "ascii"},
    "binary.stl": {"file_type": "stl"},
    "ascii.stl": {"file_type": "stl_ascii"},
    "plain.obj": {"file_type": "obj", "digits": 12},
}


def written(folder: Path, name: str, mesh: trimesh.Trimesh = SPHERE) -> Path:
    path = folder / name
    mesh.export(path, **FORMATS[name])
    return path


def corners(mesh: Mesh) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    return mesh.vertices[mesh.triangles]


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_triangles_in_the_same_order(tmp_path: Path, name: str) -> None:
    expected = SPHERE.vertices[SPHERE.faces]
    assert np.abs(corners(read_mesh(written(tmp_path, name))) - expected).max() < 1e-5


@pytest.mark.parametrize("name", ["binary.stl", "ascii.stl"])
def test_corners_of_an_stl_with_the_same_coordinates_are_one_vertex(tmp_path: Path, name: str) -> None:
    mesh = read_mesh(written(tmp_path, name))
    assert len(mesh.vertices) == len(SPHERE.vertices)
    assert find_defects(mesh).open_edges == 0


def test_a_binary_stl_may_begin_with_the_word_solid_and_carry_attributes(tmp_path: Path) -> None:
    path = written(tmp_path, "binary.stl")
    data = bytearray(path.read_bytes())
    data[:80] = b"solid VXelements".ljust(80)
    data[84 + 48 : 84 + 50] = b"\x12\x34"
    path.write_bytes(data)
    assert len(read_mesh(path).triangles) == len(SPHERE.faces)


@pytest.mark.skipif(not BUNNY.is_file(), reason="the bunny is not at hand")
def test_the_bunny_is_read_as_trimesh_reads_it() -> None:
    ours, theirs = read_mesh(BUNNY), trimesh.load(BUNNY, process=False)
    assert np.array_equal(ours.triangles, theirs.faces)
    assert np.array_equal(ours.vertices, theirs.vertices.astype(np.float32))


def test_a_ply_with_more_properties_and_big_endian_is_read(tmp_path: Path) -> None:
    path = tmp_path / "big.ply"
    header = (
        "ply\nformat binary_big_endian 1.0\ncomment made by hand\nelement vertex 3\nproperty double x\n"
        "property double y\nproperty double z\nproperty uchar red\nelement face 1\nproperty uchar flags\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    points = [struct.pack(">dddB", *xyz, 7) for xyz in ((0, 0, 0), (1, 0, 0), (0, 1, 0.5))]
    path.write_bytes(header.encode() + b"".join(points) + struct.pack(">BBiii", 1, 3, 0, 1, 2))
    assert corners(read_mesh(path)).tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]]


def test_an_obj_with_normals_quads_and_backward_corners_is_read(tmp_path: Path) -> None:
    path = tmp_path / "quad.obj"
    path.write_text(
        "o thing\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 -1e-1\nvn 0 0 1\nusemtl x\nf 1//1 2//1 3//1 -1//1\n"
    )
    assert read_mesh(path).triangles.tolist() == [[0, 1, 2], [0, 2, 3]]


@given(st.floats(-1e6, 1e6, width=32), st.sampled_from(["{!r}", "{:.9e}", "{:+.12f}", "{:.9E}"]))
def test_numbers_are_read_to_the_last_bit_of_a_float32(value: float, form: str) -> None:
    text = np.frombuffer(form.format(value).encode(), np.uint8)
    found, at, ok = mesh_text.decimal(text, 0, len(text))
    assert ok
    assert at == len(text)
    assert np.float32(found) == np.float32(float(form.format(value)))


@pytest.mark.parametrize("text", ["", "-", ".", "1.2.3", "12a", "e5", "1e", "--1", "0x10"])
def test_what_is_no_number_is_not_read_as_one(text: str) -> None:
    assert not mesh_text.decimal(np.frombuffer(text.encode(), np.uint8), 0, len(text))[2]


# -- broken files -----------------------------------------------------------------------------------------


def cut(path: Path, share: float) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


@pytest.mark.parametrize("share", [0.3, 0.8, 0.999])
@pytest.mark.parametrize("name", ["binary.ply", "ascii.ply", "binary.stl", "ascii.stl"])
def test_a_file_that_was_cut_off_is_refused_with_where(tmp_path: Path, name: str, share: float) -> None:
    path = written(tmp_path, name)
    cut(path, share)
    with pytest.raises(InputError, match=r"cut off|the file ends in triangle \d+ of 1280"):
        read_mesh(path)


def replaced(path: Path, old: bytes, new: bytes) -> None:
    data = path.read_bytes()
    assert data.count(old) >= 1
    path.write_bytes(data.replace(old, new, 1))


def test_a_vertex_that_is_not_a_number_is_refused_with_its_number(tmp_path: Path) -> None:
    bad = SPHERE.copy()
    bad.vertices[17, 1] = np.nan
    for name in ("binary.ply", "ascii.ply", "plain.obj"):
        with pytest.raises(InputError, match=r"vertex 17.*expected finite coordinates, found .*nan"):
            read_mesh(written(tmp_path, name, bad))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", ":4: a corner does not exist; 3 vertices are known"),
        ("v 0 0 0\nv 1 zero 0\nf 1 2 1\n", ":2: expected `v` and three numbers"),
        ("v 0 0 0\nv 1 0 0\nf 1 2\n", ":3: expected a face with three corners or more"),
        ("v 0 0 0\n", "expected triangles; the file holds 1 vertices"),
        ("", "expected triangles; the file holds 0 vertices"),
    ],
)
def test_a_wrong_obj_is_refused_at_its_line(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "wrong.obj"
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(message)):
        read_mesh(path)


PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n" + (
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ply\n", "plx\n", ":1: expected `ply`"),
        ("property float y", "property floot y", ":5: expected a line of a PLY header, found `property floot y`"),
        ("1 0 0\n", "1 O 0\n", ":11: expected numbers for x, y and z"),
        ("3 0 1 2", "4 0 1 2", ":13: expected the number 3, then three vertex numbers from 0 to 2"),
        ("3 0 1 2", "3 0 1 3", ":13: expected the number 3, then three vertex numbers from 0 to 2"),
        ("element face 1", "element face 0", "expected triangles; the file holds 3 vertices"),
        ("property float x\n", "", "expected vertices with x, y and z, found y, z"),
        ("end_header\n", "", "expected a line of a PLY header, found `0 0 0`"),
    ],
)
def test_a_wrong_ply_is_refused_at_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "wrong.ply"
    path.write_text(PLY.replace(old, new, 1))
    with pytest.raises(InputError, match=re.escape(message)):
        read_mesh(path)


def test_a_binary_ply_with_a_quad_or_a_missing_corner_is_refused_with_the_face(tmp_path: Path) -> None:
    path = written(tmp_path, "binary.ply")
    whole = path.read_bytes()
    record = len(whole) - 13 * len(SPHERE.faces) + 13 * 100
    path.write_bytes(whole[:record] + b"\x04" + whole[record + 1 :])
    with pytest.raises(InputError, match=r"face 100: expected 3 corners, found 4"):
        read_mesh(path)
    path.write_bytes(whole[: record + 1] + struct.pack("<i", 5000) + whole[record + 5 :])
    with pytest.raises(InputError, match=r"face 100: corner 5000 does not exist; there are 642 vertices"):
        read_mesh(path)


def test_another_ending_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected a mesh with the ending \.ply, \.stl or \.obj"):
        read_mesh(tmp_path / "mesh.step")
    with pytest.raises(InputError, match="there is none"):
        read_mesh(tmp_path / "mesh.ply")


# -- meshes that are no surface ---------------------------------------------------------------------------


def with_a_fin(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A third triangle at one edge."""
    a, b, _ = mesh.faces[7]
    vertices = np.vstack([mesh.vertices, 1.2 * mesh.vertices[a]])
    return trimesh.Trimesh(vertices, np.vstack([mesh.faces, [a, b, len(vertices) - 1]]), process=False)


def turned(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    faces = mesh.faces.copy()
    faces[50] = faces[50][::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def partly_in_metres(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    small = mesh.copy()
    small.vertices = small.vertices / 1000.0 + (5, 0, 0)
    return trimesh.util.concatenate([mesh, mesh.copy().apply_translation((200, 0, 0)), small])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (with_a_fin, r"not a surface: 1 edges have three triangles or more; the first is at triangle [57], \("),
        (turned, r"3 edges are between triangles of opposite orientation.*the first is at triangle \d+, \("),
        (partly_in_metres, r"mixed units\? Triangle \d+ has an edge of 0\.00"),
        (
            lambda mesh: mesh.copy().apply_scale(1e-3),
            r"0\.1386 mm in size if it is in mm.*; in m or in it would fit",
        ),
    ],
)
def test_a_mesh_that_is_no_clean_surface_is_refused_with_the_place(
    tmp_path: Path, spoil: Callable[[trimesh.Trimesh], trimesh.Trimesh], message: str
) -> None:
    path = written(tmp_path, "binary.ply", spoil(SPHERE))
    with pytest.raises(InputError, match=message):
        read_scan(path)


def test_a_mesh_with_defects_is_taken_where_that_is_accepted_and_they_are_counted(tmp_path: Path) -> None:
    path = written(tmp_path, "binary.ply", with_a_fin(SPHERE))
    assert read_scan(path, accept_defects=True).defects.non_manifold_edges == 1


def test_holes_and_flat_triangles_are_counted_not_refused(tmp_path: Path) -> None:
    a, b, c = SPHERE.faces[3]
    flat = trimesh.Trimesh(SPHERE.vertices, np.vstack([SPHERE.faces[1:], [a, a, a]]), process=False)
    found = read_scan(written(tmp_path, "binary.ply", flat), accept_defects=True).defects
    assert found.degenerate == 1
    assert found.open_edges == 3 + 0
    assert (b, c) != (a, a)


@pytest.mark.parametrize("unit", ["mm", "cm", "m", "um", "in"])
def test_lengths_come_in_mm_whatever_the_unit(tmp_path: Path, unit: str) -> None:
    factor = {"mm": 1, "cm": 10, "m": 1000, "um": 1e-3, "in": 25.4}[unit]
    path = written(tmp_path, "binary.ply", SPHERE.copy().apply_scale(1 / factor))
    assert np.abs(corners(read_scan(path, unit=unit).mesh) - SPHERE.vertices[SPHERE.faces]).max() < 1e-4
