"""Rates of `coupole identify` on published libraries, with 95 % intervals.

`python tools/prove_identification.py PIGMENTS` is for development: it uses only `KremerHistorical.rs` in the
folder PIGMENTS, by leaving out. `--test` applies the rule to `GamblinConservationColors.rs` and
`oilpaint/oilpaint.rs` with Kremer as the library. Its output must not be used to choose anything
(docs/decisions/0042-identification.md).

`--paints FOLDER` applies the rule to paints of 11 other makers, whose tables are in the folder (`cmt` of the
repository painting_tools of Ruben Wiersma), with Kremer as the library: by default paints of the six makers on
which the rule was developed, with `--test` those of the other five. `--both FOLDER` adds those of the six makers
that have a class of Kremer's to the library.
"""

from __future__ import annotations

import argparse
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.spectra.measured import Measured
from coupole.appearance.spectra.spectra_library import LibrarySpectrum, read_library
from coupole.heritage.analysis.identification import identify
from coupole.heritage.analysis.pigment_classes import PigmentClass, shipped_classes
from coupole.heritage.analysis.references import Rate, References, make_references, trimmed_spectrum
from coupole.heritage.analysis.spectral_features import BANDS_NM
from coupole.heritage.analysis.unmixing import unmix, weights_of_bands
from smallest import add_smallest

DEVELOPED_ON = "KremerHistorical.rs"
TESTED_ON = ("GamblinConservationColors.rs", "oilpaint/oilpaint.rs")
DEVELOPING_MAKERS = ("DalerRowney", "Holbein", "Maimeri", "Talens", "WinsorNewton", "apaFerrario")
TESTING_MAKERS = ("Chroma", "Golden", "Liquitex", "Schmincke", "Vallejo")
"""Every second maker by the alphabet, settled before a spectrum was looked at."""
_LAMP_BLACK = {"PBK6": "carbon black"}
_INDEX = re.compile(r"\(P\.?\s?(Y|O|R|V|B|G|Br|Bk|W)\.?\s?(\d+)(?:[:.]\d)?\)", re.IGNORECASE)
"""The only Colour Index name of a paint; paints of several pigments are not counted."""
_SAME = 1e-4
_SEED = 7

Query = tuple[Measured, str]
"""A spectrum with its class; the class is empty if Kremer's table does not have the Colour Index name."""


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
    holds: list[bool] = []
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
        if identification.parts and names == true:
            measured_share = weights_of_bands(noisy) ** 2 / (weights @ ratio[pair])
            of_parts = dict(zip(classes[pair], weights * (ratio[pair] @ measured_share), strict=True))
            low, high = identification.parts[0].interval
            first = of_bands.model.class_names.index(identification.parts[0].class_name)
            holds.append(low <= of_parts[first] / sum(of_parts.values()) <= high)
        verdicts[f"{identification.verdict}, {'right' if names == true or (names < true) else 'wrong'}"] += 1
        count += 1
    print("mixtures of two, both in the library:", ", ".join(f"{k} {v}" for k, v in sorted(verdicts.items())))
    print(f"intervals of their shares hold: {Rate(sum(holds), len(holds))}")
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


def published_queries(folder: Path) -> list[Query]:
    """Return the spectra of the test set with their classes, by the tables that come with Coupole."""
    queries = []
    for name in TESTED_ON:
        spectra = read_library(folder / name)
        table = shipped_classes(spectra)
        queries += [(trimmed_spectrum(s), table[s.name].class_name) for s in spectra if table[s.name].class_name]
    return queries


def paints_of(folder: Path, makers: Sequence[str], kremer: Sequence[LibrarySpectrum]) -> list[Query]:
    """Return the paints of one pigment of certain makers, each spectrum once, with the class of its Colour Index
    name in Kremer's table."""
    classes = {entry.colour_index.upper(): entry.class_name for entry in shipped_classes(kremer).values()}
    classes = {index: name for index, name in classes.items() if index} | _LAMP_BLACK
    nm = np.array((folder / "spectra.txt").read_text().split(), dtype=float)
    queries: list[Query] = []
    for path in sorted(path for maker in makers for path in folder.glob(f"{maker}_*.rs")):
        for row in path.read_text(encoding="utf-8", errors="replace").splitlines():
            name, values = row.strip().strip('"').rpartition('"')[::2]
            index = _INDEX.search(name)
            if index is None or len(values.split()) != len(nm):
                continue
            reflectance = np.array(values.split(), dtype=float)
            if all(np.abs(reflectance - before.values).max() >= _SAME for before, _ in queries):
                sample = Measured(f"{path.stem} {' '.join(name.split())}", nm, reflectance, ())
                queries.append((sample, classes.get(f"P{index[1]}{index[2]}".upper(), "")))
    return queries


def with_paints(kremer: Sequence[LibrarySpectrum], folder: Path) -> References:
    """Return Kremer's library with the paints of the developing makers that have one of its classes."""
    paints = [
        (LibrarySpectrum(sample.name, str(folder), line, sample.wavelengths_nm, sample.values), name)
        for line, (sample, name) in enumerate(paints_of(folder, DEVELOPING_MAKERS, kremer), start=1)
        if name
    ]
    table = shipped_classes(kremer) | {paint.name: PigmentClass(name, "") for paint, name in paints}
    return make_references([*kremer, *(paint for paint, _ in paints)], table)


def test(references: References, queries: Sequence[Query]) -> None:
    """Print the four rates of queries, and each verdict."""
    classes = set(references.class_of)
    inside = [(sample, true) for sample, true in queries if true in classes]
    outside = [(sample, true) for sample, true in queries if true not in classes]
    rest_of_library = {true: references.without_class(true) for _, true in inside}
    with_class = [(true, identify(sample, references)) for sample, true in inside]
    without_class = [(true, identify(sample, rest_of_library[true])) for sample, true in inside]
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
    stated = [answer.verdict == "match" and answer.class_name == true for true, answer in with_class]
    confident = sum(answer.verdict in ("match", "mixture") for _, answer in with_class)
    print(f"\n(1) first candidate right: {Rate(right, len(with_class))}")
    print(
        f"(2) match, right: {Rate(sum(stated), len(with_class))}; match or mixture, wrong: "
        f"{Rate(confident - sum(stated), len(with_class))}"
    )
    for number, results in ((3, without_class), (4, never)):
        print(
            f"({number}) unknown: {Rate(sum(answer.verdict == 'unknown' for _, answer in results), len(results))}"
        )


def main() -> None:
    """Read the arguments, print the rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pigments", type=Path)
    parser.add_argument("--test", action="store_true")
    parser.add_argument("--paints", type=Path, metavar="FOLDER", help="tables of paints of other makers")
    parser.add_argument("--both", type=Path, metavar="FOLDER", help="tables of paints for the library")
    parser.add_argument("--mixtures", type=int, default=100, help="of two spectra")
    add_smallest(parser, mixtures=2)
    options = parser.parse_args()
    spectra = read_library(options.pigments / DEVELOPED_ON)
    references = make_references(spectra, shipped_classes(spectra))
    if options.both:
        references = with_paints(spectra, options.both)
    if options.paints:
        makers = TESTING_MAKERS if options.test else DEVELOPING_MAKERS
        test(references, paints_of(options.paints, makers, spectra))
    elif options.test:
        test(references, published_queries(options.pigments))
    else:
        develop(references, options.mixtures)


if __name__ == "__main__":
    main()
