"""One scene, from its checked description to pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

from coupole.appearance.render import by_gold, pictures, variant, wall
from coupole.appearance.render.film import write_film
from coupole.appearance.render.rendering import Renderer, Spectral, open_renderer
from coupole.appearance.render.scene_file import Camera, Scene, remarks
from coupole.appearance.render.spectra import power
from coupole.intake.plain_data import read_json

Progress = Callable[[str, int, int], None]
"""Function that takes the camera, the number of finished passes, and of all passes."""


def reduced_scene(
    scene: Scene,
    *,
    samples: int | None = None,
    width_px: int | None = None,
    step_nm: int | None = None,
    noise: float | None = None,
) -> Scene:
    """Return the scene with fewer samples, narrower pictures or coarser bands, for a quick preview."""
    cameras = [camera.narrowed_to(width_px) if width_px else camera for camera in scene.cameras]
    fields = {**scene.model_dump(mode="json"), "cameras": [camera.model_dump() for camera in cameras]}
    if samples:
        fields["samples"] = samples
    if noise:
        fields["noise"] = noise
    if step_nm:
        fields["bands"] = {"step_nm": step_nm}
    return Scene.model_validate(fields)


def variant_of(scene: Scene) -> str:
    """Mitsuba's variant for rendering."""
    return variant.spectral(is_polarised=scene.polarisation)


def render(scene: Scene, folder: Path, out: Path, progress: Progress) -> dict[str, Any]:
    """Render all cameras into the folder `out`, and return the summary. The scene's paths are relative to
    `folder`.

    Raises InputError for an inconsistent scene or a missing library, OSError for files.
    """
    moves = _moves(scene)
    summary = _film(scene, moves, folder, out, progress) if moves else _still(scene, folder, out, progress)
    return {
        "scene": scene.name,
        "synthetic": True,
        "bands": len(range(380, 781, scene.bands.step_nm)),
        "samples": scene.samples,
        "depth": scene.depth,
        "seed": scene.seed,
        "observer": f"CIE {scene.observer}",
        "remarks": remarks(scene),
        **summary,
    }


def _still(scene: Scene, folder: Path, out: Path, progress: Progress) -> dict[str, Any]:
    with open_renderer(scene, folder) as renderer:
        eye = pictures.eye_of(renderer.scene, folder)
        written_by = _written_by(renderer)
        summaries = {}
        for camera in scene.cameras:
            spectral = _render_view(renderer, camera, folder, partial(progress, camera.name))
            stem = out / f"{scene.name}-{camera.name}"
            summaries[camera.name] = pictures.write(renderer.scene, spectral, stem, eye=eye, written_by=written_by)
        summary: dict[str, Any] = {"renderer": written_by, "cameras": summaries}
        if scene.caustic is not None:
            stem = out / f"{scene.name}-caustic"
            white_power = power(renderer.scene.lights[0].spectrum, folder)
            summary["caustic"] = wall.write_wall(
                renderer.scene, folder, stem, white_power, partial(progress, "caustic")
            )
    return summary


@dataclass(frozen=True)
class _Moves:
    """Things that change from one picture of a film to the next."""

    steps: Sequence[Callable[[Scene], Scene]]
    frames_per_s: int
    description: str


def _moves(scene: Scene) -> _Moves | None:
    if scene.film is not None:
        times = scene.film.times()
        steps = [lambda fixed, when=when: fixed.at(when) for when in times]
        return _Moves(steps, scene.film.frames_per_s, f"{times[0].isoformat()} to {times[-1].isoformat()}")
    if scene.turntable is not None:
        turns = [lambda fixed, angle=angle: fixed.turned_about_z(angle) for angle in scene.turntable.angles_deg()]
        return _Moves(turns, scene.turntable.frames_per_s, f"turned by {scene.turntable.degrees:g} degrees")
    return None


def _film(scene: Scene, moves: _Moves, folder: Path, out: Path, progress: Progress) -> dict[str, Any]:
    """Write a PNG and its summary for each camera and step, then the film. Existing pictures of the same scene are
    kept.

    All pictures have the scene's `white_cd_m2` as white, or the white of the first picture of each camera.
    """
    count, summaries, written_by = len(moves.steps), {}, ""
    for camera in scene.cameras:
        frames = out / f"{scene.name}-{camera.name}-frames"
        frames.mkdir(parents=True, exist_ok=True)
        still_scene = scene.model_copy(
            update={"cameras": (camera,), "film": None, "turntable": None, "caustic": None}
        )
        frame_summaries: list[dict[str, Any]] = []
        for number, step in enumerate(moves.steps):
            progress(camera.name, number, count)
            frame_summaries.append(_frame(step(still_scene), folder, frames / f"{number:04d}"))
            written_by = frame_summaries[-1]["renderer"]
            if number == 0:
                display = still_scene.display.model_copy(update={"white_cd_m2": frame_summaries[0]["white_cd_m2"]})
                still_scene = still_scene.model_copy(update={"display": display})
        progress(camera.name, count, count)
        path = out / f"{scene.name}-{camera.name}.mp4"
        comment = f"{scene.name}: {pictures.SYNTHETIC}; {written_by}; {moves.description}"
        write_film(
            [frames / summary["files"]["png"] for summary in frame_summaries], path, moves.frames_per_s, comment
        )
        summaries[camera.name] = {
            "files": {"film": path.name, "frames": frames.name},
            "frames": len(frame_summaries),
            "white_cd_m2": frame_summaries[0]["white_cd_m2"],
            "mean_cd_m2": [summary["mean_cd_m2"] for summary in frame_summaries],
        }
    return {"renderer": written_by, "cameras": summaries}


def _frame(scene: Scene, folder: Path, stem: Path) -> dict[str, Any]:
    """Make one picture of a film, unless it exists, so that an interrupted film continues."""
    summary_path = stem.with_suffix(".json")
    digest = sha256(f"{scene.model_dump_json()} {variant_of(scene)}".encode()).hexdigest()
    if summary_path.exists():
        old_summary: dict[str, Any] = read_json(summary_path, allow_nan=True)
        if old_summary["of"] == digest:
            return old_summary
    with open_renderer(scene, folder) as renderer:
        spectral = _render_view(renderer, scene.cameras[0], folder, lambda done, total: None)
        eye = pictures.eye_of(renderer.scene, folder)
        written_by = _written_by(renderer)
        picture_summary = pictures.write(
            renderer.scene, spectral, stem, eye=eye, written_by=written_by, with_spectra=False
        )
    summary = {"of": digest, "renderer": written_by, **picture_summary}
    summary_path.write_text(json.dumps(summary) + "\n")
    return summary


def _render_view(
    renderer: Renderer, camera: Camera, folder: Path, progress: Callable[[int, int], None]
) -> Spectral:
    gathering = renderer.scene.gathered
    if gathering is None:
        return renderer.render(camera, progress)
    return by_gold.render(renderer.scene, gathering, camera, folder, progress)


def _written_by(renderer: Renderer) -> str:
    photons = "" if renderer.scene.gathered is None else ", and photons gathered by the eye"
    return f"Mitsuba {renderer.version}, {renderer.variant_name}{photons}"
