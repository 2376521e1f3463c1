"""Lateral chromatic aberration: a lens for each colour channel, all from the same images.

The board's poses are shared, so what the lenses have in common (focal length against distance, principal point
against tilt) cancels out of their differences, which are known far better than each lens alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration import optics
from coupole.calibration.adjustment import Block, Group, adjust
from coupole.calibration.board import Sighting
from coupole.calibration.camera import PIXEL_SIGMA_PX, Corners, calibrate_camera
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats, moved, skew
from coupole.errors import InputError


@dataclass(frozen=True)
class ChannelLenses:
    """A lens for each channel."""

    intrinsics: Mapping[str, Intrinsics]
    names: tuple[str, ...]
    """[s] of the parameters, as `red.fx`."""
    covariance: Floats
    """[s, s] of all channels together."""
    degrees: Floats
    """[s]."""
    sigma_px: Mapping[str, float]
    """Noise of a corner by channel."""

    def shift(self, channel: str, against: str, pixels: Floats) -> tuple[Floats, Floats]:
        """How far a channel sees directions from where another sees them, px [k, 2], and the covariance of that,
        px^2 [k, 2, 2]. `pixels` [k, 2] say where in the field, as an undistorted lens would see the directions.
        """
        one, other = self.intrinsics[channel], self.intrinsics[against]
        directions = (pixels - (other.cx, other.cy)) / (other.fx, other.fy)
        points = np.column_stack([directions, np.ones(len(directions))])
        seen = {name: optics.project(points, lens.vector()) for name, lens in ((channel, one), (against, other))}
        slopes = np.zeros((len(points), 2, len(self.names)))
        for at, name in enumerate(self.names):
            owner, _, parameter = name.partition(".")
            if owner in seen:
                sign = 1.0 if owner == channel else -1.0
                slopes[:, :, at] = sign * seen[owner].by_intrinsics[:, :, optics.NAMES.index(parameter)]
        spread = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        return seen[channel].pixels - seen[against].pixels, spread


def calibrate_channels(
    sightings: Mapping[str, Sequence[Sighting]], size_px: tuple[int, int], model: str = "brown5"
) -> ChannelLenses:
    """Lenses from the same images [n] in several channels (`board.in_channel`).

    Raises InputError: channels with different numbers of images, or images that do not determine a lens.
    """
    channels = tuple(sightings)
    counts = {len(seen) for seen in sightings.values()}
    if len(counts) != 1:
        raise InputError(f"camera: every channel needs the same images; found {sorted(counts)} of them")
    starts = {channel: calibrate_camera(sightings[channel], size_px, model) for channel in channels}
    corners = {channel: Corners.of(sightings[channel]) for channel in channels}
    columns = [optics.NAMES.index(name) for name in starts[channels[0]].free]
    width, images = len(columns), counts.pop()
    shared = width * len(channels)
    first = starts[channels[0]]
    state = (np.stack([starts[channel].intrinsics.vector() for channel in channels]), first.camera_from_board)

    def evaluate(at: tuple[Floats, Floats]) -> list[Block]:
        lenses, poses = at
        blocks = []
        for number, channel in enumerate(channels):
            mine = corners[channel]
            seen = optics.project(mine.in_camera(poses), lenses[number])
            turned = poses[mine.view, :3, :3] @ skew(mine.board_mm)
            by_pose = np.concatenate([seen.by_point, -seen.by_point @ turned], axis=-1)
            jacobian = np.concatenate([seen.by_intrinsics[:, :, columns], by_pose], axis=-1) / PIXEL_SIGMA_PX
            residuals = (mine.pixels - seen.pixels) / PIXEL_SIGMA_PX
            for view, part in enumerate(mine.parts):
                own = shared + 6 * view
                where = np.r_[width * number : width * (number + 1), own : own + 6]
                blocks.append(Block(residuals[part].ravel(), jacobian[part].reshape(-1, width + 6), where, number))
        return blocks

    def move(at: tuple[Floats, Floats], change: Floats) -> tuple[Floats, Floats]:
        lenses = at[0].copy()
        lenses[:, columns] += change[:shared].reshape(len(channels), width)
        return lenses, moved(at[1], change[shared:].reshape(-1, 6))

    groups = [Group(channel, estimated=True, rejects=2) for channel in channels]
    found = adjust(state, evaluate, move, groups, shared + 6 * images, what="camera")
    return ChannelLenses(
        {channel: Intrinsics(*map(float, found.state[0][i])) for i, channel in enumerate(channels)},
        tuple(f"{channel}.{name}" for channel in channels for name in first.free),
        found.covariance[:shared, :shared],
        found.degrees[:shared],
        {channel: PIXEL_SIGMA_PX * found.factor(channel) for channel in channels},
    )
