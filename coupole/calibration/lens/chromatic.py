"""Lateral chromatic aberration: a lens for each colour channel, all from the same images.

All lenses share the board's poses. So their common errors (focal length correlated with distance, principal point
with tilt) cancel in their differences. The differences are known far better than each lens alone. Colours differ
in scale, centre and the first term of radial distortion. The higher terms, which only few corners at the field's
rim determine, are common to all colours.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration import optics
from coupole.calibration.adjustment import Block, Group, adjust
from coupole.calibration.lens.board import Sighting
from coupole.calibration.lens.camera import calibrate_camera
from coupole.calibration.lens.corners import PIXEL_SIGMA_PX, Corners
from coupole.calibration.optics import Intrinsics
from coupole.calibration.rotations import Floats, moved_transforms, skew
from coupole.errors import InputError

OWN = ("fx", "fy", "cx", "cy", "k1")
"""Parameters that are estimated for each colour separately, if the lens model has them."""
SHARED = "shared"


@dataclass(frozen=True)
class ChannelLenses:
    """A lens for each channel."""

    intrinsics: Mapping[str, Intrinsics]
    names: tuple[str, ...]
    """[s] names of the parameters, such as `red.fx`, or `shared.k2` for a parameter that all colours have in
    common."""
    covariance: Floats
    """[s, s] covariance of all channels together."""
    degrees: Floats
    """[s]."""
    sigma_px: Mapping[str, float]
    """Noise of a corner by channel."""

    def shift(self, channel: str, against: str, pixels: Floats) -> tuple[Floats, Floats]:
        """Return the shift of a channel's image against another's, px [k, 2], and its covariance, px^2 [k, 2, 2].
        `pixels` [k, 2] are places in the field, to which a lens without distortion would map the directions.
        """
        channel_lens, reference_lens = self.intrinsics[channel], self.intrinsics[against]
        directions = (pixels - (reference_lens.cx, reference_lens.cy)) / (reference_lens.fx, reference_lens.fy)
        points = np.column_stack([directions, np.ones(len(directions))])
        projections = {
            name: optics.project(points, lens.vector())
            for name, lens in ((channel, channel_lens), (against, reference_lens))
        }
        slopes = np.zeros((len(points), 2, len(self.names)))
        for at, name in enumerate(self.names):
            owner, _, parameter = name.partition(".")
            for name_of, sign in ((channel, 1.0), (against, -1.0)):
                if owner in (name_of, SHARED):
                    slopes[:, :, at] += (
                        sign * projections[name_of].by_intrinsics[:, :, optics.NAMES.index(parameter)]
                    )
        covariance = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        return projections[channel].pixels - projections[against].pixels, covariance


def calibrate_channels(
    sightings: Mapping[str, Sequence[Sighting]], size_px: tuple[int, int], model: str = "brown5"
) -> ChannelLenses:
    """Estimate lenses from the same images [n] in several channels (`board.in_channel`).

    Raises InputError if channels differ in the number of images, or if images do not determine a lens.
    """
    channels = tuple(sightings)
    counts = {len(channel_sightings) for channel_sightings in sightings.values()}
    if len(counts) != 1:
        raise InputError(f"camera: every channel needs the same images; found {sorted(counts)} of them")
    starts = {channel: calibrate_camera(sightings[channel], size_px, model) for channel in channels}
    corners = {channel: Corners.of(sightings[channel]) for channel in channels}
    first = starts[channels[0]]
    own_columns = [optics.NAMES.index(name) for name in first.free if name in OWN]
    common = [optics.NAMES.index(name) for name in first.free if name not in OWN]
    images, width = counts.pop(), len(own_columns)
    of_lens = width * len(channels) + len(common)
    lenses = np.stack([starts[channel].intrinsics.vector() for channel in channels])
    lenses[:, common] = lenses[0, common]

    def evaluate(at: tuple[Floats, Floats]) -> list[Block]:
        lenses, poses = at
        blocks = []
        for number, channel in enumerate(channels):
            channel_corners = corners[channel]
            projection = optics.project(channel_corners.in_camera(poses), lenses[number])
            by_turn = poses[channel_corners.view, :3, :3] @ skew(channel_corners.board_mm)
            by_pose = np.concatenate([projection.by_point, -projection.by_point @ by_turn], axis=-1)
            by_lens = projection.by_intrinsics[:, :, own_columns + common]
            jacobian = np.concatenate([by_lens, by_pose], axis=-1) / PIXEL_SIGMA_PX
            residuals = (channel_corners.pixels - projection.pixels) / PIXEL_SIGMA_PX
            of_mine = np.r_[width * number : width * (number + 1), width * len(channels) : of_lens]
            for view, part in enumerate(channel_corners.parts):
                pose = of_lens + 6 * view
                where = np.r_[of_mine, pose : pose + 6]
                blocks.append(
                    Block(residuals[part].ravel(), jacobian[part].reshape(-1, len(where)), where, number)
                )
        return blocks

    def move(at: tuple[Floats, Floats], change: Floats) -> tuple[Floats, Floats]:
        lenses = at[0].copy()
        lenses[:, own_columns] += change[: width * len(channels)].reshape(len(channels), width)
        lenses[:, common] += change[width * len(channels) : of_lens]
        return lenses, moved_transforms(at[1], change[of_lens:].reshape(-1, 6))

    groups = [Group(channel, is_estimated=True, rejects=2) for channel in channels]
    state = (lenses, first.camera_from_board)
    adjustment = adjust(state, evaluate, move, groups, of_lens + 6 * images, calibration_name="camera")
    names = [f"{channel}.{optics.NAMES[column]}" for channel in channels for column in own_columns]
    names += [f"{SHARED}.{optics.NAMES[column]}" for column in common]
    return ChannelLenses(
        {channel: Intrinsics(*map(float, adjustment.state[0][i])) for i, channel in enumerate(channels)},
        tuple(names),
        adjustment.covariance[:of_lens, :of_lens],
        adjustment.degrees[:of_lens],
        {channel: PIXEL_SIGMA_PX * adjustment.factor(channel) for channel in channels},
    )
