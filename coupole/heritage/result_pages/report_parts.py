"""Parts that all reports of an identification share: what was compared, the finding in words, limits, and the
place for a signature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

import coupole
from coupole.heritage.analysis.identification import PigmentFinding
from coupole.heritage.analysis.pigment_classes import FAMILIES
from coupole.heritage.pigment_maps.spectra_origin import FACTS
from coupole.heritage.result_pages.identification_record import RECORD, Origin
from coupole.pages.page_charts import Curve, chart
from coupole.pages.page_parts import Code, Inline, Moment, Plot, Section, Table

LINE = "________________________________"
SIMULATED = "The data are simulated: nothing here was measured on an object."
_CONFUSED_AT = 0.05
LIMITS = (
    "The answer is a class of colouring matter, not a product, a maker or a date.",
    "A class that the library does not have cannot be found. The verdict unknown is then the right answer, and is "
    "not always given.",
    "A reflectance spectrum shows the uppermost layers. Varnish, dirt, retouching, thin glazes and fluorescence "
    "change it; spectra with varnish, dirt or thin glazes were not tested.",
    "Whites, blacks, and pigments whose bands lie in the ultraviolet or the near infrared may not be told apart "
    "by visible light.",
    "With Kremer's library of historical pigments, paints of other makers were matched in 27 of 74 tested cases "
    "and matched wrongly in 3. The first class was right in 57 of them. Other libraries were not tested "
    "in this way.",
    "Probabilities apply to the classes of this library, and to spectra like the spectra in "
    "it. Confirm the finding "
    "by another method (such as X-ray fluorescence or Raman spectroscopy) before a treatment depends on it.",
)


def facts_of(origin: Origin) -> dict[str, Inline]:
    """Facts at the top of a report: object, sample, instrument, person. The report says which of them are not
    known.
    """
    facts: dict[str, Inline] = {name: origin.facts.get(name, "not stated") for name in FACTS}
    return facts | {name: words for name, words in origin.facts.items() if name not in FACTS}


def words_of(finding: PigmentFinding) -> str:
    """The finding as a sentence, with its probability."""
    first = finding.candidates[0]
    match finding.verdict:
        case "match":
            return f"The spectrum shows {finding.class_name}, with a probability of {first.probability:.0%}."
        case "mixture":
            parts = " and ".join(f"{part.class_name} ({part.share:.0%} of K/S)" for part in finding.parts)
            return f"The spectrum shows a mixture of {parts}."
        case "ambiguous":
            return f"The spectrum does not decide for a class: {finding.reason}."
        case _:
            return f"The pigment is not identified: {finding.reason}."


def confusions_of(finding: PigmentFinding) -> str:
    """Return the classes with which the finding could be confused, as a sentence."""
    finding_names = {finding.class_name} | {part.class_name for part in finding.parts}
    other_classes = [
        f"{candidate.class_name} ({candidate.probability:.0%})"
        for candidate in finding.candidates
        if candidate.class_name not in finding_names and candidate.probability >= _CONFUSED_AT
    ]
    kin = sorted({name for family in FAMILIES if family & finding_names for name in family - finding_names})
    sentences = [f"other classes of the library: {', '.join(other_classes)}" if other_classes else
                 f"no other class of the library has a probability of {_CONFUSED_AT:.0%} or more"]  # fmt: skip
    if kin:
        sentences.append(f"of the same family, with bands of the same kind: {', '.join(kin)}")
    sentences.append(f"a class that the library does not have: {finding.not_in_library:.0%}")
    return "; ".join(sentences)


def fit_plots(finding: PigmentFinding) -> list[Plot]:
    """The measured spectrum with the fitted spectrum, and the difference of the two."""
    evidence = finding.evidence
    parts = " and ".join(part.name for part in finding.parts) or finding.candidates[0].name
    difference = 100.0 * (evidence.reflectance - evidence.fit)
    rms = float(np.sqrt(np.mean(difference**2)))
    fit = chart(
        f"{finding.name}: reflectance measured, and fitted by {parts}",
        evidence.wavelengths_nm,
        [Curve("measured", evidence.reflectance), Curve("fitted", evidence.fit, is_dashed=True)],
    )
    rest = chart(
        f"{finding.name}: measured minus fitted, in percent of reflectance; rms {rms:.2f} %",
        evidence.wavelengths_nm,
        [Curve("measured minus fitted", difference), Curve("zero", np.zeros(len(difference)), is_dashed=True)],
    )
    return [fit, rest]


def compared_section(origin: Origin) -> Section:
    """The library with its version and licence, the inputs with their checksums, and the software."""
    library = origin.library
    rows = [("input", name, Code(digest)) for name, digest in origin.inputs.items()]
    rows += [("library", name, Code(digest)) for name, digest in library.files.items()]
    return Section(
        "compared",
        "What was compared",
        facts={
            "library": [Code(library.name), f", {library.spectra} spectra of {library.classes} classes"],
            "classes by": library.table,
            "licence of the library": library.licence or "not stated beside it",
            "software": f"Coupole {coupole.__version__}; method: decision 42 of its documentation",
        },
        tables=[Table("Files, with their SHA-256", ("file of", "name", "SHA-256"), rows)],
    )


def limits_section() -> Section:
    """Return the limits of the method, in plain words."""
    return Section("limits", "Limits of the method", items=LIMITS)


def signature_section(origin: Origin, record: Mapping[str, object]) -> Section:
    """The place for a signature (filled if the report is signed already), and a text that says how a change is
    detected.
    """
    signature = origin.signature
    stamp: Sequence[Inline] = (LINE,) if signature is None else (Moment(signature.time_utc), " UTC")
    facts: dict[str, Inline] = {
        "name": LINE if signature is None else signature.name,
        "role": LINE if signature is None else signature.role,
        "date": stamp,
        "signature": LINE,
        "checksum of the content": Code(str(record["content_sha256"])),
    }
    return Section(
        "signature",
        "Signature",
        words=["I have read the findings, the limits and the spectra of this report."],
        facts=facts,
        notes=[
            [
                "The checksum (SHA-256) is that of the findings in ", Code(RECORD), " beside this page. ",
                Code("coupole verify FOLDER"), " tells whether record, page or maps were changed later. It is ",
                "a checksum, not a cryptographic signature: it does not prove who signed. A signed copy on paper "
                "with this checksum ties the person to the content.",
            ]
        ],
    )  # fmt: skip


def remark_of(origin: Origin) -> str:
    """Words that must be known first."""
    return SIMULATED if origin.is_simulated else ""
