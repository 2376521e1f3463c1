"""Rates of `coupole identify` on published libraries, with 95 % intervals.

`python tools/prove_identification.py PIGMENTS` develops: `KremerHistorical.rs` in the folder PIGMENTS alone, by
leaving out. `--test` runs the rule on `GamblinConservationColors.rs` and `oilpaint/oilpaint.rs` with Kremer as
the library: nothing may be chosen by what it prints (docs/decisions/0042-identification.md).
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
from coupole.heritage.analysis.references import Rate, References, make_references, measured
from coupole.heritage.analysis.spectral_features import BANDS_NM
from coupole.heritage.analysis.unmixing import unmix
from smallest import add_smallest

DEVELOPED_ON = "KremerHistorical.rs"
TESTED_ON = ("GamblinConservationColors.rs", "oilpaint/oilpaint.rs")
_SEED = 7


def develop(references: References, mixtures: int) -> None:
    """Print rates of the library by itself, and of mixtures of two of its spectra."""
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
    found = of_bands.model.held_out.probabilities[:, :-1]
    several = np.bincount(of_bands.classes)[of_bands.classes] > 1
    right = (found.argmax(axis=1) == of_bands.classes)[several]
    stated = found.max(axis=1)[several]
    for low, high in ((0.0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 1.0)):
        inside = (stated >= low) & (stated < high + 1e-9)
        rate = Rate(int(right[inside].sum()), int(inside.sum()))
        print(f"stated {low:.2f} to {high:.2f}: mean {stated[inside].mean():.2f}, right {rate}")


def _mixtures(references: References, mixtures: int) -> None:
    """Opaque mixtures of two spectra of different classes, with noise of 0.001; and single ones, each as if the
    library lacked it, or its class."""
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
        found = identify(Measured("mixture", nm, noisy, ()), references)
        true = {of_bands.model.class_names[classes[row]] for row in pair}
        named = {part.class_name for part in found.parts} or {found.class_name}
        verdicts[f"{found.verdict}, {'right' if named == true or (named < true) else 'wrong'}"] += 1
        count += 1
    print("mixtures of two, both in the library:", ", ".join(f"{k} {v}" for k, v in sorted(verdicts.items())))
    rows = np.arange(len(values))
    for what, groups in (("it", rows), ("its class", classes)):
        kept = [groups != groups[row] for row in rows]
        settled = [unmix(values[row], values[kept[row]], classes[kept[row]]) for row in rows]
        seen = sum(found is not None and found.is_settled for found in settled)
        print(f"mixture seen in a single pigment, {what} left out: {Rate(seen, len(rows))}")


def test(references: References, folder: Path) -> None:
    """Print the four rates of the test set, and each verdict that counts against one."""
    classes = set(references.class_of)
    inside: list[tuple[Measured, str]] = []
    outside: list[tuple[Measured, str]] = []
    for name in TESTED_ON:
        spectra = read_library(folder / name)
        table = shipped_classes(spectra)
        for spectrum in spectra:
            class_name = table[spectrum.name].class_name
            if class_name:
                (inside if class_name in classes else outside).append((measured(spectrum), class_name))
    found = [(true, identify(one, references)) for one, true in inside]
    gone = [(true, identify(one, references.without_class(true))) for one, true in inside]
    never = [(true, identify(one, references)) for one, true in outside]
    for title, results in (("class in the library", found), ("taken out", gone), ("not in it", never)):
        print(f"\n{title}:")
        for true, one in results:
            first = one.candidates[0]
            print(f"  {one.name:38s} {true:28s} {one.verdict:9s} {one.class_name:28s} {first.probability:.2f}")
    right = sum(one.candidates[0].class_name == true for true, one in found)
    matched = [one.class_name == true for true, one in found if one.verdict == "match"]
    print(f"\n(1) first candidate right: {Rate(right, len(found))}")
    wrong = Rate(len(matched) - sum(matched), len(found))
    print(f"(2) match, right: {Rate(sum(matched), len(found))}; wrong: {wrong}")
    for number, results in ((3, gone), (4, never)):
        print(f"({number}) unknown: {Rate(sum(one.verdict == 'unknown' for _, one in results), len(results))}")


def main() -> None:
    """Read the arguments, print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pigments", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--mixtures", type=int, default=100, help="of two spectra")
    add_smallest(parser, mixtures=2)
    asked = parser.parse_args()
    spectra = read_library(asked.pigments / DEVELOPED_ON)
    references = make_references(spectra, shipped_classes(spectra))
    if asked.test:
        test(references, asked.pigments)
    else:
        develop(references, asked.mixtures)


if __name__ == "__main__":
    main()
