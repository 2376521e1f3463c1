"""Light from all directions, as a picture with latitude and longitude as axes.

The top row is up. The middle column is the frame's middle direction. The left side of the picture is to the left
of an observer who looks in the middle direction. For results of runs, up is z and the middle is x, so that left is
y. For results of pictures, up is y and the middle is z, towards the camera, so that left is x. Within a pixel,
radiance is constant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from coupole.errors import InputError

Floats = NDArray[np.float64]

OF_RUNS = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
"""Rows: middle, left, up, in the support frame."""
OF_PICTURES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
_GOLDEN = (math.sqrt(5.0) - 1.0) / 2.0


@dataclass(frozen=True)
class Environment:
    """Radiance by direction."""

    radiance: NDArray[np.float32]
    """[h, w, channels]"""
    axes: Floats
    """[3, 3] rows: middle, left, up."""

    def turned_about_up(self, angle_deg: float) -> Environment:
        """Return the environment turned about the up direction, from the middle to the left."""
        cosine, sine = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
        turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        return replace(self, axes=turn @ self.axes)

    def solid_angles(self) -> Floats:
        """[h] solid angle of a pixel in each row, sr."""
        height, width = self.radiance.shape[:2]
        heights = np.cos(np.linspace(0.0, math.pi, height + 1))
        angles: Floats = (heights[:-1] - heights[1:]) * 2.0 * math.pi / width
        return angles

    def total(self) -> float:
        """Integral of the colours' mean over all directions."""
        mean = self.radiance.mean(axis=2, dtype=np.float64)
        return float(np.sum(mean * self.solid_angles()[:, None]))

    def sample(self, count: int) -> tuple[Floats, Floats, Floats]:
        """Return directions [count, 3] with a density in proportion to radiance, their radiances [count,
        channels], and their number per steradian [count]. Each call returns the same directions.

        Rows and columns are chosen by their cumulative light, with a lattice of golden sections.
        """
        mean = self.radiance.mean(axis=2, dtype=np.float64)
        light = mean * self.solid_angles()[:, None]
        by_row = np.append(0.0, np.cumsum(light.sum(axis=1)))
        number = np.arange(count)
        across = (number * _GOLDEN + 0.5) % 1.0
        row, down = _parts_at(by_row, (number + 0.5) / count)
        column, right = np.empty(count, np.int64), np.empty(count)
        for row_number in np.unique(row):
            here = row == row_number
            column[here], right[here] = _parts_at(np.append(0.0, np.cumsum(light[row_number])), across[here])
        height, width = mean.shape
        edges = np.cos(np.linspace(0.0, math.pi, height + 1))
        up = edges[row] + down * (edges[row + 1] - edges[row])
        azimuth = 2.0 * math.pi * (0.5 - (column + right) / width)
        level = np.sqrt(np.maximum(1.0 - up * up, 0.0))
        local = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up], axis=1)
        density = count * mean[row, column] / by_row[-1]
        return local @ self.axes, self.radiance[row, column].astype(np.float64), density


def _parts_at(cumulative_sum: Floats, shares: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Return, for each share of a cumulative sum, the part that contains it, and the position in this part, 0 to
    1."""
    at = shares * cumulative_sum[-1]
    part = np.clip(np.searchsorted(cumulative_sum, at, side="right") - 1, 0, len(cumulative_sum) - 2)
    within = (at - cumulative_sum[part]) / np.maximum(cumulative_sum[part + 1] - cumulative_sum[part], 1e-300)
    return part.astype(np.int64), np.clip(within, 0.0, 1.0)


def read_environment(path: Path, axes: Floats, strength: Floats, turn_deg: float = 0.0) -> Environment:
    """Read a file in OpenEXR or Radiance format, and multiply it by a strength [3]. Raises InputError if the file
    cannot be read, is not twice as wide as high, or has values that no light can have."""
    radiance = _read_radiance(path)
    if radiance.ndim != 3 or radiance.shape[2] < 3 or radiance.shape[1] != 2 * radiance.shape[0]:
        raise InputError(f"{path}: expected three colours, twice as wide as high; got {radiance.shape}")
    radiance = radiance[..., :3]
    if not np.all(np.isfinite(radiance)) or radiance.min() < 0.0 or not radiance.any():
        raise InputError(f"{path}: expected finite values, none below 0 and some above; repair it or name another")
    return Environment(radiance * strength.astype(np.float32), axes).turned_about_up(turn_deg)


def _read_radiance(path: Path) -> NDArray[np.float32]:
    """[h, w, channels] radiance; red is first."""
    if path.suffix.lower() not in {".exr", ".hdr"}:
        raise InputError(f"{path}: expected an environment in a file .exr or .hdr")
    if path.suffix.lower() == ".hdr":
        import cv2

        try:
            picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        except cv2.error:  # more pixels than OpenCV takes
            picture = None
        if picture is None:
            raise InputError(f"{path}: expected a Radiance file that can be read")
        return np.ascontiguousarray(picture[..., ::-1], np.float32)
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{path}: expected an OpenEXR file that can be read: {error}") from error
    for name in ("RGB", "RGBA"):
        if name in channels:
            return channels[name][..., :3].astype(np.float32)
    if not {"R", "G", "B"} <= set(channels):
        raise InputError(f"{path}: expected channels R, G and B; got {', '.join(channels)}")
    return np.stack([channels[name] for name in "RGB"], axis=2).astype(np.float32)
