"""What a page shows of a result of pictures: a flat picture, and the material of each of its pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.look.look_blocks import Look, block_of, halves, octahedral
from coupole.reflectance.picture_result import MATERIALS, PictureResult, opened

MOST_PX = 16_000_000
"""More has no place in a texture that every browser takes."""


def look_of_pictures(folder: Path) -> Look:
    """Of a whole result. Raises InputError if it is none, has no materials, or is too large."""
    result = PictureResult(folder)
    about, mask = result.about, result.mask
    height, width = mask.shape
    if mask.size > MOST_PX:
        raise InputError(
            f"{folder}: pictures of {width} x {height} are too large for a page; make a result of a part of them"
        )
    if not (folder / MATERIALS).exists():
        raise InputError(f"{folder / MATERIALS}: is not there; `coupole reflectance --pictures` makes it")
    with opened(folder / MATERIALS) as file:
        normal, kd, ks = (file[name][()].astype(np.float64) for name in ("normal", "kd", "ks"))
        gloss = np.stack([file["alpha"][()], file["residual"][()]], axis=1).astype(np.float64)
    known = np.isfinite(gloss[:, 0])

    def spread(values: NDArray[Any]) -> NDArray[Any]:
        """[h * w, ...] 0 but where pixels have values."""
        all_of_them = np.zeros((mask.size, *values.shape[1:]), values.dtype)
        all_of_them[np.flatnonzero(mask)[known]] = values[known]
        return all_of_them

    blocks = (
        block_of("places", np.array([[0, 0, 0], [width, 0, 0], [width, height, 0], [0, height, 0]], np.uint16)),
        block_of("triangles", np.array([[0, 1, 2], [0, 2, 3]], np.uint32)),
        block_of("normals", spread(octahedral(normal))),
        block_of("kd", spread(halves(kd))),
        block_of("ks", spread(halves(ks))),
        block_of("gloss", spread(halves(gloss))),
        block_of("uncertainty", np.zeros((1, 4), np.uint8)),
    )
    shown = {
        "kind": "pictures",
        "picture_px": [width, height],
        "views": [],
        "fit": "GGX of each pixel",
        "simulated": None,
        "software": about.get("software", {}),
        "origin_mm": [0.0, 0.0, 0.0],
        "step_mm": 1.0,
        "irradiance": 1.0,
        "unit": "share of the pictures' full scale, divided by their intensities",
        "told": {
            "Pictures": f"{len(result.directions)} of {width} x {height}",
            "Light": "distant, without the shadows that the object casts. Strength 1 is that of the pictures. "
            "`coupole reflectance relight` comes nearer to them: it interpolates between the pictures.",
        },
    }
    errors = {"normals": "0.004 degrees", "kd, ks, roughness": "0.05 % or 3e-8"}
    return Look(shown, blocks, errors=errors)
