"""The result folder of pictures under known lights: its contents, and how to read it.

Large data are in HDF5 files, with shapes, units and axes in attributes; docs/reference/result-folder.md describes
them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError, Problem, reason
from coupole.intake.plain_data import read_json

Floats = NDArray[np.float32]

SCHEMA = "coupole-reflectance-pictures/1"
SAMPLES, MATERIALS, INTERPOLATION = "samples/pictures.h5", "fits/materials.h5", "fits/interpolation.h5"
INTERVALS = "fits/intervals.h5"
"""File of the coefficients and factors by which intervals of relit pictures are predicted; missing if there were
too few lights."""
CONES = "normals_95_deg.npy"
NORMALS, ABOUT, REPORT = "normals.npy", "result.json", "report.html"
AXES = "x to the right of the picture, y up, z to the camera"


@contextmanager
def open_result_file(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file of a result. Raises InputError if it cannot be read."""
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        problem = Problem(str(path), 0, 0, "", "cannot be read; make the result again into another folder")
        raise InputError([problem]) from error
    with file:
        yield file


@dataclass(frozen=True)
class PictureResult:
    """A result folder, complete or unfinished."""

    folder: Path

    @cached_property
    def about(self) -> dict[str, Any]:
        """Content of result.json. Raises InputError if the folder has no such file, or one of another kind."""
        path = self.folder / ABOUT
        try:
            about = read_json(path, allow_nan=True)
        except (OSError, InputError) as error:
            expectation = "expected the result of `coupole reflectance --pictures`"
            problem = Problem(str(path), 0, 0, "", f"{expectation}; {reason(error)}")
            raise InputError([problem]) from error
        if not isinstance(about, dict) or about.get("schema") != SCHEMA:
            raise InputError([Problem(str(path), 0, 0, "schema", f"expected {SCHEMA}")])
        return about

    @cached_property
    def mask(self) -> NDArray[np.bool_]:
        """[h, w] True for pixels that were fitted."""
        with open_result_file(self.folder / SAMPLES) as file:
            return np.asarray(file["mask"], dtype=bool)

    @cached_property
    def directions(self) -> NDArray[np.float64]:
        """[lights, 3] unit vectors to all lights, including left-out lights."""
        with open_result_file(self.folder / SAMPLES) as file:
            return np.asarray(file["directions"], dtype=np.float64)

    @cached_property
    def _scales(self) -> Floats:
        """[lights, 1, 3] factors from raw values to full scale 1 divided by the intensities."""
        with open_result_file(self.folder / SAMPLES) as file:
            factors: NDArray[np.float64] = 1.0 / (file.attrs["full_scale"] * np.asarray(file["intensities"]))
        return factors[:, None].astype(np.float32)

    def values(self, lights: NDArray[np.int64], pixels: slice = slice(None)) -> Floats:
        """[lights, pixels, 3] values in full scales divided by the intensities; `lights` must be in rising
        order."""
        with open_result_file(self.folder / SAMPLES) as file:
            raw = file["values"]
            values = np.empty((len(lights), *raw[0, pixels].shape), np.float32)
            for place, light in enumerate(lights):
                values[place] = raw[light, pixels]
        values *= self._scales[lights]
        return values

    def picture(self, values: Floats, outside: float = 0.0) -> Floats:
        """[h, w, ...] picture of values [pixels, ...]."""
        picture = np.full((*self.mask.shape, *values.shape[1:]), outside, np.float32)
        picture[self.mask] = values
        return picture
