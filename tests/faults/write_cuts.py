"""What a disk holds after the power failed at any moment of a recorded session.

`read` reads the log of `recorded_writes.c`. `Disk` replays it up to a cut: what was synced is there; each write
after the last sync of its file is there, or not, or torn, whatever the order they were made in. Sectors of 512
bytes are written whole or not at all. Names in a folder reach the disk in their order, at the latest with the
folder's sync: a file's own sync does not bring its name there.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

SECTOR = 512
_ENTRY = struct.Struct("<IIQQII")
OPEN, WRITE, TRUNCATE, ALLOCATE, SYNC, RENAME, UNLINK, MKDIR, LINK, UNKNOWN = range(1, 11)
CHANGING = (WRITE, TRUNCATE, ALLOCATE, RENAME, UNLINK, MKDIR, LINK)


@dataclass(frozen=True)
class Call:
    """One call; `path` is the name that the file had when it was opened."""

    op: int
    path: str = ""
    second: str = ""
    offset: int = 0
    bytes: int = 0
    data: bytes = b""
    handle: int = 0


def read(log: Path) -> list[Call]:
    """All calls of the log, in order; of a write the file's name is that of its `open`."""
    raw, at, calls = log.read_bytes(), 0, []
    opened: dict[int, str] = {}
    while at < len(raw):
        op, handle, offset, count, name_bytes, second_bytes = _ENTRY.unpack_from(raw, at)
        at += _ENTRY.size
        name, second = raw[at : at + name_bytes].decode(), raw[at + name_bytes :][:second_bytes].decode()
        at += name_bytes + second_bytes
        data = raw[at : at + count] if op == WRITE else b""
        at += len(data)
        if op == OPEN:
            opened[handle] = name
        calls.append(Call(op, name or opened.get(handle, ""), second, offset, count, data, handle))
    return calls


@dataclass(eq=False)
class _File:
    """One file: what is synced, and the calls since."""

    synced: bytearray = field(default_factory=bytearray)
    since: list[Call] = field(default_factory=list)


@dataclass(eq=False)
class _Folder:
    names: dict[str, _File | _Folder] = field(default_factory=dict)
    """As the process sees them."""
    synced: dict[str, _File | _Folder] = field(default_factory=dict)
    since: list[dict[str, _File | _Folder]] = field(default_factory=list)
    """The names after each change since the last sync."""


class Disk:
    """The files under `root` during a recorded session."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._top = _Folder()
        self._handles: dict[int, _File | _Folder] = {}

    def after(self, call: Call) -> None:
        """Carry out the next call."""
        if call.op == OPEN:
            self._open(call)
        elif call.op == SYNC:
            _sync(self._handles[call.handle])
        elif call.op in (WRITE, ALLOCATE) or (call.op == TRUNCATE and call.handle):
            file = self._handles[call.handle]
            assert isinstance(file, _File)
            file.since.append(call)
        elif call.op == TRUNCATE:
            file = self._at(call.path)
            assert isinstance(file, _File)
            file.since.append(call)
        elif call.op == MKDIR:
            self._name(call.path, _Folder())
        elif call.op == LINK:
            self._name(call.second, self._at(call.path))
        elif call.op == UNLINK:
            self._name(call.path, None)
        elif call.op == RENAME:
            self._rename(call.path, call.second)
        else:
            raise AssertionError(f"a way to write that is not replayed: {call.path}")

    def _open(self, call: Call) -> None:
        found = self._find(call.path)
        if found is None and call.offset:  # O_CREAT
            found = _File()
            self._name(call.path, found)
        assert found is not None, call.path
        if call.bytes and isinstance(found, _File):  # O_TRUNC
            found.since.append(Call(TRUNCATE, call.path, offset=0))
        self._handles[call.handle] = found

    def _parts(self, path: str) -> list[str]:
        return [part for part in path.removeprefix(self._root).split("/") if part]

    def _find(self, path: str) -> _File | _Folder | None:
        at: _File | _Folder | None = self._top
        for part in self._parts(path):
            at = at.names.get(part) if isinstance(at, _Folder) else None
        return at

    def _at(self, path: str) -> _File | _Folder:
        found = self._find(path)
        assert found is not None, path
        return found

    def _name(self, path: str, what: _File | _Folder | None) -> None:
        *parents, name = self._parts(path)
        folder = self._at("/".join([self._root, *parents]))
        assert isinstance(folder, _Folder)
        folder.names = {key: value for key, value in folder.names.items() if key != name}
        if what is not None:
            folder.names[name] = what
        folder.since.append(folder.names)

    def _rename(self, path: str, to: str) -> None:
        """Atomic: both names change at once, as both are in one folder here."""
        *parents, old = self._parts(path)
        *others, new = self._parts(to)
        assert parents == others, "renamed into another folder"
        folder = self._at("/".join([self._root, *parents]))
        assert isinstance(folder, _Folder)
        moved = folder.names[old]
        folder.names = {key: value for key, value in folder.names.items() if key != old} | {new: moved}
        folder.since.append(folder.names)

    # -- what is on it ------------------------------------------------------------------------------------

    def as_the_process_sees_it(self, to: Path) -> None:
        """After kill -9: the operating system writes everything."""
        _lay(self._top, to, _all_of)

    def after_power_failed(self, to: Path, chance: random.Random) -> None:
        """One of the many things that may be on the disk."""
        kept = chance.choice((0.0, 0.3, 0.7, 1.0))
        hole = chance.choice((0x00, 0xFF))

        def content(file: _File) -> bytes:
            return _some_of(file, kept, hole, chance)

        _lay(self._top, to, content, chance)


def _sync(what: _File | _Folder) -> None:
    if isinstance(what, _Folder):
        what.synced, what.since = what.names, []
    else:
        what.synced, what.since = bytearray(_all_of(what)), []


def _lay(
    folder: _Folder, to: Path, content: Callable[[_File], bytes], chance: random.Random | None = None
) -> None:
    to.mkdir(exist_ok=True)
    names = folder.names
    if chance is not None:
        names = chance.choice([folder.synced, *folder.since])
    for name, what in names.items():
        if isinstance(what, _Folder):
            _lay(what, to / name, content, chance)
        else:
            (to / name).write_bytes(content(what))


def _apply(content: bytearray, call: Call, data: bytes, offset: int) -> None:
    if call.op == TRUNCATE:
        del content[call.offset :]
        content.extend(bytes(call.offset - len(content)))
    elif call.op == ALLOCATE:
        content.extend(bytes(max(0, call.offset + call.bytes - len(content))))
    else:
        content.extend(bytes(max(0, offset - len(content))))
        content[offset : offset + len(data)] = data


def _all_of(file: _File) -> bytes:
    content = bytearray(file.synced)
    for call in file.since:
        _apply(content, call, call.data, call.offset)
    return bytes(content)


def _some_of(file: _File, kept: float, hole: int, chance: random.Random) -> bytes:
    """Each write after the last sync: there, missing, or in parts. What was beyond the end and is missing reads as
    zeros, or, on flash, as 0xff."""
    content, written = bytearray(file.synced), bytearray(b"\1" * len(file.synced))
    for call in file.since:
        if call.op != WRITE:
            if chance.random() < max(kept, 0.5):
                before = len(content)
                _apply(content, call, b"", 0)
                del written[len(content) :]
                written.extend(bytes(max(0, len(content) - before)))
            continue
        begin = call.offset
        while begin < call.offset + len(call.data):
            end = min((begin // SECTOR + 1) * SECTOR, call.offset + len(call.data))
            if chance.random() < kept:
                grown = max(0, end - len(content))
                content.extend(bytes(grown))
                written.extend(bytes(grown))
                content[begin:end] = call.data[begin - call.offset : end - call.offset]
                written[begin:end] = b"\1" * (end - begin)
            begin = end
    if hole:
        for index in range(len(file.synced), len(content)):
            if not written[index]:
                content[index] = hole
    return bytes(content)


def synced_lines(calls: list[Call], name: str) -> dict[bytes, int]:
    """Whole lines of a file that is only appended to, and the number of calls after which each is on the disk."""
    content, lines = b"", {}
    for number, call in enumerate(calls, 1):
        if Path(call.path).name != name:
            continue
        if call.op == WRITE:
            content = content[: call.offset] + call.data
        elif call.op == SYNC:
            for line in content.split(b"\n")[:-1]:
                lines.setdefault(line, number)
    return lines
