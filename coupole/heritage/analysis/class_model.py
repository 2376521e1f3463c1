"""Probabilities of classes of pigments, and of none of these classes, from a library of spectra.

A Gaussian process regresses the membership of each class (Rasmussen and Williams, Gaussian Processes for Machine
Learning, 2006, section 6.5) with a Matern 3/2 kernel on the distances of `spectral_features.features`; the median
distance is its length. Each reference is used in several appearances. Leaving out a reference, or a class with all
its members, has a closed form (in the same book, Eq. 5.12). Memberships m become probabilities exp(b m_c)/Z. The
probability of none of the classes is exp(b (t0 + t1 v))/Z, where v is the process's variance. log b, t0 and t1
make the correct answers most probable. For a reference that is left out, the correct answer is its class; if its
class is left out too, it is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.heritage.analysis.pigment_classes import lacking
from coupole.heritage.analysis.spectral_features import appearances, features

_Single = NDArray[np.float32]
_Any = TypeVar("_Any", Array, _Single)
_NOISE = 0.4
_HARDLY = 0.05
"""Variance among references, as a multiple of the variance of noise, below which a direction counts as noise."""
_MOST_KNOWN = 0.05
"""Share of the references that may count as known when their class is left out."""
_LEAST_KNOWN = 0.6
_SURE = 0.8
_START = (2.0, 0.55, 0.75)


@dataclass(frozen=True)
class HeldOut:
    """Probabilities of the references, each computed as if it were not in the library."""

    probabilities: Array
    """[n, classes + 1] probabilities when the reference itself is left out. The last one is the probability that
    no class is right.
    """
    without_class: Array
    """[n, classes + 1] probabilities when the reference's whole class is left out."""


class ClassModel:
    """Classes of the references `reflectance` [n, bands], which have no gaps, at `wavelengths_nm` [bands];
    `classes` [n] are the numbers of their classes."""

    def __init__(
        self,
        reflectance: Array,
        wavelengths_nm: Array,
        classes: NDArray[np.intp],
        class_names: tuple[str, ...],
    ) -> None:
        looks = appearances(reflectance, wavelengths_nm)
        self.class_names = class_names
        self._classes, self._count = classes, len(looks)
        self._rows = features(looks.reshape(-1, looks.shape[-1]))
        squared_distances = _squared_distances(self._rows, self._rows)
        self._length2 = (
            float(np.median(squared_distances[squared_distances > 0.0]))
            if np.any(squared_distances > 0.0)
            else 1.0
        )
        self._members = np.eye(len(class_names))[np.tile(classes, self._count)]
        self._precision = np.linalg.inv(self._kernel(squared_distances) + _NOISE * np.eye(len(squared_distances)))
        self._weights = self._precision @ self._members

    def probabilities(self, reflectance: Array) -> Array:
        """[q, classes + 1] probability of each class for spectra [q, bands]; the last one is the probability of no
        class."""
        near = self._kernel(_squared_distances(features(reflectance), self._rows))
        variance = 1.0 - ((near @ self._precision) * near).sum(axis=1)
        return _probabilities(np.column_stack([near @ self._weights, variance]), self._scale)

    def quick_probabilities(self, reflectance: Array) -> Array:
        """Return nearly the same probabilities in a third of the time, for many pixels; they differ by less than
        0.001. Distances are of single precision, and directions in which the references hardly differ count as
        noise."""
        rows, directions, factors = self._main_directions
        near = self._kernel(_squared_distances(features(reflectance).astype(np.float32), rows)).astype(np.float64)
        quadratic = (near**2).sum(axis=1) / _NOISE - ((near @ directions) ** 2) @ factors
        return _probabilities(np.column_stack([near @ self._weights, 1.0 - quadratic]), self._scale)

    @cached_property
    def _main_directions(self) -> tuple[_Single, Array, Array]:
        """Features of the references; eigenvectors of their kernel; the amount by which each eigenvector lowers
        the precision of noise.
        """
        precisions, vectors = np.linalg.eigh(self._precision)
        is_main = precisions < 1.0 / (_NOISE * (1.0 + _HARDLY))
        return self._rows.astype(np.float32), vectors[:, is_main], 1.0 / _NOISE - precisions[is_main]

    def nearest(self, reflectance: Array) -> Array:
        """[q, n] distance of spectra [q, bands] from each reference in its most similar appearance."""
        squared_distances = _squared_distances(features(reflectance), self._rows)
        nearest: Array = np.sqrt(squared_distances.reshape(len(squared_distances), self._count, -1).min(axis=1))
        return nearest

    def is_known(self, probabilities: Array) -> NDArray[np.bool_]:
        """Tell, for rows of probabilities [q, classes + 1], whether the library has the class."""
        is_known: NDArray[np.bool_] = 1.0 - probabilities[:, -1] >= self.threshold
        return is_known

    def is_sure(self, probabilities: Array) -> NDArray[np.bool_]:
        """Tell whether the first class is probable enough if the library has the class."""
        sure: NDArray[np.bool_] = probabilities[:, :-1].max(axis=1) >= _SURE * (1.0 - probabilities[:, -1])
        return sure

    @cached_property
    def held_out(self) -> HeldOut:
        """Held-out probabilities of the references in their measured appearance."""
        without_row, all_of_class = (
            _probabilities(predictions[: len(self._classes)], self._scale) for predictions in self._left_out
        )
        return HeldOut(without_row, all_of_class)

    @cached_property
    def threshold(self) -> float:
        """Probability that the class of a spectrum is in the library, from which the spectrum counts as known. If
        the class of a reference is left out of the library, only a share of 0.05 of the references reach this
        probability. References that a family (`pigment_classes`) excludes count as not reaching it.
        """
        probabilities = self.held_out.without_class
        known_probability = 1.0 - probabilities[:, -1]
        for row, number in enumerate(self._classes):
            other_classes = set(self.class_names) - {self.class_names[number]}
            if lacking(self.class_names[probabilities[row, :-1].argmax()], other_classes):
                known_probability[row] = 0.0
        return max(_LEAST_KNOWN, float(np.quantile(known_probability, 1.0 - _MOST_KNOWN)))

    @cached_property
    def _left_out(self) -> tuple[Array, Array]:
        """Memberships and variance [appearances x n, classes + 1], once without the reference, once without its
        class."""
        numbers = np.arange(len(self._classes))
        return self._without(np.tile(numbers, self._count)), self._without(np.tile(self._classes, self._count))

    def _without(self, group: NDArray[np.intp]) -> Array:
        predictions = np.empty((len(group), len(self.class_names) + 1))
        for number in np.unique(group):
            rows = np.flatnonzero(group == number)
            covariance = np.linalg.inv(self._precision[np.ix_(rows, rows)])
            predictions[rows, :-1] = self._members[rows] - covariance @ self._weights[rows]
            predictions[rows, -1] = np.diag(covariance) - _NOISE
        return predictions

    @cached_property
    def _scale(self) -> Array:
        """log b, t0 and t1. If a class has only one reference, leaving out this reference leaves out the class."""
        from scipy.optimize import minimize

        without_row, all_of_class = self._left_out
        classes = np.tile(self._classes, self._count)
        sizes = np.bincount(self._classes)[classes]
        weight = sizes**-0.5
        several = sizes > 1

        def loss(scale: Array) -> float:
            none = np.log(_probabilities(all_of_class, scale)[:, -1] + 1e-12)
            total = -float(weight @ none / weight.sum()) + 1e-3 * float(scale @ scale)
            if several.any():
                right = _probabilities(without_row[several], scale)[np.arange(several.sum()), classes[several]]
                total -= float(weight[several] @ np.log(right + 1e-12) / weight[several].sum())
            return total

        minimum = minimize(
            loss, _START, method="Nelder-Mead", options={"maxiter": 300, "xatol": 1e-3, "fatol": 1e-4}
        )
        return np.asarray(minimum.x)

    def _kernel(self, squared_distances: _Any) -> _Any:
        distance = np.sqrt(3.0 * squared_distances / self._length2)
        kernel: _Any = (1.0 + distance) * np.exp(-distance)
        return kernel


def _probabilities(class_scores: Array, scale: Array) -> Array:
    sharpness = np.exp(scale[0])
    exponents = sharpness * np.column_stack([class_scores[:, :-1], scale[1] + scale[2] * class_scores[:, -1]])
    exponents -= exponents.max(axis=1, keepdims=True)
    powers = np.exp(exponents)
    probabilities: Array = powers / powers.sum(axis=1, keepdims=True)
    return probabilities


def _squared_distances(a: _Any, b: _Any) -> _Any:
    squared_distances: _Any = np.maximum(
        (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1)[None] - 2.0 * a @ b.T,
        0.0,
    )
    return squared_distances
