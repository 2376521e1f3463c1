"""`coupole render SCENE`: spectral pictures by path tracing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from coupole.commands.common import JsonOption, fail
from coupole.errors import InputError


def render(
    scene: Annotated[Path, typer.Argument(help="The scene (YAML).", show_default=False)],
    out: Annotated[Path, typer.Option("--out", help="Folder for the pictures.")] = Path("rendered"),
    samples: Annotated[int | None, typer.Option("--samples", min=1, help="Paths through each pixel.")] = None,
    width: Annotated[
        int | None, typer.Option("--width", min=4, help="Of the pictures, if less than the scene's.")
    ] = None,
    step: Annotated[int | None, typer.Option("--step", help="Between bands, nm: 5, 10, 20 or 40.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Render a scene in spectral bands: an EXR of all bands and a PNG for each camera, and a summary."""
    from rich.progress import Progress, TaskID

    from coupole.commands.render_scene import STUDIO, read_scene, render_scene
    from coupole.plan.rig import load_class
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if step not in {None, 5, 10, 20, 40}:
            raise InputError(f"--step: expected 5, 10, 20 or 40, found {step}; choose one of them")
        document, wanted = read_scene(scene)
        studio = load_class(STUDIO)
        wanted = studio.reduced(wanted, samples=samples, width_px=width, step_nm=step)
        console.print(f"{wanted.name}: Mitsuba, {studio.variant(wanted)}")
        with Progress(console=console, disable=not console.is_terminal) as bars:
            tasks: dict[str, TaskID] = {}

            def show(name: str, done: int, total: int) -> None:
                if name not in tasks:
                    tasks[name] = bars.add_task(name, total=total)
                bars.update(tasks[name], completed=done)

            summary = render_scene(document, wanted, out, show)
    except InputError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps({"folder": str(out), **summary}))
        return
    for seen in summary["cameras"].values():
        console.print(f"{out / seen['files']['png']}: white {seen['white_cd_m2']:.4g} cd/m2, simulated")
