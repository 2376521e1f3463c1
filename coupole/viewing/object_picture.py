"""The object on the support, with its measures, so that an operator can check the object and its place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from coupole.errors import InputError
from coupole.geometry import look_at
from coupole.preflight.job import Job
from coupole.viewing import view_colours as colours
from coupole.viewing.view_canvas import Canvas, Lookout
from coupole.viewing.view_scene import measured_solid
from coupole.viewing.view_solids import Solid, disk

_WIDTH_PX, _HEIGHT_PX, _STRIP_PX = 560, 520, 26
_THICKNESS_MM = 15.0
_AROUND = 1.15
"""Size of the picture as a factor of the object's size, so that its surroundings are shown."""
_SCALE_BARS_MM = (1, 2, 5, 10, 20, 50, 100, 200, 500)


def write_object_picture(job: Job, path: Path) -> None:
    """Write the PNG. Raises InputError if the plan names no mesh."""
    from PIL import Image, ImageDraw

    if not len(job.shape.corners_mm):
        raise InputError("the plan names no mesh of its object")
    solid = measured_solid(job)
    support = disk("support", job.cell.rig.support.diameter_mm / 2, _THICKNESS_MM)
    low, high = job.shape.corners_mm.min(axis=(0, 1)), job.shape.corners_mm.max(axis=(0, 1))
    sheet = Image.new("RGB", (2 * _WIDTH_PX, _HEIGHT_PX + _STRIP_PX), "white")
    pen = ImageDraw.Draw(sheet)
    x, y, z = (f"{b - a:.0f}" for a, b in zip(low, high, strict=True))
    for k, (above, words) in enumerate(
        ((True, f"from above: x {x} mm, y {y} mm"), (False, f"from the front (-y): x {x} mm, z {z} mm"))
    ):
        lookout = _lookout(low, high, above=above)
        sheet.paste(_view_from(lookout, support, solid), (k * _WIDTH_PX, _STRIP_PX))
        pen.text((k * _WIDTH_PX + 10, 6), words, fill=_ink())
        _scale_bar(pen, lookout, k * _WIDTH_PX)
    sheet.save(path, optimize=True)


def _lookout(low: Any, high: Any, *, above: bool) -> Lookout:
    """Return a viewpoint without perspective, with the support's centre in the picture."""
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
    across, along = (high - low)[[0, 1] if above else [0, 2]] + 20.0
    eye = look_at((low + high) / 2, 5000.0, -90.0, 90.0 if above else 0.0)
    scale = min(_WIDTH_PX / across, _HEIGHT_PX / along) / _AROUND
    return Lookout(eye, scale, _WIDTH_PX, _HEIGHT_PX, perspective=False)


def _view_from(lookout: Lookout, support: Solid, object_solid: Solid) -> Any:
    canvas = Canvas(lookout)
    canvas.fill([support], [colours.SUPPORT])
    canvas.fill([object_solid], [colours.OBJECT])
    for axis, colour in ((0, colours.HOME), (1, colours.CAMERA_WAY), (2, colours.SIGHT)):
        end = np.zeros(3)
        end[axis] = 40.0
        canvas.line(np.array((np.zeros(3), end)), colour, 2.5, hidden_opacity=0.35)
    return canvas.image()


def _scale_bar(pen: Any, lookout: Lookout, left_px: int) -> None:
    length_mm = max(mm for mm in _SCALE_BARS_MM if mm * lookout.scale < 0.4 * _WIDTH_PX or mm == 1)
    y, x = _HEIGHT_PX + _STRIP_PX - 14, left_px + 14
    pen.line((x, y, x + length_mm * lookout.scale, y), fill=_ink(), width=3)
    pen.text((x, y - 18), f"{length_mm} mm", fill=_ink())


def _ink() -> tuple[int, ...]:
    return tuple(round(255 * part) for part in colours.INK)
