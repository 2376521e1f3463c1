"""Sentences about the certificates on which records rest."""

from __future__ import annotations

import datetime

from coupole.calibration.artefact import NOT_TRACEABLE, facts_of, sentence_of
from coupole.calibration.record import Kind, Record
from coupole.pages.page_parts import Section

WITHOUT_ARTEFACT: dict[Kind, str] = {
    "dark": "no artefact is needed: the figures are in the camera's own unit, DN",
    "response": "no artefact is needed: the figures are ratios of the camera's own signals",
    "flat-field": "no artefact is needed: the figures are ratios of the camera's own signals",
    "leds": "traceable through the records that it was made from",
    "mesh": "traceable through the records that it was made from, and through the scanner",
}
"""Kinds of records that are made without an artefact of their own."""


def trace_of(record: Record) -> tuple[str, ...]:
    """Return one line for each artefact of a record, or one line that says why there is none."""
    if record.artefacts:
        return tuple(sentence_of(item) for item in record.artefacts)
    return (WITHOUT_ARTEFACT.get(record.kind, NOT_TRACEABLE),)


def is_traceable(record: Record) -> bool:
    """True if all artefacts of a record have a certificate, or if the record needs no artefact of its own."""
    if record.artefacts:
        return all(item.is_traceable for item in record.artefacts)
    return record.kind in WITHOUT_ARTEFACT


def overdue_of(record: Record, day: datetime.date) -> tuple[str, ...]:
    """Return the certificates of a record that were due for calibration before a day."""
    certificates = [(item.artefact, item.artefact.certificate) for item in record.artefacts]
    return tuple(
        f"{record.kind} {record.name}: the certificate {certificate.number} of {artefact.title} was due on "
        f"{certificate.due}"
        for artefact, certificate in certificates
        if certificate is not None and certificate.due is not None and certificate.due < day
    )


def traceability_section(record: Record) -> Section:
    """Return the part of a record's page that names the certificates on which it rests."""
    sections = [
        Section(f"artefact-{number}", f"The {item.role}", facts=dict(facts_of(item)))
        for number, item in enumerate(record.artefacts, start=1)
    ]
    words = overdue_of(record, record.created.date()) if sections else trace_of(record)
    return Section("traceability", "Traceability", words=words, sections=sections)
