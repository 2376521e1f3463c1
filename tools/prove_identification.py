"""Rates of `coupole identify` on published libraries, with 95 % intervals.

`python tools/prove_identification.py PIGMENTS` is for development: it uses only `KremerHistorical.rs` in the
folder PIGMENTS, by leaving out. `--test` applies the rule to `GamblinConservationColors.rs` and
`oilpaint/oilpaint.rs` with Kremer as the library. Its output must not be used to choose anything
(docs/decisions/0042-identification.md).
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.spectra_library import read_library
from coupole.heritage.analysis.identification import identify
from coupole.heritage.analysis.pigment_classes import shipped_classes
from coupole.heritage.analysis.references import Rate, References, make_references, trimmed_spectrum
from coupole.heritage.analysis.spectral_features import BANDS_NM
from coupole.heritage.analysis.unmixing import unmix
from smallest import add_smallest

DEVELOPED_ON = "KremerHistorical.rs"
TESTED_ON = ("GamblinConservationColors.rs", "oilpaint/oilpaint.rs")
_SEED = 7


def develop(references: References, mixtures: int) -> None:
    """Print the rates of the library with itself, and of mixtures of two of its spectra."""
    first = references.reflectance[0]
    of_bands = references.of_bands("", first)
    rates = of_bands.rates
    print(f"{len(of_bands.rows)} spectra of {len(of_bands.model.class_names)} classes")
    print(
        f"first candidate right: {rates.right}\nmatch, right: {rates.matches}\nmatch, wrong: {rates.false_matches}"
    )
    print(f"class left out, unknown: {rates.unknown}; threshold {of_bands.model.threshold:.3f}")
    _calibration(references)
    _mixtures(references, mixtures)


def _calibration(references: References) -> None:
    of_bands = references.of_bands("", references.reflectance[0])
    probabilities = of_bands.model.held_out.probabilities[:, :-1]
    several = np.bincount(of_bands.classes)[of_bands.classes] > 1
    right = (probabilities.argmax(axis=1) == of_bands.classes)[several]
    stated_probability = probabilities.max(axis=1)[several]
    for low, high in ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0)):
        inside = (stated_probability >= low) & (stated_probability < high + 1e-9)
        rate = Rate(int(right[inside].sum()), int(inside.sum()))
        print(f"stated {low:.2f} to {high:.2f}: mean {stated_probability[inside].mean():.2f}, right {rate}")


def _mixtures(references: References, mixtures: int) -> None:
    """Return opaque mixtures of two spectra of different classes, with noise of 0.001; and single spectra, for
    which the library lacks the spectrum or its class."""
    random = np.random.default_rng(_SEED)
    of_bands = references.of_bands("", references.reflectance[0])
    values, classes, nm = of_bands.reflectance, of_bands.classes, BANDS_NM[of_bands.bands]
    ratio = kubelka_munk.k_over_s(values)
    verdicts: Counter[str] = Counter()
    count = 0
    while count < mixtures:
        pair = random.choice(len(values), 2, replace=False)
        if classes[pair[0]] == classes[pair[1]]:
            continue
        weights = random.uniform(0.5, 1.0, 2) / ratio[pair].mean(axis=1)
        mixture = kubelka_munk.opaque(weights / weights.sum() @ ratio[pair])
        noisy = np.clip(mixture + 0.001 * random.standard_normal(len(nm)), 0.001, 0.999)
        identification = identify(Measured("mixture", nm, noisy, ()), references)
        true = {of_bands.model.class_names[classes[row]] for row in pair}
        names = {part.class_name for part in identification.parts} or {identification.class_name}
        verdicts[f"{identification.verdict}, {'right' if names == true or (names < true) else 'wrong'}"] += 1
        count += 1
    print("mixtures of two, both in the library:", ", ".join(f"{k} {v}" for k, v in sorted(verdicts.items())))
    rows = np.arange(len(values))
    for omission, groups in (("it", rows), ("its class", classes)):
        rest_of_library = [groups != groups[row] for row in rows]
        unmixings = [
            unmix(values[row], values[rest_of_library[row]], classes[rest_of_library[row]]) for row in rows
        ]
        false_mixtures = sum(
            identification is not None and identification.is_settled for identification in unmixings
        )
        print(f"mixture seen in a single pigment, {omission} left out: {Rate(false_mixtures, len(rows))}")


def test(references: References, folder: Path) -> None:
    """Print the four rates of the test set, and each wrong verdict."""
    classes = set(references.class_of)
    inside: list[tuple[Measured, str]] = []
    outside: list[tuple[Measured, str]] = []
    for name in TESTED_ON:
        spectra = read_library(folder / name)
        table = shipped_classes(spectra)
        for spectrum in spectra:
            class_name = table[spectrum.name].class_name
            if class_name:
                (inside if class_name in classes else outside).append((trimmed_spectrum(spectrum), class_name))
    with_class = [(true, identify(sample, references)) for sample, true in inside]
    without_class = [(true, identify(sample, references.without_class(true))) for sample, true in inside]
    never = [(true, identify(sample, references)) for sample, true in outside]
    for title, results in (
        ("class in the library", with_class),
        ("taken out", without_class),
        ("not in it", never),
    ):
        print(f"\n{title}:")
        for true, answer in results:
            first = answer.candidates[0]
            print(
                f"  {answer.name:38s} {true:28s} {answer.verdict:9s} {answer.class_name:28s} "
                f"{first.probability:.2f}"
            )
    right = sum(answer.candidates[0].class_name == true for true, answer in with_class)
    match_is_right = [answer.class_name == true for true, answer in with_class if answer.verdict == "match"]
    print(f"\n(1) first candidate right: {Rate(right, len(with_class))}")
    wrong = Rate(len(match_is_right) - sum(match_is_right), len(with_class))
    print(f"(2) match, right: {Rate(sum(match_is_right), len(with_class))}; wrong: {wrong}")
    for number, results in ((3, without_class), (4, never)):
        print(
            f"({number}) unknown: {Rate(sum(answer.verdict == 'unknown' for _, answer in results), len(results))}"
        )


def main() -> None:
    """Read the arguments, print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pigments", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--mixtures", type=int, default=100, help="of two spectra")
    add_smallest(parser, mixtures=2)
    options = parser.parse_args()
    spectra = read_library(options.pigments / DEVELOPED_ON)
    references = make_references(spectra, shipped_classes(spectra))
    if options.test:
        test(references, options.pigments)
    else:
        develop(references, options.mixtures)


if __name__ == "__main__":
    main()
