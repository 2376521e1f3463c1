"""`coupole render`: a scene file to spectral pictures. The renderer itself is part of the simulation."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from coupole.errors import InputError, StorageError
from coupole.plan import yamlfile
from coupole.plan.rig import load_class
from coupole.plan.yamlfile import Document

STUDIO = "coupole.appearance.render.studio:Studio"

Progress = Callable[[str, int, int], None]


def read_scene(path: Path) -> tuple[Document, Any]:
    """The scene file, checked; its files are there. Raises InputError with file:line:column."""
    studio = load_class(STUDIO)
    document = yamlfile.read(path)
    scene = document.validate(studio.Settings)
    missing = [
        document.problem(at, f"no such file: {document.resolve(named)}")
        for at, named in studio.files(scene)
        if not document.resolve(named).is_file()
    ]
    if missing:
        raise InputError(missing)
    return document, scene


def render_scene(document: Document, scene: Any, folder: Path, progress: Progress) -> dict[str, Any]:
    """Render into `folder`, with a summary (JSON) beside the pictures.

    Raises InputError if the scene or this machine cannot do it, StorageError if nothing can be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        summary: dict[str, Any] = load_class(STUDIO).render(scene, document.path.parent, folder, progress)
        path = folder / f"{scene.name}.json"
        path.write_text(json.dumps(summary, indent=2) + "\n")
    except OSError as error:
        raise StorageError(
            f"{folder}: {error.strerror or error}. Choose another folder, or free space."
        ) from error
    return summary
