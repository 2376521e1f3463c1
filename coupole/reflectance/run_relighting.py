"""Views of a run under a distant light that was not there, from a fit to its triangles."""

from __future__ import annotations

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.motion.occlusion import RAY_START_MM, blocked, ray_mesh
from coupole.reflectance.run_fits import predicted
from coupole.reflectance.run_result import FITS, SLICES, RunResult, read_about
from coupole.reflectance.triangle_fit import TriangleSamples

FAR_MM = 1e5
"""From where a distant light shines; shadows end before it."""
_SHADOW_MM = 3000.0


def best_fit(result: RunResult) -> str:
    """The one that missed least under the LEDs kept for the check; GGX with its normal if none were."""
    known = {name: mae for name, mae in read_about(result.folder)["mae"].items() if mae is not None}
    return min(known, key=known.__getitem__, default="ggx_normal")


def relit_view(
    result: RunResult, direction: NDArray[np.float64], view: str | None = None, fit: str | None = None
) -> NDArray[np.float32]:
    """[h, w, channels] radiance, linear, of a view under a light from `direction` [3] in the support frame; 1 is a
    white diffuser that faces the light. 0 in shadow, and where no triangle with a material is seen.

    The view is the first one unless it is named, the fit that of `FITS` which missed least under the LEDs that
    were kept for the check. Raises InputError for a view or a fit that is not there.
    """
    names = [one.view for one in result.views]
    if view is not None and view not in names:
        raise InputError(f"--view: expected one of {', '.join(names)}; got {view!r}")
    if fit is not None and fit not in (known := (*FITS, "clusters")):
        raise InputError(f"--fit: expected one of {', '.join(known)}; got {fit!r}")
    mine = result.views[0 if view is None else names.index(view)]
    with h5py.File(mine.path, "r") as file:
        seen, centres, normals = file["seen"][()], file["centres_mm"][()], file["normals"][()]
    towards = result.base_from_support[:3, :3] @ (direction / np.linalg.norm(direction))
    count = len(centres)
    light = TriangleSamples(
        np.zeros((count, 1, result.channels), np.float32),
        (centres.mean(axis=0) + FAR_MM * towards)[None],
        np.zeros(1, np.int64),
        mine.camera_mm[None],
        centres,
        normals,
        np.ones(count),
    )
    name = fit or best_fit(result)
    if name in SLICES and not result.slices_path(name, mine).exists():
        raise InputError(f"{result.folder}: has no fit {name}; `coupole reflectance fit {result.folder}` makes it")
    made = predicted(result, name, mine, slice(0, count), light)
    values = np.pi * np.nan_to_num(made[:, 0])
    starts = centres + RAY_START_MM * normals
    values[blocked(ray_mesh(result.corners_mm.astype(np.float64)), starts, starts + _SHADOW_MM * towards)] = 0.0
    values[normals @ towards <= 0.0] = 0.0
    picture = np.zeros((*seen.shape, values.shape[1]), np.float32)
    picture[seen >= 0] = values[seen[seen >= 0]]
    return picture
