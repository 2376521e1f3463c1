"""`coupole render SCENE`: spectral pictures by path tracing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import InputError, StorageError

if TYPE_CHECKING:
    from coupole.appearance.render.scene_file import Scene
    from coupole.plan.yamlfile import Document

Progress = Callable[[str, int, int], None]


def render(
    scene: Annotated[Path, typer.Argument(help="The scene (YAML).", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder for the pictures.")] = Path("rendered"),
    samples: Annotated[
        int | None, typer.Option("--samples", min=1, help="Number of light paths through each pixel.")
    ] = None,
    width: Annotated[
        int | None, typer.Option("--width", min=4, help="Width of the pictures, if smaller than the scene's.")
    ] = None,
    step: Annotated[
        int | None, typer.Option("--step", help="Step between spectral bands, nm: 5, 10, 20 or 40.")
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(
            "--noise", min=1e-4, max=0.9, help="Stop when half of the pixels have at most this relative noise."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Render a scene in spectral bands: an EXR of all bands and a PNG for each camera, and a summary."""
    from rich.progress import Progress, TaskID

    from coupole.appearance.render import studio
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if step not in {None, 5, 10, 20, 40}:
            raise InputError(f"--step: expected 5, 10, 20 or 40, found {step}; choose one of them")
        document, settings = read_scene(scene)
        settings = studio.reduced_scene(settings, samples=samples, width_px=width, step_nm=step, noise=noise)
        console.print(f"{settings.name}: Mitsuba, {studio.variant_of(settings)}")
        with Progress(console=console, disable=not console.is_terminal) as bars:
            tasks: dict[str, TaskID] = {}

            def show(name: str, count: int, total: int) -> None:
                if name not in tasks:
                    tasks[name] = bars.add_task(name, total=total)
                bars.update(tasks[name], completed=count)

            summary = render_scene(document, settings, out, show)
    except InputError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps({"folder": str(out), **summary}))
        return
    for remark in summary["remarks"]:
        console.print(remark, markup=False)
    for camera in summary["cameras"].values():
        file_name = camera["files"].get("film") or camera["files"]["png"]
        console.print(f"{out / file_name}: white {camera['white_cd_m2']:.4g} cd/m2{_noise(camera)}, simulated")


def _noise(camera_summary: dict[str, Any]) -> str:
    noise = camera_summary.get("noise")
    return "" if noise is None else f", noise {noise:.2g} with {camera_summary['samples']} paths a pixel"


def read_scene(path: Path) -> tuple[Document, Scene]:
    """Read and check the scene file, and check that its files exist. Raises InputError with file:line:column."""
    from coupole.appearance.render.scene_file import Scene, files
    from coupole.plan import yamlfile

    document = yamlfile.read_document(path)
    scene = document.validate(Scene)
    missing = [
        document.problem(at, f"no such file: {document.resolve(file_name)}")
        for at, file_name in files(scene)
        if not (document.resolve(file_name).is_file() or (document.resolve(file_name) / "result.json").is_file())
    ]
    if missing:
        raise InputError(missing)
    return document, scene


def render_scene(document: Document, scene: Scene, folder: Path, progress: Progress) -> dict[str, Any]:
    """Render into `folder`, with a summary (JSON).

    Raises InputError if the scene cannot be rendered on this machine, StorageError if nothing can be written.
    """
    from coupole.appearance.render import studio

    try:
        folder.mkdir(parents=True, exist_ok=True)
        summary: dict[str, Any] = studio.render(scene, document.path.parent, folder, progress)
        path = folder / f"{scene.name}.json"
        path.write_text(json.dumps(summary, indent=2) + "\n")
    except OSError as error:
        raise StorageError(
            f"{folder}: {error.strerror or error}. Choose another folder, or free space."
        ) from error
    return summary
