"""Names of the files in a folder of link meshes, for each link."""

from __future__ import annotations

from pathlib import Path

from coupole.intake.input_files import InputFiles

LINKS = 7
"""The base and six links."""


def link_mesh_path(folder: Path, link: int) -> Path:
    """Return `base_link.stl` for link 0, `link_1.stl` to `link_6.stl` for the others."""
    return folder / (f"link_{link}.stl" if link else "base_link.stl")


def missing_link_meshes(folder: Path, files: InputFiles) -> list[Path]:
    """Return the files that a folder of link meshes lacks."""
    return [path for link in range(LINKS) if not files.there(path := link_mesh_path(folder, link))]
