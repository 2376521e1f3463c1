"""Triangle meshes of up to tens of millions of triangles: PLY, STL and OBJ, read at the speed of the disk.

Invalid files are refused with the place of the error: a file that ends too early, coordinates that are not finite,
corners that do not exist, faces that are not triangles, no faces. The readers need at most about three times the
memory of vertices and triangles.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from coupole.errors import InputError
from coupole.scan.mesh import MOST_VERTICES, Mesh
from coupole.scan.mesh_bytes import MeshFile
from coupole.scan.mesh_obj import read_obj
from coupole.scan.mesh_ply import read_ply
from coupole.scan.mesh_stl import read_stl


def read_mesh(path: Path, data: bytes | None = None) -> Mesh:
    """Read a mesh in the format of its suffix: .ply, .stl or .obj. Raises InputError with the place of the error.

    `data` are the file's bytes if they have been read already; the file is then not read again. An STL repeats
    vertices for each triangle; vertices with bitwise equal coordinates become one.
    """
    readers: dict[str, Callable[[MeshFile], Mesh]] = {".ply": read_ply, ".stl": read_stl, ".obj": read_obj}
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: expected a mesh with the ending .ply, .stl or .obj")
    if data is None and not path.is_file():
        raise InputError(f"{path}: expected a mesh file; there is none")
    mesh = readers[path.suffix.lower()](MeshFile(path, data))
    if len(mesh.triangles) == 0:
        raise InputError(
            f"{path}: expected triangles; the file holds {len(mesh.vertices)} vertices and no triangles"
        )
    if len(mesh.vertices) >= MOST_VERTICES:
        raise InputError(f"{path}: expected fewer than {MOST_VERTICES} vertices, found {len(mesh.vertices)}")
    return mesh
