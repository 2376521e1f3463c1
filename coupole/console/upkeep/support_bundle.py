"""A zip for those who help with a fault: rig, plans, journals, output, versions, and the log of requests at the
console. It has no frames, and no secrets that allow a sign-in."""

from __future__ import annotations

import functools
import importlib.metadata
import json
import platform
import re
import shutil
import sys
import zipfile
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import coupole
from coupole.errors import InputError, StorageError
from coupole.intake.plain_data import json_of
from coupole.plan.cell import Cell
from coupole.storage.durable import make_folder
from coupole.storage.run_json import RUN_JSON

MOST_RUNS, MOST_FILE_BYTES, _MOST_KEPT = 20, 20_000_000, 5
OF_A_RUN = (RUN_JSON, "journal.jsonl", "README.txt", "manifest.sha256", "inputs/plan.yaml", "inputs/rig.yaml")
OF_THE_CONSOLE = ("audit.jsonl", "queue.json", "output/*", "commands/*")
"""Files of the console in the bundle. Accounts and the addresses of notifications are left out."""
LEFT_OUT = "(left out)"
_KEY = (
    r"(?<![\w.-])[\w.-]*(?:passw(?:or)?d|passphrase|pwd|secret|token|credential|api[_-]?key|private[_-]?key|"
    r"authorization|cookie|hooks?)[\w.-]*"
)
_ENTRY = re.compile(rf"""(?i)((["']?){_KEY}\2\s*[:=])([ \t]*)(\S.*)?$""")
_IS_KEY = re.compile(rf"(?i){_KEY}")
_QUOTED = re.compile(r"""("(?:[^"\\]|\\.)*"|'(?:[^']|'')*')(?=\s*(?:[,}\]]|$))""")
_LEAD = re.compile(r"[ \t]*(?:#[ \t]*)?")
_SECRETS = (
    re.compile(r"(?s)(-----BEGIN [A-Z ]*PRIVATE KEY-----)(.*?)(?=-----END|\Z)"),
    re.compile(r"()(\$argon2\w*\$[^\s\"']+)"),
    re.compile(r"(://[^\s/:@\"']*:)([^\s/@\"']+)(?=@)"),
    re.compile(r"(?i)(https?://)([^\s\"']*hook[^\s\"']*)"),
    re.compile(r"(?i)(\bBearer\s+)([\w.~+/-]{8,}=*)"),
)
_README = """\
Coupole, support bundle of {t}.

versions.json   this machine, and the versions of the software that Coupole uses
disk.json       of the runs
rig/            the rig, its LED table, and its records of calibrations without their maps
plans/          the folder of plans
state/          faults of the arm, and other facts of the cell
runs/           of the {runs} newest runs: description, journal, plan and rig; no frames
console/        who requested what; the queue; the output of commands and acquisitions

It contains names of people (who asked for what) and of objects. Values of keys that look like passwords or
tokens are replaced by {left_out}; accounts and notifications are not included.
"""


def without_secrets(text: str) -> str:
    """Return the text with "(left out)" in place of secrets."""
    for secret in _SECRETS:
        text = secret.sub(lambda match: f"{match[1]}{LEFT_OUT}", text)
    if not _IS_KEY.search(text):
        return text
    if (whole := _json_without(text)) is not None:
        return whole
    safe_lines: list[str] = []
    below: tuple[int, bool] | None = None
    for line in text.splitlines(keepends=True):
        if below is not None and _is_below(line, *below):
            continue
        document = _json_without(line) if line.startswith(("{", "[")) else None
        safe, below = (document, None) if document is not None else _line_without(line)
        safe_lines.append(safe)
    return "".join(safe_lines)


def _json_without(text: str) -> str | None:
    """Return the document without secrets; None if it is not JSON; unchanged if no key names a secret."""
    try:
        document = json_of(text, "a text", allow_nan=True)
    except InputError:
        return None
    safe_document = _value_without(document)
    if safe_document == document:
        return text
    return json.dumps(safe_document, ensure_ascii=False, indent=2 if "\n" in text.strip() else None) + "\n"


def _value_without(value: Any) -> Any:
    if isinstance(value, dict):
        return {
            key: LEFT_OUT if _IS_KEY.fullmatch(key) and inner else _value_without(inner)
            for key, inner in value.items()
        }
    if isinstance(value, list):
        return [_value_without(inner) for inner in value]
    return without_secrets(value) if isinstance(value, str) and _IS_KEY.search(value) else value


def _line_without(line: str) -> tuple[str, tuple[int, bool] | None]:
    """Return a line of YAML or of text without secrets. Also return the column that shows where the left-out value
    continues: following lines belong to it if they begin beyond this column. The last value says whether items of
    a list may begin at this column.
    """
    words, end = line.rstrip("\r\n"), line[len(line.rstrip("\r\n")) :]
    if (entry := _ENTRY.search(words)) is None:
        return line, None
    value = entry[4] or ""
    if (quoted_match := _QUOTED.match(value)) is not None:
        quote = value[0]
        rest, below = _line_without(value[quoted_match.end() :])
        return f"{words[: entry.start()]}{entry[1]}{entry[3]}{quote}{LEFT_OUT}{quote}{rest}{end}", below
    begin = words[: entry.start()]
    lead = _LEAD.match(words)
    column = len(begin) if not begin.strip("-# \t") else len(lead[0]) if lead else 0
    return f"{begin}{entry[1]} {LEFT_OUT}{end}", (column, value.startswith("#") or not value)


def _is_below(line: str, column: int, items: bool) -> bool:
    """Tell whether a line continues a value whose key is at this column."""
    lead = _LEAD.match(line)
    at = len(lead[0]) if lead else 0
    rest = line[at:]
    return not rest.strip() or at > column or (items and at == column and rest.startswith("-"))


class SupportBundles:
    """Bundles are made on request, and kept until there are newer ones."""

    def __init__(self, cell: Cell, plans: Path, folder: Path) -> None:
        """`folder`: state of the console."""
        self._cell, self._plans, self._console = cell, plans, folder
        self._folder = folder / "bundles"

    def make(self) -> str:
        """Make a bundle; return its name. Raises StorageError."""
        name = f"coupole-support-{datetime.now(UTC).strftime('%Y%m%dT%H%M%S%fZ')}.zip"
        try:
            make_folder(self._folder)
            self._folder.chmod(0o700)
            partial = self._folder / f".{name}.part"
            with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as bundle:
                for inside, text in self._texts():
                    bundle.writestr(inside, text)
            partial.replace(self._folder / name)
            for old in sorted(self._folder.glob("*.zip"))[:-_MOST_KEPT]:
                old.unlink()
        except OSError as error:
            raise StorageError(f"{self._folder}: no support bundle can be written: {error.strerror}") from error
        return name

    def path(self, name: str) -> Path:
        """Return the path of a bundle. Raises InputError if there is none of this name."""
        path = self._folder / name
        if not re.fullmatch(r"coupole-support-\w+\.zip", name) or not path.is_file():
            raise InputError(f"{name!r}: no such support bundle")
        return path

    def _texts(self) -> Iterator[tuple[str, str]]:
        """Return the names of the texts in the bundle, and the texts."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        yield "README.txt", _README.format(t=now, runs=MOST_RUNS, left_out=LEFT_OUT)
        yield "versions.json", json.dumps(versions(), indent=2)
        disk = shutil.disk_usage(self._cell.storage_folder if self._cell.storage_folder.is_dir() else Path.cwd())
        reserve = self._cell.rig.storage.reserve_bytes
        yield "disk.json", json.dumps({**disk._asdict(), "reserve": reserve}, indent=2)
        for inside, path in self._files():
            if (text := _text(path)) is not None:
                yield inside, without_secrets(text)

    def _files(self) -> Iterator[tuple[str, Path]]:
        cell = self._cell
        rig = cell.document.path
        yield f"rig/{rig.name}", rig
        yield f"rig/{cell.leds_path.name}", cell.leds_path
        for record in cell.rig.calibrations if cell.rig.calibrations != "none" else ():
            path = cell.document.resolve(record)
            yield f"rig/calibrations/{path.name}", path
        other_folders = (cell.storage_folder.resolve(), cell.state_folder.resolve())
        plans = (
            path
            for path in self._plans.rglob("*.yaml")
            if not any(map(path.resolve().is_relative_to, other_folders))
        )
        yield from _below("plans", self._plans, plans)
        yield from _below("state", cell.state_folder, cell.state_folder.glob("*.jsonl"))
        yield from _below("state", cell.state_folder, cell.state_folder.glob("*.yaml"))
        runs = sorted((path.parent for path in cell.storage_folder.glob(f"*/{RUN_JSON}")), reverse=True)
        for run in runs[:MOST_RUNS]:
            yield from ((f"runs/{run.name}/{name}", run / name) for name in OF_A_RUN)
        for pattern in OF_THE_CONSOLE:
            yield from _below("console", self._console, self._console.glob(pattern))


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of Coupole, Python, the system, and the packages that Coupole needs."""
    version_of = {"coupole": coupole.__version__, "python": sys.version.split()[0], "system": platform.platform()}
    for requirement in sorted(importlib.metadata.requires("coupole") or []):
        name = re.split(r"[\s<>=!~;\[]", requirement, maxsplit=1)[0]
        try:
            version_of[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            version_of[name] = "not installed"
    return version_of


def _below(inside: str, folder: Path, paths: Iterable[Path]) -> Iterator[tuple[str, Path]]:
    for path in sorted(paths):
        yield f"{inside}/{path.relative_to(folder)}", path


def _text(path: Path) -> str | None:
    """Return the text of a file; None if it does not exist, is not text, or is too long to be sent."""
    try:
        if not path.is_file() or path.stat().st_size > MOST_FILE_BYTES:
            return None
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
