"""The certificate of a cell as a printable page and as JSON."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.certificate.chain import ChainLink
from coupole.calibration.certificate.statements import Description
from coupole.calibration.record import Parameter, Record
from coupole.pages.page_parts import Code, Inline, Page, Section, Table, Verdict

ONLY_THESE = "The results relate only to the items calibrated, in the state in which they were calibrated."
SIMULATED = "SIMULATED DATA: NOT A CALIBRATION OF A REAL CELL"
_COVERAGE = (
    "U is the expanded uncertainty: the standard uncertainty (JCGM 100) times k of Student's distribution, for a "
    "coverage of 95 %."
)
_METHODS = {
    "camera": "lens by images of a flat board, bundle adjustment with covariance",
    "chromatic": "lens of each colour by images of a flat board",
    "hand-eye": "camera on the flange by images of a flat board at poses of the arm, joint adjustment",
    "leds": "positions and normals of LEDs by images of the LEDs at poses of the arm",
    "mesh": "pose of a scan by its stickers in images at poses of the arm",
    "dark": "dark signal by dark frames of several exposures",
    "response": "gain and linearity by photon transfer and exposure series",
    "flat-field": "fall-off by a luminous panel that is shifted and turned",
    "led-power": "power of LEDs by a white tile of certified reflectance",
    "drift": "drift of LED power by readings of a white tile",
    "colour": "colour profile by a chart",
    "glare": "veiling glare by black traps in a white field",
    "artefact-check": "comparison with an artefact that was not used in any fit, E_n by ISO 13528",
}


@dataclass(frozen=True)
class CellCertificate:
    """The whole content of a certificate."""

    description: Description
    chain: tuple[ChainLink, ...]
    issue_time: datetime
    doubts: tuple[str, ...]
    """Reasons not to issue it: records that were not accepted, expired records (by date or by drift), and broken
    chains."""

    @property
    def records(self) -> tuple[Record, ...]:
        return tuple(link.item.record for link in self.chain)

    @property
    def is_simulated(self) -> bool:
        return any(record.simulated for record in self.records)


def document_of(certificate: CellCertificate) -> dict[str, Any]:
    """Return the certificate for programs, with a checksum of its own content."""
    content = {
        "title": "Certificate of calibration",
        "simulated": certificate.is_simulated,
        **certificate.description.model_dump(mode="json"),
        "issued": certificate.issue_time.isoformat(),
        "calibrated": _dates(certificate),
        "methods": _methods(certificate),
        "results": [
            {"record": record.name, "kind": record.kind, "parameters": [_figure(p) for p in record.parameters]}
            for record in certificate.records
        ],
        "checks": [
            {**value.model_dump(mode="json"), "en": value.en}
            for record in certificate.records
            for value in record.comparisons
        ],
        "chain": [
            {
                "kind": link.item.record.kind,
                "name": link.item.record.name,
                "sha256": link.item.record.sha256,
                "file_sha256": link.file_sha256,
                "made_from": list(link.made_from),
                "traceability": list(link.traces),
                "gaps": list(link.gaps),
                "inputs": [line.model_dump() for line in link.item.record.inputs],
            }
            for link in certificate.chain
        ],
        "relates_to": ONLY_THESE,
        "doubts": list(certificate.doubts),
    }
    digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
    return {**content, "sha256": digest}


def certificate_page(certificate: CellCertificate) -> Page:
    """Return the printable page."""
    description = certificate.description
    start, end = _dates(certificate)
    return Page(
        title=f"Certificate of calibration {description.number}",
        pictures=[],
        summary=f"{description.item.name}, {description.item.identification}, was calibrated from {start} to "
        f"{end} by {description.laboratory.name}.",
        quality=_quality(certificate),
        next_step=ONLY_THESE,
        remark=SIMULATED if certificate.is_simulated else "",
        facts=_facts(certificate),
        sections=[
            Section("doubts", "Not to be issued", items=[Verdict(line, "bad") for line in certificate.doubts]),
            Section("methods", "Methods", items=_methods(certificate), notes=description.deviations),
            Section("conditions", "Conditions", facts=_conditions(certificate)),
            Section("results", "Results", words=[_COVERAGE], tables=[_results(r) for r in certificate.records]),
            Section("checks", "Checks by independent artefacts", tables=_checks(certificate.records)),
            Section(
                "traceability", "Traceability", words=[_traceable_words(certificate)], tables=[_chain(certificate)]
            ),
            Section(
                "authorisation", "Authorisation", facts=_authorisation(certificate), notes=["End of certificate."]
            ),
        ],
    )


def _quality(certificate: CellCertificate) -> Inline:
    if certificate.doubts:
        return Verdict(f"Not to be issued: {len(certificate.doubts)} reasons, below.", "bad")
    return Verdict(f"All {len(certificate.chain)} records are accepted, in force and traceable.", "ok")


def _dates(certificate: CellCertificate) -> tuple[str, str]:
    days = sorted(f"{record.created:%Y-%m-%d}" for record in certificate.records)
    return days[0], days[-1]


def _methods(certificate: CellCertificate) -> list[str]:
    software = sorted({record.software for record in certificate.records})
    kinds = dict.fromkeys(record.kind for record in certificate.records)
    return [
        *certificate.description.methods,
        *(f"{kind}: {_METHODS[kind]} ({', '.join(software)})" for kind in kinds),
    ]


def _facts(certificate: CellCertificate) -> dict[str, Inline]:
    description, (start, end) = certificate.description, _dates(certificate)
    item = description.item
    facts: dict[str, Inline] = {
        "certificate": description.number,
        "laboratory": f"{description.laboratory.name}, {description.laboratory.address}",
        "place of calibration": description.place,
        "customer": f"{description.customer.name}, {description.customer.address}",
        "item": f"{item.name}, {item.identification}",
        "condition of the item": item.condition,
        "date of receipt": str(item.received) if item.received else "does not apply: the cell stays in its place",
        "dates of calibration": f"{start} to {end}",
        "date of issue": f"{certificate.issue_time:%Y-%m-%d}",
    }
    return facts


def _conditions(certificate: CellCertificate) -> dict[str, Inline]:
    climate = certificate.description.climate
    facts: dict[str, Inline] = {"climate of the room": "was not measured"}
    if climate is not None:
        low, high = climate.temperature_c
        facts = {"temperature of the room": f"{low:g} to {high:g} C, u {climate.u_temperature_k:g} K"}
        if climate.humidity_percent is not None:
            low, high = climate.humidity_percent
            u = "" if climate.u_humidity_percent is None else f", u {climate.u_humidity_percent:g} %"
            facts["relative humidity"] = f"{low:g} to {high:g} %{u}"
        facts["measured by"] = climate.instrument
    for record in certificate.records:
        if record.validity.temperature_c is not None:
            low, high = record.validity.temperature_c
            facts[f"{record.kind} {record.name} holds for"] = (
                f"a temperature of the coolest LED board from {low:g} to {high:g} C"
            )
    return facts


def _figure(parameter: Parameter) -> dict[str, Any]:
    k = float(coverage_factor(parameter.degrees_of_freedom))
    return {"name": parameter.name, "value": parameter.value, "expanded_u": k * parameter.u, "k": k}


def _results(record: Record) -> Table:
    rows = []
    for parameter in record.parameters:
        figure = _figure(parameter)
        value = "" if parameter.value is None else f"{parameter.value:.7g}"
        rows.append((parameter.name, value, f"{figure['expanded_u']:.2g}", f"{figure['k']:.2f}"))
    poses = [
        (name, " ".join(f"{v:.4f}" for v in (*pose.translation_mm, *pose.abc_deg)), "x y z mm, A B C deg", "")
        for name, pose in record.transforms.items()
    ]
    title = (
        f"{record.kind} {record.name}, {record.created:%Y-%m-%d}; the names contain the units, and a name "
        "without a unit is a relative figure"
    )
    return Table(title, ("quantity", "value", "U", "k"), [*poses, *rows])


def _checks(records: Sequence[Record]) -> list[Table]:
    tables = []
    for record in records:
        rows = [
            (
                value.position,
                value.name,
                f"{value.certified_value:.5f}",
                f"{value.measured_value:.5f}",
                f"{value.expanded_u_certified:.5f}",
                f"{value.expanded_u_measured:.5f}",
                f"{value.en:.2f}",
            )
            for value in record.comparisons
        ]
        head = ("position", "value", "certified", "measured", "U certified", "U measured", "E_n")
        tables += [Table(f"{record.name}: k = 2", head, rows)] if rows else []
    return tables


def _traceable_words(certificate: CellCertificate) -> str:
    if any(link.gaps for link in certificate.chain):
        return "The chain to certificates is broken where the table says so: those results are not traceable."
    return (
        "Each result is traceable through an unbroken chain of records, each sealed by its SHA-256 and naming the "
        "SHA-256 of all that it was made from, to the certificates of the artefacts named."
    )


def _chain(certificate: CellCertificate) -> Table:
    rows: list[tuple[Inline, ...]] = [
        (
            f"{link.item.record.kind} {link.item.record.name}",
            Code(link.item.record.sha256),
            ", ".join(link.made_from),
            "; ".join(link.traces),
            Verdict("; ".join(link.gaps), "bad") if link.gaps else Verdict("unbroken", "ok"),
        )
        for link in certificate.chain
    ]
    return Table(
        "Chain of records", ("record", "SHA-256", "made from", "artefacts and certificates", "chain"), rows
    )


def _authorisation(certificate: CellCertificate) -> dict[str, Inline]:
    person = certificate.description.authorised_by
    return {
        "authorised by": f"{person.name}, {person.function}",
        "signature": "____________________",
        "checksum of the JSON": Code(str(document_of(certificate)["sha256"])),
    }
