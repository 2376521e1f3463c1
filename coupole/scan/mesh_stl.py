"""STL, binary or text. It repeats vertices for each triangle."""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels import kernel
from coupole.scan import mesh_text
from coupole.scan.mesh import CHUNK, Mesh, expect_finite, expect_text
from coupole.scan.mesh_bytes import MeshFile, read_records
from coupole.scan.mesh_text import NOT_A_NUMBER, OK

_STL_RECORD = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER_BYTES = 80


def read_stl(source: MeshFile) -> Mesh:
    """Read an STL: as binary if its size agrees with its count of triangles, whatever its header says; otherwise
    as text."""
    path, size = source.path, source.size_bytes
    with source.open_file() as file:
        header = file.read(_STL_HEADER_BYTES)
        count = int.from_bytes(file.read(4), "little")
    file_bytes = _STL_HEADER_BYTES + 4 + count * _STL_RECORD.itemsize
    if size != file_bytes:
        if header.lstrip()[:5] == b"solid":
            return _read_ascii_stl(source)
        if size < _STL_HEADER_BYTES + 4:
            raise InputError(f"{path}: expected a header of 84 bytes; the file has {size}")
        at = (size - _STL_HEADER_BYTES - 4) // _STL_RECORD.itemsize
        raise InputError(
            f"{path}: the file ends in triangle {at} of {count}, or is not an STL: {size} bytes, not {file_bytes}"
        )
    welder = _Welder(count)
    with source.open_file() as file:
        file.seek(_STL_HEADER_BYTES + 4)
        for first in range(0, count, CHUNK):
            part = np.ascontiguousarray(read_records(file, _STL_RECORD, min(CHUNK, count - first))["corners"])
            expect_finite(path, part, f"corner {{}} counted from triangle {first}")
            welder.add(part)
    return welder.mesh()


def _read_ascii_stl(source: MeshFile) -> Mesh:
    path, data = source.path, source.mapped_bytes()
    count, line = _count_lines_with(data, np.frombuffer(b"vertex", np.uint8))
    if count % 3 or not re.search(rb"endsolid[^\n]*\s*\Z", bytes(data[-4096:])):
        raise InputError(f"{path}:{line}: expected `endsolid` after whole triangles: the file was cut off")
    corners = np.empty((count // 3, 3, 3), np.float32)
    state, line = _fill_ascii_stl(data, np.frombuffer(b"vertex", np.uint8), corners.reshape(-1, 3))
    expect_text(path, state, line, "`vertex` and three numbers")
    expect_finite(path, corners, "corner {}")
    welder = _Welder(len(corners))
    welder.add(corners)
    return welder.mesh()


@kernel
def _starts_with(data, at, end, word):  # type: ignore[no-untyped-def]
    matches = end - at >= len(word)
    for k in range(len(word)):
        matches = matches and data[at + k] == word[k]
    return matches


@kernel
def _count_lines_with(data, word):  # type: ignore[no-untyped-def]
    at, lines, count = 0, 0, 0
    while at < len(data):
        end = mesh_text.line_end(data, at)
        count += _starts_with(data, mesh_text.skip_blanks(data, at, end), end, word)
        at, lines = end + 1, lines + 1
    return count, lines


@kernel
def _fill_ascii_stl(data, word, points):  # type: ignore[no-untyped-def]
    at, line, n = 0, 1, 0
    while at < len(data) and n < len(points):
        end = mesh_text.line_end(data, at)
        at = mesh_text.skip_blanks(data, at, end)
        if _starts_with(data, at, end, word):
            at += len(word)
            for axis in range(3):
                at = mesh_text.skip_blanks(data, at, end)
                value, at, is_number = mesh_text.decimal(data, at, end)
                if not is_number:
                    return NOT_A_NUMBER, line
                points[n, axis] = value
            n += 1
        at, line = end + 1, line + 1
    return OK, line


class _Welder:
    """Gives corners with equal coordinates the same number, in order of first occurrence."""

    def __init__(self, triangles: int) -> None:
        slots = 1 << max(4, int(np.ceil(np.log2(max(1, triangles) * 1.5))))
        self._slots = np.full(slots, -1, np.int64)
        self._vertices = np.empty((max(4, triangles // 2 + 4), 3), np.float32)
        self._triangles = np.empty((triangles, 3), np.uint32)
        self._known, self._filled = 0, 0

    def add(self, corners: NDArray[np.float32]) -> None:
        points, welded_count = corners.reshape(-1, 3), 0
        out = self._triangles.reshape(-1)[3 * self._filled :]
        while welded_count < len(points):
            welded_count, self._known = _weld(points, welded_count, self._slots, self._vertices, self._known, out)
            # there is not enough room: the mesh has more vertices than a closed surface
            if welded_count < len(points):
                self._vertices = np.concatenate([self._vertices, np.empty_like(self._vertices)])
                self._slots = np.full(2 * len(self._slots), -1, np.int64)
                _fill_slots(self._slots, self._vertices, self._known)
        self._filled += len(corners)

    def mesh(self) -> Mesh:
        return Mesh(self._vertices[: self._known].copy(), self._triangles)


@kernel
def _slot(slots, vertices, x, y, z):  # type: ignore[no-untyped-def]
    """Return the slot of a point in the hash table (open addressing), or the free slot for it."""
    key = np.empty(3, np.float32)
    key[0], key[1], key[2] = x + np.float32(0.0), y + np.float32(0.0), z + np.float32(0.0)  # -0 becomes 0
    bits = key.view(np.uint32)
    mix = np.uint64(bits[0]) * np.uint64(0x9E3779B97F4A7C15)
    mix = (mix ^ (mix >> np.uint64(29)) ^ np.uint64(bits[1])) * np.uint64(0xBF58476D1CE4E5B9)
    mix = (mix ^ (mix >> np.uint64(32)) ^ np.uint64(bits[2])) * np.uint64(0x94D049BB133111EB)
    at = np.int64((mix ^ (mix >> np.uint64(31))) & np.uint64(len(slots) - 1))
    while slots[at] >= 0:
        n = slots[at]
        if vertices[n, 0] == x and vertices[n, 1] == y and vertices[n, 2] == z:
            return at
        at = (at + 1) & (len(slots) - 1)
    return at


@kernel
def _fill_slots(slots, vertices, vertex_count):  # type: ignore[no-untyped-def]
    for n in range(vertex_count):
        slots[_slot(slots, vertices, vertices[n, 0], vertices[n, 1], vertices[n, 2])] = n


@kernel
def _weld(points, done_count, slots, vertices, vertex_count, out):  # type: ignore[no-untyped-def]
    while done_count < len(points):
        x, y, z = points[done_count, 0], points[done_count, 1], points[done_count, 2]
        at = _slot(slots, vertices, x, y, z)
        if slots[at] < 0:
            if vertex_count == len(vertices) or 2 * vertex_count > len(slots):
                return done_count, vertex_count
            vertices[vertex_count, 0], vertices[vertex_count, 1], vertices[vertex_count, 2] = x, y, z
            slots[at] = vertex_count
            vertex_count += 1
        out[done_count] = slots[at]
        done_count += 1
    return done_count, vertex_count
