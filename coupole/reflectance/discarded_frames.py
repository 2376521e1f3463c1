"""Results of runs whose frames are discarded once their samples are safe (`discard: after_fit`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from coupole.errors import ChecksumMismatch, FrameDiscarded, InputError
from coupole.reflectance.result_folder import complete, in_the_making
from coupole.storage import manifest
from coupole.storage.array_digest import digest_on_disk
from coupole.storage.discarding import (
    append_to_journal,
    discard,
    discarded_views,
    finish,
    place_of_result,
    reason_to_keep,
    to_discard,
)
from coupole.storage.processing import default_result, go_on_command
from coupole.storage.run import Run
from coupole.storage.run_status import is_complete
from coupole.storage.sample_proofs import has_proofs, note, problem_of, proofs_of, prove, samples_path

_LOCK_NAP_S = 0.2
_MOST_HASHED_BYTES = 2_000_000_000
"""Files of views that are larger than this are hashed only by `verify --manifest`."""


# -- the result that stands for the frames --------------------------------------------------------------------


def refuse_without_frames(run: Run, out: Path) -> None:
    """Raise FrameDiscarded if frames of a run were discarded for the samples of another result. Raise StorageError
    if the samples of this result differ from the proven ones."""
    for view, event in discarded_views(run).items():
        result = place_of_result(run, event)
        if result.resolve() != out.resolve():
            raise FrameDiscarded(
                f"{run.folder}: {len(event.frames)} frames of the view {view} were discarded when their samples "
                f"were safe, as its plan says (`discard: after_fit`). Only {result} has these samples: go on with "
                f"`{go_on_command(run.folder, result)}`. A result with other settings needs a run of its own"
            )
        if problem := problem_of(result, view, event.digest):
            raise ChecksumMismatch(f"{problem}. It replaces {len(event.frames)} discarded frames of {run.folder}")


def refuse_texels(run: Run, out: Path) -> None:
    """Raise FrameDiscarded if texels are requested for a run whose frames are discarded, or will be for this
    result: texels need the frames of all LEDs."""
    if discarded_views(run) or is_for_discarding(run, out):
        raise FrameDiscarded(
            f"--texels: needs the frames of all LEDs, and the frames of {run.folder} are "
            f"discarded, or will be, as its "
            "plan says (`discard: after_fit`). Nothing was changed. Give the command without --texels, or acquire "
            "the object by a plan without `discard`"
        )


# -- proof, and what follows from it --------------------------------------------------------------------------


def prove_written(out: Path, view: str, digest: str) -> None:
    """Read the samples of a view back, and note this proof. If they differ from the written ones, they are taken
    again the next time. Raises ChecksumMismatch, StorageError."""
    try:
        prove(out, view, digest)
    except ChecksumMismatch:
        samples_path(out, view).with_suffix(".json").unlink(missing_ok=True)
        raise


def read_back_again(out: Path, view: str) -> str:
    """Return the digest of a view's samples that an earlier process has proven, if they are unchanged; empty if
    they were never proven. Raises ChecksumMismatch, StorageError."""
    proofs = proofs_of(out, view)
    if not proofs:
        return ""
    if problem := problem_of(out, view, proofs[0]):
        raise ChecksumMismatch(problem)
    return proofs[0]


def read_back_or_drop(out: Path, view: str) -> str:
    """Do the same as `read_back_again` for a view whose frames are there. If the samples have changed, they are
    marked to be taken again, and the returned text is empty."""
    try:
        return read_back_again(out, view)
    except ChecksumMismatch:
        samples_path(out, view).with_suffix(".json").unlink(missing_ok=True)
        return ""


def rewrite(path: Path, write: Callable[[Path], Any]) -> None:
    """Replace a view's file of samples, as `complete` does. If the file may stand for discarded frames, the old
    file is compared with its proof first. The new file is read back and noted before it replaces the old one.
    Raises ChecksumMismatch, StorageError, OSError."""
    out, view = path.parents[1], path.stem
    if not has_proofs(out):
        complete(path, write)
        return
    read_back_again(out, view)
    with in_the_making(path) as part:
        write(part)
        digest = digest_on_disk(part)
        if digest_on_disk(part) != digest:
            raise ChecksumMismatch(f"{part}: differs each time it is read; check disk and memory of this machine")
        note(out, view, digest)


def discard_complete(run: Run, out: Path, say: Callable[[str, int, int], object]) -> None:
    """Discard the frames that a run's plan names, after its last session, for all views whose samples in its
    result are safe. Also finish a discard that a crash has interrupted. Waits while a session holds the run.
    Raises StorageError."""
    if not is_complete(run.folder):
        return
    with _hold_when_free(run):
        finish(run)
        views = [view for view in run.views if view not in discarded_views(run)]
        for count, view in enumerate(views, start=1):
            if reason_to_keep(run, view) or not samples_path(out, view).exists():
                continue
            if not (digest := read_back_or_drop(out, view)):
                raise ChecksumMismatch(
                    f"{samples_path(out, view)}: is not what was written. Its frames are kept; give the command "
                    "again: the samples are taken again"
                )
            if (event := to_discard(run, view, out.resolve(), digest)) is not None:
                _forget(run, view)
                discard(run, event, append_to_journal(run))
            say("frames discarded", count, len(views))
        _enter_finished(run)


def refuse_stale(discarded_names: Collection[str], view: str, out: Path) -> None:
    """Raise InputError if samples that are to be removed stand for discarded frames."""
    if view in discarded_names:
        raise InputError(
            f"{samples_path(out, view)}: does not belong to the frames that the run has now, and cannot be taken "
            "again, because frames were discarded. Nothing was changed: was the journal, a record or the mesh "
            "changed? Put back what was there"
        )


def is_for_discarding(run: Run, out: Path) -> bool:
    """Tell whether frames of a run are discarded once this result has their samples. This is true if the plan says
    so and the run was acquired for this result."""
    asked_result = run.asked_result or default_result(run.folder)
    if not asked_result.is_dir():  # both may have been moved together
        asked_result = run.folder.with_name(asked_result.name)
    return run.discards and asked_result.resolve() == out.resolve()


@contextmanager
def _hold_when_free(run: Run) -> Iterator[None]:
    """Wait until no session has the run's lock, then hold the lock."""
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(run.hold_lock())
                break
            except InputError:
                time.sleep(_LOCK_NAP_S)
        yield


def _forget(run: Run, view: str) -> None:
    """Remove the journal and a view's file from the manifest, before they change."""
    paths = run.journal_path, run.view_path(view)
    manifest.forget(run.folder, [str(path.relative_to(run.folder)) for path in paths])


def _enter_finished(run: Run) -> None:
    """Add files to the manifest, if they will not change any more and are not too large."""
    paths = [run.journal_path, *map(run.view_path, run.views)]
    listed_names = manifest.read_checksums(run.folder)
    names = {str(path.relative_to(run.folder)): path.stat().st_size for path in paths if path.is_file()}
    manifest.enter(
        run.folder,
        [name for name, size in names.items() if name not in listed_names and size < _MOST_HASHED_BYTES],
    )
