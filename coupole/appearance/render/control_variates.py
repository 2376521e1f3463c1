"""Bands that take their noise from one guide: control variates between groups of bands.

All groups of bands have the same paths, so their noise is nearly the same. One group, the guide, is rendered with
all paths that the noise limit needs. Every other band is rendered with fewer of the same paths, and corrected by
what the guide learnt from the rest:

    band = mean of its few paths + slope * (guide's mean of all paths - guide's mean of the few)

With the slope cov(band, guide) / var(guide), the variance that the few paths leave is 1 - (correlation squared) of
theirs (P. Glasserman, Monte Carlo Methods in Financial Engineering, Springer 2003, section 4.1). The slope is
estimated from the batches of paths, with covariance and variance summed over a pixel and its neighbours. It is
estimated from the paths that it corrects, so there is a bias, of second order in the noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

GUIDE_SHARE, RESIDUAL_SHARE = 0.9, 0.43
"""Shares of the noise limit for the guide, and for what the guide does not explain in the other groups. Their
squares add up to one."""
FIRST_PATHS = 2
"""Paths through each pixel in the first batches. Few, because they are the fewest that a group can have."""
_LEAST_BATCHES = 8
"""Number of batches before a noise is known well enough to stop."""
_BATCHES_PER_DOUBLING = 4
_WINDOW_PX = 5
"""Pixels along each side of the window over which covariances are summed."""

Image = NDArray[np.floating[Any]]


def batch_sizes(first: int, most: int) -> Iterator[int]:
    """Yield numbers of paths through a pixel, of one batch after the other: `first` at the beginning, doubled
    again and again, `most` in all. At least two batches."""
    remaining_paths, number = max(most, 2), 0
    while remaining_paths > 0:
        growth = 2 ** (max(0, number - _LEAST_BATCHES + _BATCHES_PER_DOUBLING) // _BATCHES_PER_DOUBLING)
        size = min(remaining_paths - (number == 0), first * growth)
        yield size
        remaining_paths, number = remaining_paths - size, number + 1


@dataclass(frozen=True)
class Follower:
    """A group of bands, corrected by the guide."""

    picture: Image
    """[h, w, 4]."""
    residual_noise: float
    """Noise that the guide does not explain: median over the lit pixels of the relative standard error, of the
    noisiest band."""


@dataclass
class Moments:
    """Sums over batches of paths, of a band [h, w, channels] and of the guide [h, w, 1]."""

    count: int = 0
    """Batches so far."""
    paths: int = 0
    _band: Any = 0.0
    _guide: Any = 0.0
    _squares: Any = 0.0
    _guide_squares: Any = 0.0
    _products: Any = 0.0

    def add(self, size: int, band: Image, guide: Image) -> None:
        """Add a batch of `size` paths through each pixel, with its mean pictures."""
        self.count, self.paths = self.count + 1, self.paths + size
        band, guide = band.astype(float), guide.astype(float)
        self._band, self._guide = self._band + size * band, self._guide + size * guide
        self._squares = self._squares + size * band**2
        self._guide_squares = self._guide_squares + size * guide**2
        self._products = self._products + size * band * guide

    @property
    def mean(self) -> Image:
        return np.asarray(self._band / self.paths)

    @property
    def guide_mean(self) -> Image:
        return np.asarray(self._guide / self.paths)

    def _variances(self) -> tuple[Image, Image, Image]:
        """Variance of one path of the band and of the guide, and their covariance."""
        freedom = max(1, self.count - 1)
        return (
            np.maximum(self._squares - self._band * self.mean, 0.0) / freedom,
            np.maximum(self._guide_squares - self._guide * self.guide_mean, 0.0) / freedom,
            (self._products - self._band * self.guide_mean) / freedom,
        )

    def noise(self) -> float:
        """Median over the lit pixels of the relative standard error of the mean."""
        return self._relative(self._variances()[0], self.mean)

    def correct_by(self, guide_of_all: Image) -> Follower:
        """Return the band, corrected by the guide's mean of all paths [h, w, 1]."""
        variance, guide_variance, covariance = self._variances()
        window = (_WINDOW_PX, _WINDOW_PX, 1)
        around, guide_around = uniform_filter(covariance, window), uniform_filter(guide_variance, window)
        slope = np.divide(around, guide_around, out=np.zeros_like(around), where=guide_around > 0.0)
        picture = np.maximum(self.mean + slope * (guide_of_all - self.guide_mean), 0.0)
        residual = variance - 2.0 * slope * covariance + slope**2 * guide_variance
        return Follower(picture, self._relative(np.maximum(residual, 0.0), picture))

    def _relative(self, variance: Image, mean: Image) -> float:
        """Median over the lit pixels, of the channel where it is highest."""
        error = np.sqrt(variance / self.paths)
        lit = mean > 0.0
        return max(
            (
                float(np.median(error[..., channel][lit[..., channel]] / mean[..., channel][lit[..., channel]]))
                for channel in range(mean.shape[-1])
                if lit[..., channel].any()
            ),
            default=0.0,
        )


@dataclass
class Guide:
    """The group of bands that guides the others. Its batches are in a file, since pictures may be large and
    batches many."""

    path: Path
    """File of the batches; one that is there is replaced."""
    height_px: int
    width_px: int
    sizes: list[int] = field(default_factory=list)
    """Paths of each batch."""
    moments: Moments = field(default_factory=Moments)
    _sums: Any = 0.0

    @property
    def picture(self) -> Image:
        """[h, w, 4] mean of all paths."""
        return np.asarray(self._sums / self.moments.paths)

    def add(self, size: int, picture: Image) -> None:
        """Add a batch with its mean picture [h, w, 4]."""
        guide = picture.mean(axis=2, keepdims=True, dtype=float).astype(np.float32)
        with self.path.open("ab" if self.sizes else "wb") as file:
            file.write(guide.tobytes())
        self._sums = self._sums + size * picture
        self.sizes.append(size)
        self.moments.add(size, guide, guide)

    def batch(self, number: int) -> Image:
        """Mean picture [h, w, 1] of a batch."""
        shape = (self.height_px, self.width_px, 1)
        count = self.height_px * self.width_px
        return np.fromfile(self.path, np.float32, count, offset=4 * number * count).reshape(shape)

    def is_enough(self, noise_limit: float) -> bool:
        """Tell whether the guide has its share of the noise limit, or less."""
        return self.moments.count >= _LEAST_BATCHES and self.moments.noise() <= GUIDE_SHARE * noise_limit

    def correct(self, batches: Iterable[tuple[int, Image]], noise_limit: float) -> Follower:
        """Take batches of another group, with the same paths, until what the guide does not explain is within its
        share of the noise limit; return the group's picture."""
        moments = Moments()
        for number, (size, picture) in enumerate(batches):
            moments.add(size, picture, self.batch(number))
            if moments.count >= _LEAST_BATCHES or moments.count == len(self.sizes):
                follower = moments.correct_by(self.moments.mean)
                if follower.residual_noise <= RESIDUAL_SHARE * noise_limit:
                    break
        return follower
