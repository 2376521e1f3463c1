"""Spectra from the exports of spectrophotometers.

The reader accepts lines of numbers, the wavelength in nm first, separated by tabs, semicolons, commas or blanks.
Numbers have decimal points or decimal commas; wavelengths ascend or descend. Values are in percent, fractions, or
the power of a light. Lines without a number among their fields are comments. Lines that begin with `#`, and all
text before the first row, are comments too. Ambiguous input is refused, and the line is named.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError, Problem

Unit = Literal["auto", "percent", "fraction", "power"]

_NUMBER = re.compile(r"[+-]?(\d+([.,]\d*)?|[.,]\d+)([eE][+-]?\d+)?")
_SEPARATORS = (("tab", "\t"), ("semicolon", ";"), ("comma", ","), ("blank", None))
_LEAST_ROWS = 3
_NM = (150.0, 3000.0)
_FRACTION_AT_MOST = 1.05
"""A white tile may read a little above 1. Values in percent that are all below this would be read as fractions.
Give `unit` for black samples of such instruments."""
_PERCENT_AT_LEAST = 2.5
_REFLECTANCE = (-0.02, 1.5)
"""Limits of reflectance. Noise can give values below 0, fluorescence and gloss can give values above 1; values
beyond the limits are not reflectances."""


@dataclass(frozen=True)
class Measured:
    """One spectrum as exported by the instrument."""

    name: str
    wavelengths_nm: Array
    """[n] wavelengths in rising order."""
    values: Array
    """[n] values: reflectance as a fraction, or power."""
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class _Row:
    line: int
    fields: tuple[str, ...]


@dataclass(frozen=True)
class _Table:
    rows: list[_Row]
    header: str
    """The line before the first row, if it is a comment."""
    remarks: tuple[str, ...]
    separator: str


def read_spectrum(path: Path, *, unit: Unit = "auto", column: int | None = None) -> Measured:
    """Read the spectrum in a file. `column` (from 1, after the wavelength) is needed if there are several."""
    return parse_spectrum(decode_text(path.read_bytes()), str(path), name=path.stem, unit=unit, column=column)


def parse_spectrum(
    text: str, file: str, *, name: str = "", unit: Unit = "auto", column: int | None = None
) -> Measured:
    """Read a spectrum from text, as `read_spectrum` does from a file; `file` is the name in errors. Raises
    InputError for ambiguous input."""
    table = _table(text, file)
    rows = table.rows
    _check_columns(table, file)
    columns = len(rows[0].fields) - 1
    if column is None and columns > 1:
        raise _wrong(
            file, rows[0].line, f"expected one spectrum, found {columns}; say which column, 1 to {columns}"
        )
    if column is not None and not 1 <= column <= columns:
        raise _wrong(file, rows[0].line, f"expected column 1 to {columns}, found {column}; choose one of them")
    nm = np.array([_number(row.fields[0]) for row in rows])
    values = np.array([_number(row.fields[column or 1]) for row in rows])
    _check_wavelengths(nm, rows, file)
    values = values * _scale(values, table, unit, file)
    _check_values(values, rows, unit, file)
    order = slice(None, None, 1 if nm[0] < nm[-1] else -1)
    return Measured(name, nm[order].copy(), values[order].copy(), table.remarks)


def decode_text(raw: bytes) -> str:
    """Return an instrument's text: UTF-16 or UTF-8 by its byte order mark, otherwise UTF-8, otherwise Latin-1."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Older instruments write a Windows code page; only comments can contain such letters.
        return raw.decode("latin-1")


def _table(text: str, file: str) -> _Table:
    """Return rows of numbers, by the separator that gives the most rows, and the file's other information."""
    lines = [(number, line.strip(" \r")) for number, line in enumerate(text.split("\n"), start=1) if line.strip()]
    counts = {name: sum(_is_row(_fields(line, mark)) for _, line in lines) for name, mark in _SEPARATORS}
    separator = max(counts, key=lambda name: counts[name])
    mark = dict(_SEPARATORS)[separator]
    rows: list[_Row] = []
    remarks: list[str] = []
    header = ""
    for number, line in lines:
        fields = _fields(line, mark)
        if _is_row(fields):
            rows.append(_Row(number, fields))
            continue
        if rows and not line.startswith("#") and any(_NUMBER.fullmatch(field) for field in fields):
            raise _wrong(
                file, number, f"expected numbers separated by {separator}s, found {line!r}; correct the line"
            )
        remarks.append(line)
        header = header if rows else line
    if len(rows) < _LEAST_ROWS:
        raise InputError(
            [Problem(file, 0, 0, "", f"expected {_LEAST_ROWS} or more lines `nm, value`; check the export")]
        )
    return _Table(rows, header, tuple(remarks), separator)


def _fields(line: str, mark: str | None) -> tuple[str, ...]:
    fields = [field.strip() for field in line.split(mark)]
    while len(fields) > 1 and not fields[-1]:
        fields.pop()
    return tuple(fields)


def _is_row(fields: tuple[str, ...]) -> bool:
    return len(fields) > 1 and all(_NUMBER.fullmatch(field) for field in fields)


def _number(field: str) -> float:
    return float(field.replace(",", "."))


def _check_columns(table: _Table, file: str) -> None:
    rows, first = table.rows, table.rows[0]
    for row in rows:
        if len(row.fields) != len(first.fields):
            raise _wrong(
                file,
                row.line,
                f"expected {len(first.fields)} numbers as in line {first.line}, "
                f"found {len(row.fields)}; correct the line",
            )
    if table.separator == "comma":
        points = any("." in field for row in rows for field in row.fields)
        if not points and len(first.fields) > 2 and len(table.header.split(",")) != len(first.fields):
            raise _wrong(
                file,
                first.line,
                "commas may separate columns here or mark decimals; "
                "export with semicolons, or with a header line that names each column",
            )
        return
    first_with = {mark: row for row in reversed(rows) for field in row.fields for mark in ".," if mark in field}
    if len(first_with) == 2:
        raise _wrong(
            file,
            max(row.line for row in first_with.values()),
            "decimal points and decimal commas in one file; export again with one of them",
        )


def _check_wavelengths(nm: Array, rows: list[_Row], file: str) -> None:
    for value, row in zip(nm, rows, strict=True):
        if not _NM[0] <= value <= _NM[1]:
            raise _wrong(
                file,
                row.line,
                f"expected a wavelength in nm, {_NM[0]:g} to {_NM[1]:g}, found {value:g}; "
                "the first column must be the wavelength",
            )
    step = np.sign(nm[1] - nm[0])
    for before, after, row in zip(nm, nm[1:], rows[1:], strict=False):
        if step == 0.0 or np.sign(after - before) != step:
            raise _wrong(
                file,
                row.line,
                f"expected wavelengths that all rise or all fall, found {after:g} after {before:g}; give one "
                "spectrum in a file",
            )


def _scale(values: Array, table: _Table, unit: Unit, file: str) -> float:
    if unit != "auto":
        return 0.01 if unit == "percent" else 1.0
    highest = int(np.argmax(values))
    peak = float(values[highest])
    if _speaks_of_percent(table.header) or peak >= _PERCENT_AT_LEAST:
        return 0.01
    # A percent sign in another comment may refer to humidity.
    if peak <= _FRACTION_AT_MOST and not any(_speaks_of_percent(remark) for remark in table.remarks):
        return 1.0
    raise _wrong(
        file,
        table.rows[highest].line,
        f"the largest value, {peak:g}, may be percent or a fraction; say which with `unit`",
    )


def _speaks_of_percent(remark: str) -> bool:
    return "%" in remark or "percent" in remark.lower()


def _check_values(values: Array, rows: list[_Row], unit: Unit, file: str) -> None:
    low, high = (-np.inf, np.inf) if unit == "power" else _REFLECTANCE
    for value, row in zip(values, rows, strict=True):
        if not (low <= value <= high and np.isfinite(value)):
            raise _wrong(
                file,
                row.line,
                f"expected {'a number' if unit == 'power' else f'a reflectance of {low:g} to {high:g}'}, found "
                f"{value:g}; check whether it is percent, a fraction or a power",
            )


def _wrong(file: str, line: int, message: str) -> InputError:
    return InputError([Problem(file, line, 1, "", message)])
