"""Proofs of the samples that replace discarded frames: `proofs.jsonl` in the folder of their result.

Each line has the digest of a view's file of samples. The digest was taken from the written data, and was the same
when the file was read back. Another line is added before the file is replaced. This happens when light from
surface to surface is subtracted from the samples, and when samples that contradict others are left out.
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
    """True for samples that were taken from frames. Their file may have replaced an earlier one."""


def has_proofs(result: Path) -> bool:
    """Tell whether samples of a result replace discarded frames, or may do so later."""
    return (result / NAME).exists()


def proofs_of(result: Path, view: str) -> list[str]:
    """Return the digests that the samples of a view have had, in the order of time. A line that a crash has cut is
    ignored. Raises StorageError for a line that is not a proof."""
    digests: list[str] = []
    for proof in _read_proofs(result / NAME):
        if proof.view == view:
            digests = [proof.digest] if proof.is_first else [*digests, proof.digest]
    return digests


def prove(result: Path, view: str, digest: str) -> None:
    """Read the samples of a view back, compare them with the written data, whose `digest` is given, and note the
    digest. Raises ChecksumMismatch if they differ, StorageError."""
    path = samples_path(result, view)
    if digest_on_disk(path) != digest:
        raise ChecksumMismatch(
            f"{path}: read back, it differs from what was written. Its frames are kept; check disk and "
            "memory of this machine, then take the samples again"
        )
    note(result, view, digest, is_first=True)


def note(result: Path, view: str, digest: str, *, is_first: bool = False) -> None:
    """Note a digest that was confirmed by reading back. It is on the disk when this returns. Raises
    StorageError."""
    about = {"t": utc_now(), "view": view, "digest": digest, "is_first": is_first}
    file = LineFile(result / NAME)
    try:
        file.append([json.dumps(about) + "\n"])
    finally:
        file.close()


def problem_of(result: Path, view: str, first: str) -> str:
    """Return the fault of a view's samples on the disk, which were proven with the digest `first`; empty if there
    is none."""
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
        return f"{path}: differs from what was proven: it was changed, or the disk failed. Put it back from a copy"
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
