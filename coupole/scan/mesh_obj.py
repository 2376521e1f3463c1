"""OBJ: vertices and faces; everything else is ignored."""

from __future__ import annotations

import numpy as np

from coupole.errors import InputError
from coupole.kernels import kernel
from coupole.scan import mesh_text
from coupole.scan.mesh import Mesh, expect_finite, expect_text
from coupole.scan.mesh_bytes import MeshFile
from coupole.scan.mesh_text import BAD_CORNER, NOT_A_NUMBER, OK


def read_obj(source: MeshFile) -> Mesh:
    """Read an OBJ. Raises InputError with the line of the error."""
    path, data = source.path, source.mapped_bytes()
    count, triangles_count, bad_line = _count_obj(data)
    if bad_line:
        raise InputError(f"{path}:{bad_line}: expected a face with three corners or more")
    vertices, triangles = np.empty((count, 3), np.float32), np.empty((triangles_count, 3), np.uint32)
    state, line = _fill_obj(data, vertices, triangles)
    if state == BAD_CORNER:
        raise InputError(f"{path}:{line}: a corner does not exist; {count} vertices are known")
    expect_text(path, state, line, "`v` and three numbers, or `f` and vertices")
    expect_finite(path, vertices, "vertex {}")
    return Mesh(vertices, triangles)


@kernel
def _obj_line(data, at, end):  # type: ignore[no-untyped-def]
    """Return the kind of line (1 for a vertex, 2 for a face, 0 for any other), and the offset of its first
    value."""
    at = mesh_text.skip_blanks(data, at, end)
    if at + 1 < end and (data[at + 1] == 32 or data[at + 1] == 9):
        if data[at] == 118:
            return 1, at + 1
        if data[at] == 102:
            return 2, at + 1
    return 0, at


@kernel
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


@kernel
def _fill_obj(data, vertices, triangles):  # type: ignore[no-untyped-def]
    """Fill vertices and triangles. Faces with more than three corners become triangle fans; negative corners count
    back from the last vertex."""
    at, line, v, t = 0, 1, 0, 0
    while at < len(data):
        end = mesh_text.line_end(data, at)
        kind, at = _obj_line(data, at, end)
        if kind == 1:
            for axis in range(3):
                at = mesh_text.skip_blanks(data, at, end)
                value, at, is_number = mesh_text.decimal(data, at, end)
                if not is_number:
                    return NOT_A_NUMBER, line
                vertices[v, axis] = value
            v += 1
        elif kind == 2:
            first, last, corners = 0, 0, 0
            at = mesh_text.skip_blanks(data, at, end)
            while at < end:
                stop = mesh_text.token_end(data, at, end)
                value, after, is_number = mesh_text.whole(data, at, stop)
                if not is_number or (after < stop and data[after] != 47):
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
