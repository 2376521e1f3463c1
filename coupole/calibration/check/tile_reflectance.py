"""Reflectance of a second tile, by the calibrated powers of the LEDs.

The model is logarithmic. For the LED k in the channel c, in a view of the tile at the place p, it is

    ln value_kc = ln power_kc + delta_pc + J_k . theta_p + j_k kappa + D_kc . phi + noise,

Here value is the power that the LED would have if the tile were as described (`tile_views.Row`). delta is the
logarithm of measured over certified reflectance. theta is the tile's tilt and height, kappa its departure from
Minnaert's law. phi are the figures that the powers share; they represent the first tile. All of these except delta
have priors, from the description of this tile and from the covariance in the record of the powers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration.light.drift_records import Powers
from coupole.calibration.light.frames import LightFrame, LightFrames, channels_of
from coupole.calibration.light.led_power import LEAST_PRIOR, prior_of
from coupole.calibration.light.led_power_tile import Setting, TileReader
from coupole.calibration.light.records import Progress, counter
from coupole.calibration.light.spectralon import Tile
from coupole.calibration.light.tile_views import OF_PLACE, Emitter, Row, rows_of
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_FLASH = 5e-4
"""Relative scatter of an LED's flashes (as in `calibrate_led_power`)."""
_LEAST_ROWS = 6
_DARK = 0.1
"""Least signal that is used, as a share of the expected signal. A smaller signal means a shadow, or a dead LED."""


@dataclass(frozen=True)
class Place:
    """Observations of the tile at one place: rows of its views, by channel, with the figures of this place."""

    name: str
    tile: Mapping[str, Tile]
    """The certified tile, by channel."""
    rows: Mapping[str, Sequence[Row]]


@dataclass(frozen=True)
class MeasuredTile:
    """Reflectances in the certificate's geometry."""

    places: tuple[str, ...]
    channels: tuple[str, ...]
    reflectance: Floats
    """[places, channels]."""
    covariance: Floats
    """[places channels, places channels] covariance of the logarithms of reflectance, so it is relative."""
    certified_reflectance: Floats
    """[places, channels]."""
    u_certified: Floats
    """[places, channels]."""
    residual_ratio: float
    """Root mean square of the residuals, divided by their stated noise."""


def reflectance_of(
    places: Sequence[Place], powers: Mapping[str, Powers], shared_covariance: Floats
) -> MeasuredTile:
    """Return the reflectance of a tile at each place, per channel.

    `shared_covariance` is the covariance of the figures that the powers share, channel after channel in the order
    of `powers`. Raises InputError if too few LEDs can be used at a place.
    """
    channels = tuple(powers)
    deltas, shared_count = len(places) * len(channels), len(shared_covariance)
    size = deltas + OF_PLACE * len(places) + 1 + shared_count
    blocks, y, u = [], [], []
    for p, place in enumerate(places):
        for c, channel in enumerate(channels):
            usable = _usable(place.rows[channel], powers[channel])
            if len(usable) < _LEAST_ROWS:
                raise InputError(
                    f"{place.name}: {len(usable)} LEDs of known power light the tile in {channel}; expected "
                    f"{_LEAST_ROWS} or more. Look at its place in the description, and at shadows"
                )
            design = np.zeros((len(usable), size))
            design[:, p * len(channels) + c] = 1.0
            slopes = np.stack([row.design for row in usable])
            design[:, deltas + OF_PLACE * p : deltas + OF_PLACE * (p + 1)] = slopes[:, :OF_PLACE]
            design[:, deltas + OF_PLACE * len(places)] = slopes[:, -1]
            at = [powers[channel].row[row.led] for row in usable]
            first = size - shared_count + c * len(powers[channel].names)
            design[:, first : first + len(powers[channel].names)] = powers[channel].common[at]
            values = np.array([row.value for row in usable])
            blocks.append(design)
            y.append(np.log(values / powers[channel].power[at]))
            u_noise = np.array([row.u for row in usable]) / values
            u.append(np.sqrt(u_noise**2 + powers[channel].u_own[at] ** 2 + _FLASH**2))
    return _solve(
        places, channels, np.concatenate(blocks), np.concatenate(y), np.concatenate(u), shared_covariance
    )


def _solve(
    places: Sequence[Place],
    channels: tuple[str, ...],
    design: Floats,
    y: Floats,
    u: Floats,
    shared_covariance: Floats,
) -> MeasuredTile:
    deltas = len(places) * len(channels)
    priors = [prior_of(place.tile[channels[0]]) for place in places]
    sigmas = np.maximum([*(s for prior in priors for s in prior[:OF_PLACE]), priors[0][-1]], LEAST_PRIOR)
    end = deltas + len(sigmas)
    # Channels share the first tile's errors, so the covariance has no inverse: its root's figures are independent.
    design = np.hstack([design[:, :end], design[:, end:] @ _root(shared_covariance)])
    weight = np.diag(np.concatenate([np.zeros(deltas), sigmas**-2.0, np.ones(design.shape[1] - end)]))
    weighted_design = design / u[:, None] ** 2
    covariance = np.asarray(np.linalg.inv(design.T @ weighted_design + weight), np.float64)
    solution = covariance @ (weighted_design.T @ y)
    residuals = (y - design @ solution) / u
    certified_values = np.array([[place.tile[channel].reflectance for channel in channels] for place in places])
    u_certified = np.array([[place.tile[channel].u_reflectance for channel in channels] for place in places])
    return MeasuredTile(
        tuple(place.name for place in places),
        channels,
        certified_values * np.exp(solution[:deltas]).reshape(certified_values.shape),
        covariance[:deltas, :deltas],
        certified_values,
        u_certified,
        float(np.sqrt(np.mean(residuals**2))),
    )


def _root(covariance: Floats) -> Floats:
    """Return R [n, r] with R R' = a covariance [n, n]. The covariance is scaled first, because the units of its
    figures differ."""
    u = np.sqrt(np.maximum(np.diag(covariance), LEAST_PRIOR**2))
    values, vectors = np.linalg.eigh(covariance / np.outer(u, u))
    root: Floats = u[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _usable(rows: Sequence[Row], powers: Powers) -> list[Row]:
    """Return rows under LEDs of known power that light the tile."""
    known_rows = [row for row in rows if row.led in powers.row and powers.power[powers.row[row.led]] > 0]
    return [row for row in known_rows if row.value > _DARK * powers.power[powers.row[row.led]]]


def place_of(name: str, frames: LightFrames, setting: Setting, progress: Progress) -> Place:
    """Return the tile in all views of a run that show it completely. Raises InputError if no view does."""
    lit = [frame for frame in frames.lit if frame.led is not None]
    if not lit:
        raise InputError(f"{name}: no frame under an LED")
    channels = channels_of(frames.pattern)
    reader = TileReader(frames, setting, lit[0].read().shape)
    views: dict[tuple[str, float, int], list[LightFrame]] = {}
    for frame in lit:
        if reader.sees(frame.base_from_camera):
            views.setdefault((frame.view, frame.exposure_us, frame.shot.label.repeat), []).append(frame)
    if not views:
        raise InputError(f"{name}: no view shows the whole tile where its description puts it")
    tell = counter(progress, sum(map(len, views.values())))
    tiles = {channel: setting.tile_of(channel) for channel in channels}
    rows: dict[str, list[Row]] = {channel: [] for channel in channels}
    for number, view_frames in enumerate(views.values()):
        for channel, view in reader.view(view_frames, tell).items():
            rows[channel] += rows_of(
                number, view, setting.positions, tiles[channel], Emitter(setting.emission)
            ).rows
    return Place(name, tiles, rows)
