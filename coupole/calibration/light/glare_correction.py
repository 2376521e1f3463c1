"""Subtracts veiling glare from frames, with a record of `calibrate glare`.

The veil is found from a frame's own light. These errors remain: noise of the shares and the form of the veil,
which the record states; light from beyond the picture's edge; and saturated pixels, for which only a lower bound
of the light is known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.calibration.earlier import read_earlier
from coupole.calibration.light.frames import LightFrames, channels_of
from coupole.calibration.light.veil import PARTS, at_pixels, block_px_of, light_of_blocks, parts_of, veil_of
from coupole.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class GlareCorrection:
    """Shares of the veil's parts in a camera's channels."""

    channels: tuple[str, ...]
    shares: Floats
    """[channels, parts]"""
    covariances: Floats
    """[channels, parts, parts]"""
    u_form: Floats
    """[channels] relative standard uncertainty of a veil from its form."""
    size_px: tuple[int, int]

    @property
    def block_px(self) -> int:
        return block_px_of(self.size_px[0])

    def veil(self, light: Floats, channel: int) -> tuple[Floats, float]:
        """Return the veil [block rows, block columns] in one channel's `light` of blocks, which includes the veil,
        in the same unit. Also return its relative standard uncertainty, root mean square over the picture."""
        width_blocks = self.size_px[0] / self.block_px
        veil = veil_of(light, self.shares[channel], width_blocks)
        parts = parts_of(light - veil, width_blocks).reshape(len(PARTS), -1)
        variance = np.einsum("in,ij,jn->n", parts, self.covariances[channel], parts).mean()
        square = float(np.mean(veil**2))
        return veil, float(np.sqrt(variance / square + self.u_form[channel] ** 2)) if square else 0.0

    def without_veil(self, signal: Floats, masks: Mapping[str, NDArray[np.bool_]]) -> Floats:
        """Return the linear signal [h, w] above dark, without its veil. `masks` [h, w] are True at the pixels of a
        channel."""
        clean = signal.copy()
        for number, channel in enumerate(self.channels):
            veil, _ = self.veil(light_of_blocks(signal, masks[channel], self.block_px), number)
            rows, columns = np.nonzero(masks[channel])
            clean[rows, columns] -= at_pixels(veil, rows, columns, self.block_px)
        return clean


def read_glare(path: Path, frames: LightFrames) -> GlareCorrection:
    """Return the correction by a record that is valid for these frames. Raises InputError for a record of another
    kind or camera."""
    record = read_earlier(path, "glare", frames.about, frames.size_px)
    names = [parameter.name for parameter in record.parameters]
    channels = channels_of(frames.pattern)
    rows = []
    for channel in channels:
        share_names = [f"share.{part}.{channel}" for part in PARTS]
        if absent := [name for name in share_names if name not in names]:
            raise InputError(f"{path}: has no figure {absent[0]}; calibrate the glare anew, with this camera")
        rows.append([names.index(name) for name in share_names])
    values = np.array([parameter.value or 0.0 for parameter in record.parameters])
    return GlareCorrection(
        channels,
        values[np.array(rows)],
        np.stack([record.covariance_matrix[np.ix_(row, row)] for row in rows]),
        np.array([record.value(f"u_form.{channel}") for channel in channels]),
        frames.size_px,
    )
