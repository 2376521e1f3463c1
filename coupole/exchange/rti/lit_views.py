"""Views under distant lights of equal strength, from runs and from results of pictures."""

from __future__ import annotations

import fnmatch
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.formats import Source, source_of
from coupole.exchange.srgb import srgb
from coupole.reflectance.light_files import read_rows
from coupole.reflectance.picture_result import NORMALS, PictureResult
from coupole.reflectance.picture_set import FEWEST_LIGHTS, read_picture
from coupole.reflectance.uncalibrated import INTENSITIES, write_pictures
from coupole.storage.run import Run

Floats = NDArray[np.float64]
Picture = NDArray[np.float32]
Said = Callable[[str, int, int], None]

WHITE_QUANTILE = 0.999
"""Quantile, over pixels, of the brightest value under any light; this value counts as white."""
_BATCH = 8
"""Number of pictures held in memory."""
_BLOCK = 1 << 16
"""Number of pixels whose planes are updated together."""


@dataclass(frozen=True)
class LitView:
    """Pictures of one view, read one by one."""

    name: str
    origin: str
    """Measured or simulated, if this is known, and the run or the pictures."""
    size_px: tuple[int, int]
    """Width, height."""
    pixel_mm: float | None
    directions: Floats
    """[lights, 3] unit vectors: x right, y up, z to the camera; all above the picture's plane."""
    linear: Callable[[int], Picture]
    """Function of the number of a light; returns [h, w, 3]. White is 1; brighter values are above 1."""
    normals: Picture | None = None
    """[h, w, 3] fitted normals; NaN outside the mask."""

    def __len__(self) -> int:
        return len(self.directions)

    def encoded_picture(self, number: int) -> Picture:
        """[h, w, 3] picture encoded for displays: sRGB, 0 to 1."""
        picture: Picture = srgb(self.linear(number))
        return picture

    def some_pixels(self, most: int) -> slice:
        """Choose pixels at equal steps, in the order of rows."""
        return slice(None, None, -(-self.size_px[0] * self.size_px[1] // most))

    def samples(self, pixels: slice, say: Said) -> Picture:
        """[lights, pixels, 3] encoded values."""
        values = []
        for number in range(len(self)):
            values.append(srgb(self.linear(number).reshape(-1, 3)[pixels]))
            say(f"{self.name}: reading", number + 1, len(self))
        return np.stack(values)

    def weighted_sums(self, weights: Floats, say: Said) -> Picture:
        """[h, w, planes]: sums of encoded values by `weights` [lights, 3, planes]."""
        width, height = self.size_px
        weights = weights.astype(np.float32)
        planes = np.zeros((height * width, weights.shape[2]), np.float32)
        values = np.empty((height * width, 3 * _BATCH), np.float32)
        for first in range(0, len(self), _BATCH):
            batch = range(first, min(first + _BATCH, len(self)))
            for place, number in enumerate(batch):
                values[:, 3 * place : 3 * place + 3] = self.encoded_picture(number).reshape(-1, 3)
            by = weights[first : batch.stop].reshape(-1, weights.shape[2])
            for pixel in range(0, len(planes), _BLOCK):
                planes[pixel : pixel + _BLOCK] += values[pixel : pixel + _BLOCK, : len(by)] @ by
            say(f"{self.name}: planes", batch.stop, len(self))
        return planes.reshape(height, width, -1)


def chosen_views(run: Run, patterns: Sequence[str]) -> list[str]:
    """Return the names of the views that match one of the patterns, or all views without patterns. Raises
    InputError if none matches."""
    names = list(dict.fromkeys(shot.view for shot in run.proven()))
    matches = [
        name for name in names if not patterns or any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)
    ]
    if not matches:
        raise InputError(f"{run.folder}: no view matches; it has {', '.join(names)}")
    return matches


def lit_views(source: Path, patterns: Sequence[str], scratch: Path, say: Said) -> Iterator[LitView]:
    """Yield the views of a run, whose pictures are stored in a folder under `scratch` while they are used; or the
    view of a result of pictures. Raises InputError, StorageError for damaged frames."""
    if source_of(source) is Source.PICTURES:
        yield view_of_result(PictureResult(source.resolve()), say)
        return
    run = Run(source)
    for name in chosen_views(run, patterns):
        with tempfile.TemporaryDirectory(prefix=".pictures-", dir=scratch) as folder:
            yield view_of_run(run, name, Path(folder), say)


def view_of_run(run: Run, name: str, folder: Path, say: Said) -> LitView:
    """Return a view whose pictures are written into `folder`: nominal positions of LEDs, values divided by their
    nominal light. Raises InputError if too few LEDs are in front of the camera."""
    pictures = write_pictures(run.folder, name, folder, lambda step, done, of: say(f"{name}: {step}", done, of))
    directions = pictures.lights_mm / np.linalg.norm(pictures.lights_mm, axis=1, keepdims=True)
    strengths = read_rows(folder / INTENSITIES, (3,))
    height, width = read_picture(pictures.files[0]).shape[:2]

    def linear(number: int) -> Picture:
        factors = (1.0 / (65535.0 * strengths[number])).astype(np.float32)
        values: Picture = read_picture(pictures.files[number]) * factors
        return values

    return _lit_view(
        name=name,
        origin=f"Coupole, {'simulated' if pictures.is_simulated else 'measured'}: {run.folder.name}, view {name}",
        size_px=(width, height),
        pixel_mm=pictures.width_mm / width,
        directions=directions,
        linear=linear,
        say=say,
    )


def view_of_result(result: PictureResult, say: Said) -> LitView:
    """Return the view of a result of pictures; it is black outside its mask."""
    about, height, width = result.about, *result.mask.shape
    kinds: dict[Any, str] = {True: "simulated", False: "measured"}
    kind = kinds.get(about.get("simulated"), "not known whether it was measured or simulated")
    of = about.get("uncalibrated_run") or result.folder.name
    return _lit_view(
        name=result.folder.name,
        origin=f"Coupole, pictures under known lights, {kind}: {of}",
        size_px=(width, height),
        pixel_mm=None,
        directions=result.directions,
        linear=lambda number: result.picture(result.values(np.array([number]))[0]),
        normals=np.load(result.folder / NORMALS),
        say=say,
    )


def refuse_few_lights(name: str, lights: Floats) -> NDArray[np.int64]:
    """Return the numbers of the lights [n, 3] (directions or positions) in front of the picture's plane. Raises
    InputError if they are too few."""
    above = np.flatnonzero(lights[:, 2] > 0.0)
    if len(above) < FEWEST_LIGHTS:
        raise InputError(
            f"{name}: {len(above)} lights are in front of the picture's plane; at least {FEWEST_LIGHTS} are needed"
        )
    return above


def _lit_view(
    *, linear: Callable[[int], Picture], directions: Floats, name: str, say: Said, **about: Any
) -> LitView:
    """Return the view with white 1, and only with lights in front of the picture's plane, because viewers can have
    no others."""
    above = refuse_few_lights(name, directions)
    brightest = linear(int(above[0])).max(axis=2)
    for count, number in enumerate(above):
        brightest = np.maximum(brightest, linear(int(number)).max(axis=2))
        say(f"{name}: white", count + 1, len(above))
    if not brightest.any():
        raise InputError(f"{name}: the pictures are black")
    white = np.float32(np.quantile(brightest[brightest > 0], WHITE_QUANTILE))
    return LitView(name, directions=directions[above], linear=lambda n: linear(int(above[n])) / white, **about)
