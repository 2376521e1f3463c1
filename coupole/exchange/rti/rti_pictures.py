"""Pictures of a view under each LED with the LEDs' directions, for programs for RTI: `.lp`, and relight's `.dome`
with the LEDs' positions."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.rti.lit_views import WHITE_QUANTILE
from coupole.exchange.srgb import srgb
from coupole.exchange.target_folder import writing_into
from coupole.reflectance.uncalibrated import PicturedView, lights_of_view, write_pictures
from coupole.storage.durable import write_synced
from coupole.storage.run import Run

LINEAR = "linear"
"""Folder of the 16-bit pictures with lights, intensities and mask; `--pictures` makes a result from this folder.
"""
_JPEG_QUALITY = 95


def export_rti(folder: Path, out: Path, views: Sequence[str], say: Callable[[str, int, int], None]) -> list[Path]:
    """Write `VIEW/` for each of these views of a run: `led0417.jpg` and so on (8 bit, sRGB, one white for all),
    `VIEW.lp`, `VIEW.dome`, and `linear/`. Positions of the LEDs are nominal; no calibration is used.

    Raises InputError if there are too few LEDs, or if the folder has other pictures; StorageError for damaged
    frames or a disk that cannot be written.
    """
    run = Run(folder)
    paths: list[Path] = []
    for view in views:
        with writing_into(out / view):
            paths += _export_view(run, view, out / view, say)
    return paths


def _export_view(run: Run, view: str, out: Path, say: Callable[[str, int, int], None]) -> list[Path]:
    import cv2

    as_jpeg = (
        *(cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    )
    pictures = write_pictures(
        run.folder, view, out / LINEAR, lambda step, done, of: say(f"{view}: {step}", done, of)
    )
    brightest = _read_picture(pictures.files[0])
    for source in pictures.files:
        brightest = np.maximum(brightest, _read_picture(source))
    codes = _srgb_codes(float(np.quantile(brightest.max(axis=2), WHITE_QUANTILE)))
    paths = []
    for number, source in enumerate(pictures.files):
        paths.append(out / f"{source.stem}.jpg")
        write_synced(paths[-1], cv2.imencode(".jpg", codes[_read_picture(source)], as_jpeg)[1].tobytes())
        say(f"{view}: jpeg", number + 1, len(pictures.files))
    directions = pictures.lights_mm / np.linalg.norm(pictures.lights_mm, axis=1, keepdims=True)
    lines = [f"{path.name} {x:.6f} {y:.6f} {z:.6f}" for path, (x, y, z) in zip(paths, directions, strict=True)]
    write_synced(out / f"{view}.lp", "\n".join([str(len(lines)), *lines]) + "\n")
    dome = _write_dome(run, view, pictures, out / f"{view}.dome")
    return [*paths, out / f"{view}.lp", dome, *sorted((out / LINEAR).iterdir())]


def write_dome(run: Run, view: str, path: Path) -> Path:
    """Write relight's file of the positions of the LEDs that lit a view, in the order of their numbers. Raises
    InputError if there are too few LEDs."""
    return _write_dome(run, view, lights_of_view(run.folder, view), path)


def _write_dome(run: Run, view: str, pictured_view: PicturedView, path: Path) -> Path:
    distances_mm = np.linalg.norm(pictured_view.lights_mm, axis=1, keepdims=True)
    dome = {
        "label": f"{run.folder.name} {view}",
        "notes": f"Coupole, {'simulated' if pictured_view.is_simulated else 'measured'}; nominal places of the "
        "LEDs",
        "imageWidth": pictured_view.width_mm,
        "domeDiameter": 2.0 * float(distances_mm.mean()),
        "verticalOffset": 0.0,
        "lightConfiguration": "lights3d",
        "directions": _points(pictured_view.lights_mm / distances_mm),
        "positionsSphere": [],
        "positions3d": _points(pictured_view.lights_mm),
        "ledAdjust": [],
    }
    write_synced(path, json.dumps(dome, indent=1) + "\n")
    return path


def _points(places: NDArray[np.float64]) -> list[dict[str, float]]:
    return [dict(zip("xyz", place, strict=True)) for place in places.tolist()]


def _read_picture(path: Path) -> NDArray[np.uint16]:
    """[h, w, 3] or [h, w, 1], blue first."""
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return np.atleast_3d(picture).astype(np.uint16)


def _srgb_codes(white: float) -> NDArray[np.uint8]:
    """[65536] 8-bit codes of linear values; the code of `white` is 255."""
    return np.rint(255.0 * srgb(np.arange(1 << 16) / max(white, 1.0))).astype(np.uint8)
