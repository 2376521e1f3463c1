"""Identifies the reference spectrum that a spectrum taken in situ resembles, if any (seed 000, section 3.5).

On old paint dust adds white and varnish absorbs, and the contrast of the spectrum falls while its
shape remains. Three measures of shape are therefore averaged, each a correlation over the bands that
both spectra cover, 1 for equal shapes:

- of reflectance (cosine of the spectral angle after subtraction of the means: independent of added white and of a
factor),
- of log(K/S) (independent of a factor on K/S, such as another concentration in white),
- of the slope over 20 nm (where the edges and peaks are).

The usual spectral angle is also reported. It alone discriminates poorly, because all spectra are positive and so
all angles are small.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.spectra.grid import BANDS, Array
from coupole.errors import InputError

_LEAST_COMMON = 30
_DARKEST = 0.005
"""Below this reflectance, K/S is mostly the instrument's stray light."""
_FLAT = 0.01
"""Standard deviation of reflectance below which a spectrum has no shape to compare."""


@dataclass(frozen=True)
class Candidate:
    """Similarity of one reference to the spectrum."""

    name: str
    score: float
    """Mean of the three correlations."""
    shape: float
    k_over_s: float
    slope: float
    spectral_angle_deg: float


@dataclass(frozen=True)
class Verdict:
    """Result of an identification."""

    finding: Literal["match", "ambiguous", "none"]
    reason: str
    margin: float
    """Score of the first candidate less that of the second; infinite if there is one only."""
    candidates: tuple[Candidate, ...]
    """Best first."""


def identify(
    spectrum: Array, references: Mapping[str, Array], *, least_score: float = 0.9, least_margin: float = 0.02
) -> Verdict:
    """Compare `spectrum` [81] with each of `references` [81]; NaN marks bands that were not measured.

    "match" needs the best score to reach `least_score` and to lead by `least_margin`; "ambiguous" reaches the
    first only; otherwise it is "none". A mixture, or a pigment that the references lack, gives "none": see
    `pigments.fit`.
    """
    if not references:
        raise InputError("identification: expected reference spectra, found none; give some")
    known = spectrum[np.isfinite(spectrum)]
    if known.size and known.std() < _FLAT:
        return Verdict("none", f"flat: it varies by less than {_FLAT:g}, so it has no shape to compare", 0.0, ())
    candidates = sorted(
        (compare(name, spectrum, reference) for name, reference in references.items()), key=lambda c: -c.score
    )
    best = candidates[0]
    margin = best.score - candidates[1].score if len(candidates) > 1 else np.inf
    listed = tuple(candidates)
    if best.score < least_score:
        return Verdict(
            "none", f"{best.name} comes nearest, at {best.score:.3f} of {least_score:g}", margin, listed
        )
    if margin < least_margin:
        return Verdict(
            "ambiguous", f"{best.name} and {candidates[1].name} differ by {margin:.3f} only", margin, listed
        )
    return Verdict("match", f"{best.name}, {margin:.3f} before the next", margin, listed)


def compare(name: str, spectrum: Array, reference: Array) -> Candidate:
    """One reference against the spectrum, both [81]."""
    if spectrum.shape != (BANDS,) or reference.shape != (BANDS,):
        raise InputError(
            f"identification with {name}: expected two spectra of {BANDS} bands, found {spectrum.shape} and "
            f"{reference.shape}; resample them with `resampling.on_grid`"
        )
    both = np.isfinite(spectrum) & np.isfinite(reference)
    if both.sum() < _LEAST_COMMON:
        raise InputError(
            f"identification with {name}: expected {_LEAST_COMMON} or more common bands, found {both.sum()}; "
            "measure over a wider range"
        )
    a, b = spectrum[both], reference[both]
    scores = (
        _correlation(a, b),
        _correlation(_log_k_over_s(a), _log_k_over_s(b)),
        _correlation(*_slopes(spectrum, reference)),
    )
    cosine = a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    angle_deg = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return Candidate(name, float(np.mean(scores)), *scores, angle_deg)


def _correlation(a: Array, b: Array) -> float:
    """Pearson's correlation; 0 if one of the two is constant, because it has no shape."""
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(a @ b) / norm if norm > 1e-12 else 0.0


def _log_k_over_s(reflectance: Array) -> Array:
    return np.log(kubelka_munk.k_over_s(np.clip(reflectance, _DARKEST, 1.0 - _DARKEST)))


def _slopes(spectrum: Array, reference: Array) -> tuple[Array, Array]:
    """Differences over four bands, where both are known at both ends."""
    a, b = spectrum[4:] - spectrum[:-4], reference[4:] - reference[:-4]
    both = np.isfinite(a) & np.isfinite(b)
    return a[both], b[both]
