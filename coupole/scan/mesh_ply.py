"""PLY: text, or binary in either byte order; other properties are skipped."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels import kernel
from coupole.scan import mesh_text
from coupole.scan.mesh import CHUNK, Mesh, expect_corners, expect_finite, expect_records, expect_room, expect_text
from coupole.scan.mesh_bytes import MeshFile, read_records
from coupole.scan.mesh_text import BAD_CORNER, NOT_A_NUMBER, OK, TOO_FEW

_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}


@dataclass(frozen=True)
class _Element:
    """One block of a PLY: its properties are (name, type) or (name, count type, item type)."""

    name: str
    count: int
    properties: tuple[tuple[str, ...], ...]


def read_ply(source: MeshFile) -> Mesh:
    """Read a PLY. Raises InputError with the place of the error."""
    path = source.path
    file_format, elements, at, line = _ply_header(source)
    for element in elements:
        _expect_possible(source, element, ascii_text=file_format == "ascii")
    if file_format == "ascii":
        return _read_ascii_ply(source, elements, at, line)
    order = "<" if file_format == "binary_little_endian" else ">"
    vertices, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
    with source.open_file() as file:
        file.seek(at)
        for element in elements:
            if element.name == "vertex":
                vertices = _binary_vertices(path, file, element, order)
            elif element.name == "face":
                triangles = _binary_triangles(path, file, element, order, len(vertices))
                break
            else:
                file.seek(element.count * _plain_record(path, element, order).itemsize, 1)
    return Mesh(vertices, triangles)


def _expect_possible(source: MeshFile, element: _Element, *, ascii_text: bool) -> None:
    """Raise InputError if the file is too short for an element, or if a property occurs twice."""
    path, names = source.path, [field[0] for field in element.properties]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(
            f"{path}: element `{element.name}` has property `{twice[0]}` twice; expected each name once"
        )
    kinds = [_PLY_TYPES.get(field[1], "u1") for field in element.properties]  # for a list, its count
    least_bytes = 2 * len(kinds) if ascii_text else sum(np.dtype(kind).itemsize for kind in kinds)
    expect_room(path, f"`{element.name}`", element.count, max(1, least_bytes), source.size_bytes + 1)


def _ply_header(source: MeshFile) -> tuple[str, list[_Element], int, int]:
    """Return format, elements, and the byte and line at which the data begin."""
    elements: list[_Element] = []
    path, file_format = source.path, ""
    with source.open_file() as file:
        for number in range(1, 10_000):
            words = file.readline(4096).decode("ascii", "replace").split()
            if number == 1 and words != ["ply"]:
                raise InputError(f"{path}:1: expected `ply`; this is not a PLY file")
            match words:
                case ["format", kind, _] if kind in ("ascii", "binary_little_endian", "binary_big_endian"):
                    file_format = kind
                case ["element", name, count] if count.isdigit():
                    elements.append(_Element(name, int(count), ()))
                case ["property", "list", count_type, item_type, name] if elements:
                    elements[-1] = _with(elements[-1], (name, count_type, item_type))
                case ["property", kind, name] if elements and kind in _PLY_TYPES:
                    elements[-1] = _with(elements[-1], (name, kind))
                case ["end_header"] if file_format:
                    return file_format, elements, file.tell(), number + 1
                case ["ply"] | ["comment" | "obj_info", *_]:
                    pass
                case _:
                    text = " ".join(words) or "nothing"
                    raise InputError(f"{path}:{number}: expected a line of a PLY header, found `{text[:60]}`")
    raise InputError(f"{path}: expected `end_header`; the header has no end")


def _with(element: _Element, property_words: tuple[str, ...]) -> _Element:
    return _Element(element.name, element.count, (*element.properties, property_words))


def _plain_record(path: Path, element: _Element, order: str) -> np.dtype[np.void]:
    """Return the layout of an element without lists."""
    if any(len(field) == 3 for field in element.properties):
        raise InputError(f"{path}: element `{element.name}` has lists; only faces may have lists")
    return np.dtype([(name, order + _PLY_TYPES[kind]) for name, kind in element.properties])


def _binary_vertices(path: Path, file, element: _Element, order: str) -> NDArray[np.float32]:  # type: ignore[no-untyped-def]
    record = _plain_record(path, element, order)
    if not {"x", "y", "z"} <= set(record.names or ()):
        raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(record.names or ())}")
    vertices = np.empty((element.count, 3), np.float32)
    if record.names == ("x", "y", "z") and record.itemsize == 12 and order == "<":
        byte_count = file.readinto(vertices.data.cast("B")) if element.count else 0
        expect_records(path, "vertex", element.count, byte_count // 12)
    else:
        for first in range(0, element.count, CHUNK):
            part = read_records(file, record, min(CHUNK, element.count - first))
            expect_records(
                path, "vertex", element.count, first + len(part), min(CHUNK, element.count - first) + first
            )
            for k, axis in enumerate("xyz"):
                # numbers that float32 cannot hold become infinite, and are refused below
                with np.errstate(over="ignore"):
                    vertices[first : first + len(part), k] = part[axis]
    expect_finite(path, vertices, "vertex {}")
    return vertices


def _binary_triangles(path: Path, file, element: _Element, order: str, vertices: int) -> NDArray[np.uint32]:  # type: ignore[no-untyped-def]
    lists = [field for field in element.properties if len(field) == 3]
    if len(lists) != 1 or lists[0][0] not in ("vertex_indices", "vertex_index"):
        raise InputError(f"{path}: expected faces with one list, `vertex_indices`")
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for field in element.properties:
        if len(field) == 3:
            kinds = [_PLY_TYPES.get(kind, "") for kind in field[1:]]
            if kinds[0] not in ("u1", "i1", "u2", "i2", "u4", "i4") or kinds[1] not in (
                "i4",
                "u4",
                "u2",
                "i2",
                "u1",
            ):
                raise InputError(
                    f"{path}: expected faces as lists of whole numbers, found {' of '.join(field[1:])}"
                )
            fields += [("corners", order + kinds[0]), ("indices", order + kinds[1], (3,))]
        else:
            fields.append((field[0], order + _PLY_TYPES[field[1]]))
    record = np.dtype(fields)
    triangles = np.empty((element.count, 3), np.uint32)
    for first in range(0, element.count, CHUNK):
        record_count = min(CHUNK, element.count - first)
        part = read_records(file, record, record_count)
        corners = part["corners"]
        if (wrong := np.flatnonzero(corners != 3)).size:
            count = int(corners[wrong[0]])
            raise InputError(f"{path}: face {first + wrong[0]}: expected 3 corners, found {count}")
        expect_records(path, "face", element.count, first + len(part), first + record_count)
        triangles[first : first + len(part)] = part["indices"]
        expect_corners(path, triangles[first : first + len(part)], vertices, first)
    return triangles


def _read_ascii_ply(source: MeshFile, elements: list[_Element], at: int, line: int) -> Mesh:
    path, data = source.path, source.mapped_bytes()
    vertices, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
    for element in elements:
        names = [field[0] for field in element.properties]
        if element.name == "vertex":
            _plain_record(path, element, "<")
            if not {"x", "y", "z"} <= set(names):
                raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(names)}")
            vertices = np.empty((element.count, 3), np.float32)
            columns = np.array([names.index(axis) for axis in "xyz"])
            state, at, line = _fill_vertices(data, at, line, columns, vertices)
            expect_text(path, state, line, "numbers for x, y and z")
            expect_finite(path, vertices, f"vertex {{}} (lines from {line - len(vertices)})")
        elif element.name == "face":
            triangles = np.empty((element.count, 3), np.uint32)
            state, at, line = _fill_faces(data, at, line, triangles, len(vertices))
            expect_text(
                path, state, line, f"the number 3, then three vertex numbers from 0 to {len(vertices) - 1}"
            )
        else:
            at, line = _after_lines(path, data, at, element), line + element.count
    return Mesh(vertices, triangles)


def _after_lines(path: Path, data: NDArray[np.uint8], at: int, element: _Element) -> int:
    """Return the place where the lines of a skipped element end."""
    if element.count == 0:
        return at
    begins = np.concatenate([[at], at + 1 + np.flatnonzero(data[at:] == ord("\n"))])
    there = int(np.sum(begins < len(data)))
    expect_records(path, element.name, element.count, min(there, element.count))
    return int(begins[element.count]) if len(begins) > element.count else len(data)


@kernel
def _fill_vertices(data, at, line, columns, vertices):  # type: ignore[no-untyped-def]
    last_column = columns.max()
    for n in range(len(vertices)):
        if at >= len(data):
            return TOO_FEW, at, line
        end = mesh_text.line_end(data, at)
        for column in range(last_column + 1):
            at = mesh_text.skip_blanks(data, at, end)
            value, at, is_number = mesh_text.decimal(data, at, end)
            if not is_number:
                return (TOO_FEW if end >= len(data) else NOT_A_NUMBER), at, line
            for axis in range(3):
                if columns[axis] == column:
                    vertices[n, axis] = value
        at, line = end + 1, line + 1
    return OK, at, line


@kernel
def _fill_faces(data, at, line, triangles, vertices):  # type: ignore[no-untyped-def]
    for n in range(len(triangles)):
        if at >= len(data):
            return TOO_FEW, at, line
        end = mesh_text.line_end(data, at)
        for k in range(4):
            at = mesh_text.skip_blanks(data, at, end)
            value, at, is_number = mesh_text.whole(data, at, end)
            if not is_number:
                return (TOO_FEW if end >= len(data) else NOT_A_NUMBER), at, line
            if k == 0:
                if value != 3:
                    return BAD_CORNER, at, line
            elif value < 0 or value >= vertices:
                return BAD_CORNER, at, line
            else:
                triangles[n, k - 1] = value
        at, line = end + 1, line + 1
    return OK, at, line
