"""The page to paint parts of a mesh: scripts, shaders, style and the mesh, in one HTML file that loads nothing."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, StorageError, reason
from coupole.exchange.look.look_blocks import in_script
from coupole.exchange.look.page_template import filled
from coupole.scan.simplify import simplified_mesh

MOST_TRIANGLES = 100_000
"""Greatest number of triangles of a page. A finer mesh is simplified; each of its triangles then gets the part of
the nearest simplified triangle."""
SCRIPTS = ("surface.js", "brush.js", "parts.js", "pick.js")
_POLICY = "script-src 'unsafe-inline'; style-src 'unsafe-inline'"
_SHARED = ("vectors.js", "camera.js")
"""Scripts shared with the page to relight."""


def write_pick_page(
    vertices_mm: NDArray[np.float64],
    triangles: NDArray[np.int64],
    title: str,
    path: Path,
    names: Sequence[str] = (),
    most_triangles: int = MOST_TRIANGLES,
) -> int:
    """Write the page of a mesh, vertices [n, 3] and triangles [m, 3]; return the number of its triangles.

    `names` are the parts with which the page begins; without names, it begins with one unnamed part. Raises
    InputError for a name that does not end in .html, StorageError if it cannot be written.
    """
    if path.suffix.lower() != ".html":
        raise InputError(f"--out {path}: expected a name that ends in .html")
    points, faces = simplified_mesh(vertices_mm, triangles, most_triangles)
    if len(faces) == 0:
        raise InputError(
            f"{title}: nothing is left of the mesh when it is simplified to {most_triangles} triangles; check it"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page_text(points, faces, title, names), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}. Choose another place, or free space.") from error
    return len(faces)


def page_text(
    points_mm: NDArray[np.float64], triangles: NDArray[np.int64], title: str, names: Sequence[str] = ()
) -> str:
    """Return the HTML."""
    mesh = {
        "title": title,
        "names": list(names),
        "vertices_mm": base64.b64encode(points_mm.astype("<f4").tobytes()).decode(),
        "triangles": base64.b64encode(triangles.astype("<u4").tobytes()).decode(),
    }
    look = resources.files("coupole.exchange.look") / "page"
    folder = resources.files(__package__) / "page"
    scripts = [(look / name).read_text(encoding="utf-8") for name in _SHARED]
    scripts += [(folder / name).read_text(encoding="utf-8") for name in SCRIPTS]
    contents = {
        "MESH": in_script(mesh),
        "SCRIPTS": "\n".join(scripts),
    }
    page, style = ((folder / name).read_text(encoding="utf-8") for name in ("pick.html", "pick.css"))
    return filled(page, f"Parts of {title}", style, _POLICY, contents)
