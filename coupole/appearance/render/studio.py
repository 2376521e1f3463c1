"""One scene, from its checked description to pictures."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from coupole.appearance.render import pictures, variant, wall
from coupole.appearance.render.rendering import opened
from coupole.appearance.render.scene_file import Scene, remarks

Progress = Callable[[str, int, int], None]
"""Camera, passes done, passes in all."""


def reduced(scene: Scene, *, samples: int | None, width_px: int | None, step_nm: int | None) -> Scene:
    """The scene with fewer samples, narrower pictures or coarser bands, for a quick look."""
    cameras = [camera.narrowed(width_px) if width_px else camera for camera in scene.cameras]
    changed = {**scene.model_dump(mode="json"), "cameras": [camera.model_dump() for camera in cameras]}
    if samples:
        changed["samples"] = samples
    if step_nm:
        changed["bands"] = {"step_nm": step_nm}
    return Scene.model_validate(changed)


def variant_of(scene: Scene) -> str:
    """Mitsuba's variant for rendering."""
    return variant.spectral(polarised=scene.polarisation)


def render(scene: Scene, folder: Path, out: Path, progress: Progress) -> dict[str, Any]:
    """Render all cameras into the folder `out`; returns the summary. The scene's paths are relative to `folder`.

    Raises InputError for an inconsistent scene or a missing library, OSError for files.
    """
    with opened(scene, folder) as renderer:
        white = pictures.white_of(scene, folder)
        written_by = f"Mitsuba {renderer.version}, {renderer.variant_name}"
        seen = {}
        for camera in scene.cameras:
            name = camera.name
            found = renderer.render(camera, partial(progress, name))
            stem = out / f"{scene.name}-{name}"
            seen[name] = pictures.write(scene, found, stem, white=white, written_by=written_by)
        summary: dict[str, Any] = {"cameras": seen}
        if scene.caustic is not None:
            stem = out / f"{scene.name}-caustic"
            summary["caustic"] = wall.write_wall(scene, folder, stem, white, partial(progress, "caustic"))
    return {
        "scene": scene.name,
        "synthetic": True,
        "renderer": written_by,
        "bands": len(range(380, 781, scene.bands.step_nm)),
        "samples": scene.samples,
        "depth": scene.depth,
        "seed": scene.seed,
        "observer": f"CIE {scene.observer}",
        "remarks": remarks(scene),
        **summary,
    }
