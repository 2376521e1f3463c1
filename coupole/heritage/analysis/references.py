"""A library with its classes, prepared for comparison, and its error rates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.spectra_library import LibrarySpectrum
from coupole.errors import InputError, Problem
from coupole.heritage.analysis.class_model import ClassModel
from coupole.heritage.analysis.pigment_classes import PigmentClass, lacking
from coupole.heritage.analysis.spectral_features import BANDS_NM, log_k_over_s, on_bands

LEAST_BANDS = 16
_LEAST_CLASSES, _LEAST_SPECTRA = 2, 4
_COVERED = 0.9
"""Share of the references that must have been measured in a band for the band to be used."""
_SAME = 1e-4
_WIDEST_GAP_NM = 20.0
_VIOLET_NM = 460.0
_RISE_BEYOND, _RISE_BY = 0.1, 0.005
"""Limits of the change of a spectrum over 20 nm. The first limit is for a log(K/S) that falls more than the
references' log(K/S). Unlike the rise of the reflectance, this fall does not depend on the concentration. The
second is for reflectance.
"""


@dataclass(frozen=True)
class Rate:
    """`count` out of `of`, with its interval of 95 % (Clopper and Pearson, Biometrika 26, 404, 1934)."""

    count: int
    of: int

    @property
    def interval(self) -> tuple[float, float]:
        """Lowest and highest rate."""
        from scipy.stats import beta

        low = float(beta.ppf(0.025, self.count, self.of - self.count + 1)) if self.count else 0.0
        high = float(beta.ppf(0.975, self.count + 1, self.of - self.count)) if self.count < self.of else 1.0
        return low, high

    def __str__(self) -> str:
        if not self.of:
            return "0 of 0"
        low, high = self.interval
        return f"{self.count} of {self.of} ({100 * low:.0f} to {100 * high:.0f} %)"


@dataclass(frozen=True)
class HeldOutRates:
    """Rates of verdicts on the library's own spectra, each identified as if it were not in the library."""

    right: Rate
    """Rate at which the first candidate has the right class, among spectra with others of their class in the
    library."""
    matches: Rate
    """Rate of the verdict `match` with the right class, among the same spectra."""
    false_matches: Rate
    """Rate of the verdict `match` with a wrong class, among the same spectra."""
    unknown: Rate
    """Rate of the verdict `unknown` after the whole class is left out, among all spectra."""


@dataclass
class OfBands:
    """The references that were measured in certain bands."""

    bands: NDArray[np.intp]
    rows: NDArray[np.intp]
    """[n] numbers of the references."""
    reflectance: Array
    """[n, bands]"""
    classes: NDArray[np.intp]
    """[n] numbers of classes."""
    model: ClassModel

    @cached_property
    def rates(self) -> HeldOutRates:
        """Error rates, found by leaving out each spectrum and each class. Mixtures are not searched."""
        model, classes = self.model, self.classes
        several = np.bincount(classes)[classes] > 1
        probabilities, none = model.held_out.probabilities, model.held_out.without_class
        right = probabilities[:, :-1].argmax(axis=1) == classes
        names = model.class_names
        match = model.is_known(probabilities) & model.is_sure(probabilities)
        match &= [not lacking(names[best], names) for best in probabilities[:, :-1].argmax(axis=1)]
        is_known = model.is_known(none)
        for row, number in enumerate(classes):
            other_names = [name for name in names if name != names[number]]
            is_known[row] &= not lacking(names[none[row, :-1].argmax()], other_names)
        of = int(several.sum())
        return HeldOutRates(
            Rate(int((right & several).sum()), of),
            Rate(int((match & right & several).sum()), of),
            Rate(int((match & ~right & several).sum()), of),
            Rate(int((~is_known).sum()), len(classes)),
        )

    @cached_property
    def reference_spread(self) -> Array:
        """[bands] rms difference of log(K/S), minus its mean, between the most similar references of a class."""
        log_ratio = log_k_over_s(self.reflectance)
        shape = log_ratio - log_ratio.mean(axis=1, keepdims=True)
        differences = []
        for row, number in enumerate(self.classes):
            other_rows = np.flatnonzero((self.classes == number) & (np.arange(len(self.classes)) != row))
            if len(other_rows):
                apart = shape[other_rows] - shape[row]
                differences.append(apart[np.argmin((apart**2).sum(axis=1))])
        if not differences:
            return np.full(self.reflectance.shape[1], 0.1)
        band_spread: Array = np.sqrt(np.mean(np.square(differences), axis=0)) + 0.01
        return band_spread


@dataclass
class References:
    """Spectra of known class."""

    names: tuple[str, ...]
    class_of: tuple[str, ...]
    """[n] class of each spectrum."""
    reflectance: Array
    """[n, 221] reflectance at `BANDS_NM`; NaN where it was not measured."""
    remarks: tuple[str, ...]
    """Remarks on spectra that were left out, with the reasons."""
    _of_bands_cache: dict[bytes, OfBands] = field(default_factory=dict)

    def of_bands(self, spectrum_name: str, reflectance: Array) -> OfBands:
        """Return the references in the bands in which a spectrum [221] and nine of ten references were measured.

        Raises InputError if the bands are fewer than 16.
        """
        is_known = np.isfinite(self.reflectance)
        shared_bands = np.isfinite(reflectance) & (is_known.mean(axis=0) >= _COVERED)
        if shared_bands.sum() < LEAST_BANDS:
            spectrum_nm = BANDS_NM[np.isfinite(reflectance)]
            library_nm = BANDS_NM[is_known.mean(axis=0) >= _COVERED]
            raise InputError(
                f"spectrum {spectrum_name}: expected {LEAST_BANDS} or more bands of 10 nm in common with the "
                f"library, found {shared_bands.sum()}; it covers {_range(spectrum_nm)}, the library "
                f"{_range(library_nm)}"
            )
        key = shared_bands.tobytes()
        if key not in self._of_bands_cache:
            bands, rows = np.flatnonzero(shared_bands), np.flatnonzero(is_known[:, shared_bands].all(axis=1))
            names = tuple(sorted({self.class_of[row] for row in rows}))
            if len(names) < _LEAST_CLASSES:
                raise InputError(
                    f"spectrum {spectrum_name}: expected references of {_LEAST_CLASSES} or more classes in its "
                    f"bands, found {len(names)}; most spectra of the library cover other wavelengths"
                )
            classes = np.array([names.index(self.class_of[row]) for row in rows])
            values = self.reflectance[np.ix_(rows, bands)]
            self._of_bands_cache[key] = OfBands(
                bands, rows, values, classes, ClassModel(values, BANDS_NM[bands], classes, names)
            )
        return self._of_bands_cache[key]

    def without_stray_light(self, reflectance: Array) -> tuple[Array, str]:
        """Return a spectrum [221] without a violet end where K/S falls more than in any reference, and a remark
        about the omitted part, if any.

        Pigments absorb more towards the ultraviolet. Instruments have least light there, so stray light becomes
        visible.
        """
        violet = np.flatnonzero(BANDS_NM < _VIOLET_NM)
        with np.errstate(invalid="ignore"):
            of_all = np.vstack([reflectance, self.reflectance])
            log_ratio = np.where(np.isfinite(of_all), log_k_over_s(np.nan_to_num(of_all)), np.nan)
            rise = log_ratio[:, violet + 2] - log_ratio[:, violet]
            step = reflectance[violet] - reflectance[violet + 2]
            most = np.nanmax(rise[1:], initial=0.0) + _RISE_BEYOND
            wrong = np.flatnonzero((rise[0] > most) & (step > _RISE_BY))
        if not len(wrong):
            return reflectance, ""
        last = violet[wrong[-1]]
        reliable = reflectance.copy()
        reliable[: last + 1] = np.nan
        return (
            reliable,
            f"below {BANDS_NM[last + 1]:g} nm it rises in a way that no reference does (stray light?), so these "
            "bands are left out",
        )

    def without_class(self, class_name: str) -> References:
        """Return the library without one of its classes."""
        rows = [row for row, name in enumerate(self.class_of) if name != class_name]
        return References(
            tuple(self.names[row] for row in rows),
            tuple(self.class_of[row] for row in rows),
            self.reflectance[rows],
            self.remarks,
        )


def trimmed_spectrum(spectrum: LibrarySpectrum) -> Measured:
    """Return a file's spectrum for identification, without missing bands at its ends.

    Raises InputError, with file and line, for gaps wider than 20 nm, which resampling does not fill.
    """
    is_known = np.isfinite(spectrum.reflectance)
    nm = spectrum.wavelengths_nm[is_known]
    wide = np.flatnonzero(np.diff(nm) > _WIDEST_GAP_NM)
    if len(wide):
        raise InputError(
            [
                Problem(
                    spectrum.file,
                    spectrum.line,
                    1 if spectrum.line else 0,
                    spectrum.name,
                    f"expected samples every {_WIDEST_GAP_NM:g} nm or closer, found none between {nm[wide[0]]:g} "
                    f"and {nm[wide[0] + 1]:g} nm; measure it again, or leave it out",
                )
            ]
        )
    return Measured(spectrum.name, nm, spectrum.reflectance[is_known], ())


def make_references(spectra: Sequence[LibrarySpectrum], classes: Mapping[str, PigmentClass]) -> References:
    """Return the library with the classes of a table. Spectra without a class are left out. If a spectrum occurs
    under two names, one is kept, or none if the two have different classes; `remarks` say so.

    Raises InputError for a library without classes, or with fewer than two, and for spectra with gaps.
    """
    if not spectra:
        raise InputError("library: expected spectra, found none")
    table = {name.casefold(): pigment_class for name, pigment_class in classes.items()}
    members = [
        (spectrum, table[spectrum.name.casefold()].class_name)
        for spectrum in spectra
        if spectrum.name.casefold() in table and table[spectrum.name.casefold()].class_name
    ]
    file = spectra[0].file
    if len({name for _, name in members}) < _LEAST_CLASSES or len(members) < _LEAST_SPECTRA:
        raise InputError(
            f"library {file}: expected {_LEAST_SPECTRA} or more spectra of {_LEAST_CLASSES} or more classes, "
            f"found classes for {len(members)} of {len(spectra)}; name a table of name and class with --classes"
        )
    remarks = []
    if len(members) < len(spectra):
        without = [s.name for s in spectra if s.name not in {c.name for c, _ in members}]
        remarks.append(f"{len(without)} spectra have no class and are left out: {_list_of_names(without)}")
    values = np.stack([on_bands(trimmed_spectrum(spectrum)) for spectrum, _ in members])
    rows, doublets = _without_doublets(values, members)
    return References(
        tuple(members[row][0].name for row in rows),
        tuple(members[row][1] for row in rows),
        values[rows],
        (*remarks, *doublets),
    )


def _without_doublets(
    values: Array, classed_spectra: list[tuple[LibrarySpectrum, str]]
) -> tuple[list[int], list[str]]:
    dropped_rows: set[int] = set()
    remarks = []
    for row in range(len(values)):
        apart = np.abs(values[:row] - values[row])
        in_both = np.isfinite(apart)
        same = np.where(in_both, apart, 0.0).max(axis=1, initial=0.0) < _SAME
        for before in np.flatnonzero(same & in_both.any(axis=1)):
            (first, first_class), (second, second_class) = classed_spectra[before], classed_spectra[row]
            agree = first_class == second_class
            dropped_rows |= {row} if agree else {int(before), row}
            effect = "counts once" if agree else f"is left out: {first_class}, {second_class}"
            remarks.append(
                f"{first.file}:{first.line} {first.name}, :{second.line} {second.name}: the same spectrum, "
                f"which {effect}"
            )
    return [row for row in range(len(values)) if row not in dropped_rows], remarks


def _list_of_names(names: list[str]) -> str:
    return ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")


def _range(nm: Array) -> str:
    return f"{nm[0]:g} to {nm[-1]:g} nm" if len(nm) else "none"
