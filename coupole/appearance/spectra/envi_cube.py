"""Image cubes of reflectance in ENVI's format: a header of text (`.hdr`) and a binary file.

SPy (the package `spectral`) reads the header. The pixels are read in blocks of rows, so that a cube may be larger
than the memory. Reads are plain reads of the file: a cube that becomes shorter meanwhile gives an error.
"""

from __future__ import annotations

import contextlib
import re
import tempfile
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.appearance.spectra.measured import decode_text
from coupole.errors import InputError, Problem, reason
from coupole.intake.regular_file import open_regular

HEADER = ".hdr"
WavelengthUnit: TypeAlias = Literal["nm", "um"]
_ENDINGS = ("", ".img", ".dat", ".raw", ".bin", ".cube", ".hyspex", ".bsq", ".bil", ".bip")
_INTERLEAVES = ("bsq", "bil", "bip")
_TYPES = {"1": "u1", "2": "i2", "3": "i4", "4": "f4", "5": "f8", "12": "u2", "13": "u4", "14": "i8", "15": "u8"}
_UNITS = {
    "nm": 1.0, "nanometers": 1.0, "nanometer": 1.0, "nanometres": 1.0, "nanometre": 1.0,
    "um": 1e3, "micrometers": 1e3, "micrometer": 1e3, "micrometres": 1e3, "micrometre": 1e3, "microns": 1e3,
    "micron": 1e3,
}  # fmt: skip
_NM = (150.0, 3000.0)
_LEAST_BANDS = 3
_LONGEST_HEADER = 4_000_000
_BLOCK_VALUES = 4_000_000


@dataclass(frozen=True)
class CubeOptions:
    """The user's words about a cube; they take precedence over its header's."""

    scale: float | None = None
    """Number in the file that is a reflectance of 1."""
    wavelength_unit: WavelengthUnit | None = None


@dataclass(frozen=True, eq=False)
class Cube:
    """A cube of reflectance; its pixels remain on the disk."""

    header: Path
    data: Path
    rows: int
    columns: int
    wavelengths_nm: Array
    """[bands used] wavelengths in rising order."""
    scale: float
    """Number in the file that is a reflectance of 1."""
    fields: dict[str, Any]
    """The header's fields, by their names in small letters."""
    left_out: tuple[int, ...]
    """Bands, from 1, that the header's list `bbl` names as bad."""
    _bands: NDArray[np.intp]
    """[bands used] place of each of these wavelengths among the bands of the file."""
    _all_bands: int
    _dtype: np.dtype[Any]
    _interleave: str
    _offset: int
    _ignore_value: np.generic | None

    @property
    def description(self) -> str:
        """The header's description as one line; empty if it has none."""
        return " ".join(str(self.fields.get("description", "")).split())

    @cached_property
    def rows_at_once(self) -> int:
        """Rows of a block: at most 4 million values, and at least one row."""
        return max(1, min(self.rows, _BLOCK_VALUES // (self.columns * self._all_bands)))

    def blocks(self) -> Iterator[tuple[int, int]]:
        """First row, and the row behind the last one, of each block."""
        for first in range(0, self.rows, self.rows_at_once):
            yield first, min(first + self.rows_at_once, self.rows)

    def read_rows(self, first: int, end: int) -> NDArray[np.float32]:
        """[rows, columns, bands used] reflectance of the rows from `first` to before `end`. Pixels of the header's
        ignored value are NaN in this band. Raises InputError if the file cannot be read, or is too short."""
        count, size = end - first, self._dtype.itemsize
        try:
            with self.data.open("rb", buffering=0) as file:
                if self._interleave == "bsq":
                    pixels = np.empty((count, self.columns, len(self._bands)), self._dtype)
                    for place, band in enumerate(self._bands):
                        at = (int(band) * self.rows + first) * self.columns
                        pixels[:, :, place] = self._values(file, at * size, count * self.columns).reshape(
                            count, -1
                        )
                else:
                    at = first * self.columns * self._all_bands
                    values = self._values(file, at * size, count * self.columns * self._all_bands)
                    if self._interleave == "bil":
                        pixels = values.reshape(count, self._all_bands, -1)[:, self._bands].transpose(0, 2, 1)
                    else:
                        pixels = values.reshape(count, self.columns, -1)[:, :, self._bands]
        except OSError as error:
            raise InputError(f"{self.data}: {reason(error)}") from error
        with np.errstate(
            over="ignore", invalid="ignore"
        ):  # such values are infinite, so they are not reflectances
            reflectance = pixels.astype(np.float32)
            reflectance /= np.float32(self.scale)
        if self._ignore_value is not None:
            reflectance[pixels == self._ignore_value] = np.nan
        return reflectance

    def _values(self, file: Any, at: int, count: int) -> NDArray[Any]:
        file.seek(self._offset + at)
        values = np.fromfile(file, self._dtype, count)
        if len(values) != count:
            raise InputError(
                f"{self.data}: ends at byte {self._offset + at + values.nbytes}; the file became shorter"
            )
        return values


def is_cube(path: Path) -> bool:
    """Tell whether a path names an ENVI header, or a file with an ENVI header beside it."""
    return path.suffix.lower() == HEADER or (path.is_file() and _header_beside(path) is not None)


def open_cube(path: Path, options: CubeOptions | None = None) -> Cube:
    """Read a cube's header, given its path or the binary file's, and find the binary file.

    Raises InputError, with file and line, for headers that do not state what is needed.
    """
    user = options or CubeOptions()
    header = path if path.suffix.lower() == HEADER else _header_beside(path)
    if header is None:
        raise InputError(f"{path}: expected an ENVI header beside it, {path.name}{HEADER}")
    text = _header_text(header)
    fields = _Fields(header, text)
    rows, columns, bands = (fields.count(name) for name in ("lines", "samples", "bands"))
    dtype = fields.dtype()
    interleave = fields.word("interleave").lower()
    if interleave not in _INTERLEAVES:
        raise fields.wrong("interleave", f"expected {', '.join(_INTERLEAVES)}; found {interleave!r}")
    offset = fields.count("header offset", least=0) if "header offset" in fields.values else 0
    fields.refuse_other_kinds()
    scale = user.scale if user.scale is not None else fields.number("reflectance scale factor", 0.0)
    if scale == 0.0 and dtype.kind == "f" and "reflectance scale factor" not in fields.values:
        scale = 1.0
    if not (np.isfinite(scale) and scale > 0.0):
        raise fields.wrong(
            "reflectance scale factor",
            "expected the number that is a reflectance of 1, because the values are integers; give --scale, such "
            "as 10000" if scale == 0.0 else f"expected a number above 0, found {scale:g}",
        )  # fmt: skip
    nm = fields.wavelengths_nm(bands, user.wavelength_unit)
    good = fields.good_bands(bands)
    order = np.flatnonzero(good)[np.argsort(nm[good], kind="stable")]
    data = _data_beside(header) if path == header else path
    needed_bytes = offset + rows * columns * bands * dtype.itemsize
    if (size := data.stat().st_size) < needed_bytes:
        raise InputError(
            f"{data}: expected {needed_bytes} bytes ({rows} lines, {columns} samples, {bands} bands of "
            f"{dtype.itemsize} bytes{f', after {offset}' if offset else ''}, by {header.name}), found {size}"
        )
    return Cube(
        header, data, rows, columns, nm[order], float(scale), fields.values,
        tuple(int(band) + 1 for band in np.flatnonzero(~good)), order, bands, dtype, interleave, offset,
        fields.ignore_value(dtype),
    )  # fmt: skip


def _header_beside(path: Path) -> Path | None:
    names = (path.with_name(path.name + HEADER), path.with_suffix(HEADER), path.with_suffix(HEADER.upper()))
    return next((name for name in names if name.is_file()), None)


def _data_beside(header: Path) -> Path:
    for ending in _ENDINGS:
        for name in (header.with_suffix(ending), header.with_suffix(ending.upper())):
            if name != header and name.is_file():
                return name
    raise InputError(
        f"{header}: expected the binary file beside it ({header.stem} with "
        f"{', '.join(ending or 'no ending' for ending in _ENDINGS)}), found none; name the binary file instead"
    )


def _header_text(header: Path) -> str:
    try:
        with open_regular(header) as file:
            raw = file.read(_LONGEST_HEADER + 1)
    except OSError as error:
        raise InputError(f"{header}: {reason(error)}") from error
    is_binary = len(raw) > _LONGEST_HEADER or (b"\0" in raw and not raw.startswith((b"\xff\xfe", b"\xfe\xff")))
    text = "" if is_binary else decode_text(raw)
    if not text.startswith("ENVI"):
        found_words = text.split("\n", 1)[0][:40] if text else "a binary file"
        raise InputError([Problem(str(header), 1, 1, "", f"expected the word ENVI, found {found_words!r}")])
    return text.replace("\r\n", "\n").replace("\r", "\n")


class _Fields:
    """Fields of a header, with the lines in which they stand."""

    def __init__(self, header: Path, text: str) -> None:
        from spectral.io import envi

        self._header = header
        self._lines: dict[str, int] = {}
        for number, line in enumerate(text.split("\n"), start=1):
            name, mark, _ = line.partition("=")
            if mark and not line.startswith(";"):
                self._lines.setdefault(" ".join(name.lower().split()), number)
        if text.count("{") != text.count("}"):
            opening_lines = [number for number, line in enumerate(text.split("\n"), start=1) if "{" in line]
            raise InputError([Problem(str(header), opening_lines[-1] if opening_lines else 0, 1, "",
                                      "expected as many closing braces as opening ones")])  # fmt: skip
        plain = text.replace("µ", "u").replace("μ", "u").encode("ascii", "replace")
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about capital letters in names
            copy = Path(folder) / "cube.hdr"
            copy.write_bytes(plain)
            try:
                fields = envi.read_envi_header(str(copy))
            except envi.EnviException as error:
                raise InputError(f"{header}: expected lines of name = value: {error}") from error
        self.values: dict[str, Any] = {" ".join(name.lower().split()): value for name, value in fields.items()}

    def wrong(self, name: str, message: str) -> InputError:
        """The error about a field, with its line if the header has it."""
        line = self._lines.get(name, 0)
        return InputError([Problem(str(self._header), line, 1 if line else 0, name, message)])

    def word(self, name: str) -> str:
        """The text of a field that must be there."""
        if name not in self.values:
            raise self.wrong(name, "expected this field, found none; check the program that wrote the cube")
        return str(self.values[name]).strip()

    def number(self, name: str, default: float) -> float:
        """The number of a field that may be missing."""
        if name not in self.values:
            return default
        with contextlib.suppress(ValueError):
            return float(self.word(name))
        raise self.wrong(name, f"expected a number, found {self.word(name)!r}")

    def ignore_value(self, dtype: np.dtype[Any]) -> np.generic | None:
        """The value of pixels without data, as the file has it; None if the file's type of number cannot express
        it."""
        number = self.number("data ignore value", np.nan)
        with np.errstate(over="ignore"):
            if np.isfinite(number) and (dtype.kind == "f" or (
                number == int(number) and np.iinfo(dtype).min <= number <= np.iinfo(dtype).max
            )):  # fmt: skip
                value: np.generic = dtype.type(int(number) if dtype.kind != "f" else number)
                return value
        return None

    def count(self, name: str, least: int = 1) -> int:
        """A whole number of `least` or more."""
        word = self.word(name)
        if not re.fullmatch(r"[0-9]{1,9}", word) or int(word) < least:
            above = "above 0" if least else "of 0 or more"
            raise self.wrong(name, f"expected a whole number {above}, found {word!r}")
        return int(word)

    def dtype(self) -> np.dtype[Any]:
        """Type of the values, with their byte order."""
        word = self.word("data type")
        if word not in _TYPES:
            raise self.wrong("data type", f"expected one of {', '.join(_TYPES)}, found {word!r}; complex "
                                          "values are not reflectances")  # fmt: skip
        dtype = np.dtype(_TYPES[word])
        order = self.word("byte order") if dtype.itemsize > 1 else "0"
        if order not in ("0", "1"):
            raise self.wrong("byte order", f"expected 0 (little endian) or 1 (big endian), found {order!r}")
        return dtype.newbyteorder("<" if order == "0" else ">")

    def refuse_other_kinds(self) -> None:
        """Raise InputError for libraries, classifications, compressed files and files with gaps between rows."""
        kind = str(self.values.get("file type", "")).lower()
        if "library" in kind or "classification" in kind:
            raise self.wrong("file type", f"expected an image of reflectance, found {self.values['file type']!r}")
        if self.number("file compression", 0.0):
            raise self.wrong("file compression", "expected 0: compressed files are not read")
        for name in ("major frame offsets", "minor frame offsets"):
            if any(word not in ("0", "") for word in map(str, self.values.get(name, []))):
                raise self.wrong(name, "expected 0: files with gaps between rows are not read")

    def wavelengths_nm(self, bands: int, unit: WavelengthUnit | None) -> Array:
        """[bands] wavelengths in the file's order."""
        words = self.values.get("wavelength")
        if not isinstance(words, list):
            raise self.wrong("wavelength", "expected the wavelengths of the bands in braces, found none; without "
                                           "them nothing can be identified")  # fmt: skip
        numbers = []
        for word in (word for word in words if word or len(words) == bands):
            try:
                numbers.append(float(word))
            except ValueError:
                raise self.wrong("wavelength", f"expected numbers, found {word!r}") from None
        if len(numbers) != bands:
            raise self.wrong(
                "wavelength", f"expected {bands} wavelengths, one for each band; found {len(numbers)}"
            )
        found_words = " ".join(str(self.values.get("wavelength units", "")).lower().split())
        factor = {"nm": 1.0, "um": 1e3}[unit] if unit else _UNITS.get(found_words)
        if factor is None:
            raise self.wrong(
                "wavelength units",
                f"expected Nanometers or Micrometers, found {found_words or 'none'}; give --wavelength-unit "
                "nm or um",
            )
        nm = factor * np.array(numbers)
        if not np.all((nm >= _NM[0]) & (nm <= _NM[1])):
            raise self.wrong(
                "wavelength",
                f"expected {_NM[0]:g} to {_NM[1]:g} nm, found {np.min(nm):g} to {np.max(nm):g}; check the unit",
            )
        return nm

    def good_bands(self, bands: int) -> NDArray[np.bool_]:
        """[bands] True for bands that the list of bad bands does not exclude. Raises InputError if two bands of
        the same wavelength remain, or fewer than three bands."""
        words = self.values.get("bbl")
        good = np.ones(bands, bool)
        if words is not None:
            try:
                good = np.array([float(word) != 0.0 for word in words])
            except ValueError:
                raise self.wrong("bbl", "expected 0 or 1 for each band") from None
            if len(good) != bands:
                raise self.wrong("bbl", f"expected {bands} numbers, one for each band; found {len(good)}")
        nm = np.array([float(word) for word in self.values["wavelength"] if word])[good]
        if good.sum() < _LEAST_BANDS:
            raise self.wrong(
                "bbl" if words else "bands", f"expected {_LEAST_BANDS} or more bands, found {good.sum()}"
            )
        if len(np.unique(nm)) < len(nm):
            twice = next(value for value in nm if (nm == value).sum() > 1)
            message = f"expected each wavelength once, found {twice:g} twice; name one of the bands in bbl"
            raise self.wrong("wavelength", message)
        return good
