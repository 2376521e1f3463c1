"""Libraries of spectra, as collections publish them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from coupole.appearance.spectra.spectra_library import read_library
from coupole.errors import InputError
from tests.places import SHARED_DATA

PIGMENTS = SHARED_DATA / "pigments"


def written(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_rows_with_wavelengths_beside_them(tmp_path: Path) -> None:
    written(tmp_path, "spectra.txt", "400\t500\t600")
    path = written(tmp_path, "paints.rs", '"Red, light (P.R. 1)" \t0.1 \t0.2\t\t0.9\r\n"Blue"\t0.8\t0.3\t0.1\r\n')

    red, blue = read_library(path)

    assert (red.name, red.line, blue.name, blue.line) == ("Red, light (P.R. 1)", 1, "Blue", 2)
    np.testing.assert_array_equal(red.wavelengths_nm, [400, 500, 600])
    np.testing.assert_array_equal(red.reflectance, [0.1, 0.2, 0.9])


def test_k_and_s_become_the_reflectance_of_an_opaque_layer(tmp_path: Path) -> None:
    # R = 0.5 for K/S = 0.25, and 2 - sqrt(3) for K/S = 1 (Kubelka and Munk 1931); a negative K is noise.
    written(tmp_path, "spectra.txt", "400\n500\n600\n")
    (paint,) = read_library(written(tmp_path, "oil.rs", "Blue\t0.5\t1\t-0.1\t2\t1\t1\n"))

    np.testing.assert_allclose(paint.reflectance, [0.5, 2 - 3**0.5, np.nan], rtol=1e-12)
    assert paint.absorption is not None
    assert paint.scattering is not None
    np.testing.assert_array_equal(paint.absorption, [0.5, 1, -0.1])
    np.testing.assert_array_equal(paint.scattering, [2, 1, 1])


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ","), ("\t", ",")])
def test_a_table_with_the_wavelengths_in_its_first_line_in_percent(
    tmp_path: Path, separator: str, decimal: str
) -> None:
    rows = [["name", "600", "500", "400"], ["White", "90.5", "80", "70"], ["Red", "50", "5", "4.5"]]
    text = "\n".join(separator.join(row).replace(".", decimal) for row in rows)

    white, red = read_library(written(tmp_path, "table.csv", text))

    np.testing.assert_array_equal(white.wavelengths_nm, [400, 500, 600])
    np.testing.assert_allclose(white.reflectance, [0.7, 0.8, 0.905])
    np.testing.assert_allclose(red.reflectance, [0.045, 0.05, 0.5])


def test_a_folder_of_exports(tmp_path: Path) -> None:
    written(tmp_path, "red.txt", "400 0.1\n500 0.2\n600 0.9\n")
    written(tmp_path, "blue.csv", "nm;R %\n400;80\n500;30\n600;10\n")

    assert {s.name: s.reflectance.tolist() for s in read_library(tmp_path)} == {
        "blue": [0.8, 0.3, 0.1],
        "red": [0.1, 0.2, 0.9],
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,400,500,600\nRed,0.1,0.2\n", "t.csv:2:1: Red: expected 3 numbers .* found 2"),
        ("name,400,500,600\nBlue,1,1,1\nRed,0.1,,0.2\n", "t.csv:3:1: Red: .* 500 nm, found an empty field"),
        ("name,400,500,600\nRed,0.1,nan,0.2\n", "t.csv:2:1: Red: .* 500 nm, found 'nan'"),
        ("name,0.4,0.5,0.6\nRed,0.1,0.3,0.2\n", "t.csv:1:1: .* 0.4 to 0.6; micrometres"),
        ("Red,0.1,0.4,0.2\n", "t.csv:1:1: expected .* wavelengths in nm that all rise"),
        ("name,400,500,600\nRed,0.1,0.2,1.8\n", "t.csv:2:1: Red: .* 1.8, may be percent or a fraction"),
        ("name,400,500,600\nRed,0.1,0.2,-0.3\n", "t.csv:2:1: Red: .* found -0.3 at 600 nm"),
        ("name,400,500,600\nRed,0,0,1\nBlue,1,0,0\nRed,0,0,0.9\n", "t.csv:4:1: the name 'Red' is used in .*:2"),
    ],
)
def test_what_cannot_be_read_without_guessing_is_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_library(written(tmp_path, "t.csv", text))


@pytest.mark.skipif(not PIGMENTS.is_dir(), reason="shared data are not here")
def test_published_libraries_are_read_whole() -> None:
    counts = {path.name: len(read_library(path)) for path in sorted(PIGMENTS.glob("*.rs"))}

    assert counts == {
        "GamblinConservationColors.rs": 43,
        "GretagMacbethMini.rs": 24,
        "KremerHistorical.rs": 214,
    }
    oils = read_library(PIGMENTS / "oilpaint" / "oilpaint.rs")
    assert len(oils) == 10
    assert len(oils[0].wavelengths_nm) == 204
