"""Contents of a page of a result of pictures: a flat picture, and the material of each of its pixels."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.look.look_blocks import Block, Look, block_of, halves, octahedral
from coupole.exchange.look.look_tiles import TILE_PX, levels_of, tiles_of
from coupole.reflectance.picture_result import MATERIALS, PictureResult, open_result_file


def look_of_pictures(folder: Path) -> Look:
    """Return the page's contents for a complete result. Raises InputError if it is not one, or has no
    materials."""
    result = PictureResult(folder)
    about, mask = result.about, result.mask
    height, width = mask.shape
    if not (folder / MATERIALS).exists():
        raise InputError(f"{folder / MATERIALS}: is not there; `coupole reflectance --pictures` makes it")
    fields = np.full((_FIELDS, height, width), np.nan, np.float32)
    with open_result_file(folder / MATERIALS) as file:
        is_fitted = mask.copy()
        is_fitted[mask] = np.isfinite(file["alpha"][()])
        first = 0
        for name in ("normal", "kd", "ks", "alpha", "residual"):
            values = np.atleast_2d(file[name][()].T).astype(np.float32)
            fields[first : first + len(values), is_fitted] = values[:, is_fitted[mask]]
            first += len(values)
    tiles = list(_material_tiles(fields))
    document = {
        "kind": "pictures",
        "picture_px": [width, height],
        "tile_px": TILE_PX,
        "levels": levels_of(width, height),
        "tiles": _TILES,
        "views": [],
        "fit": "GGX of each pixel",
        "simulated": about.get("simulated"),
        "software": about.get("software", {}),
        "origin_mm": [0.0, 0.0, 0.0],
        "step_mm": 1.0,
        "irradiance": 1.0,
        "unit": "share of the pictures' full scale, divided by their intensities",
        "told": {
            "Pictures": f"{len(result.directions)} of {width} x {height}",
            "Light": (
                "distant, without the shadows that the object casts. Strength 1 is the strength "
                "of the pictures' lights. "
                "`coupole reflectance relight` comes nearer to the photographs, because it interpolates between "
                "the pictures."
            ),
            "Seen from afar": "the mean materials of 2 x 2 pixels, of 4 x 4 and so on. The gloss of a mean "
            "material differs from the mean of the glosses.",
        },
    }
    errors = {"normals": "0.004 degrees", "kd, ks, roughness": "0.05 % or 3e-8"}
    return Look(document, (), tuple(sorted(tiles, key=_level, reverse=True)), errors=errors)


_TILES = "tile"
_FIELDS, _ALPHA = 11, 9


def _level(block: Block) -> int:
    return int(block.name.split("-")[1])


def _material_tiles(fields: NDArray[np.float32]) -> Iterator[Block]:
    """Yield the tiles of [11, h, w] normal, kd, ks, alpha, residual: [10, TILE_PX, TILE_PX] of 16 bits each."""
    for tile in tiles_of(fields):
        flat = tile.values.reshape(_FIELDS, -1).astype(np.float64)
        codes = np.zeros((_FIELDS - 1, flat.shape[1]), np.uint16)
        some = np.isfinite(flat[_ALPHA])
        if some.any():
            codes[:2, some] = octahedral(flat[:3, some].T).T
            codes[2:, some] = halves(flat[3:, some]).view(np.uint16)
        yield block_of(tile.name(_TILES), codes.reshape(-1, TILE_PX, TILE_PX))
