"""A scan as `coupole scan` writes it, and the stickers in the images of a run."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats
from coupole.calibration.sources import Sources
from coupole.calibration.stickers.detection import Sticker, find_stickers
from coupole.errors import InputError
from coupole.storage.durable import sha256

TARGETS, MESH = "targets.csv", "mesh.ply"
_COORDINATES = ("x_mm", "y_mm", "z_mm")


@dataclass(frozen=True)
class Scan:
    """The scanner's table of stickers, in the mesh's frame."""

    names: tuple[str, ...]
    targets_mm: Floats
    """[n, 3]."""
    mesh: Path
    inputs: tuple[tuple[str, str], ...]
    """Name and SHA-256 of both files."""


@dataclass(frozen=True)
class StickerImages:
    """Stickers in all images, and one image that is shown."""

    stickers: tuple[tuple[Sticker, ...], ...]
    names: tuple[str, ...]
    size_px: tuple[int, int]
    shown_number: int
    """Number of the image with most stickers."""
    picture: Floats
    """[H, W] the shown image."""
    depth_mm: tuple[float, float]
    """Least and greatest distance from the camera at which stickers were looked for."""


def read_scan(folder: Path) -> Scan:
    """Read a folder of `coupole scan`. Raises InputError, which names the missing parts."""
    table, mesh = folder / TARGETS, folder / MESH
    for path in (mesh, table):
        if not path.is_file():
            raise InputError(
                f"{folder}: expected a scan as `coupole scan MESH --targets TABLE` writes it; there is "
                f"no {path.name}"
            )
    with table.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    try:
        targets_mm = np.array([[float(row[axis]) for axis in _COORDINATES] for row in rows])
        names = tuple(row["name"] for row in rows)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{table}: not as `coupole scan` wrote it: {error!r}. Import the scan again") from error
    inputs = tuple((f"{folder.resolve().name}/{path.name}", sha256(path)) for path in (mesh, table))
    return Scan(names, targets_mm.reshape(-1, 3), mesh, inputs)


def find_all_stickers(
    sources: Sources,
    lens: Intrinsics,
    *,
    diameter_mm: float,
    depth_mm: tuple[float, float],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> StickerImages:
    """Find stickers in all images of runs. Raises InputError if the images differ in size or show none."""
    stickers_of: list[tuple[Sticker, ...]] = []
    size_px: tuple[int, int] | None = None
    shown_number, picture = 0, np.zeros((1, 1))
    for number, source in enumerate(sources.images):
        image = source.read_picture().plane()
        size = (image.shape[1], image.shape[0])
        if size_px is not None and size != size_px:
            raise InputError(f"{source.name}: {size[0]} x {size[1]} pixels, the images before it {size_px}")
        size_px = size
        stickers_of.append(tuple(find_stickers(image, lens, diameter_mm=diameter_mm, depth_mm=depth_mm)))
        if number == 0 or len(stickers_of[number]) > len(stickers_of[shown_number]):
            shown_number, picture = number, image
        progress(number + 1, len(sources.images))
    if size_px is None or not stickers_of[shown_number]:
        raise InputError(
            f"stickers of {diameter_mm:g} mm are in none of {len(sources.images)} images. Are the disks lighter "
            "than their borders, and as large as --diameter-mm says?"
        )
    names = tuple(source.name for source in sources.images)
    return StickerImages(tuple(stickers_of), names, size_px, shown_number, picture, depth_mm)
