"""Intervals of relit pictures, calibrated by lights that are left out.

The lights are divided into three folds. Each light's picture is predicted from all other lights, with a correction
that was learnt without its fold, and compared with the measured picture. The scale of the error is predicted
log-linearly from quantities known beforehand (`foreseen`; locally weighted conformal prediction: Lei et al. 2018).
Quantiles of error over scale are fitted by strata (`strata`). Last, intervals are fitted without each fold in
turn, and all intervals are widened until they contain the stated share of the left-out folds (cross-conformal
prediction: Vovk 2015).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance import learned_correction as correction
from coupole.reflectance.foreseen import Foreseen, StripMaterials, foresee
from coupole.reflectance.learned_correction import MARGIN_PX, Network, Strip
from coupole.reflectance.light_gains import SUSPECT
from coupole.reflectance.light_interpolation import nearest
from coupole.reflectance.picture_result import INTERVALS, MATERIALS, PictureResult, open_result_file
from coupole.reflectance.relighting import Beams, Interpolation, strip_between, strips
from coupole.reflectance.strata import StratumFactors, fit_strata
from coupole.storage.hdf5_file import hdf5_file

Floats = NDArray[np.float64]
Say = Callable[[int, int], None]

LEVELS = {"95": 0.95, "68": 0.6827}
"""Shares of the pixels that intervals contain, by their names in the file."""
FEWEST_LIGHTS = 12
"""Least number of lights from which intervals can be calibrated."""
FOLDS = 3
_STRIP_ROWS, _STRIP_PIXELS = 16, 20_000
"""Rows of the strips, drawn at random, and number of their pixels, from which intervals are calibrated."""
_LESSON_SAMPLES = 400_000
_SAMPLES = 400_000
"""Largest number of residuals that are kept."""
_LEAST_SIZE = 5e-5
"""Share of the peak that is added to errors before their logarithm is taken."""
_FARTHEST = 2.0
"""Largest distance of a new light from the measured lights, as a multiple of their spacing. Beyond this distance
the error is not known."""


@dataclass(frozen=True)
class RelitIntervals:
    """Data from which the half widths of intervals are predicted."""

    coefficients: Floats
    """[columns of `Foreseen.regressors`] coefficients for the logarithm of the error's scale."""
    factors: dict[str, StratumFactors]
    """Quantiles of the errors, by the names in `LEVELS`."""
    spacing: float
    """Largest distance, between unit vectors, from a measured light to its nearest one."""

    def half_widths(self, foreseen: Foreseen, level: str, peak: float) -> NDArray[np.float32]:
        """[n, 3] half widths of the interval `level` of `LEVELS`; NaN for pixels without material."""
        scale = np.exp(foreseen.regressors(peak) @ self.coefficients)
        widths = scale * self.factors[level].quantiles(foreseen.labels(peak))
        return widths.reshape(foreseen.values.shape).astype(np.float32)

    def widening(self, distance: float) -> float:
        """Return the factor for a light at a distance from its nearest measured light. It is 1 up to the spacing,
        in proportion to the distance beyond the spacing, and NaN beyond twice the spacing."""
        return float("nan") if distance > _FARTHEST * self.spacing else max(1.0, distance / self.spacing)

    def write(self, path: Path) -> None:
        """Write the file of a result."""
        with hdf5_file(path, "w") as file:
            file.attrs["spacing"] = self.spacing
            file["coefficients"] = self.coefficients
            for level, factors in self.factors.items():
                file.create_group(level).attrs["log_quantile"] = factors.log_quantile
                for name, logs in factors.log_factors.items():
                    file[f"{level}/{name}"] = logs


def read_intervals(folder: Path) -> RelitIntervals:
    """Read the intervals of a result. Raises InputError if the result has none."""
    with open_result_file(folder / INTERVALS) as file:
        factors = {
            level: StratumFactors(
                float(file[level].attrs["log_quantile"]),
                {name: np.asarray(logs) for name, logs in file[level].items()},
            )
            for level in LEVELS
        }
        return RelitIntervals(np.asarray(file["coefficients"]), factors, float(file.attrs["spacing"]))


def refuse_uncalibrated(result: PictureResult) -> None:
    """Raise InputError if a result has no intervals."""
    if not (result.folder / INTERVALS).exists():
        raise InputError(
            f"{result.folder}: has no intervals: they need {FEWEST_LIGHTS} lights, and a result of this "
            "version; repeat the command that made the result"
        )


def half_width_picture(
    result: PictureResult, interpolation: Interpolation, beams: Beams, level: str, *, say: Say
) -> NDArray[np.float32]:
    """[h, w, 3] half widths of the interval `level` of `LEVELS` of a relit picture; NaN outside the mask, and
    where nothing is known. Half widths of several beams are added, which gives an upper bound of their sum."""
    intervals = read_intervals(result.folder)
    materials = read_strip_materials(result)
    directions = result.directions[interpolation.lights]
    picture = np.where(result.mask[..., None], np.zeros(3, np.float32), np.float32(np.nan))
    for number, (way, rgb) in enumerate(beams):
        unit = way / np.linalg.norm(way)
        distance = float(np.linalg.norm(directions[nearest(directions, unit, 1)[0]] - unit))
        factor = np.float32(intervals.widening(distance)) * np.abs(rgb).astype(np.float32)
        for top, bottom in strips(result.mask):
            above, below = max(0, top - MARGIN_PX), min(len(result.mask), bottom + MARGIN_PX)
            strip = strip_between(result, interpolation, above, below)
            of_strip = materials.at(_pixels(result, above, below))
            widths = intervals.half_widths(
                foresee(strip, of_strip, interpolation, directions, unit), level, interpolation.peak
            )
            part = np.full((below - above, *picture.shape[1:]), np.nan, np.float32)
            part[strip.mask] = factor * widths
            picture[top:bottom] += part[top - above : bottom - above]
        say(number + 1, len(beams))
    return picture


def read_strip_materials(result: PictureResult) -> StripMaterials:
    """Read the materials of all pixels of the mask."""
    with open_result_file(result.folder / MATERIALS) as file:
        names = ("normal", "kd", "ks", "alpha", "residual")
        return StripMaterials(*(np.asarray(file[name], dtype=np.float64) for name in names))


def _pixels(result: PictureResult, top: int, bottom: int) -> slice:
    """Return the places, among the pixels of the mask, of the pixels in some rows."""
    before = int(np.count_nonzero(result.mask[:top]))
    return slice(before, before + int(np.count_nonzero(result.mask[top:bottom])))


@dataclass(frozen=True)
class Residuals:
    """Errors of left-out lights at n pixels and channels, with the quantities that were known beforehand."""

    sizes: Floats
    """[n] absolute errors."""
    lights: NDArray[np.int64]
    regressors: Floats
    """[n, columns]"""
    labels: dict[str, NDArray[np.int64]]

    def at(self, samples: NDArray[np.bool_]) -> Residuals:
        """Return some of the residuals."""
        labels = {name: stratum[samples] for name, stratum in self.labels.items()}
        return Residuals(self.sizes[samples], self.lights[samples], self.regressors[samples], labels)


def calibrate(
    result: PictureResult, interpolation: Interpolation, *, say: Say = lambda count, of: None
) -> RelitIntervals:
    """Calibrate the intervals of a result by its own lights; each light is left out in turn. Needs `FEWEST_LIGHTS`
    lights."""
    fold = np.random.default_rng(0).permutation(len(interpolation.lights)) % FOLDS
    residuals = _left_out_residuals(result, interpolation, fold, say)
    coefficients = _fit_scale(residuals, interpolation.peak)
    factors = {}
    for name, level in LEVELS.items():
        level_factors = _fit_level(residuals, coefficients, level)
        log_quantile = level_factors.log_quantile + np.log(
            _needed_widening(residuals, fold, interpolation.peak, level)
        )
        factors[name] = dataclasses.replace(level_factors, log_quantile=float(log_quantile))
    directions = result.directions[interpolation.lights]
    distances = [directions[nearest(directions, way, 2)[1]] - way for way in directions]
    return RelitIntervals(coefficients, factors, float(np.linalg.norm(distances, axis=1).max()))


def _fit_scale(residuals: Residuals, peak: float) -> Floats:
    logs = np.log(residuals.sizes + _LEAST_SIZE * peak)
    return np.asarray(np.linalg.lstsq(residuals.regressors, logs, rcond=None)[0])


def _fit_level(residuals: Residuals, coefficients: Floats, level: float) -> StratumFactors:
    ratios = residuals.sizes / np.exp(residuals.regressors @ coefficients)
    return fit_strata(ratios, residuals.labels, residuals.lights, level)


def _needed_widening(residuals: Residuals, fold: NDArray[np.int64], peak: float, level: float) -> float:
    """Return the factor by which intervals that were fitted without a fold must be widened to be valid in this
    fold."""
    ratios = np.empty(len(residuals.sizes))
    for number in range(FOLDS):
        in_fold = fold[residuals.lights] == number
        other_residuals, inside = residuals.at(~in_fold), residuals.at(in_fold)
        coefficients = _fit_scale(other_residuals, peak)
        quantiles = _fit_level(other_residuals, coefficients, level).quantiles(inside.labels)
        ratios[in_fold] = inside.sizes / (quantiles * np.exp(inside.regressors @ coefficients))
    return float(np.quantile(ratios, level))


Rows = tuple[Strip, StripMaterials]


def _left_out_residuals(
    result: PictureResult, interpolation: Interpolation, fold: NDArray[np.int64], say: Say
) -> Residuals:
    """Predict each light from the others, in some strips, and yield the residuals."""
    rows = list(_calibration_rows(result, interpolation))
    directions = result.directions[interpolation.lights]
    networks = _fold_networks([strip for strip, _ in rows], interpolation, directions, fold)
    generator = np.random.default_rng(0)
    share = _SAMPLES / (len(fold) * sum(strip.values[0].size for strip, _ in rows))
    parts = []
    for light in range(len(fold)):
        say(light, len(fold))
        without = _without(interpolation, light, networks[fold[light]])
        for strip, materials in rows:
            foreseen = _foreseen_without(strip, materials, without, directions, light)
            measured_values = interpolation.gains[light] * strip.values[light]
            part = _residuals_of(foreseen, measured_values, light, interpolation.peak)
            is_drawn = generator.random(len(part.sizes)) < share
            parts.append(part.at(is_drawn & np.isfinite(part.regressors).all(axis=1)))
    return _join(parts)


def _foreseen_without(
    strip: Strip, materials: StripMaterials, without: Interpolation, directions: Floats, light: int
) -> Foreseen:
    """Predict one light of the strip, whose lights have `directions` [lights, 3], from the other lights alone."""
    other_strip = Strip(strip.mask, np.delete(strip.values, light, axis=0), strip.level)
    return foresee(other_strip, materials, without, np.delete(directions, light, axis=0), directions[light])


def _without(interpolation: Interpolation, light: int, network: Network | None) -> Interpolation:
    """Return the interpolation from all other lights, with the correction `network`."""
    other_lights = np.delete(np.arange(len(interpolation.lights)), light)
    gains = interpolation.gains[other_lights]
    return dataclasses.replace(
        interpolation, lights=interpolation.lights[other_lights], gains=gains, network=network
    )


def _residuals_of(foreseen: Foreseen, measured_values: NDArray[np.floating], light: int, peak: float) -> Residuals:
    """Return the residuals of a prediction against the values [n, 3] under its light."""
    return Residuals(
        np.abs(measured_values - foreseen.values).ravel().astype(np.float64),
        np.full(foreseen.values.size, light),
        foreseen.regressors(peak),
        foreseen.labels(peak),
    )


def _join(parts: Sequence[Residuals]) -> Residuals:
    labels = {name: np.concatenate([part.labels[name] for part in parts]) for name in parts[0].labels}
    return Residuals(
        np.concatenate([part.sizes for part in parts]),
        np.concatenate([part.lights for part in parts]),
        np.concatenate([part.regressors for part in parts]),
        labels,
    )


def _calibration_rows(result: PictureResult, interpolation: Interpolation) -> Iterator[Rows]:
    """Yield strips, drawn at random, until they have enough pixels."""
    materials = read_strip_materials(result)
    tops = np.arange(0, len(result.mask), _STRIP_ROWS)
    pixels = 0
    for top in np.random.default_rng(0).permutation(tops):
        bottom = int(min(top + _STRIP_ROWS, len(result.mask)))
        of_rows = _pixels(result, int(top), bottom)
        if of_rows.stop > of_rows.start and pixels < _STRIP_PIXELS:
            pixels += of_rows.stop - of_rows.start
            yield strip_between(result, interpolation, int(top), bottom), materials.at(of_rows)


def _fold_networks(
    calibration_strips: Sequence[Strip], interpolation: Interpolation, directions: Floats, fold: NDArray[np.int64]
) -> list[Network | None]:
    """Learn the correction once for each fold without its lights; None if the interpolation has no correction."""
    if interpolation.network is None:
        return [None] * FOLDS
    sound = np.flatnonzero(np.abs(interpolation.gains - 1.0) <= SUSPECT)
    kernels = correction.all_kernels(interpolation.kernel)
    values = len(sound) * sum(strip.values[0].size for strip in calibration_strips)
    generator = np.random.default_rng(0)
    by_light: dict[int, list[correction.Lesson]] = {int(light): [] for light in sound}
    for strip in calibration_strips:
        lessons = correction.lessons(
            strip, directions, sound.tolist(), kernels, share=_LESSON_SAMPLES / values, generator=generator
        )
        for light, lesson in zip(sound, lessons, strict=True):
            by_light[int(light)].append(lesson)
    lessons_of_lights = {light: correction.join_lessons(parts) for light, parts in by_light.items()}
    return [
        correction.train([lesson for light, lesson in lessons_of_lights.items() if fold[light] != number])
        for number in range(FOLDS)
    ]
