"""Classes of pigments by colouring matter: tables that name them, and families of classes with one colouring
matter."""

from __future__ import annotations

import csv
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from coupole.appearance.spectra.measured import decode_text
from coupole.appearance.spectra.spectra_library import LibrarySpectrum
from coupole.errors import InputError, Problem, reason

FAMILIES: tuple[frozenset[str], ...] = (
    frozenset({"iron red", "iron yellow and brown earths"}),
    frozenset({"carbon black", "manganese oxide", "organic brown"}),
    frozenset({"cobalt glass", "cobalt blue"}),
)
"""Families of classes with bands of the same kind: haematite and goethite, which heat converts into each other;
black and brown without bands; cobalt(II) among four oxygens. A class of a family is identified only by comparison
with the others, so a library that lacks one class of a family cannot decide for another."""
_COLUMNS = ("name", "class", "colour_index")


@dataclass(frozen=True)
class PigmentClass:
    """Entry of a table for one spectrum."""

    class_name: str
    """Name of the class; empty for mixtures and products of unknown composition."""
    colour_index: str
    """Generic name without dots and blanks (PR101), or empty."""


def read_classes(path: Path) -> dict[str, PigmentClass]:
    """Read a table of name, class and, if known, Colour Index name, separated by commas, semicolons or tabs. A
    first line with these words may be missing. Raises InputError with file and line."""
    try:
        text = decode_text(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    return _parse_classes(text, str(path))


def shipped_classes(spectra: Sequence[LibrarySpectrum]) -> dict[str, PigmentClass]:
    """Return the tables shipped with Coupole for the files of these spectra, found by the files' names."""
    folder = resources.files(__package__).joinpath("classes")
    classes: dict[str, PigmentClass] = {}
    for stem in {Path(spectrum.file).stem for spectrum in spectra}:
        table = folder.joinpath(f"{stem}.csv")
        if table.is_file():
            classes |= _parse_classes(table.read_text(encoding="utf-8"), f"{stem}.csv")
    return classes


def lacking(class_name: str, known_classes: Collection[str]) -> list[str]:
    """Return the classes of the same family that are not among `known_classes`."""
    return sorted(
        sibling
        for family in FAMILIES
        if class_name in family
        for sibling in family
        if sibling not in set(known_classes)
    )


def _parse_classes(text: str, file: str) -> dict[str, PigmentClass]:
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{file}: expected lines of name and class, found none")
    mark = max("\t;,", key=lines[0].count)
    classes: dict[str, PigmentClass] = {}
    reader = csv.reader(text.splitlines(), delimiter=mark)
    columns = {name: index for index, name in enumerate(_COLUMNS)}
    for row in reader:
        if not any(field.strip() for field in row) or row[0].startswith("#"):
            continue
        fields = [" ".join(field.split()) for field in row]
        words = [field.lower().replace(" ", "_") for field in fields]
        if not classes and "name" in words and "class" in words:
            columns = {name: words.index(name) for name in _COLUMNS if name in words}
            continue
        if len(fields) <= max(columns["name"], columns["class"]) or not fields[columns["name"]]:
            raise _wrong(file, reader.line_num, f"expected a name and a class, found {mark.join(row)!r}")
        name, class_name = fields[columns["name"]], fields[columns["class"]]
        index = columns.get("colour_index", len(fields))
        pigment_class = PigmentClass(class_name, fields[index] if index < len(fields) else "")
        if classes.get(name, pigment_class) != pigment_class:
            raise _wrong(
                file, reader.line_num, f"{name!r} is in two classes: {classes[name].class_name}, {class_name}"
            )
        classes[name] = pigment_class
    return classes


def _wrong(file: str, line: int, message: str) -> InputError:
    return InputError([Problem(file, line, 1, "", message)])
