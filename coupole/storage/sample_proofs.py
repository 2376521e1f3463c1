"""Proofs of the samples that stand for discarded frames: `proofs.jsonl` in the folder of their result.

Each line has the digest of a view's file of samples, taken from what was written, and found again when the file
was read back. A line more is added, before the file is replaced, when light from surface to surface is taken off
the samples, and when those that contradict others are left out.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from coupole.errors import ChecksumMismatch, InputError, StorageError
from coupole.intake.plain_data import json_of
from coupole.storage.array_digest import digest_on_disk
from coupole.storage.line_file import LineFile, utc_now

NAME = "proofs.jsonl"
SAMPLES = "samples"


@dataclass(frozen=True)
class Proof:
    """One line."""

    view: str
    digest: str
    is_first: bool
    """True for samples that were taken from frames, whose file may have replaced an earlier one."""


def has_proofs(result: Path) -> bool:
    """Tell whether samples of a result stand, or may come to stand, for frames that are discarded."""
    return (result / NAME).exists()


def proofs_of(result: Path, view: str) -> list[str]:
    """Digests that the samples of a view have had since they were taken, the first first. A line that a crash has
    cut is no proof. Raises StorageError for what is no proof."""
    digests: list[str] = []
    for proof in _read_proofs(result / NAME):
        if proof.view == view:
            digests = [proof.digest] if proof.is_first else [*digests, proof.digest]
    return digests


def prove(result: Path, view: str, digest: str) -> None:
    """Read the samples of a view back, compare them with what was written, whose `digest` is given, and note it.
    Raises ChecksumMismatch if they differ, StorageError."""
    path = samples_path(result, view)
    if digest_on_disk(path) != digest:
        raise ChecksumMismatch(
            f"{path}: read back, it differs from what was written. Its frames are kept; check disk and "
            "memory of this machine, then take the samples again"
        )
    note(result, view, digest, is_first=True)


def note(result: Path, view: str, digest: str, *, is_first: bool = False) -> None:
    """Note a digest that was found again; on the disk when this returns. Raises StorageError."""
    about = {"t": utc_now(), "view": view, "digest": digest, "is_first": is_first}
    file = LineFile(result / NAME)
    try:
        file.append([json.dumps(about) + "\n"])
    finally:
        file.close()


def problem_of(result: Path, view: str, first: str) -> str:
    """Return what is wrong with the samples of a view, read from the disk, that were proven with the digest
    `first`; empty if nothing is."""
    path = samples_path(result, view)
    if not path.is_file():
        return f"{path} is missing: put it back from a copy; nothing else has these samples"
    try:
        proofs, present_digest = proofs_of(result, view), digest_on_disk(path)
    except (StorageError, OSError) as error:
        return str(error)
    if not proofs or proofs[0] != first:
        return f"{result / NAME}: does not have the proof of the view {view} that the run's journal names"
    if present_digest not in proofs:
        return f"{path}: is not what was proven: it was changed, or the disk failed. Put it back from a copy"
    return ""


def samples_path(result: Path, view: str) -> Path:
    """The file of a view's samples."""
    return result / SAMPLES / f"{view}.h5"


def _read_proofs(path: Path) -> list[Proof]:
    try:
        lines = path.read_bytes().splitlines(keepends=True)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path}: cannot be read: {error.strerror}") from error
    proofs = []
    for number, line in enumerate(lines, 1):
        if not line.strip() or (number == len(lines) and not line.endswith(b"\n")):
            continue
        try:
            fields = json_of(line, str(path), line=number)
            proofs.append(Proof(str(fields["view"]), str(fields["digest"]), bool(fields["is_first"])))
        except (InputError, KeyError, TypeError) as error:
            raise StorageError(f"{path}: line {number} is not a proof of samples: {error}") from error
    return proofs
