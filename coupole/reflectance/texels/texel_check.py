"""Errors of texels, compared with the errors of triangles, in pictures of LEDs that were kept for the check.

Pictures are made as by `coupole reflectance relight --led`. They are compared with the frames pixel by pixel,
where both have a value. Inter-reflection is subtracted from the frames, as from the samples.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.reflectance.block_work import Said, silent
from coupole.reflectance.fits import FITS, TEXELS
from coupole.reflectance.new_light.light_kinds import LedLight
from coupole.reflectance.relit_uncertainty import uncertainty_of_picture
from coupole.reflectance.result_folder import read_settings
from coupole.reflectance.run_check import PEAK_QUANTILE
from coupole.reflectance.run_intervals import WideningSamples, residuals_of
from coupole.reflectance.run_pictures import read_check_frames
from coupole.reflectance.run_relighting import best_fit, scene_of_view
from coupole.reflectance.run_result import FRAMES, RunResult, ViewSamples
from coupole.reflectance.texels.pixel_file import ABOUT, FOLDER, read_view_texels, size_of_texels
from coupole.storage.durable import write_synced

SCHEMA = "coupole-texels/1"
WIDENED_BY_EVERY = 2
"""Step between the left-out LEDs whose pictures are used to find the widths of intervals."""
_MOST_SAMPLES = 200_000
"""Number of pixels and channels of a picture from which the widths are found."""
_BLOCK_BYTES = 500_000_000
"""Memory for shares of direct light that are read together, bytes."""
Singles = NDArray[np.float32]


def check_texels(result: RunResult, say: Said = silent) -> dict[str, Any]:
    """Compare pictures by texels, and by the best fit of triangles, with the frames of left-out LEDs. Write
    `texels/texels.json`, and return its content."""
    triangle_fit = best_fit(result, FITS)
    misses: dict[str, list[NDArray[np.float64]]] = {TEXELS: [], triangle_fit: []}
    measured_parts: list[Singles] = []
    for number, view in enumerate(result.views, start=1):
        makers = {name: picture_maker(result, view, name) for name in (TEXELS, triangle_fit)}
        for measured_picture, pictures in held_out_pictures(result, view, makers):
            has_both = np.isfinite(measured_picture) & np.logical_and.reduce(
                [picture > 0.0 for picture in pictures.values()]
            )
            measured_parts.append(measured_picture[has_both])
            for name, picture in pictures.items():
                off = (picture - measured_picture)[has_both]
                misses[name].append(np.array([np.abs(off).sum(), np.square(off).sum(), off.size]))
        say("check of texels", number, len(result.views))
    values = np.concatenate(measured_parts) if measured_parts else np.empty(0, np.float32)
    peak = float(np.quantile(values, PEAK_QUANTILE)) if len(values) else float("nan")
    about = {
        "schema": SCHEMA,
        "simulated": read_settings(result.folder)["simulated"],
        "pixels": {view.view: len(read_view_texels(result, view).pixels) for view in result.views},
        "mae": {name: _mean(parts, 0) for name, parts in misses.items()},
        "held_out_psnr_db": {name: _psnr_db(parts, peak) for name, parts in misses.items()},
    }
    about["widening"] = texel_widening(result, say)
    size = size_of_texels(result.folder)
    if size is not None and size.mm is not None:
        about["asked_mm"] = size.mm
        about["side_px"] = {view.view: read_view_texels(result, view).side_px for view in result.views}
    write_synced(result.folder / FOLDER / ABOUT, json.dumps(about, indent=1) + "\n")
    return about


def _mean(parts: list[NDArray[np.float64]], column: int) -> float | None:
    sums = np.sum(parts, axis=0) if parts else np.zeros(3)
    return float(sums[column] / sums[2]) if sums[2] else None


def _psnr_db(parts: list[NDArray[np.float64]], peak: float) -> float | None:
    square = _mean(parts, 1)
    return None if not square else float(10.0 * np.log10(peak**2 / square))


def texel_widening(result: RunResult, say: Said = silent) -> dict[str, Any] | None:
    """Return quantiles of the errors of pictures, divided by their stated uncertainty, in the form of
    `result.json` for fits. They come from every second left-out LED; None from too few pixels."""
    samples = WideningSamples()
    for number, view in enumerate(result.views, start=1):
        _add_errors(samples, result, view)
        say("widths of intervals", number, len(result.views))
    return samples.widening()


def _add_errors(samples: WideningSamples, result: RunResult, view: ViewSamples) -> None:
    """Add the errors of a view's pictures to the samples."""
    scene = scene_of_view(result, view.view, TEXELS)
    residuals = np.nan_to_num(residuals_of(scene))[..., None].repeat(result.channels, axis=2).astype(np.float32)
    makers: dict[str, Callable[[int], Singles]] = {
        "picture": lambda led: scene.picture([LedLight(number=led)]),
        "uncertainty": lambda led: uncertainty_of_picture(scene, [LedLight(number=led)]),
        "residual": lambda _: residuals,
        "led": lambda led: np.full(residuals.shape, led, np.float32),
    }
    for measured_picture, pictures in held_out_pictures(result, view, makers, every=WIDENED_BY_EVERY):
        has_all = np.isfinite(measured_picture) & (pictures["picture"] > 0.0) & (pictures["uncertainty"] > 0.0)
        places = np.flatnonzero(has_all)
        places = places[:: 1 + len(places) // _MOST_SAMPLES]
        measured_values = measured_picture.ravel()[places].astype(np.float64)
        values, u_values, residual, leds = (
            image.ravel()[places].astype(np.float64) for image in pictures.values()
        )
        samples.ratios.append(np.abs(measured_values - values) / u_values)
        samples.relative.append(u_values / values)
        samples.residual.append(residual)
        samples.leds.append(leds.astype(np.int64))


def held_out_pictures(
    result: RunResult, view: ViewSamples, makers: Mapping[str, Callable[[int], Singles]], *, every: int = 1
) -> Iterator[tuple[Singles, dict[str, Singles]]]:
    """Yield pictures of each LED that was kept for the check, or of every n-th LED: the measured picture [h / 2, w
    / 2, channels] in shares of the camera's range, and the pictures of the `makers`, by their names. A maker
    returns [h, w, channels] for an LED."""
    frames = read_check_frames(result, view)
    with h5py.File(result.folder / FRAMES / view.path.name, "r") as file:
        offsets = file["offsets"][()]
    is_checked = np.isin(view.leds, frames.leds)
    blocks = [result.direct_shares(view, rows, is_checked) for rows in result.view_blocks(view, _BLOCK_BYTES)]
    direct = dict(zip(view.leds[is_checked], np.concatenate(blocks).swapaxes(0, 1), strict=True))
    for number, led in list(enumerate(frames.leds))[::every]:
        measured_picture = frames.share[number].astype(np.float32) * frames.picture(direct[led])
        pictures = {name: make(int(led)) for name, make in makers.items()}
        yield (
            measured_picture,
            {name: _of_blocks(picture, offsets, measured_picture.shape) for name, picture in pictures.items()},
        )


def picture_maker(result: RunResult, view: ViewSamples, fit: str) -> Callable[[int], Singles]:
    """Return a function that makes a view's picture by a fit under an LED."""
    scene = scene_of_view(result, view.view, fit)
    return lambda led: scene.picture([LedLight(number=led)])


def _of_blocks(picture: Singles, offsets: NDArray[np.int64], shape: tuple[int, ...]) -> Singles:
    """[h / 2, w / 2, channels] values of the pixels that are used in blocks of 2 x 2."""
    parts = [picture[row::2, column::2, channel] for channel, (row, column) in enumerate(offsets)]
    return np.stack([part[: shape[0], : shape[1]] for part in parts], axis=-1)
