"""A first look at a view while its run goes on: normals and diffuse colour by a quick fit to some of its samples.

It is not part of the result. It uses one view alone and few triangles and LEDs, and its samples still contain
light that was reflected by other surfaces.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.pages.maps import GAMMA, picture_png
from coupole.reflectance.run_result import RunResult, read_view_samples
from coupole.reflectance.triangle_fit import fit_triangles

_MOST_TRIANGLES, _MOST_LEDS, _MOST_WIDTH_PX = 5000, 64, 480
_SCAN_NOISE_UM = 30.0


def write_normals(result: Path, view: str, path: Path) -> None:
    """Write a picture of a view: normals on the left (x, y, z of the base frame as red, green, blue), diffuse
    colour on the right, and black where nothing is known. Raises OSError."""
    samples_of_view = read_view_samples(result / "samples" / f"{view}.h5")
    rows = slice(0, None, -(-len(samples_of_view.triangles) // _MOST_TRIANGLES))
    led_mask = np.zeros(len(samples_of_view.leds), np.bool_)
    led_mask[:: -(-len(led_mask) // _MOST_LEDS)] = True
    samples = RunResult(result).view_samples(samples_of_view, rows, led_mask)
    materials = fit_triangles(samples, np.ones(np.count_nonzero(led_mask), np.bool_), _SCAN_NOISE_UM)
    with h5py.File(samples_of_view.path, "r") as file:
        places, centres_mm = file["seen"][()], file["centres_mm"][()]
    step = -(-places.shape[1] // _MOST_WIDTH_PX)
    places = places[::step, ::step]
    nearest = cKDTree(samples.centres_mm).query(centres_mm)[1]
    kd = np.repeat(materials.kd, 3, axis=1)[:, :3] if materials.kd.shape[1] == 1 else materials.kd
    normals_picture = _picture(places, nearest, 0.5 + 0.5 * materials.normals)
    colour_picture = _picture(places, nearest, _for_the_eye(kd))
    part = path.with_suffix(".png.part")
    part.write_bytes(picture_png(np.hstack([normals_picture, colour_picture])))
    part.replace(path)


def _for_the_eye(kd: NDArray[np.float64]) -> NDArray[np.float64]:
    finite_kd = kd[np.isfinite(kd)]
    white = max(float(np.quantile(finite_kd, 0.99)), 1e-12) if len(finite_kd) else 1.0
    shares: NDArray[np.float64] = np.clip(kd / white, 0.0, 1.0) ** (1.0 / GAMMA)
    return shares


def _picture(
    places: NDArray[np.int32], nearest: NDArray[np.int64], colours: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """[h, w, 3] colours of pixels; each pixel takes the row of `colours` that is nearest to its triangle."""
    picture = np.zeros((*places.shape, 3), np.uint8)
    seen_mask = places >= 0
    shares = np.nan_to_num(colours[nearest[places[seen_mask]]])
    picture[seen_mask] = np.rint(255.0 * np.clip(shares, 0.0, 1.0)).astype(np.uint8)
    return picture
