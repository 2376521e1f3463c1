"""Facts in the files of spectra about object, instrument and person; the files of a library."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from coupole.appearance.spectra.measured import decode_text
from coupole.appearance.spectra.spectra_library import WAVELENGTHS, library_files
from coupole.errors import InputError, reason
from coupole.storage.durable import sha256

FACTS = ("object", "sample", "instrument", "measured by", "measured on")
"""Names of facts, in the order of a report."""
_NAMES = {
    "object": "object", "artwork": "object", "sample": "sample", "point": "sample", "spot": "sample",
    "instrument": "instrument", "device": "instrument", "sensor type": "instrument", "measured by": "measured by",
    "operator": "measured by", "user": "measured by", "measured on": "measured on", "date": "measured on",
    "acquisition time": "measured on", "acquisition date": "measured on",
}  # fmt: skip
_LINE = re.compile(r"^[#;%]\s*([A-Za-z][A-Za-z _]{1,30}?)\s*[:=]\s*(\S.*?)\s*$")
_SIMULATED = re.compile(r"\b(simulated|synthetic)\b", re.IGNORECASE)
_DENIED = {"simulated": {"no", "false", "0", "none"}}
_HEAD_BYTES, _LONGEST = 65536, 300
_NOTHING = {"", "unknown", "none", "n/a"}


def file_facts(path: Path) -> tuple[dict[str, str], bool]:
    """Return the facts in a file's lines of comment (`# instrument: ...`), and whether they call the data
    simulated or synthetic. Raises InputError."""
    facts: dict[str, str] = {}
    is_simulated = False
    for line in _head(path).splitlines():
        if not line.startswith(("#", ";", "%")):
            continue
        match = _LINE.match(line)
        name, words = (match[1].lower().replace("_", " "), match[2]) if match else ("", line)
        if name in _DENIED:
            is_simulated |= words.lower() not in _DENIED[name]
        elif name in _NAMES:
            facts.setdefault(_NAMES[name], words[:_LONGEST])
        else:
            is_simulated |= bool(_SIMULATED.search(line))
    return facts, is_simulated


def header_facts(fields: Mapping[str, object]) -> tuple[dict[str, str], bool]:
    """Return the same from the fields of an ENVI header. If the header names no object, its description is used
    as the object.
    """
    facts: dict[str, str] = {}
    for name, words in fields.items():
        text = " ".join(str(words).split())
        if name in _NAMES and text.lower() not in _NOTHING:
            facts.setdefault(_NAMES[name], text[:_LONGEST])
    description = " ".join(str(fields.get("description", "")).split())
    if description and "object" not in facts:
        facts["object"] = description[:_LONGEST]
    return facts, bool(_SIMULATED.search(description))


def digests(paths: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 of files by name; folders stand for their spectra. Raises InputError."""
    files = [file for path in paths for file in library_files(path)]
    files += [beside for file in files if (beside := file.parent / WAVELENGTHS).is_file() and beside not in files]
    file_digests: dict[str, str] = {}
    for file in dict.fromkeys(files):
        try:
            file_digests[file.name if file.name not in file_digests else str(file)] = sha256(file)
        except OSError as error:
            raise InputError(f"{file}: {reason(error)}") from error
    return file_digests


def licence_beside(library: Path) -> str:
    """Return the first line of a file of licence beside a library, with the file's name; empty if there is
    none."""
    folder = library if library.is_dir() else library.parent
    for name in ("LICENSE", "LICENCE", "LICENSE.txt", "LICENCE.txt", "LICENSE.md", "COPYING"):
        if (path := folder / name).is_file():
            lines = [line.strip() for line in _head(path).splitlines() if line.strip()]
            return f"{lines[0][:_LONGEST]} ({name})" if lines else ""
    return ""


def _head(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return decode_text(file.read(_HEAD_BYTES))
    except OSError as error:
        raise InputError(f"{path}: {reason(error)}") from error
