"""Classes of pigments that agree with the few channel values of a camera. Few classes can be distinguished, and
the answer says so.

A camera's channel value is the mean of reflectance, weighted by the channel's sensitivity and the light
(`spectra.channels`). Every reference is tried at many concentrations, with factors of 1/4 to 16 on K/S. Classes
that agree with the channels within their uncertainty cannot be distinguished by the channels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.spectra.channels import channel_values, channel_weights
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.resampling import resample
from coupole.errors import InputError
from coupole.heritage.analysis.identification import Candidate
from coupole.heritage.analysis.references import References
from coupole.heritage.analysis.spectral_features import BANDS_NM, STEP_NM

_FACTORS = np.geomspace(0.25, 16.0, 61)
_COVERED = 0.9
_SPREAD = 0.05
"""Assumed relative spread of channels between batches of one pigment at the same concentration."""
_WITHIN = {1: 3.84, 2: 5.99, 3: 7.81}
"""95th percentile of chi squared by degrees of freedom."""


@dataclass(frozen=True)
class ChannelFinding:
    """Classes that agree with the channels."""

    candidates: tuple[Candidate, ...]
    """Nearest reference of each class, best first; probabilities among the library's classes."""
    not_told_apart: tuple[str, ...]
    """Classes that agree with the channels, best first; none if the library has no such colour."""


def classes_of_channels(
    channels: Array, u_channels: Array, light: Measured, sensitivities: list[Measured], references: References
) -> ChannelFinding:
    """Find the classes. `channels` [c] are diffuse reflectances by channel with relative standard uncertainties
    `u_channels` [c]; `light` is the LEDs' power, `sensitivities` [c] are the sensor's.

    Raises InputError for channels that are not positive, or that are sensitive where the library was not measured.
    """
    if not np.all(np.isfinite(channels) & (channels > 0.0)):
        raise InputError(f"the spot: expected positive reflectances, found {channels}; choose another spot")
    covered_bands = np.isfinite(references.reflectance).mean(axis=0) >= _COVERED
    rows = np.isfinite(references.reflectance[:, covered_bands]).all(axis=1)
    power, *channel_sensitivities = (
        np.nan_to_num(resample(spectrum, BANDS_NM, STEP_NM)[0]) for spectrum in (light, *sensitivities)
    )
    weights = channel_weights(np.maximum(power, 0.0), np.maximum(np.stack(channel_sensitivities), 0.0))
    share = weights[:, covered_bands].sum(axis=1)
    if share.min() < _COVERED:
        raise InputError(
            f"library: expected spectra wherever the channels see light; found {share.min():.0%} of one channel's "
            "light covered; use a library with a wider range"
        )
    weights = weights[:, covered_bands] / share[:, None]
    ratio = kubelka_munk.k_over_s(np.clip(references.reflectance[np.ix_(rows, covered_bands)], 0.004, 0.999))
    tints = channel_values(kubelka_munk.opaque(ratio[:, None] * _FACTORS[:, None]), weights)
    u = np.sqrt(u_channels**2 + _SPREAD**2)
    chi2 = (np.square((np.log(tints) - np.log(channels)) / u)).sum(axis=-1).min(axis=1)
    names = np.array(references.names)[rows]
    classes = np.array(references.class_of)[rows]
    best = {name: int(np.argmin(np.where(classes == name, chi2, np.inf))) for name in np.unique(classes)}
    likely = {name: float(np.exp(-0.5 * (chi2[row] - chi2.min()))) for name, row in best.items()}
    order = sorted(best, key=lambda name: float(chi2[best[name]]))
    total = sum(likely.values())
    limit = _WITHIN[min(3, max(1, len(channels) - 1))]
    return ChannelFinding(
        tuple(Candidate(str(names[best[name]]), str(name), likely[name] / total) for name in order),
        tuple(str(name) for name in order if chi2[best[name]] <= limit),
    )
