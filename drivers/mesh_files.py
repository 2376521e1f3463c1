"""Triangle meshes of up to tens of millions of triangles: PLY, STL and OBJ, read at the speed of the disk.

What cannot be right is refused, with its place: a file that ends too early, coordinates that are no finite
numbers, corners that do not exist, faces that are no triangles, nothing at all. Memory stays within about three
times what vertices and triangles take themselves.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from drivers import mesh_text
from drivers.mesh_text import BAD_CORNER, NOT_A_NUMBER, OK, TOO_FEW

_STL_RECORD = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER_BYTES = 80
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
_CHUNK = 4_000_000
"""Records that are converted at once."""
_MOST_VERTICES = 2**32 - 2


@dataclass(frozen=True)
class Mesh:
    """Triangles over shared vertices, in the file's unit."""

    vertices: NDArray[np.float32]
    """[n, 3], finite."""
    triangles: NDArray[np.uint32]
    """[m, 3] rows of `vertices`."""


def read_mesh(path: Path) -> Mesh:
    """Read a mesh by its ending: .ply, .stl or .obj. Raises InputError with the place of what is wrong.

    Vertices of an STL, which repeats them for each triangle, are those with the same coordinates, bit by bit.
    """
    readers: dict[str, Callable[[Path], Mesh]] = {".ply": _read_ply, ".stl": _read_stl, ".obj": _read_obj}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a mesh with the ending .ply, .stl or .obj")
    if not path.is_file():
        raise InputError(f"{path}: expected a mesh file; there is none")
    mesh = readers[path.suffix.lower()](path)
    if len(mesh.triangles) == 0:
        raise InputError(
            f"{path}: expected triangles; the file holds {len(mesh.vertices)} vertices and none of them"
        )
    return mesh


# -- PLY --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Element:
    """One block of a PLY: its properties are (name, type) or (name, count type, item type)."""

    name: str
    count: int
    properties: tuple[tuple[str, ...], ...]


def _read_ply(path: Path) -> Mesh:
    file_format, elements, at, line = _ply_header(path)
    if file_format == "ascii":
        return _read_ascii_ply(path, elements, at, line)
    order = "<" if file_format == "binary_little_endian" else ">"
    vertices, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
    with path.open("rb") as file:
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


def _ply_header(path: Path) -> tuple[str, list[_Element], int, int]:
    """Format, elements, and byte and line at which the data begin."""
    elements: list[_Element] = []
    file_format = ""
    with path.open("rb") as file:
        for number in range(1, 10_000):
            words = file.readline(4096).decode("ascii", "replace").split()
            if number == 1 and words != ["ply"]:
                raise InputError(f"{path}:1: expected `ply`; this is no PLY file")
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
                    found = " ".join(words) or "nothing"
                    raise InputError(f"{path}:{number}: expected a line of a PLY header, found `{found[:60]}`")
    raise InputError(f"{path}: expected `end_header`; the header has no end")


def _with(element: _Element, described: tuple[str, ...]) -> _Element:
    return _Element(element.name, element.count, (*element.properties, described))


def _plain_record(path: Path, element: _Element, order: str) -> np.dtype[np.void]:
    """Layout of an element without lists."""
    if any(len(described) == 3 for described in element.properties):
        raise InputError(f"{path}: element `{element.name}` holds lists; only faces may")
    return np.dtype([(name, order + _PLY_TYPES[kind]) for name, kind in element.properties])


def _binary_vertices(path: Path, file, element: _Element, order: str) -> NDArray[np.float32]:  # type: ignore[no-untyped-def]
    record = _plain_record(path, element, order)
    if not {"x", "y", "z"} <= set(record.names or ()):
        raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(record.names or ())}")
    vertices = np.empty((element.count, 3), np.float32)
    if record.names == ("x", "y", "z") and record.itemsize == 12 and order == "<":
        read = file.readinto(vertices.data.cast("B")) if element.count else 0
        _expect_records(path, "vertex", element.count, read // 12)
    else:
        for first in range(0, element.count, _CHUNK):
            part = np.fromfile(file, record, min(_CHUNK, element.count - first))
            _expect_records(
                path, "vertex", element.count, first + len(part), min(_CHUNK, element.count - first) + first
            )
            for k, axis in enumerate("xyz"):
                vertices[first : first + len(part), k] = part[axis]
    _expect_finite(path, vertices, "vertex {}")
    return vertices


def _binary_triangles(path: Path, file, element: _Element, order: str, vertices: int) -> NDArray[np.uint32]:  # type: ignore[no-untyped-def]
    lists = [described for described in element.properties if len(described) == 3]
    if len(lists) != 1 or lists[0][0] not in ("vertex_indices", "vertex_index"):
        raise InputError(f"{path}: expected faces with one list, `vertex_indices`")
    fields: list[tuple[str, str] | tuple[str, str, tuple[int]]] = []
    for described in element.properties:
        if len(described) == 3:
            kinds = [_PLY_TYPES.get(kind, "") for kind in described[1:]]
            if kinds[0] not in ("u1", "i1", "u2", "i2", "u4", "i4") or kinds[1] not in (
                "i4",
                "u4",
                "u2",
                "i2",
                "u1",
            ):
                raise InputError(
                    f"{path}: expected faces as lists of whole numbers, found {' of '.join(described[1:])}"
                )
            fields += [("corners", order + kinds[0]), ("indices", order + kinds[1], (3,))]
        else:
            fields.append((described[0], order + _PLY_TYPES[described[1]]))
    record = np.dtype(fields)
    triangles = np.empty((element.count, 3), np.uint32)
    for first in range(0, element.count, _CHUNK):
        wanted = min(_CHUNK, element.count - first)
        part = np.fromfile(file, record, wanted)
        corners = part["corners"]
        if (wrong := np.flatnonzero(corners != 3)).size:
            found = int(corners[wrong[0]])
            raise InputError(f"{path}: face {first + wrong[0]}: expected 3 corners, found {found}: no triangle")
        _expect_records(path, "face", element.count, first + len(part), first + wanted)
        triangles[first : first + len(part)] = part["indices"]
        _expect_corners(path, triangles[first : first + len(part)], vertices, first)
    return triangles


def _expect_records(path: Path, what: str, count: int, read: int, wanted: int | None = None) -> None:
    if read < (count if wanted is None else wanted):
        raise InputError(f"{path}: the file ends in {what} {read} of {count}: it was cut off")


def _expect_finite(path: Path, points: NDArray[np.float32], where: str) -> None:
    """`where` names a point by its number."""
    bad = _first_not_finite(points.reshape(-1, 3))
    if bad >= 0:
        xyz = ", ".join(f"{value:g}" for value in points.reshape(-1, 3)[bad])
        raise InputError(f"{path}: {where.format(bad)}: expected finite coordinates, found {xyz}")


def _expect_corners(path: Path, triangles: NDArray[np.uint32], vertices: int, first: int) -> None:
    bad = _first_beyond(triangles, vertices)
    if bad >= 0:
        worst = int(triangles[bad].max())
        raise InputError(
            f"{path}: face {first + bad}: corner {worst} does not exist; there are {vertices} vertices"
        )


@numba.njit(cache=True, nogil=True)
def _first_not_finite(points):  # type: ignore[no-untyped-def]
    for k in range(len(points)):
        if not np.isfinite(points[k, 0] + points[k, 1] + points[k, 2]):
            return k
    return -1


@numba.njit(cache=True, nogil=True)
def _first_beyond(triangles, vertices):  # type: ignore[no-untyped-def]
    for k in range(len(triangles)):
        if triangles[k, 0] >= vertices or triangles[k, 1] >= vertices or triangles[k, 2] >= vertices:
            return k
    return -1


def _read_ascii_ply(path: Path, elements: list[_Element], at: int, line: int) -> Mesh:
    data = mesh_text.mapped(path)
    vertices, triangles = np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint32)
    for element in elements:
        names = [described[0] for described in element.properties]
        if element.name == "vertex":
            if not {"x", "y", "z"} <= set(names):
                raise InputError(f"{path}: expected vertices with x, y and z, found {', '.join(names)}")
            vertices = np.empty((element.count, 3), np.float32)
            columns = np.array([names.index(axis) for axis in "xyz"])
            state, at, line = _fill_vertices(data, at, line, columns, vertices)
            _expect_text(path, state, line, "x, y and z in numbers")
            _expect_finite(path, vertices, f"vertex {{}} (lines from {line - len(vertices)})")
        elif element.name == "face":
            triangles = np.empty((element.count, 3), np.uint32)
            state, at, line = _fill_faces(data, at, line, triangles, len(vertices))
            _expect_text(path, state, line, f"3 and three vertices of 0 to {len(vertices) - 1}")
        else:
            for _ in range(element.count):
                at, line = mesh_text.line_end(data, at) + 1, line + 1
    return Mesh(vertices, triangles)


def _expect_text(path: Path, state: int, line: int, expected: str) -> None:
    if state == TOO_FEW:
        raise InputError(f"{path}:{line}: expected {expected}; the file ends here: it was cut off")
    if state != OK:
        raise InputError(f"{path}:{line}: expected {expected}")


@numba.njit(cache=True, nogil=True)
def _fill_vertices(data, at, line, columns, vertices):  # type: ignore[no-untyped-def]
    last_column = columns.max()
    for n in range(len(vertices)):
        if at >= len(data):
            return TOO_FEW, at, line
        end = mesh_text.line_end(data, at)
        for column in range(last_column + 1):
            at = mesh_text.skip_blanks(data, at, end)
            value, at, found = mesh_text.decimal(data, at, end)
            if not found:
                return (TOO_FEW if end >= len(data) else NOT_A_NUMBER), at, line
            for axis in range(3):
                if columns[axis] == column:
                    vertices[n, axis] = value
        at, line = end + 1, line + 1
    return OK, at, line


@numba.njit(cache=True, nogil=True)
def _fill_faces(data, at, line, triangles, vertices):  # type: ignore[no-untyped-def]
    for n in range(len(triangles)):
        if at >= len(data):
            return TOO_FEW, at, line
        end = mesh_text.line_end(data, at)
        for k in range(4):
            at = mesh_text.skip_blanks(data, at, end)
            value, at, found = mesh_text.whole(data, at, end)
            if not found:
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


# -- STL --------------------------------------------------------------------------------------------------


def _read_stl(path: Path) -> Mesh:
    """Binary, whatever its header says, if its size is what its count asks for; else text."""
    size = path.stat().st_size
    with path.open("rb") as file:
        header = file.read(_STL_HEADER_BYTES)
        count = int.from_bytes(file.read(4), "little")
    expected = _STL_HEADER_BYTES + 4 + count * _STL_RECORD.itemsize
    if size != expected:
        if header.lstrip()[:5] == b"solid":
            return _read_ascii_stl(path)
        if size < _STL_HEADER_BYTES + 4:
            raise InputError(f"{path}: expected a header of 84 bytes; the file has {size}")
        at = (size - _STL_HEADER_BYTES - 4) // _STL_RECORD.itemsize
        raise InputError(
            f"{path}: the file ends in triangle {at} of {count}, or is no STL: {size} bytes, not {expected}"
        )
    welder = _Welder(count)
    with path.open("rb") as file:
        file.seek(_STL_HEADER_BYTES + 4)
        for first in range(0, count, _CHUNK):
            part = np.ascontiguousarray(np.fromfile(file, _STL_RECORD, min(_CHUNK, count - first))["corners"])
            _expect_finite(path, part, f"corner {{}} counted from triangle {first}")
            welder.add(part)
    return welder.mesh()


def _read_ascii_stl(path: Path) -> Mesh:
    data = mesh_text.mapped(path)
    count, line = _count_lines_with(data, np.frombuffer(b"vertex", np.uint8))
    if count % 3 or not re.search(rb"endsolid[^\n]*\s*\Z", bytes(data[-4096:])):
        raise InputError(f"{path}:{line}: expected `endsolid` after whole triangles: the file was cut off")
    corners = np.empty((count // 3, 3, 3), np.float32)
    state, line = _fill_ascii_stl(data, np.frombuffer(b"vertex", np.uint8), corners.reshape(-1, 3))
    _expect_text(path, state, line, "`vertex` and three numbers")
    _expect_finite(path, corners, "corner {}")
    welder = _Welder(len(corners))
    welder.add(corners)
    return welder.mesh()


@numba.njit(cache=True, nogil=True)
def _starts_with(data, at, end, word):  # type: ignore[no-untyped-def]
    found = end - at >= len(word)
    for k in range(len(word)):
        found = found and data[at + k] == word[k]
    return found


@numba.njit(cache=True, nogil=True)
def _count_lines_with(data, word):  # type: ignore[no-untyped-def]
    at, lines, count = 0, 0, 0
    while at < len(data):
        end = mesh_text.line_end(data, at)
        count += _starts_with(data, mesh_text.skip_blanks(data, at, end), end, word)
        at, lines = end + 1, lines + 1
    return count, lines


@numba.njit(cache=True, nogil=True)
def _fill_ascii_stl(data, word, points):  # type: ignore[no-untyped-def]
    at, line, n = 0, 1, 0
    while at < len(data) and n < len(points):
        end = mesh_text.line_end(data, at)
        at = mesh_text.skip_blanks(data, at, end)
        if _starts_with(data, at, end, word):
            at += len(word)
            for axis in range(3):
                at = mesh_text.skip_blanks(data, at, end)
                value, at, found = mesh_text.decimal(data, at, end)
                if not found:
                    return NOT_A_NUMBER, line
                points[n, axis] = value
            n += 1
        at, line = end + 1, line + 1
    return OK, line


class _Welder:
    """Gives corners with the same coordinates the same number, in order of first sight."""

    def __init__(self, triangles: int) -> None:
        slots = 1 << max(4, int(np.ceil(np.log2(max(1, triangles) * 1.5))))
        self._slots = np.full(slots, -1, np.int64)
        self._vertices = np.empty((max(4, triangles // 2 + 4), 3), np.float32)
        self._triangles = np.empty((triangles, 3), np.uint32)
        self._known, self._filled = 0, 0

    def add(self, corners: NDArray[np.float32]) -> None:
        points, done = corners.reshape(-1, 3), 0
        out = self._triangles.reshape(-1)[3 * self._filled :]
        while done < len(points):
            done, self._known = _weld(points, done, self._slots, self._vertices, self._known, out)
            if done < len(points):  # room runs out: more vertices than a closed surface has
                self._vertices = np.concatenate([self._vertices, np.empty_like(self._vertices)])
                self._slots = np.full(2 * len(self._slots), -1, np.int64)
                _fill_slots(self._slots, self._vertices, self._known)
        self._filled += len(corners)

    def mesh(self) -> Mesh:
        return Mesh(self._vertices[: self._known].copy(), self._triangles)


@numba.njit(cache=True, nogil=True)
def _slot(slots, vertices, x, y, z):  # type: ignore[no-untyped-def]
    """Where a point stands, or could: open addressing, from a mix of its coordinates' bits."""
    key = np.empty(3, np.float32)
    key[0], key[1], key[2] = x + np.float32(0.0), y + np.float32(0.0), z + np.float32(0.0)  # -0 becomes 0
    bits = key.view(np.uint32)
    mixed = np.uint64(bits[0]) * np.uint64(0x9E3779B97F4A7C15)
    mixed = (mixed ^ (mixed >> np.uint64(29)) ^ np.uint64(bits[1])) * np.uint64(0xBF58476D1CE4E5B9)
    mixed = (mixed ^ (mixed >> np.uint64(32)) ^ np.uint64(bits[2])) * np.uint64(0x94D049BB133111EB)
    at = np.int64((mixed ^ (mixed >> np.uint64(31))) & np.uint64(len(slots) - 1))
    while slots[at] >= 0:
        n = slots[at]
        if vertices[n, 0] == x and vertices[n, 1] == y and vertices[n, 2] == z:
            return at
        at = (at + 1) & (len(slots) - 1)
    return at


@numba.njit(cache=True, nogil=True)
def _fill_slots(slots, vertices, known):  # type: ignore[no-untyped-def]
    for n in range(known):
        slots[_slot(slots, vertices, vertices[n, 0], vertices[n, 1], vertices[n, 2])] = n


@numba.njit(cache=True, nogil=True)
def _weld(points, done, slots, vertices, known, out):  # type: ignore[no-untyped-def]
    while done < len(points):
        x, y, z = points[done, 0], points[done, 1], points[done, 2]
        at = _slot(slots, vertices, x, y, z)
        if slots[at] < 0:
            if known == len(vertices) or 2 * known > len(slots):
                return done, known
            vertices[known, 0], vertices[known, 1], vertices[known, 2] = x, y, z
            slots[at] = known
            known += 1
        out[done] = slots[at]
        done += 1
    return done, known


# -- OBJ --------------------------------------------------------------------------------------------------


def _read_obj(path: Path) -> Mesh:
    data = mesh_text.mapped(path)
    count, triangles_count, bad_line = _count_obj(data)
    if bad_line:
        raise InputError(f"{path}:{bad_line}: expected a face with three corners or more")
    vertices, triangles = np.empty((count, 3), np.float32), np.empty((triangles_count, 3), np.uint32)
    state, line = _fill_obj(data, vertices, triangles)
    if state == BAD_CORNER:
        raise InputError(f"{path}:{line}: a corner does not exist; {count} vertices are known")
    _expect_text(path, state, line, "`v` and three numbers, or `f` and vertices")
    _expect_finite(path, vertices, "vertex {}")
    return Mesh(vertices, triangles)


@numba.njit(cache=True, nogil=True)
def _obj_line(data, at, end):  # type: ignore[no-untyped-def]
    """1 for a vertex, 2 for a face, 0 for anything else; and where its words begin."""
    at = mesh_text.skip_blanks(data, at, end)
    if at + 1 < end and (data[at + 1] == 32 or data[at + 1] == 9):
        if data[at] == 118:
            return 1, at + 1
        if data[at] == 102:
            return 2, at + 1
    return 0, at


@numba.njit(cache=True, nogil=True)
def _count_obj(data):  # type: ignore[no-untyped-def]
    at, line, vertices, triangles = 0, 1, 0, 0
    while at < len(data):
        end = mesh_text.line_end(data, at)
        kind, at = _obj_line(data, at, end)
        if kind == 1:
            vertices += 1
        elif kind == 2:
            corners = 0
            at = mesh_text.skip_blanks(data, at, end)
            while at < end:
                corners += 1
                at = mesh_text.skip_blanks(data, mesh_text.token_end(data, at, end), end)
            if corners < 3:
                return vertices, triangles, line
            triangles += corners - 2
        at, line = end + 1, line + 1
    return vertices, triangles, 0


@numba.njit(cache=True, nogil=True)
def _fill_obj(data, vertices, triangles):  # type: ignore[no-untyped-def]
    """Faces with more corners become fans; negative corners count back from the last vertex."""
    at, line, v, t = 0, 1, 0, 0
    while at < len(data):
        end = mesh_text.line_end(data, at)
        kind, at = _obj_line(data, at, end)
        if kind == 1:
            for axis in range(3):
                at = mesh_text.skip_blanks(data, at, end)
                value, at, found = mesh_text.decimal(data, at, end)
                if not found:
                    return NOT_A_NUMBER, line
                vertices[v, axis] = value
            v += 1
        elif kind == 2:
            first, last, corners = 0, 0, 0
            at = mesh_text.skip_blanks(data, at, end)
            while at < end:
                stop = mesh_text.token_end(data, at, end)
                value, after, found = mesh_text.whole(data, at, stop)
                if not found or (after < stop and data[after] != 47):
                    return NOT_A_NUMBER, line
                corner = v + value if value < 0 else value - 1
                if corner < 0 or corner >= len(vertices):
                    return BAD_CORNER, line
                corners += 1
                if corners == 1:
                    first = corner
                elif corners > 2:
                    triangles[t, 0], triangles[t, 1], triangles[t, 2] = first, last, corner
                    t += 1
                last = corner
                at = mesh_text.skip_blanks(data, stop, end)
        at, line = end + 1, line + 1
    return OK, line
