"""The run's diary: one JSON object a line, appended, never changed. The only module that writes or reads it.

A `frame` line stands for a proven shot whose bytes are on disk. So lines are kept back until `commit()`, which
the caller calls after it has synced the frames; then lines are written and synced too.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError

from coupole.errors import StorageError
from coupole.storage.journal_events import JOURNAL_VERSION, Event, JournalBegun
from coupole.storage.line_file import LineFile

_EVENT: TypeAdapter[Event] = TypeAdapter(Annotated[Event, Field(discriminator="event")])


class Journal:
    """Append events; `commit()` makes them last."""

    def __init__(self, path: Path) -> None:
        self._file = LineFile(path)
        self._lines: list[str] = []
        self._begun = not self._file.was_empty

    def write(self, event: Event) -> None:
        """Note an event; it reaches the disk with the next `commit()`."""
        self._lines.append(event_line(event))

    def take(self) -> list[str]:
        """The lines noted since the last time; they are the caller's now, to be handed to `append`."""
        lines, self._lines = self._lines, []
        return lines

    def commit(self) -> None:
        """Write and sync what was noted. Raises DiskFull or StorageError; then nothing of it counts."""
        self.append(self.take())

    def append(self, lines: list[str]) -> None:
        """Write and sync lines that were taken; may run on another thread than `write` and `take`."""
        if not lines:
            return
        begin = [] if self._begun else [event_line(JournalBegun())]
        self._file.append([*begin, *lines])
        self._begun = True

    def close(self) -> None:
        self._file.close()


def event_line(event: Event) -> str:
    """The line of an event: its tag, its time, and what else it says."""
    fields = event.model_dump(mode="json")
    first = {"event": fields.pop("event"), "t": fields.pop("t")}
    return json.dumps({**first, **fields}, separators=(",", ":")) + "\n"


def read(path: Path) -> Iterator[Event]:
    """Events of a journal, also of one that version 0.1 wrote; none if there is no journal yet.

    A line torn by a crash is passed over: what it said did not count yet. Raises StorageError for a line that is
    whole and says something else than an event, and for a journal of a later version.
    """
    try:
        with path.open("rb") as file:
            yield from _events(path, file)
    except FileNotFoundError:
        return
    except OSError as error:
        raise StorageError(f"{path}: cannot read the journal: {error.strerror}") from error


def tail(path: Path, most_bytes: int) -> list[Event]:
    """The last events of a journal, as far as they lie in its last `most_bytes`; none if there is no journal."""
    try:
        with path.open("rb") as file:
            begun = max(0, path.stat().st_size - most_bytes)
            file.seek(begun)
            lines = file.read(most_bytes).splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"{path}: cannot read the journal: {error.strerror}") from error
    return list(_events(path, lines[1:] if begun else lines))


def version(path: Path) -> int:
    """Of the journal as it was begun; that of today for one that is not begun yet."""
    first = next(read(path), None)
    if first is None:
        return JOURNAL_VERSION
    return first.version if isinstance(first, JournalBegun) else 1


def _events(path: Path, lines: Iterable[bytes]) -> Iterator[Event]:
    for number, line in enumerate(lines, 1):
        try:
            fields = json.loads(line)
        except (json.JSONDecodeError, UnicodeDecodeError):
            continue
        try:
            event = _EVENT.validate_python(_of_today(fields))
        except ValidationError as error:
            what = error.errors()[0]
            raise StorageError(
                f"{path}: line {number} is no event of a journal that this version knows "
                f"({'.'.join(map(str, what['loc']))}: {what['msg']}). Was it changed, or is it of a later version?"
            ) from error
        if isinstance(event, JournalBegun) and event.version > JOURNAL_VERSION:
            raise StorageError(
                f"{path}: a journal of version {event.version}; this program reads {JOURNAL_VERSION} at most. "
                "Use the version of coupole that run.json names."
            )
        yield event


def _of_today(fields: Any) -> Any:
    """What a line says in the words of today: in version 1 `resume` with `after` meant the end of a pause."""
    if isinstance(fields, dict) and fields.get("event") == "resume" and fields.get("after") == "pause":
        return {"event": "continue", "t": fields.get("t", "")}
    return fields
