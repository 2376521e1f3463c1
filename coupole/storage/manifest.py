"""`manifest.sha256`: SHA-256 of a run's files; in the run's folder `sha256sum -c manifest.sha256` checks it.

At every moment, and after a crash, all files that it lists are on the disk and unchanged. A session writes
journal, views and report. So these files are taken out of the list before the session begins, and entered when
they are complete. `verify --manifest` enters files that are not listed yet.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import threading
from collections.abc import Callable, Iterable
from collections.abc import Set as AbstractSet
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from coupole.errors import StorageError, reason
from coupole.intake.regular_file import open_regular
from coupole.storage.disk_errors import disk_error
from coupole.storage.durable import sha256, write_synced
from coupole.storage.inner_path import inner

NAME = "manifest.sha256"
VIEWS = "views"
_CHANGING = ("journal.jsonl", "report.html")
_UNFINISHED = (".part", ".archive")
_CHUNK_BYTES = 4 * 2**20

Progress = Callable[[int, int], None]
"""Called with the number of files hashed so far, and the number of all files."""

_DIGEST = re.compile(r"[0-9a-f]{64}")


def read_checksums(run: Path) -> dict[str, str]:
    """Return the SHA-256 by path in the run; empty without a manifest. Raises StorageError for a line of another
    kind."""
    path = run / NAME
    try:
        with open_regular(path) as file:
            lines = file.read().decode().splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise StorageError(f"{path}: cannot be read: {reason(error)}") from error
    digests = {}
    for number, line in enumerate(lines, 1):
        digest, _, name = line.partition("  ")
        if not _DIGEST.fullmatch(digest) or not name:
            raise StorageError(f"{path}: line {number} is not a SHA-256, two spaces, and a file")
        try:
            digests[inner(name)] = digest
        except ValueError as error:
            raise StorageError(f"{path}: line {number}: {error}, found {name!r:.200}") from error
    return digests


def files(run: Path) -> list[str]:
    """Return every file that a manifest can list, sorted. Unfinished files and the manifest itself are left
    out."""
    names = [str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()]
    return sorted(name for name in names if name != NAME and not name.endswith(_UNFINISHED))


def begin(run: Path) -> None:
    """List the files of a new run, which its sessions will not change."""
    _write(run, {name: sha256(run / name) for name in files(run)})


def open_for_session(run: Path, complete_views: Iterable[str]) -> None:
    """Take out the files that a session may write, before it begins. `complete_views` are files of views that it
    will not open."""
    kept_names = set(complete_views)
    forget(run, [name for name in read_checksums(run) if _written_by_sessions(name) and name not in kept_names])


def forget(run: Path, names: Iterable[str]) -> None:
    """Take files out of the list before they change. Nothing happens without a manifest."""
    digests, forgotten_names = read_checksums(run), set(names)
    if forgotten_names & digests.keys():
        _write(run, {name: digest for name, digest in digests.items() if name not in forgotten_names})


def _written_by_sessions(name: str) -> bool:
    return name in _CHANGING or name.startswith(f"{VIEWS}/")


def enter(
    run: Path,
    names: Iterable[str],
    progress: Progress = lambda done, total: None,
    on_read: Callable[[], None] = lambda: None,
) -> None:
    """Hash these files at low priority and list them; `on_read` is called after every 4 MiB. Raises
    StorageError."""
    entered_names = list(names)
    digests = read_checksums(run)
    stop = threading.Event()
    with ThreadPoolExecutor(1, "manifest", initializer=_yield_to_others) as hashing:
        try:
            for count, name in enumerate(entered_names):
                progress(count, len(entered_names))
                digests[name] = hashing.submit(_synced_sha256, run / name, stop, on_read).result()
        finally:
            stop.set()
    _write(run, digests)
    progress(len(entered_names), len(entered_names))


def _yield_to_others() -> None:
    """Give the calling thread the lowest priority; on Linux a thread has its own priority."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 19)


def _synced_sha256(path: Path, stop: threading.Event, on_read: Callable[[], None]) -> str:
    """Sync a file, then hash it: the manifest must not list more than the disk has."""
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            os.fsync(file.fileno())
            while (chunk := file.read(_CHUNK_BYTES)) and not stop.is_set():
                digest.update(chunk)
                on_read()
    except OSError as error:
        raise disk_error(path, error) from error
    return digest.hexdigest()


def problems(
    run: Path, progress: Progress = lambda done, total: None, *, only: AbstractSet[str] | None = None
) -> dict[str, str]:
    """Return the faults of listed files by name: a file is missing or has changed. With `only`, check only these
    files."""
    digests, messages = read_checksums(run), {}
    digests = {name: digest for name, digest in digests.items() if only is None or name in only}
    for count, (name, digest) in enumerate(digests.items()):
        progress(count, len(digests))
        try:
            same = sha256(run / name) == digest
        except OSError as error:
            messages[name] = f"{name}: is in {NAME}, but cannot be read: {error.strerror}"
        else:
            if not same:
                messages[name] = f"{name}: is not what {NAME} lists: it was changed, or the disk failed"
    return messages


def unlisted_files(run: Path) -> list[str]:
    """Return files that the manifest does not cover yet."""
    digests = read_checksums(run)
    return [name for name in files(run) if name not in digests]


def _write(run: Path, checksums: dict[str, str]) -> None:
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(checksums.items()))
    try:
        write_synced(run / NAME, text)
    except OSError as error:
        raise disk_error(run / NAME, error) from error
