"""Preview of a plan: some of its frames are rendered without devices.

Each frame is developed to a PNG that is marked as simulated, and one sheet shows all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import coupole
from coupole.devices import NO_LED
from coupole.errors import InputError, StorageError
from coupole.geometry import Transform
from coupole.kinematics import forward
from coupole.motion.itinerary import arm_of, base_from_flange
from coupole.plan.bursts import Burst
from coupole.plan.registry import STILLS, load_class
from coupole.plan.schedule import ViewPose
from coupole.preflight.job import Job
from coupole.preflight.simulated_world import frozen, world_config
from coupole.viewing.raw_preview import Coding, develop, figures

_THUMBNAIL_PX, _LABEL_PX, _COLUMNS = 320, 22, 4

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Still:
    """One rendered shot: its id, its file, its exposure."""

    shot: str
    file: str
    saturated: float
    """Largest share of saturated pixels of any channel."""
    brightest: float
    """99.9 % quantile, share of the range above black."""


def simulate(job: Job, folder: Path, count: int, *, width_px: int | None, progress: Progress) -> list[Still]:
    """Render `count` of a plan's shots, spread over views and lights; `width_px` makes frames smaller.

    Raises InputError if the rig has no simulated counterpart, StorageError if nothing can be written.
    """
    sensor = job.cell.rig.sensor
    if width_px and width_px < sensor.width_px:
        height_px = max(8, sensor.height_px * width_px // sensor.width_px // 2 * 2)
        pitch_um = sensor.pixel_pitch_um * sensor.width_px / width_px
        sensor = sensor.model_copy(
            update={"width_px": width_px // 2 * 2, "height_px": height_px, "pixel_pitch_um": pitch_um}
        )
    coding = Coding(sensor.bayer_pattern, sensor.black_dn, sensor.white_dn)
    with frozen(world_config(job.cell, job, sensor), job.cell.files) as config:
        stills = load_class(STILLS)(config)
    shots = list(_spread_shots(job, count))
    if not shots:
        raise InputError(f"{job.document.path}: expected shots with light; the plan has none")
    previews, pictures = [], []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number, (view, burst, step) in enumerate(shots):
            progress(number, len(shots))
            led = int(burst.table["led"][step])
            raw: NDArray[np.uint16] = stills.take(
                flange_at(view, job),
                leds=[] if led == NO_LED else [led],
                panels=[burst.panel] if burst.panel else [],
                exposure_s=burst.timing.exposure_us * 1e-6,
                gain=10 ** (job.plan.gain_db / 20),
            )
            picture = develop(raw, pattern=coding.pattern, black_dn=coding.black_dn, white_dn=coding.white_dn)
            shot = f"{view.name}/{burst.labels[step]}"
            file = shot.replace("/", "-") + ".png"
            _save(folder / file, picture, f"{job.plan.name} {shot}, simulated")
            picture_figures = figures(raw, coding)
            previews.append(Still(shot, file, max(picture_figures.saturated.values()), picture_figures.brightest))
            pictures.append(picture)
        progress(len(shots), len(shots))
        sheet = contact_sheet(pictures, [still.shot for still in previews])
        _save(folder / "sheet.png", sheet, f"{job.plan.name}: {len(previews)} shots, simulated")
    except OSError as error:
        raise StorageError(
            f"{folder}: {error.strerror or error}. Choose another folder, or free space."
        ) from error
    return previews


def flange_at(view: ViewPose, job: Job) -> Transform:
    """Return the nominal pose of the flange at a view, from its camera pose or its joints, without errors of the
    arm."""
    if view.joints_deg is not None:
        return forward(arm_of(job.cell.rig), np.asarray(view.joints_deg, dtype=np.float64))
    return base_from_flange(view, job.cell.rig)


def _spread_shots(job: Job, count: int) -> Iterator[tuple[ViewPose, Burst, int]]:
    """Yield shots of all views in turn, spread evenly over the bursts and lights of each view."""
    views = job.schedule.views
    for number, view in enumerate(views):
        share = count // len(views) + (number < count % len(views))
        shots = [
            (burst, int(step))
            for burst in job.schedule.bursts[number]
            for step in np.argsort(burst.table["led"], kind="stable")
            if burst.is_light()[step]
        ]
        for place in np.unique(np.linspace(0, len(shots) - 1, min(share, len(shots))).astype(int)):
            yield view, *shots[place]


def contact_sheet(pictures: list[NDArray[np.uint8]], labels: list[str]) -> NDArray[np.uint8]:
    """Pictures side by side on black, with their labels underneath."""
    from PIL import Image, ImageDraw

    height, width = pictures[0].shape[:2]
    size = (_THUMBNAIL_PX, max(1, _THUMBNAIL_PX * height // width))
    columns = min(_COLUMNS, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * size[0], rows * (size[1] + _LABEL_PX)))
    draw = ImageDraw.Draw(sheet)
    for place, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        corner = (place % columns * size[0], place // columns * (size[1] + _LABEL_PX))
        sheet.paste(Image.fromarray(picture).resize(size), corner)
        draw.text((corner[0] + 6, corner[1] + size[1] + 3), label, fill=(200, 200, 200), font_size=13)
    return np.asarray(sheet)


def _save(path: Path, picture: NDArray[np.uint8], description: str) -> None:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    about: Any = PngInfo()
    about.add_text("Description", description)
    about.add_text("Software", f"coupole {coupole.__version__}")
    Image.fromarray(picture).save(path, "PNG", optimize=True, pnginfo=about)
