"""Classes of pigments in an image cube: regions of like spectra first, then the full identification of each
region's mean, then each pixel by itself.

In the map, each pixel has its region's answer. Each pixel has a confidence: the probability that the pixel's own
spectrum gives to this answer. A pixel that is like no region has no answer.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.envi_cube import Cube
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.resampling import resample
from coupole.errors import InputError
from coupole.heritage.analysis.identification import PigmentFinding, identify
from coupole.heritage.analysis.references import OfBands, References
from coupole.heritage.analysis.spectral_features import BANDS_NM, STEP_NM, on_bands
from coupole.heritage.pigment_maps.kept_state import KeptState
from coupole.heritage.pigment_maps.pixel_regions import Regions, find_regions, noise_of_neighbours

Say = Callable[[str, int, int], None]
Mask = NDArray[np.bool_]
NOT_LOOKED_AT, UNLIKE, UNKNOWN, AMBIGUOUS, FIRST_CLASS = 0, 1, 2, 3, 4
"""Codes of the map; classes have codes from `FIRST_CLASS`, the largest first."""
CODE_NAMES = ("not looked at", "like no region", "not in the library", "not decided")
_SAMPLED_ROWS, _SAMPLED_PIXELS = 128, 20_000
_PIXELS_AT_ONCE = 1024
_DRAWS, _SEED = 200, 5
_NAMED_SHARE = 0.25
_SEEN_NM = (620.0, 550.0, 460.0)
_SEEN_GAMMA = 2.2
_REFLECTANCE = (-0.1, 0.01, 2.0)
"""Lower limit of nearly all values, and lower and upper limit of the highest values."""


@dataclass(frozen=True, eq=False)
class ImageRegion:
    """Pixels of like spectra, with the identification of their mean."""

    number: int
    """Number from 1, the largest first."""
    pixels: int
    share: float
    """Share of the pixels that were looked at."""
    mean: Array
    """[bands of the cube] mean reflectance."""
    deviation: Array
    """[bands of the cube] standard deviation of its pixels."""
    finding: PigmentFinding
    draws_alike: float
    """The mean spectrum is drawn many times with its standard error. This is the share of draws with the same
    first class (or, if the finding is unknown, the share that is unknown too)."""
    agreement: float
    """Share of the region's pixels whose own spectra give the region's answer."""
    code: int
    """The region's code in the map."""


@dataclass(frozen=True, eq=False)
class ImageFinding:
    """Maps of an image cube [rows, columns], and what they mean."""

    codes: NDArray[np.uint8]
    region_numbers: NDArray[np.uint8]
    """0 for a pixel that is like no region, or that was not examined."""
    confidence: NDArray[np.float32]
    """Probability, by the pixel's own spectrum, of the map's answer; NaN where there is no answer."""
    picture: NDArray[np.uint8]
    """[rows, columns, 3] three bands as red, green and blue, for the eye."""
    names: tuple[str, ...]
    """Meaning of the codes."""
    regions: tuple[ImageRegion, ...]

    @property
    def looked_at(self) -> int:
        """Number of pixels that were looked at."""
        return int((self.codes != NOT_LOOKED_AT).sum())

    def pixels_of(self, code: int) -> int:
        """Number of pixels with a code."""
        return int((self.codes == code).sum())


def identify_image(
    cube: Cube, references: References, folder: Path, say: Say, *, mask: Mask | None = None, most_regions: int = 40
) -> ImageFinding:
    """Identify the pixels of a cube where `mask` [rows, columns] is True. The state is kept in a folder until the
    job is done, so an interrupted job continues.

    Raises InputError if the values are not reflectances, if no pixel has values in all bands, or if cube and
    library share too few bands; StorageError.
    """
    looks = np.ones((cube.rows, cube.columns), bool) if mask is None else mask
    job = _Job(cube, references, KeptState(folder, _key(cube, references, looks, most_regions)), looks, say)
    regions = job.find_regions(most_regions)
    findings = job.identify_means(regions)
    result = job.classify_pixels(regions, findings)
    job.state.remove()
    return result


def band_matrix(nm: Array) -> tuple[NDArray[np.intp], Array]:
    """Return the numbers of the bands of `BANDS_NM` that wavelengths `nm` [n] cover, and the matrix [n, bands]
    that resamples spectra to them: averages of finer samples, straight lines between coarser ones."""
    covered_bands = np.flatnonzero(np.isfinite(on_bands(Measured("cube", nm, np.ones(len(nm)), ()))))
    unit = np.eye(len(nm))
    if np.median(np.diff(nm)) < STEP_NM - 1e-6:
        rows = [resample(Measured("cube", nm, values, ()), BANDS_NM, STEP_NM)[0][covered_bands] for values in unit]
    else:
        rows = [np.interp(BANDS_NM[covered_bands], nm, values) for values in unit]
    return covered_bands, np.stack(rows)


def _key(cube: Cube, references: References, looks: Mask, most_regions: int) -> str:
    status = cube.data.stat()
    digest = hashlib.sha256(cube.header.read_bytes())
    digest.update(np.ascontiguousarray(references.reflectance).tobytes())
    digest.update(json.dumps([references.names, references.class_of]).encode())
    digest.update(np.packbits(looks).tobytes())
    digest.update(np.ascontiguousarray(cube.wavelengths_nm).tobytes())
    facts = [str(cube.data.resolve()), status.st_size, status.st_mtime_ns, cube.scale, most_regions]
    digest.update(json.dumps(facts).encode())
    return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class _Mean:
    """A region's mean with its finding, and what its pixels are compared with."""

    mean: Array
    deviation: Array
    finding: PigmentFinding
    draws_alike: float
    of_bands: OfBands
    answer_columns: tuple[int, ...]
    """Columns of the probabilities that belong to the region's answer; -1 means none of the classes."""

    @property
    def label(self) -> str:
        """The name of the region's class in the map; empty if it has none."""
        if self.finding.verdict == "mixture":
            return " + ".join(sorted({part.class_name for part in self.finding.parts}))
        return self.finding.class_name if self.finding.verdict == "match" else ""


class _Job:
    def __init__(self, cube: Cube, references: References, state: KeptState, looks: Mask, say: Say) -> None:
        self.state = state
        self._cube, self._references, self._looks, self._say = cube, references, looks, say
        self._covered, self._matrix = band_matrix(cube.wavelengths_nm)
        values = np.full(len(BANDS_NM), np.nan)
        values[self._covered] = 0.5
        references.of_bands("of the cube", values)  # refuses too few common bands before anything is read
        shape = (cube.rows, cube.columns)
        self._numbers = state.map("regions", shape, np.uint8)
        self._confidence = state.map("confidence", shape, np.float32)
        self._agrees = state.map("agrees", shape, np.bool_)
        self._is_valid = state.map("valid", shape, np.bool_)
        self._picture = state.map("seen", (*shape, 3), np.uint8)
        self._seen_bands = [int(np.abs(cube.wavelengths_nm - nm).argmin()) for nm in _SEEN_NM]

    def find_regions(self, most: int) -> Regions:
        """Find the regions in a sample of pixels, unless they were kept."""
        if state := self.state.load("found"):
            return Regions(
                state["mean"], state["noise"], state["basis"], state["centres"], float(state["farthest"])
            )
        rows = np.flatnonzero(self._looks.any(axis=1))
        if not len(rows):
            raise InputError("expected pixels to look at, found none: mask and --area leave out all")
        rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _SAMPLED_ROWS)).astype(int))]
        left_pixels, right, sample = [], [], []
        for count, row in enumerate(rows):
            self._say("sample", count, len(rows))
            spectra = self._cube.read_rows(int(row), int(row) + 1)[0]
            is_valid = _valid(spectra) & self._looks[row]
            sample.append(spectra[is_valid])
            pairs = np.flatnonzero(is_valid[:-1] & is_valid[1:])
            pairs = pairs[:: max(1, len(pairs) * len(rows) // _SAMPLED_PIXELS)]
            left_pixels.append(spectra[pairs] @ self._matrix)
            right.append(spectra[pairs + 1] @ self._matrix)
            step = max(1, len(sample[-1]) * len(rows) // _SAMPLED_PIXELS)
            sample[-1] = sample[-1][row % step :: step]
        self._say("sample", len(rows), len(rows))
        pixels = np.concatenate(sample).astype(np.float64)
        if not len(pixels):
            raise InputError(
                f"{self._cube.data}: expected pixels with a number in every band, found none in {len(rows)} rows; "
                "name bands without data in the header's bbl"
            )
        self._refuse_other_quantities(pixels)
        pairs_left, pairs_right = np.concatenate(left_pixels), np.concatenate(right)
        if not len(pairs_left):
            raise InputError("expected neighbouring pixels, from which the noise is estimated; found none")
        result = find_regions(pixels @ self._matrix, noise_of_neighbours(pairs_left, pairs_right), most)
        self.state.save(
            "found", mean=result.mean, noise=result.noise, basis=result.basis, centres=result.centres,
            farthest=result.farthest,
        )  # fmt: skip
        return result

    def _refuse_other_quantities(self, pixels: Array) -> None:
        least, dark, most = _REFLECTANCE
        low, high = float(np.quantile(pixels, 0.01)), float(np.quantile(pixels, 0.999))
        if low < least or not dark <= high <= most:
            raise InputError(
                f"{self._cube.data}: expected reflectances as fractions after division by {self._cube.scale:g}; "
                f"found {low:.3g} to {high:.3g}. Give --scale (100 for percent); radiances and raw counts must be "
                "divided by a white first"
            )

    def identify_means(self, regions: Regions) -> list[_Mean]:
        """Give each pixel its region, and identify the regions' means."""
        count, bands = len(regions.centres), len(self._cube.wavelengths_nm)
        state = self.state.load("means") or {
            "row": np.array(0),
            "pixels": np.zeros(count),
            "sums": np.zeros((count, bands)),
            "squares": np.zeros((count, bands)),
        }
        pixels, sums, squares = state["pixels"], state["sums"], state["squares"]
        for first, end in self._cube.blocks():
            self._say("regions", first, self._cube.rows)
            if end <= int(state["row"]):
                continue
            if self._looks[first:end].any():
                spectra = self._cube.read_rows(first, end)
                is_valid = _valid(spectra) & self._looks[first:end]
                inside = spectra[is_valid].astype(np.float64)
                nearest, is_like, _ = regions.places(inside @ self._matrix)
                numbers = np.where(is_like, nearest + 1, 0)
                for number in np.unique(numbers[numbers > 0]):
                    is_mine = inside[numbers == number]
                    pixels[number - 1] += len(is_mine)
                    sums[number - 1] += is_mine.sum(axis=0)
                    squares[number - 1] += (is_mine**2).sum(axis=0)
                self._numbers[first:end][is_valid] = numbers
                self._is_valid[first:end] = is_valid
                picture = np.clip(np.nan_to_num(spectra[:, :, self._seen_bands]), 0.0, 1.0) ** (1.0 / _SEEN_GAMMA)
                self._picture[first:end] = np.rint(255 * picture)
                _flush(self._numbers, self._is_valid, self._picture)
            self.state.save("means", row=end, pixels=pixels, sums=sums, squares=squares)
        self._say("regions", self._cube.rows, self._cube.rows)
        means = []
        for number in range(count):
            self._say("identify", number, count)
            means.append(self._mean(number, pixels[number], sums[number], squares[number]))
        self._say("identify", count, count)
        return means

    def _mean(self, number: int, pixels: float, sums: Array, squares: Array) -> _Mean:
        mean = sums / max(pixels, 1.0) if pixels else np.full(len(sums), 0.5)
        deviation = np.sqrt(np.maximum(squares / max(pixels, 1.0) - mean**2, 0.0))
        spectrum = Measured(f"region {number + 1}", self._cube.wavelengths_nm, mean, ())
        finding = identify(spectrum, self._references)
        values, _ = self._references.without_stray_light(on_bands(spectrum))
        of_bands = self._references.of_bands(spectrum.name, values)
        model, places = of_bands.model, np.searchsorted(self._covered, of_bands.bands)
        error = np.sqrt((deviation**2 / max(pixels, 1.0)) @ self._matrix[:, places] ** 2)
        draws = values[of_bands.bands] + error * np.random.default_rng(_SEED).standard_normal(
            (_DRAWS, len(places))
        )
        draw_probabilities = model.probabilities(draws)
        best = model.class_names.index(finding.candidates[0].class_name)
        is_known = model.is_known(np.array([[*np.zeros(len(model.class_names)), finding.not_in_library]]))[0]
        answer_columns: tuple[int, ...]
        if finding.verdict == "unknown":
            answer_columns = (best, -1) if is_known else (-1,)
            alike = model.is_known(draw_probabilities) == is_known
        else:
            names = {part.class_name for part in finding.parts} or named_classes(finding)
            answer_columns = tuple(model.class_names.index(name) for name in names)
            alike = draw_probabilities[:, :-1].argmax(axis=1) == best
        return _Mean(mean, deviation, finding, float(alike.mean()), of_bands, answer_columns)

    def classify_pixels(self, regions: Regions, means: Sequence[_Mean]) -> ImageFinding:
        """Compare each pixel with its region's answer, and put the maps together."""
        state = self.state.load("pixels")
        done_rows = int(state["row"]) if state else 0
        for first, end in self._cube.blocks():
            self._say("pixels", first, self._cube.rows)
            if end <= done_rows:
                continue
            numbers = self._numbers[first:end]
            if (numbers > 0).any():
                spectra = self._cube.read_rows(first, end)
                for number in np.unique(numbers[numbers > 0]):
                    is_mine = numbers == number
                    clean = regions.places(spectra[is_mine].astype(np.float64) @ self._matrix)[2]
                    self._compare(first, end, is_mine, clean, means[number - 1])
                _flush(self._confidence, self._agrees)
            self.state.save("pixels", row=end)
        self._say("pixels", self._cube.rows, self._cube.rows)
        return self._result(means)

    def _compare(self, first: int, end: int, is_mine: Mask, clean: Array, mean: _Mean) -> None:
        model = mean.of_bands.model
        values = clean[:, np.searchsorted(self._covered, mean.of_bands.bands)]
        confidence, agrees = np.empty(len(values), np.float32), np.empty(len(values), bool)
        for start in range(0, len(values), _PIXELS_AT_ONCE):
            part = slice(start, start + _PIXELS_AT_ONCE)
            probabilities = model.quick_probabilities(values[part])
            confidence[part] = probabilities[:, list(mean.answer_columns)].sum(axis=1)
            agrees[part] = np.isin(probabilities[:, :-1].argmax(axis=1), mean.answer_columns)
            if -1 in mean.answer_columns:
                agrees[part] |= ~model.is_known(probabilities)
        self._confidence[first:end][is_mine] = confidence
        self._agrees[first:end][is_mine] = agrees

    def _result(self, means: Sequence[_Mean]) -> ImageFinding:
        old = np.asarray(self._numbers)
        pixels = np.bincount(old.ravel(), minlength=len(means) + 1)[1:]
        total = max(int(self._is_valid.sum()), 1)
        areas: dict[str, int] = {}
        for mean, count in zip(means, pixels, strict=True):
            areas[mean.label] = areas.get(mean.label, 0) + int(count)
        names = sorted((name for name in areas if name and areas[name]), key=lambda name: (-areas[name], name))
        lookup = np.zeros(len(means) + 1, np.uint8)
        new_numbers = np.zeros(len(means) + 1, np.uint8)
        result = []
        order = [number for number in np.argsort(-pixels, kind="stable") if pixels[number]]
        for place, number in enumerate(order, start=1):
            mean = means[number]
            code = AMBIGUOUS if mean.finding.verdict == "ambiguous" else UNKNOWN
            code = FIRST_CLASS + names.index(mean.label) if mean.label else code
            lookup[number + 1], new_numbers[number + 1] = code, place
            agreement = float(self._agrees[old == number + 1].mean())
            count = int(pixels[number])
            result.append(
                ImageRegion(place, count, count / total, mean.mean, mean.deviation,
                            _with_number(mean.finding, place), mean.draws_alike, agreement, code)
            )  # fmt: skip
        codes = lookup[old]
        codes[(old == 0) & self._is_valid] = UNLIKE
        confidence = np.where(old > 0, self._confidence, np.float32(np.nan))
        return ImageFinding(
            codes, new_numbers[old], confidence, np.array(self._picture), (*CODE_NAMES, *names), tuple(result)
        )


def _valid(spectra: NDArray[np.float32]) -> Mask:
    """Tell which pixels [..., bands] have a number in every band, and are not all zero."""
    is_valid: Mask = np.isfinite(spectra).all(axis=-1) & (spectra != 0.0).any(axis=-1)
    return is_valid


def named_classes(finding: PigmentFinding) -> set[str]:
    """Return the class of a match, or the classes between which an ambiguous verdict does not decide."""
    if finding.verdict == "match":
        return {finding.class_name}
    best = finding.candidates[0].probability
    return {
        candidate.class_name for candidate in finding.candidates if candidate.probability >= _NAMED_SHARE * best
    }


def _with_number(finding: PigmentFinding, place: int) -> PigmentFinding:
    return replace(finding, name=f"region {place}")


def _flush(*maps: NDArray[np.generic]) -> None:
    for pixel_map in maps:
        if isinstance(pixel_map, np.memmap):
            pixel_map.flush()
