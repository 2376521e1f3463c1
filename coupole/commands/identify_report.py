"""The origin of spectra, for the report of `coupole identify`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from coupole.commands.identify_options import ReportOptions
    from coupole.heritage.analysis.references import References
    from coupole.heritage.result_pages.identification_record import Origin


def origin_of(
    options: ReportOptions,
    inputs: Sequence[Path],
    library: Path,
    classes: Path | None,
    references: References,
    header_fields: Mapping[str, object] | None = None,
) -> Origin:
    """Gather what is known about inputs and library. Options precede what the files say. For an image cube,
    `header_fields` are the fields of its header. Raises InputError.
    """
    from coupole.appearance.spectra.spectra_library import library_files
    from coupole.heritage.pigment_maps import spectra_origin
    from coupole.heritage.result_pages.identification_record import LibraryFacts, Origin, signature_of

    facts: dict[str, str] = {}
    is_simulated = options.is_simulated
    if header_fields is not None:
        facts, is_called_so = spectra_origin.header_facts(header_fields)
        is_simulated |= is_called_so
    else:
        of_files = [spectra_origin.file_facts(file) for path in inputs for file in library_files(path)]
        is_simulated |= any(is_called_so for _, is_called_so in of_files)
        for name in {name for file_facts, _ in of_files for name in file_facts}:
            words = dict.fromkeys(file_facts[name] for file_facts, _ in of_files if name in file_facts)
            facts[name] = "; ".join(words)
    option_words = (
        options.object_name,
        options.sample,
        options.instrument,
        options.measured_by,
        options.measured_on,
    )
    facts |= {name: words for name, words in zip(spectra_origin.FACTS, option_words, strict=True) if words}
    files = spectra_origin.digests([library])
    table = "tables that come with Coupole"
    if classes is not None:
        files |= spectra_origin.digests([classes])
        table = classes.name
    signature = None
    if options.signed_by is not None and options.role is not None:
        signature = signature_of(options.signed_by.strip(), options.role.strip())
    return Origin(
        spectra_origin.digests(inputs),
        LibraryFacts(
            library.name,
            files,
            len(references.names),
            len(set(references.class_of)),
            table,
            options.library_licence or spectra_origin.licence_beside(library),
        ),
        facts,
        is_simulated,
        signature,
    )
