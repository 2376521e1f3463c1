"""Identification of the class of pigments in a reflectance spectrum; the library may lack this class.


Each class of the library has a probability, and so has the answer "none of them" (`class_model`). The verdicts
are:

- "match": the class is in the library, and it is this one;
- "ambiguous": it is one of several classes;
- "mixture": two references explain the spectrum together, and none does alone (`unmixing`);
- "unknown": all other cases.

The library itself gives the reliability of the verdict: `references.HeldOutRates`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Measured
from coupole.heritage.analysis.pigment_classes import lacking
from coupole.heritage.analysis.references import HeldOutRates, OfBands, References
from coupole.heritage.analysis.spectral_features import BANDS_NM, NEAR_INFRARED_NM, log_k_over_s, on_bands
from coupole.heritage.analysis.unmixing import Unmixed, unmix, weights_of_bands

Verdict = Literal["match", "mixture", "ambiguous", "unknown"]
_FLAT = 0.1
"""Standard deviation of log(K/S) below which a spectrum has no bands, so that only its level decides."""


@dataclass(frozen=True)
class Candidate:
    """A class with its nearest reference."""

    name: str
    class_name: str
    probability: float
    """Probability of the class."""


@dataclass(frozen=True)
class Part:
    """One pigment of a mixture."""

    name: str
    class_name: str
    share: float
    """Share of the mixture's K/S."""
    interval: tuple[float, float]
    """Interval of 95 % of the share, if the library has these two pigments themselves."""


@dataclass(frozen=True)
class Evidence:
    """Evidence of each band."""

    wavelengths_nm: Array
    """[n]"""
    reflectance: Array
    """[n] reflectance of the spectrum."""
    best: Array
    """[n] reflectance of the nearest reference of the first class, with K/S scaled by the best factor."""
    runner_up: Array
    """[n] reflectance of the nearest reference of the second class, scaled in the same way."""
    fit: Array
    """[n] reflectance of the answer: of the nearest reference, or of the mixture's two references
    together."""
    log_odds: Array
    """[n] for the first class against the second: positive where the spectrum is nearer to the first, in units of
    the spread within classes. Bands are correlated, so their sum is too large."""


@dataclass(frozen=True)
class PigmentFinding:
    """Result of an identification."""

    name: str
    """Name of the spectrum."""
    verdict: Verdict
    """`match`, `mixture`, `ambiguous` or `unknown`."""
    class_name: str
    """Class of the first candidate (for a mixture, of the larger share), whether or not the verdict confirms
    it."""
    reason: str
    """Reason of the verdict, as a sentence."""
    candidates: tuple[Candidate, ...]
    """Candidates, one for each class, best first."""
    not_in_library: float
    """Probability that the class is not in the library; with the candidates' probabilities it sums to 1."""
    parts: tuple[Part, ...]
    """Two pigments, if it is a mixture."""
    evidence: Evidence
    """Evidence of each band, with the two nearest references."""
    near_infrared: bool
    """True if bands beyond 780 nm were compared."""
    remarks: tuple[str, ...]
    """Remarks about the spectrum, such as bands that were left out."""
    rates: HeldOutRates
    """Shares of correct verdicts on the library's own spectra, each left out in turn."""


def identify(spectrum: Measured, references: References) -> PigmentFinding:
    """Compare a reflectance spectrum with the library, in the bands of both.

    Raises InputError if both have fewer than 16 bands of 10 nm in common.
    """
    values, left_out = references.without_stray_light(on_bands(spectrum))
    of_bands = references.of_bands(spectrum.name, values)
    reflectance = values[of_bands.bands]
    model = of_bands.model
    probabilities = model.probabilities(reflectance[None])
    distance = model.nearest(reflectance[None])[0]
    nearest = {
        number: int(rows[np.argmin(distance[rows])])
        for number in range(len(model.class_names))
        if len(rows := np.flatnonzero(of_bands.classes == number))
    }
    order = np.argsort(-probabilities[0, :-1], kind="stable")
    candidates = tuple(
        Candidate(
            references.names[of_bands.rows[nearest[number]]],
            model.class_names[number],
            float(probabilities[0, number]),
        )
        for number in order
    )
    mixture = unmix(reflectance, of_bands.reflectance, of_bands.classes)
    verdict, reason = _judge(of_bands, probabilities, candidates, mixture, reflectance)
    parts = _parts(references, of_bands, mixture) if verdict == "mixture" and mixture is not None else ()
    return PigmentFinding(
        spectrum.name,
        verdict,
        parts[0].class_name if parts else candidates[0].class_name,
        reason,
        candidates,
        float(probabilities[0, -1]),
        parts,
        _evidence(of_bands, reflectance, nearest[order[0]], nearest[order[1]], mixture if parts else None),
        bool(BANDS_NM[of_bands.bands[-1]] > NEAR_INFRARED_NM),
        (left_out,) if left_out else (),
        of_bands.rates,
    )


def _judge(
    of_bands: OfBands,
    probabilities: Array,
    candidates: tuple[Candidate, ...],
    mixture: Unmixed | None,
    reflectance: Array,
) -> tuple[Verdict, str]:
    model, best = of_bands.model, candidates[0]
    flat = "; the spectrum has no bands, so its level decides" if log_k_over_s(reflectance).std() < _FLAT else ""
    if mixture is not None and mixture.is_settled and not _lacks_siblings(of_bands, mixture):
        return "mixture", (
            f"two references leave a residual of {mixture.residual:.1%} of K/S; a single reference is worse by "
            f"{mixture.gain:.0f} and "
            f"two references of other classes by {mixture.lead:.0f} in Schwarz's criterion"
        )
    if not model.is_known(probabilities)[0]:
        return "unknown", (
            f"the probability that the library has the spectrum's class is "
            f"{1.0 - probabilities[0, -1]:.0%}, and at least "
            f"{model.threshold:.0%} is needed; {best.class_name} comes nearest{flat}"
        )
    missing = lacking(best.class_name, model.class_names)
    if missing:
        return (
            "unknown",
            f"it resembles {best.class_name}, and may be {' or '.join(missing)}, which the library lacks",
        )
    if model.is_sure(probabilities)[0]:
        return "match", f"{best.class_name} with {best.probability:.0%}{flat}"
    several = [candidate for candidate in candidates if candidate.probability >= 0.25 * best.probability]
    choices = " or ".join(f"{candidate.class_name} ({candidate.probability:.0%})" for candidate in several)
    return "ambiguous", f"{choices}{flat}"


def _lacks_siblings(of_bands: OfBands, mixture: Unmixed) -> bool:
    """Tell whether a part may be another class of its family, which the library lacks."""
    names = of_bands.model.class_names
    return any(lacking(names[of_bands.classes[row]], names) for row in mixture.references)


def _parts(references: References, of_bands: OfBands, mixture: Unmixed) -> tuple[Part, ...]:
    low, high = mixture.share_interval
    intervals = ((low, high), (1.0 - high, 1.0 - low))
    return tuple(
        Part(references.names[row], references.class_of[row], share, interval)
        for row, share, interval in zip(
            of_bands.rows[list(mixture.references)], mixture.shares, intervals, strict=True
        )
    )


def _evidence(
    of_bands: OfBands, reflectance: Array, best: int, runner_up: int, mixture: Unmixed | None
) -> Evidence:
    from coupole.appearance.matter import kubelka_munk

    log_ratio = log_k_over_s(reflectance)

    def scaled_reference(row: int) -> tuple[Array, Array]:
        of_row = log_k_over_s(of_bands.reflectance[row])
        log_fit = of_row + (log_ratio - of_row).mean()
        return kubelka_munk.opaque(np.exp(log_fit)), (log_fit - log_ratio) / of_bands.reference_spread

    (best_shape, missed_by_one), (second_shape, missed_by_two) = (
        scaled_reference(best),
        scaled_reference(runner_up),
    )
    log_odds = 0.5 * (missed_by_two**2 - missed_by_one**2)
    fit = best_shape
    if mixture is not None:
        pair = np.exp(log_k_over_s(of_bands.reflectance[list(mixture.references)]))
        weight = weights_of_bands(reflectance)
        amounts = np.linalg.lstsq((pair * np.exp(-log_ratio) * weight).T, weight, rcond=None)[0]
        fit = kubelka_munk.opaque(amounts @ pair)
    return Evidence(BANDS_NM[of_bands.bands], reflectance, best_shape, second_shape, fit, log_odds)
