"""Merges photographs of one scene: each pixel is a mean, weighted by the variance expected for its exposure."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.bracket.camera_response import DARK, NODES, SATURATED, Response, hat
from coupole.exchange.bracket.photographs import Photographs

_CONTRADICTS = 5.0
"""Standard deviations from the median of the photographs at which a value contradicts them."""
_LEAST_CONTRADICTION = 0.05
"""Least relative difference that counts as a contradiction."""
_LEAST_WEIGHT = 0.1
"""Hat weight of values below which noise is no longer Gaussian; such values are not tested for contradiction."""
_ROUNDS = 2
_MARGIN = 4.0
"""Distance from both ends of the range, in standard deviations of the noise, within which a value is not used,
because noise is cut off there."""


@dataclass(frozen=True)
class Merged:
    """Relative radiance. Its unit is the radiance that gives half of the largest value in one second."""

    radiance: NDArray[np.float32]
    """[h, w, 3]."""
    uncertainty: NDArray[np.float32]
    """[h, w, 3] relative standard uncertainty from noise and response."""
    saturation_mask: NDArray[np.bool_]
    """[h, w, 3] True if saturated in all photographs: the radiance is then a lower bound."""
    dark: NDArray[np.bool_]
    """[h, w, 3] True if dark in all photographs: the value is hardly more than noise."""
    contradicting: NDArray[np.bool_]
    """[photographs, h, w] True where a photograph was left out because it contradicts the others: something
    moved."""


def merge_exposures(photographs: Photographs, response: Response) -> Merged:
    shape = photographs.values.shape[1:]
    radiance, uncertain = np.empty(shape, np.float32), np.empty(shape, np.float32)
    is_saturated, dark = np.empty(shape, bool), np.empty(shape, bool)
    contradicting = np.zeros(photographs.values.shape[:3], bool)
    for channel in range(3):
        values = photographs.values[..., channel]
        margin = _MARGIN * float(response.noise[channel])
        usable = (values > max(DARK, margin)) & (values < min(SATURATED, 1.0 - margin))
        radiances = response.exposure(values, channel) / photographs.exposure_s[:, None, None]
        off = _contradicting(radiances, values, usable, response, channel)
        contradicting |= off
        mean, sigma = _mean(radiances, usable & ~off, photographs, response, channel)
        is_saturated[..., channel] = ~usable.any(axis=0) & (values[0] >= 0.5)
        dark[..., channel] = ~usable.any(axis=0) & ~is_saturated[..., channel]
        bound = np.where(is_saturated[..., channel], radiances[0], radiances[-1])
        is_usable = usable.any(axis=0)
        radiance[..., channel] = np.where(is_usable, mean, bound)
        uncertain[..., channel] = np.where(is_usable, sigma, np.inf)
    return Merged(radiance, uncertain, is_saturated, dark, contradicting)


def _mean(
    radiances: NDArray[np.float64],
    usable: NDArray[np.bool_],
    photographs: Photographs,
    response: Response,
    channel: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weighted mean and its relative uncertainty. The weights follow from the mean, because the noise of a pixel's
    own values would favour the darker one."""
    noise = float(response.noise[channel])
    mean = np.where(usable, radiances, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
    for _ in range(_ROUNDS):
        models = [response.value(mean * time, channel) for time in photographs.exposure_s]
        sigmas = [response.slope(model, channel) * noise for model in models]  # relative
        weights = [
            np.where(is_usable, 1.0 / (sigma * np.maximum(mean, 1e-30)) ** 2, 0.0)
            for sigma, is_usable in zip(sigmas, usable, strict=True)
        ]
        total = np.maximum(sum(weights), 1e-300)
        shares = [weight / total for weight in weights]
        mean = sum((share * radiance for share, radiance in zip(shares, radiances, strict=True)), np.zeros(1))
    relative = 1.0 / np.maximum(np.sqrt(total) * mean, 1e-30)
    return mean, np.sqrt(relative**2 + _response_variance(shares, models, response.covariance[channel]))


def _response_variance(
    shares: list[NDArray[np.float64]], values: list[NDArray[np.float64]], covariance: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Relative variance of a mean that the response contributes, for photographs with these weights and values; by
    the nearest node."""
    nodes = [np.rint(value * (NODES - 1)).astype(np.int32) for value in values]
    variance = np.zeros_like(values[0])
    for first, (share, node) in enumerate(zip(shares, nodes, strict=True)):
        variance += share**2 * covariance[node, node]
        for second in range(first):
            variance += 2.0 * share * shares[second] * covariance[node, nodes[second]]
    return np.maximum(variance, 0.0)


def _contradicting(
    radiances: NDArray[np.float64],
    values: NDArray[np.float32],
    usable: NDArray[np.bool_],
    response: Response,
    channel: int,
) -> NDArray[np.bool_]:
    """[photographs, h, w] True for values more than `_CONTRADICTS` deviations from the median of the best-exposed
    ones."""
    logs = np.where(usable, np.log(np.maximum(radiances, 1e-300)), np.nan)
    lonely = usable.sum(axis=0) < 2
    weights = np.where(usable, hat(values.astype(float)), 0.0)
    best = np.take_along_axis(logs, np.argmax(weights, axis=0)[None], axis=0)[0]
    with np.errstate(invalid="ignore"):
        middle = np.where(usable.sum(axis=0) > 2, _median(logs), best)
        sigma = response.slope(values, channel) * float(response.noise[channel])
        off = np.abs(logs - middle) > np.maximum(_CONTRADICTS * np.sqrt(2.0) * sigma, _LEAST_CONTRADICTION)
    off &= (weights > _LEAST_WEIGHT) & ~lonely
    nobody = (off | ~usable).all(axis=0)
    off &= ~(nobody & (weights == weights.max(axis=0)))
    return np.asarray(off)


def _median(logs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median over photographs, without NaN."""
    ascending = np.sort(logs, axis=0)  # NaN last
    last = np.maximum(np.isfinite(logs).sum(axis=0) - 1, 0)
    low, high = (np.take_along_axis(ascending, index[None], axis=0)[0] for index in (last // 2, (last + 1) // 2))
    return np.asarray(0.5 * (low + high))
