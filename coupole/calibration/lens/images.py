"""The board in all images of a calibration."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.lens.board import Board, Sighting, detect
from coupole.calibration.sources import Sources
from coupole.errors import InputError


@dataclass(frozen=True)
class Found:
    """The board in the images, and the reasons why other images were left out."""

    sightings: tuple[Sighting, ...]
    image_numbers: NDArray[np.intp]
    """[sightings] number of the image of each sighting."""
    size_px: tuple[int, int]
    """Width and height."""
    left_out: tuple[str, ...]
    """One line for each image that cannot be used."""


def find_board(
    board: Board, sources: Sources, progress: Callable[[int, int], None] = lambda done, total: None
) -> Found:
    """Find the board in all images. Raises InputError if the images differ in size, or if no image shows the
    board."""
    sightings, numbers, left_out = [], [], []
    size_px: tuple[int, int] | None = None
    for number, source in enumerate(sources.images):
        picture = source.read_picture()
        size = picture.size_px
        if size_px is not None and size != size_px:
            raise InputError(f"{source.name}: {size[0]} x {size[1]} pixels, the images before it {size_px}")
        size_px = size
        sighting = detect(board, picture)
        if isinstance(sighting, str):
            left_out.append(f"{source.name}: {sighting}")
        else:
            sightings.append(sighting)
            numbers.append(number)
        progress(number + 1, len(sources.images))
    if not sightings or size_px is None:
        why = f"; {left_out[0]}" if left_out else ""
        raise InputError(
            f"the board was found in none of {len(sources.images)} images{why}. Is it the board of "
            "the description?"
        )
    return Found(tuple(sightings), np.array(numbers, dtype=np.intp), size_px, tuple(left_out))
