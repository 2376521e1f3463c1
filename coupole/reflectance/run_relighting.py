"""Views of a run under a distant light that was not there, from a fit to its triangles."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import h5py
import numba
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.motion.occlusion import RAY_START_MM
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.run_fits import predicted
from coupole.reflectance.run_result import FITS, SLICES, RunResult, read_about
from coupole.reflectance.triangle_fit import TriangleSamples

FAR_MM = 1e5
"""From where a distant light shines."""
_BLOCK, _ROWS = 1 << 16, 256
"""Triangles, and rows of the picture, that a thread makes together."""


def best_fit(result: RunResult) -> str:
    """The one that missed least under the LEDs kept for the check; GGX with its normal if none were."""
    known = {name: mae for name, mae in read_about(result.folder)["mae"].items() if mae is not None}
    return min(known, key=known.__getitem__, default="ggx_normal")


def relit_view(
    result: RunResult, direction: NDArray[np.float64], view: str | None = None, fit: str | None = None
) -> NDArray[np.float32]:
    """[h, w, channels] as `RelitView.under` gives it. Raises InputError for a view or a fit that is not there."""
    return RelitView(result, view, fit).under(direction)


class RelitView:
    """A view of a result, ready for light from many directions.

    The view is the first one unless it is named, the fit that of `FITS` which missed least under the LEDs that
    were kept for the check. Raises InputError for a view or a fit that is not there.
    """

    def __init__(self, result: RunResult, view: str | None = None, fit: str | None = None) -> None:
        names = [one.view for one in result.views]
        if view is not None and view not in names:
            raise InputError(f"--view: expected one of {', '.join(names)}; got {view!r}")
        if fit is not None and fit not in (known := (*FITS, "clusters")):
            raise InputError(f"--fit: expected one of {', '.join(known)}; got {fit!r}")
        self._result, self._fit = result, fit or best_fit(result)
        self._view = result.views[0 if view is None else names.index(view)]
        if self._fit in SLICES and not result.slices_path(self._fit, self._view).exists():
            raise InputError(
                f"{result.folder}: has no fit {self._fit}; `coupole reflectance fit {result.folder}` makes it"
            )
        with h5py.File(self._view.path, "r") as file:
            self._seen, self._centres = file["seen"][()], file["centres_mm"][()]
            self._normals = file["normals"][()]
        self._starts = (self._centres + RAY_START_MM * self._normals).astype(np.float32)
        self._middle_mm = self._centres.mean(axis=0)
        self._mesh = PacketMesh(result.corners_mm)

    def under(self, direction: NDArray[np.float64]) -> NDArray[np.float32]:
        """[h, w, channels] radiance, linear, under a light from `direction` [3] in the support frame; 1 is a white
        diffuser that faces the light. 0 in shadow, and where no triangle with a material is seen."""
        towards = self._result.base_from_support[:3, :3] @ (direction / np.linalg.norm(direction))
        values = np.zeros((len(self._centres), self._result.channels), np.float32)
        picture = np.zeros((*self._seen.shape, values.shape[1]), np.float32)
        blocks = [slice(first, min(first + _BLOCK, len(values))) for first in range(0, len(values), _BLOCK)]
        bands = [slice(first, first + _ROWS) for first in range(0, len(picture), _ROWS)]
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            list(pool.map(lambda rows: self._light(rows, towards, values[rows]), blocks))
            list(pool.map(lambda rows: _paint(self._seen[rows], values, picture[rows]), bands))
        return picture

    def _light(self, rows: slice, towards: NDArray[np.float64], values: NDArray[np.float32]) -> None:
        """Fill the values [b, channels] of some of the view's triangles."""
        centres, normals = self._centres[rows], self._normals[rows]
        light_mm = self._middle_mm + FAR_MM * towards
        light = TriangleSamples(
            np.zeros((len(centres), 1, values.shape[1]), np.float32),
            light_mm[None],
            np.zeros(1, np.int64),
            self._view.camera_mm[None],
            centres,
            normals,
            np.ones(len(centres)),
        )
        made = predicted(self._result, self._fit, self._view, rows, light)[:, 0]
        lit = np.flatnonzero(normals @ towards > 0.0)
        lit = lit[~self._mesh.blocked(self._starts[rows], lit, light_mm)]
        values[lit] = np.pi * np.nan_to_num(made[lit])


@numba.njit(cache=True, nogil=True)
def _paint(seen, values, picture):  # type: ignore[no-untyped-def]
    for row in range(seen.shape[0]):
        for column in range(seen.shape[1]):
            if seen[row, column] >= 0:
                picture[row, column] = values[seen[row, column]]
