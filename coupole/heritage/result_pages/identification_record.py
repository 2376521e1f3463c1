"""`identification.json`: the spectra, the library, the findings, and who signed them, with checksums.

`content_sha256` is the SHA-256 of the canonical content: JSON with sorted keys, without blanks, without the keys
`files`, `content_sha256` and `sha256`. The page prints it. `files` has the checksum of each file beside the
record, `sha256` the checksum of the whole record without this key. Checksums tell that something was changed.
Checksums do not prove who signed: a person who changes a file can compute them again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import coupole
from coupole.errors import InputError, StorageError, reason
from coupole.heritage.analysis.identification import PigmentFinding
from coupole.heritage.analysis.references import Rate
from coupole.intake.plain_data import read_json
from coupole.storage.durable import sha256, write_synced

RECORD = "identification.json"
_KIND, _VERSION = "identification of pigments", 1
_SUMS = ("files", "content_sha256", "sha256")


@dataclass(frozen=True)
class Signature:
    """A person who signs a report, and the time."""

    name: str
    role: str
    time_utc: str
    """ISO 8601."""


@dataclass(frozen=True)
class LibraryFacts:
    """The library that spectra were compared with."""

    name: str
    files: Mapping[str, str]
    """SHA-256 of each file by its name: the library's version."""
    spectra: int
    classes: int
    table: str
    """Table with the classes of its spectra."""
    licence: str
    """Words of the library's licence; empty if no licence is stated."""


@dataclass(frozen=True)
class Origin:
    """The origin of spectra, and their library."""

    inputs: Mapping[str, str]
    """SHA-256 of each input file by its name."""
    library: LibraryFacts
    facts: Mapping[str, str] = field(default_factory=dict)
    """Object, sample, instrument and so on, in words; only what is known."""
    is_simulated: bool = False
    signature: Signature | None = None


def signature_of(name: str, role: str) -> Signature:
    """A signature at this moment."""
    return Signature(name, role, datetime.now(UTC).isoformat(timespec="seconds"))


def new_record(origin: Origin, findings: Sequence[PigmentFinding], results: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record without checksums of files. `results` are other results by name, such as the results of a
    map."""
    library = origin.library
    signature = origin.signature
    record: dict[str, Any] = {
        "kind": _KIND,
        "schema_version": _VERSION,
        "software": f"coupole {coupole.__version__}",
        "written_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "facts": dict(origin.facts),
        "simulated": origin.is_simulated,
        "inputs": dict(origin.inputs),
        "library": {
            "name": library.name, "files": dict(library.files), "spectra": library.spectra,
            "classes": library.classes, "table": library.table, "licence": library.licence or None,
        },
        "findings": [finding_document(finding) for finding in findings],
        **results,
        "signature": None
        if signature is None
        else {"name": signature.name, "role": signature.role, "time_utc": signature.time_utc},
    }  # fmt: skip
    return record | {"content_sha256": _digest(record)}


def write_record(folder: Path, record: dict[str, Any], files: Sequence[Path]) -> Path:
    """Write a record with the checksums of the files in its folder. Raises StorageError."""
    path = folder / RECORD
    try:
        whole = record | {"files": {file.name: sha256(file) for file in files}}
        whole["sha256"] = _digest(whole)
        write_synced(path, json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    return path


@dataclass(frozen=True)
class RecordCheck:
    """Result of the check of a record."""

    signature: Signature | None
    files: int
    """Number of files that were compared."""
    problems: tuple[str, ...]
    """Changes, as sentences; none if everything is as it was written."""


def is_record(folder: Path) -> bool:
    """Tell whether a folder has a record of an identification."""
    return (folder / RECORD).is_file()


def check_record(folder: Path) -> RecordCheck:
    """Compare a record and the files beside it with their checksums.

    Raises InputError if the file is not a record of an identification.
    """
    path = folder / RECORD
    try:
        whole = read_json(path)
    except OSError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    if not isinstance(whole, dict) or whole.get("kind") != _KIND or not isinstance(whole.get("files"), dict):
        raise InputError(f"{path}: expected a record of an identification with checksums, found something else")
    problems = []
    if _digest({key: value for key, value in whole.items() if key != "sha256"}) != whole.get("sha256"):
        problems.append(f"{RECORD}: its content does not match its checksum: it was changed after it was written")
    content = {key: value for key, value in whole.items() if key not in _SUMS}
    if _digest(content) != whole.get("content_sha256"):
        problems.append(f"{RECORD}: its content does not match the checksum that the page prints")
    for name, digest in whole["files"].items():
        try:
            if Path(name).name != name:
                raise OSError("its name is not the name of a file in this folder")
            if sha256(folder / name) != digest:
                problems.append(f"{name}: it was changed after the record was written")
        except OSError as error:
            problems.append(f"{name}: {reason(error)}")
    signature_words = whole.get("signature")
    signature = None
    if isinstance(signature_words, dict):
        signature = Signature(*(str(signature_words.get(key, "")) for key in ("name", "role", "time_utc")))
    return RecordCheck(signature, len(whole["files"]), tuple(problems))


def finding_document(finding: PigmentFinding) -> dict[str, Any]:
    """Return a finding as JSON's values."""
    evidence, rates = finding.evidence, finding.rates
    return {
        "name": finding.name,
        "verdict": finding.verdict,
        "class": finding.class_name,
        "candidates": [
            {"name": candidate.name, "class": candidate.class_name, "probability": candidate.probability}
            for candidate in finding.candidates
        ],
        "not_in_library": finding.not_in_library,
        "mixture": [
            {"name": part.name, "class": part.class_name, "share": part.share, "interval": list(part.interval)}
            for part in finding.parts
        ],
        "reason": finding.reason,
        "remarks": list(finding.remarks),
        "evidence": {
            "wavelengths_nm": evidence.wavelengths_nm.tolist(),
            "log_odds_first_against_second": evidence.log_odds.tolist(),
        },
        "near_infrared": finding.near_infrared,
        "held_out": {
            "first_class_right": _rate(rates.right),
            "match_right": _rate(rates.matches),
            "match_wrong": _rate(rates.false_matches),
            "unknown_without_the_class": _rate(rates.unknown),
        },
    }


def _rate(rate: Rate) -> dict[str, Any]:
    return {"count": rate.count, "of": rate.of, "interval_95": list(rate.interval)}


def _digest(content: Mapping[str, Any]) -> str:
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(canonical.encode()).hexdigest()
