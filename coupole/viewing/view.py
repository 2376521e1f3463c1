"""`coupole view`: a plan's picture and page, even if preflight refuses the plan."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

from coupole.errors import InputError, reason
from coupole.preflight.checking import check_job
from coupole.preflight.job import Job, without_hidden
from coupole.preflight.preflight import StorageFacts
from coupole.viewing.view_page import write_page
from coupole.viewing.view_picture import write_picture
from coupole.viewing.view_scene import Scene, scene_of


def look_at_plan(job: Job, folder: Path, console: Console, *, paths: bool) -> tuple[Path, Path]:
    """Write `<plan>.png` and `<plan>.html` into a folder, and print their paths.

    Raises InputError if they cannot be written there. Without `paths` all motions are straight and collisions are
    not checked.
    """
    scene = look(job, console, paths=paths)
    png, html = folder / f"{job.plan.name}.png", folder / f"{job.plan.name}.html"
    with _doing(console, "drawing"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_picture(scene, png)
            write_page(scene, html)
        except OSError as error:
            raise InputError(
                f"--out {folder}: cannot write there: {reason(error)}; name another folder"
            ) from error
    for refusal in scene.refusals:
        console.print(f"[red]refused:[/] {refusal}")
    console.print(f"{png}\n{html}", markup=False)
    return png, html


def look(job: Job, console: Console, *, paths: bool) -> Scene:
    """Return the scene, and the refusals that `check` would give, except those that concern the disk."""
    views = job.schedule.views
    with _doing(console, f"planning paths to {len(views)} views" if paths else "finding postures"):
        job = without_hidden(job) if paths else job
        job, report = check_job(job, StorageFacts(free_bytes=sys.maxsize), paths=paths)
        itinerary = job.motion.planned_itinerary(views, paths=paths)
    with _doing(console, "finding shadows"):
        return scene_of(job, itinerary, job.motion.bodies if paths else None, report.refusals)


@contextmanager
def _doing(console: Console, action: str) -> Iterator[None]:
    """Report slow work: by a temporary line on a terminal, by a plain line elsewhere."""
    if console.is_terminal:
        with console.status(action):
            yield
    else:
        console.print(action)
        yield
