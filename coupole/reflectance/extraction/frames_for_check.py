"""Frames of LEDs that are kept for the check, as pictures: one value for each block of 2 x 2 pixels and channel.

In a block, one pixel of each channel is used, so that green does not count twice (Lucat et al. 2025, 6.3). Pixels
are linear, as shares of the camera's range, with dark and flat field removed, as in the samples.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.light.frames import LightFrame
from coupole.calibration.light.veil import at_pixels
from coupole.kernels import kernel
from coupole.reflectance.extraction.frame_veils import FrameVeils
from coupole.reflectance.extraction.measured_run import MeasuredView
from coupole.reflectance.extraction.radiance import RANGE_LEFT_OUT, Radiometry
from coupole.reflectance.extraction.sample_codes import REACHED
from coupole.storage.hdf5_file import hdf5_file

MOST_FRAMES = 12
"""Largest number of frames of a view; if more LEDs are kept, they are thinned out evenly."""


def write_frames(
    radiometry: Radiometry,
    view: MeasuredView,
    samples: Path,
    left_out: Sequence[int],
    threads: int | None,
    to: Path,
) -> None:
    """Write the pictures of some of the LEDs `left_out`, each from its longest exposure. `samples` is the view's
    file. A block has a value if all its pixels are unclipped and see triangles that the LED reaches. Raises
    StorageError."""
    leds = [led for led in view.by_led if led in set(left_out)]
    leds = leds[:: -(-len(leds) // MOST_FRAMES)] if leds else []
    with h5py.File(samples, "r") as file:
        of_led = list(file["leds"][()])
        place_of_pixel, codes = file["seen"][()], file["codes"][:, np.isin(of_led, leds)]
    offsets = block_offsets(radiometry.channel, radiometry.channels)
    height, width = place_of_pixel.shape

    veils = radiometry.veils(view.frames)

    def picture(led: int) -> tuple[NDArray[np.float16], float]:
        frame = max(view.by_led[led], key=lambda frame: frame.exposure_us)
        is_lit = np.append(codes[:, leds.index(led)] == REACHED, False)  # the last one: what is not seen
        share, noise = _picture(radiometry, frame, place_of_pixel, is_lit, offsets)
        if veils is not None:
            share -= _veil_picture(radiometry, veils, view.by_led[led], frame.exposure_us, offsets)
        return share.astype(np.float16), noise

    with hdf5_file(to, "w") as file, ThreadPoolExecutor(threads or len(os.sched_getaffinity(0))) as pool:
        shape = (len(leds), height // 2, width // 2, radiometry.channels)
        data = file.create_dataset("share", shape, np.float16, track_times=False)
        data.attrs["told"] = (
            "[leds, h / 2, w / 2, channels] signal as a share of the camera's range; NaN where there is none"
        )
        noise = np.full(len(leds), np.nan)
        for number, (values, noise_picture) in enumerate(pool.map(picture, leds)):
            data[number], noise[number] = values, noise_picture
            file.raise_error()
        file.create_dataset("leds", data=np.array(leds, np.int64), track_times=False)
        file.create_dataset("noise", data=noise, track_times=False)
        file["noise"].attrs["told"] = (
            "mean absolute error of `share` by noise; NaN without a record of the response"
        )
        file.create_dataset("offsets", data=offsets, track_times=False)
        file["offsets"].attrs["told"] = "[channels, 2] row and column, within a block, of the pixel that counts"


def block_offsets(channel: NDArray[np.int8], channels: int) -> NDArray[np.int64]:
    """[channels, 2] row and column, in a block of 2 x 2, of the first pixel of each channel of a map [h, w]."""
    return np.stack([np.argwhere(channel[:2, :2] == number)[0] for number in range(channels)])


def _picture(
    radiometry: Radiometry,
    frame: LightFrame,
    place_of_pixel: NDArray[np.int32],
    is_lit: NDArray[np.bool_],
    offsets: NDArray[np.int64],
) -> tuple[NDArray[np.float32], float]:
    """Return one LED's picture, and its mean absolute error from noise."""
    height, width = place_of_pixel.shape
    range_dn = radiometry.white_dn - radiometry.black_dn
    top_dn = radiometry.white_dn - RANGE_LEFT_OUT * range_dn
    share = np.full((height // 2, width // 2, len(offsets)), np.nan, np.float32)
    noise = np.full(share.shape, np.nan, np.float32)
    _blocks(
        frame.read(), radiometry.dark(frame), place_of_pixel, is_lit, offsets, radiometry.flat,
        radiometry.curve, radiometry.noise, top_dn,
        float(range_dn), share, noise,
    )  # fmt: skip
    some = noise[np.isfinite(noise)]
    return share, float(np.sqrt(2 / np.pi) * some.mean()) if len(some) else float("nan")


def _veil_picture(
    radiometry: Radiometry,
    veils: FrameVeils,
    frames: Sequence[LightFrame],
    exposure_us: float,
    offsets: NDArray[np.int64],
) -> NDArray[np.float32]:
    """[h / 2, w / 2, channels] glare in an exposure of one LED, from all its frames, in the shares of
    `_picture`."""
    veil, _ = veils.of_led([(frame.exposure_us, frame.read().ravel()) for frame in frames])
    height, width = radiometry.flat.shape
    share = np.empty((height // 2, width // 2, len(offsets)), np.float32)
    for c, (down, right) in enumerate(offsets):
        rows, columns = np.mgrid[down : height // 2 * 2 : 2, right : width // 2 * 2 : 2]
        rates = at_pixels(veil[c], rows.ravel(), columns.ravel(), veils.glare.block_px).reshape(rows.shape)
        share[..., c] = rates * exposure_us * 1e-6 / radiometry.flat[rows, columns]
    return share / np.float32(radiometry.white_dn - radiometry.black_dn)


@kernel
def _blocks(raw, dark, place_of_pixel, is_lit, offsets, flat, curve, noise, top_dn, range_dn, share, deviation):  # type: ignore[no-untyped-def]
    for row in range(share.shape[0]):
        for column in range(share.shape[1]):
            good = True
            for pixel in range(4):
                y, x = 2 * row + pixel // 2, 2 * column + pixel % 2
                good &= is_lit[place_of_pixel[y, x]] and raw[y, x] < top_dn
            if not good:
                continue
            for c in range(share.shape[2]):
                y, x = 2 * row + offsets[c, 0], 2 * column + offsets[c, 1]
                signal = float(raw[y, x]) - dark[y, x]
                over = signal / curve[c, 2]
                straight = signal * (1.0 + over * (curve[c, 0] + over * curve[c, 1]))
                share[row, column, c] = straight / (flat[y, x] * range_dn)
                variance = noise[c, 0] + noise[c, 1] * max(signal, 0.0)
                deviation[row, column, c] = np.sqrt(variance) / (flat[y, x] * range_dn)
