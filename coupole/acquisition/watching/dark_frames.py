"""Ambient light: compares the dark frames of a burst with the first ones at the same exposure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.watching.camera_noise import CameraNoise
from coupole.acquisition.watching.findings import Found, SeenFrame
from coupole.plan.watch import WatchLimits

TILES = 8
"""Tiles across and down a frame, in which changes are looked for."""


def tile_edges(shape: tuple[int, int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First row and first column of each tile of a grid of bins."""
    rows, columns = (np.linspace(0, side, min(TILES, side) + 1).astype(np.int64)[:-1] for side in shape)
    return rows, columns


def tile_sums(bins: NDArray[np.floating]) -> NDArray[np.float64]:
    """[..., tiles, tiles] sums over the tiles of [..., rows, columns] bins."""
    rows, columns = tile_edges(bins.shape[-2:])
    down = np.add.reduceat(np.asarray(bins, float), rows, axis=-2)
    return np.asarray(np.add.reduceat(down, columns, axis=-1))


def tile_means(bins: NDArray[np.floating]) -> NDArray[np.float64]:
    return np.asarray(tile_sums(bins) / tile_sums(np.ones(bins.shape[-2:])))


def dark_level(frames: Sequence[SeenFrame]) -> NDArray[np.float32]:
    """[rows, columns] median of dark frames."""
    return np.median([frame.look.mean_dn for frame in frames], axis=0).astype(np.float32)


def ambient_light(
    reference_dn: NDArray[np.float32],
    reference_count: int,
    later: Sequence[SeenFrame],
    noise: CameraNoise,
    limits: WatchLimits,
    exposure_us: int,
) -> Found | None:
    """Find light that is in later dark frames but not in the first ones, by tiles of their median. Return None if
    this light is within the limit. The limit allows for noise, and for the dark current of a sensor that warms
    up.
    """
    if not later:
        return None
    now_dn = dark_level(later)
    more_dn = tile_means(now_dn - reference_dn)
    rows, columns = now_dn.shape
    sigma_dn = noise.dark_sigma_dn(max(1, rows // TILES), max(1, columns // TILES))
    # The median of n normal numbers scatters by up to sqrt(pi / 2) of what their mean does.
    sigma_dn *= float(np.sqrt(0.5 * np.pi * (1.0 / reference_count + 1.0 / len(later))))
    allowed_dn = limits.dark_e_per_s * exposure_us * 1e-6 * noise.dn_per_e
    limit_dn = limits.sigmas * sigma_dn + allowed_dn
    figure_dn = float(more_dn.max())
    if figure_dn <= limit_dn:
        return None
    words = f"dark frames show {figure_dn:.2f} DN more light than the first ones did"
    return Found("ambient light", (), figure_dn, limit_dn, "DN", words, reference_dn, now_dn)
