"""The run's journal: one JSON object per line. Lines are appended and never changed. Only this module reads or
writes them.

A `frame` line means that a shot is proven and its bytes are on disk. So lines are held back until `commit()`. The
caller calls it after it has synced the frames; then the lines are written and synced too.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from coupole.errors import InputError, StorageError
from coupole.intake.plain_data import NotDataError, json_of
from coupole.intake.regular_file import open_regular
from coupole.storage.journal_events import JOURNAL_VERSION, Event, JournalBegun
from coupole.storage.line_file import LineFile

FRAME_LINE = '{"event":"frame"'
"""Beginning of the line of a proven frame."""
_EVENT: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])


class Journal:
    """Appends events; `commit()` makes them durable."""

    def __init__(self, path: Path) -> None:
        self._file = LineFile(path)
        self._lines: list[str] = []
        self._writing = threading.Lock()
        self._head = [event_line(JournalBegun())] if self._file.was_empty else []

    def write(self, event: Event) -> None:
        """Add an event; the next `commit()` writes it to the disk."""
        self._lines.append(event_line(event))

    def take(self) -> list[str]:
        """Return the lines that were added since the last call. The caller must pass them to `append`."""
        lines, self._lines = self._lines, []
        return lines

    def commit(self) -> None:
        """Write and sync the added events. Raises DiskFull or StorageError; then none of these events is valid."""
        self.append(self.take())

    def append(self, lines: list[str]) -> None:
        """Write and sync lines from `take` or from `event_line`. Several threads may call this."""
        if not lines:
            return
        with self._writing:
            self._file.append([*self._head, *lines])
            self._head = []

    @property
    def is_at_its_path(self) -> bool:
        """False if the journal, or its run's folder, was moved, removed or replaced since it was opened."""
        return self._file.is_at_its_path

    @property
    def place(self) -> Path | None:
        """Path where the file is now; None if it was removed, or if the path cannot be found."""
        return self._file.place

    def close(self) -> None:
        self._file.close()


def append_lines(path: Path, lines: list[str]) -> None:
    """Append lines of `Journal.take` to the journal, and sync them. Raises DiskFull or StorageError."""
    file = LineFile(path)
    try:
        head = [event_line(JournalBegun(t=json_of(lines[0].encode(), str(path))["t"]))] if file.was_empty else []
        file.append([*head, *lines])
    finally:
        file.close()


def event_line(event: Event) -> str:
    """The line of an event: its tag, its time, and its other fields."""
    fields = event.model_dump(mode="json")
    first = {"event": fields.pop("event"), "t": fields.pop("t")}
    return json.dumps({**first, **fields}, separators=(",", ":")) + "\n"


def read_events(path: Path) -> Iterator[Event]:
    """Yield the events of a journal, also of a journal by version 0.1; none if there is no journal yet.

    A line truncated by a crash is skipped: its event was not committed. Raises StorageError for a complete line
    that is not an event, and for a journal of a later version.
    """
    try:
        with open_regular(path) as file:
            yield from _events(path, file)
    except FileNotFoundError:
        return
    except OSError as error:
        raise StorageError(f"{path}: cannot read the journal: {error.strerror}") from error


def tail(path: Path, most_bytes: int) -> list[Event]:
    """Return the events in the last `most_bytes` of a journal; none if there is no journal."""
    try:
        with open_regular(path) as file:
            offset = max(0, path.stat().st_size - most_bytes)
            file.seek(offset)
            lines = file.read(most_bytes).splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path}: cannot read the journal: {error.strerror}") from error
    return list(_events(path, lines[1:] if offset else lines))


class Follower:
    """Reads new events of a journal while another process writes it."""

    def __init__(self, path: Path) -> None:
        self._path, self._read = path, 0

    def news(self) -> list[Event]:
        """Return the events since the last call; the first call returns all events. Raises StorageError."""
        try:
            with open_regular(self._path) as file:
                file.seek(self._read)
                whole, newline, _ = file.read().rpartition(b"\n")
        except FileNotFoundError:
            return []
        except OSError as error:
            raise StorageError(f"{self._path}: cannot read the journal: {error.strerror}") from error
        self._read += len(whole) + len(newline)
        return list(_events(self._path, whole.splitlines()))


def version(path: Path) -> int:
    """Return the version of a journal; the current one if the journal does not exist yet."""
    first = next(read_events(path), None)
    if first is None:
        return JOURNAL_VERSION
    return first.version if isinstance(first, JournalBegun) else 1


def _events(path: Path, lines: Iterable[bytes]) -> Iterator[Event]:
    for number, line in enumerate(lines, 1):
        try:
            fields = json_of(line, str(path), line=number, allow_nan=True)
        except NotDataError:
            continue
        except InputError as error:
            raise StorageError(f"{error}. Was the journal changed?") from error
        try:
            event = _EVENT.validate_python(_of_today(fields))
        except ValidationError as error:
            problem = error.errors()[0]
            raise StorageError(
                f"{path}: line {number} is not an event of a journal that this version knows "
                f"({'.'.join(map(str, problem['loc']))}: {problem['msg']}). Was it changed, or written by a "
                "later version?"
            ) from error
        if isinstance(event, JournalBegun) and event.version > JOURNAL_VERSION:
            raise StorageError(
                f"{path}: a journal of version {event.version}; this program reads {JOURNAL_VERSION} at most. "
                "Use the version of coupole that run.json names."
            )
        yield event


def _of_today(fields: Any) -> Any:
    """Return a line's fields in the current version. In version 1, `resume` with `after` meant the end of a
    pause."""
    if isinstance(fields, dict) and fields.get("event") == "resume" and fields.get("after") == "pause":
        return {"event": "continue", "t": fields.get("t", "")}
    return fields
