"""The chain from a cell's records to certificates: which record was made from which others, and where the chain is
broken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from coupole.calibration.artefact import NOT_TRACEABLE
from coupole.calibration.in_force import InForce, read_in_force
from coupole.calibration.record import Kind, records_named
from coupole.calibration.traceability import is_traceable, trace_of
from coupole.storage.durable import sha256

NEEDS: dict[Kind, tuple[Kind, ...]] = {"leds": ("hand-eye",), "mesh": ("hand-eye",), "drift": ("led-power",)}
"""Kinds of records that are valid only together with a record of another kind."""


@dataclass(frozen=True)
class ChainLink:
    """A record in the chain."""

    item: InForce
    file_sha256: str
    made_from: tuple[str, ...]
    """Names of the records that it was made from."""
    traces: tuple[str, ...]
    """Its artefacts and their certificates."""
    gaps: tuple[str, ...]
    """Reasons why its chain does not end at certificates."""


def chain_of(paths: Sequence[Path]) -> tuple[ChainLink, ...]:
    """Return the records, and the records beside them that they were made from. Raises InputError."""
    records_by_digest: dict[str, InForce] = {}
    waiting = [*read_in_force(records_named(list(paths)))]
    beside: dict[str, InForce] = {}
    for folder in dict.fromkeys(item.path.parent for item in waiting):
        beside |= {sha256(item.path): item for item in read_in_force(records_named([folder]))}
    while waiting:
        item = waiting.pop(0)
        digest = sha256(item.path)
        if digest not in records_by_digest:
            records_by_digest[digest] = item
            waiting += [beside[line.sha256] for line in item.record.inputs if line.sha256 in beside]
    return tuple(_link(digest, item, records_by_digest) for digest, item in records_by_digest.items())


def _link(digest: str, item: InForce, records_by_digest: dict[str, InForce]) -> ChainLink:
    record = item.record
    made_from = [records_by_digest[line.sha256] for line in record.inputs if line.sha256 in records_by_digest]
    return ChainLink(
        item,
        digest,
        tuple(f"{source_record.record.kind} {source_record.record.name}" for source_record in made_from),
        trace_of(record),
        tuple(dict.fromkeys(_gaps(item, records_by_digest))),
    )


def _gaps(item: InForce, records_by_digest: dict[str, InForce]) -> list[str]:
    """Return gaps in a record's chain: its own gaps, and the gaps of all records from which it was made."""
    record = item.record
    name = f"{record.kind} {record.name}"
    made_from = [records_by_digest[line.sha256] for line in record.inputs if line.sha256 in records_by_digest]
    gaps = [] if is_traceable(record) else [f"{name}: {NOT_TRACEABLE}"]
    lost_kinds = set(NEEDS.get(record.kind, ())) - {source_record.record.kind for source_record in made_from}
    gaps += [
        f"{name}: its {kind} record is not among the given ones, nor beside them" for kind in sorted(lost_kinds)
    ]
    for source_record in made_from:
        gaps += _gaps(source_record, records_by_digest)
    return gaps
