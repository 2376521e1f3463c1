"""Libraries of spectra: tables with one spectrum a row, files with one spectrum each, and folders of either.

A row is a name, then numbers, separated by tabs, semicolons or commas. The wavelengths in nm are in the first
line, after any name, or in a file `spectra.txt` beside the table. A row with as many numbers as wavelengths is a
reflectance. A row with twice as many has absorption K, then scattering S of Kubelka and Munk. All other files are
read as by `measured`. Values are in percent if the highest value of the file is 2.5 or more, and fractions if it
is 1.05 or less.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from coupole.appearance.matter import kubelka_munk
from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import Unit, decode_text, parse_spectrum
from coupole.errors import InputError, Problem, reason

WAVELENGTHS = "spectra.txt"
_ENDINGS = {".rs", ".tsv", ".csv", ".txt", ".asc"}
_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")
_NM = (150.0, 3000.0)
_FRACTION_AT_MOST, _PERCENT_AT_LEAST = 1.05, 2.5
_REFLECTANCE = (-0.02, 1.5)
_LEAST_BANDS = 3


@dataclass(frozen=True)
class LibrarySpectrum:
    """One spectrum and its place in a file."""

    name: str
    file: str
    line: int
    """Line in the file; 0 if the file holds only this spectrum."""
    wavelengths_nm: Array
    """[n] wavelengths in rising order."""
    reflectance: Array
    """[n] reflectance as a fraction. For K and S it is the reflectance of an opaque layer; NaN where K is
    negative or S is not positive.
    """
    absorption: Array | None = None
    """K [n] in the file's unit, which is also the unit of S; None if reflectance was measured."""
    scattering: Array | None = None


def read_library(path: Path, *, unit: Unit = "auto") -> tuple[LibrarySpectrum, ...]:
    """Read all spectra of a table, of a file with one spectrum, or of a folder of such files (without its
    subfolders).

    Raises InputError, with file and line, for content that cannot be read without guessing, and for names that
    occur twice.
    """
    return with_unique_names([spectrum for file in library_files(path) for spectrum in _read_file(file, unit)])


def library_files(path: Path) -> list[Path]:
    """Return the files of a folder that have spectra, or the file itself. Raises InputError if there is none."""
    if not path.is_dir():
        return [path]
    files = sorted(f for f in path.iterdir() if f.suffix.lower() in _ENDINGS and f.name != WAVELENGTHS)
    if not files:
        raise InputError(f"{path}: expected spectra, {', '.join(sorted(_ENDINGS))}; found none")
    return files


def with_unique_names(spectra: Sequence[LibrarySpectrum]) -> tuple[LibrarySpectrum, ...]:
    """Return the spectra. Raises InputError if a name occurs twice."""
    by_name: dict[str, LibrarySpectrum] = {}
    for spectrum in spectra:
        if spectrum.name in by_name:
            before = by_name[spectrum.name]
            raise _wrong(
                spectrum.file,
                spectrum.line,
                f"the name {spectrum.name!r} is used in {before.file}:{before.line} too; "
                "give each spectrum a different name",
            )
        by_name[spectrum.name] = spectrum
    return tuple(spectra)


def _read_file(path: Path, unit: Unit) -> list[LibrarySpectrum]:
    try:
        text = decode_text(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: {reason(error)}") from error
    return parse_library(text, path, unit=unit)


def parse_library(text: str, path: Path, *, unit: Unit = "auto") -> list[LibrarySpectrum]:
    """Read the text of one file. `path` names it in errors. Raises InputError, with file and line."""
    lines = [(number, line.strip("\r ")) for number, line in enumerate(text.split("\n"), start=1)]
    rows = [(number, *_parse_row(line)) for number, line in lines if line.strip() and not line.startswith("#")]
    if not any(_are_numbers(fields) for _, name, fields in rows if name and not _NUMBER.fullmatch(name)):
        spectrum = parse_spectrum(text, str(path), name=path.stem, unit=unit)
        return [LibrarySpectrum(spectrum.name, str(path), 0, spectrum.wavelengths_nm, spectrum.values)]
    nm, rows = _wavelengths(path, rows)
    numbers = [_numbers(path, nm, *row) for row in rows]
    scale = _scale(path, nm, numbers, rows, unit)
    return [
        _spectrum(path, nm, values * scale if len(values) == len(nm) else values, number, name)
        for values, (number, name, _) in zip(numbers, rows, strict=True)
    ]


def _spectrum(path: Path, nm: Array, values: Array, line: int, name: str) -> LibrarySpectrum:
    order = np.argsort(nm)
    if len(values) == len(nm):
        return LibrarySpectrum(name, str(path), line, nm[order], values[order])
    k, s = values[: len(nm)][order], values[len(nm) :][order]
    is_known = (k >= 0.0) & (s > 0.0)
    if not is_known.any():
        raise _wrong(str(path), line, f"{name}: expected K and S that are positive, found none; check the export")
    reflectance = np.full(len(nm), np.nan)
    reflectance[is_known] = kubelka_munk.opaque(k[is_known] / s[is_known])
    return LibrarySpectrum(name, str(path), line, nm[order], reflectance, k, s)


def _parse_row(line: str) -> tuple[str, list[str]]:
    """Return name and fields of a row. Several tabs may align a column; each other separator begins a field."""
    quote = re.match(r'"([^"]*)"', line)
    rest = line[quote.end() :] if quote else line
    separator = next((mark for mark in "\t;," if mark in rest), None)
    fields = [field.strip() for field in rest.split(separator)]
    name = quote.group(1) if quote else fields[0]
    fields = fields[1:]
    while fields and not fields[-1]:
        fields.pop()
    return " ".join(name.split()), [field for field in fields if field] if separator in ("\t", None) else fields


def _are_numbers(fields: Sequence[str]) -> bool:
    return len(fields) >= _LEAST_BANDS and all(_NUMBER.fullmatch(field) for field in fields)


Row = tuple[int, str, list[str]]


def _wavelengths(path: Path, rows: list[Row]) -> tuple[Array, list[Row]]:
    """Return the wavelengths [n] from the first line or from the file `spectra.txt`, and the rows of spectra."""
    number, _, fields = rows[0]
    beside = path.parent / WAVELENGTHS
    first = np.array([_value(field) for field in fields]) if _are_numbers(fields) else np.zeros(0)
    if len(first) and (np.all(first >= _NM[0]) or not beside.is_file()):
        source, rows = str(path), rows[1:]
    elif beside.is_file():
        source, number = str(beside), 1
        words = decode_text(beside.read_bytes()).split()
        if wrong := [word for word in words if not _NUMBER.fullmatch(word)]:
            raise _wrong(source, 1, f"expected wavelengths in nm, found {wrong[0]!r}; correct the file")
        first = np.array([_value(word) for word in words])
    else:
        raise _wrong(
            str(path), number, f"expected wavelengths in nm in the first line, or in {beside}; found neither"
        )
    step = np.sign(np.diff(first))
    if len(first) < _LEAST_BANDS or not (np.all(step == 1.0) or np.all(step == -1.0)):
        raise _wrong(
            source,
            number,
            f"expected {_LEAST_BANDS} or more wavelengths in nm that all rise or all fall; found "
            f"{', '.join(f'{v:g}' for v in first[:4])}, ...: give them in the first line, or in {beside}",
        )
    if not np.all((first >= _NM[0]) & (first <= _NM[1])):
        remedy = "micrometres? give them in nm" if np.all(first < 10.0) else "give them in nm"
        raise _wrong(
            source, number, f"expected wavelengths of {_NM[0]:g} to {_NM[1]:g} nm, found {first[0]:g} to "
            f"{first[-1]:g}; {remedy}"
        )  # fmt: skip
    if not rows:
        raise _wrong(source, number, "expected spectra below the wavelengths, found none")
    return first, rows


def _numbers(path: Path, nm: Array, line: int, name: str, fields: list[str]) -> Array:
    if not name:
        raise _wrong(str(path), line, "expected a name, then numbers; found no name")
    for index, field in enumerate(fields):
        if not _NUMBER.fullmatch(field):
            content = f"{field!r}" if field else "an empty field"
            raise _wrong(
                str(path),
                line,
                f"{name}: expected a number at {nm[index % len(nm)]:g} nm, found {content}; measure it again, or "
                "leave the spectrum out",
            )
    if len(fields) not in (len(nm), 2 * len(nm)):
        raise _wrong(
            str(path),
            line,
            f"{name}: expected {len(nm)} numbers (reflectance) or {2 * len(nm)} (K, then S), one for each "
            f"wavelength; found {len(fields)}",
        )
    return np.array([_value(field) for field in fields])


def _scale(path: Path, nm: Array, numbers: list[Array], rows: list[Row], unit: Unit) -> float:
    """Return the factor that turns the file's reflectances into fractions, and check them."""
    spectra = [(values, row) for values, row in zip(numbers, rows, strict=True) if len(values) == len(nm)]
    if not spectra:
        return 1.0
    highest, (line, name, _) = max(spectra, key=lambda item: float(item[0].max()))
    peak = float(highest.max())
    if unit == "auto" and _FRACTION_AT_MOST < peak < _PERCENT_AT_LEAST:
        raise _wrong(
            str(path),
            line,
            f"{name}: the largest value, {peak:g}, may be percent or a fraction; say which with `unit`",
        )
    scale = 0.01 if unit == "percent" or (unit == "auto" and peak >= _PERCENT_AT_LEAST) else 1.0
    low, high = _REFLECTANCE
    for values, (at, label, _) in spectra:
        outside = np.flatnonzero((values * scale < low) | (values * scale > high))
        if len(outside):
            raise _wrong(
                str(path),
                at,
                f"{label}: expected a reflectance of {low:g} to {high:g}, found {values[outside[0]] * scale:g} "
                f"at {nm[outside[0]]:g} nm; check whether it is percent or a fraction",
            )
    return scale


def _value(field: str) -> float:
    return float(field.replace(",", "."))


def _wrong(file: str, line: int, message: str) -> InputError:
    return InputError([Problem(file, line, 1 if line else 0, "", message)])
