"""Cubes in ENVI's format: whatever SPy writes is read as it is, and headers that do not say enough are refused."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from spectral.io import envi

from coupole.appearance.spectra.envi_cube import Cube, CubeOptions, is_cube, open_cube
from coupole.errors import InputError

TYPES = ("uint8", "int16", "int32", "float32", "float64", "uint16", "uint32", "int64", "uint64")
NM = (400.0, 450.0, 500.0, 620.0, 700.0)


def read_whole(cube: Cube, rows_at_once: int) -> np.ndarray:
    return np.concatenate(
        [cube.read_rows(row, min(row + rows_at_once, cube.rows)) for row in range(0, cube.rows, rows_at_once)]
    )


@settings(deadline=None, max_examples=60)
@given(
    shape=st.tuples(st.integers(1, 5), st.integers(2, 6)),
    dtype=st.sampled_from(TYPES),
    interleave=st.sampled_from(("bsq", "bil", "bip")),
    order=st.sampled_from((0, 1)),
    is_um=st.booleans(),
    turn=st.permutations(range(len(NM))),
    offset=st.integers(0, 7),
    at_once=st.integers(1, 3),
    seed=st.integers(0, 99),
)
def test_what_spy_writes_is_read_as_it_is(
    shape: tuple[int, int],
    dtype: str,
    interleave: str,
    order: int,
    is_um: bool,
    turn: list[int],
    offset: int,
    at_once: int,
    seed: int,
) -> None:
    values = np.random.default_rng(seed).integers(0, 120, (*shape, len(NM))).astype(dtype)
    nm = np.array(NM)[turn]
    metadata = {
        "wavelength": [f"{value / 1000 if is_um else value:g}" for value in nm],
        "wavelength units": "Micrometers" if is_um else "Nanometers",
        "reflectance scale factor": 100,
    }
    with tempfile.TemporaryDirectory() as folder:
        header = Path(folder) / "cube.hdr"
        envi.save_image(
            str(header), values, dtype=dtype, interleave=interleave, byteorder=order, metadata=metadata, ext=".dat"
        )
        data = header.with_suffix(".dat")
        data.write_bytes(b"\7" * offset + data.read_bytes())
        text = header.read_text()
        assert "header offset = 0" in text
        header.write_text(text.replace("header offset = 0", f"header offset = {offset}"))

        cube = open_cube(header)
        seen = read_whole(cube, at_once)

    np.testing.assert_allclose(cube.wavelengths_nm, sorted(NM))
    np.testing.assert_allclose(seen, values[:, :, np.argsort(nm)] / 100.0, rtol=1e-6)


HEADER = """ENVI
description = {a cube}
samples = 2
lines = 3
bands = 4
header offset = 0
file type = ENVI Standard
data type = 12
interleave = bsq
byte order = 0
wavelength units = Nanometers
reflectance scale factor = 1000
wavelength = {
 400, 500,
 600, 700}
"""


def cube_of(folder: Path, text: str = HEADER, values: int = 24) -> Path:
    (folder / "cube.hdr").write_text(text, encoding="latin-1")
    (folder / "cube.dat").write_bytes(np.arange(values, dtype="<u2").tobytes())
    return folder / "cube.hdr"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ENVI\n", "LAN\n", r"cube.hdr:1:1: expected the word ENVI, found 'LAN'"),
        ("samples = 2\n", "", r"cube.hdr: samples: expected this field, found none"),
        ("lines = 3", "lines = 3.5", r"cube.hdr:4:1: lines: expected a whole number above 0, found '3.5'"),
        ("bands = 4", "bands = 0", r"cube.hdr:5:1: bands: expected a whole number above 0"),
        (
            "lines = 3",
            "lines = 30",
            r"cube.dat: expected 480 bytes \(30 lines, 2 samples, 4 bands of 2 .* found 48",
        ),
        ("data type = 12", "data type = 6", r"cube.hdr:8:1: data type: expected one of 1, 2, .* complex"),
        (
            "offset = 0",
            "offset = nan",
            r"cube.hdr:6:1: header offset: expected a whole number of 0 .* found 'nan'",
        ),
        ("= bsq", "= bsp", r"cube.hdr:9:1: interleave: expected bsq, bil, bip; found 'bsp'"),
        ("byte order = 0", "byte order = 2", r"cube.hdr:10:1: byte order: expected 0 .* or 1 .*, found '2'"),
        (
            "= Nanometers",
            "= Unknown",
            r"cube.hdr:11:1: wavelength units: expected Nanometers .* --wavelength-unit",
        ),
        ("wavelength units = Nanometers\n", "", r"cube.hdr: wavelength units: expected .* found none"),
        ("= Nanometers", "= Micrometers", r"cube.hdr:13:1: wavelength: expected 150 to 3000 nm, found 400000"),
        ("600, 700", "600", r"cube.hdr:13:1: wavelength: expected 4 wavelengths, .* found 3"),
        ("600, 700", "600, x", r"cube.hdr:13:1: wavelength: expected numbers, found 'x'"),
        ("600, 700", "600, 600", r"cube.hdr:13:1: wavelength: expected each wavelength once, found 600 twice"),
        (
            "wavelength = {\n 400, 500,\n 600, 700}\n",
            "",
            r"cube.hdr: wavelength: expected the wavelengths .* none",
        ),
        (" 600, 700}", " 600, 700", r"cube.hdr:13:1: expected as many closing braces"),
        ("= 1000", "= 0", r"cube.hdr:12:1: reflectance scale factor: expected .* --scale"),
        ("reflectance scale factor = 1000\n", "", r"cube.hdr: reflectance scale factor: expected .* integers"),
        ("= ENVI Standard", "= ENVI Spectral Library", r"cube.hdr:7:1: file type: expected an image"),
        ("a cube}", "a cube}\nfile compression = 1", r"cube.hdr:3:1: file compression: expected 0"),
        ("a cube}", "a cube}\nbbl = {1, 1}", r"cube.hdr:3:1: bbl: expected 4 numbers, .* found 2"),
        ("a cube}", "a cube}\nbbl = {1, 0, 0, 1}", r"cube.hdr:3:1: bbl: expected 3 or more bands, found 2"),
    ],
)
def test_a_header_that_does_not_say_enough_is_refused_with_its_line(
    tmp_path: Path, old: str, new: str, said: str
) -> None:
    assert HEADER.count(old) == 1

    with pytest.raises(InputError, match=said):
        open_cube(cube_of(tmp_path, HEADER.replace(old, new)))


def test_headers_of_other_programs_are_read(tmp_path: Path) -> None:
    # Capital letters, CRLF, a letter of a Windows code page, a comment, and micrometres.
    text = HEADER.replace("wavelength units = Nanometers", "Wavelength Units = µm").replace("400, 500", "0.4, 0.5")
    text = (
        text.replace("600, 700", "0.6, 0.7")
        .replace("samples", "; camera = {x\nSamples")
        .replace("; camera = {x\n", "; camera\n")
    )
    path = cube_of(tmp_path, text.replace("\n", "\r\n"))

    cube = open_cube(path)

    np.testing.assert_allclose(cube.wavelengths_nm, [400.0, 500.0, 600.0, 700.0])
    np.testing.assert_allclose(cube.read_rows(0, 1)[0, 1], np.array([1, 7, 13, 19]) / 1000.0, rtol=1e-6)
    assert is_cube(path)
    assert is_cube(path.with_suffix(".dat"))
    assert open_cube(path.with_suffix(".dat")).rows == 3


def test_bad_bands_are_left_out_and_ignored_values_are_unknown(tmp_path: Path) -> None:
    text = HEADER.replace("a cube}", "a cube}\nbbl = {1, 1, 0, 1}\ndata ignore value = 7")

    cube = open_cube(cube_of(tmp_path, text))

    assert cube.left_out == (3,)
    np.testing.assert_allclose(cube.read_rows(0, 1)[0], [[0.0, 0.006, 0.018], [0.001, np.nan, 0.019]], rtol=1e-6)


@pytest.mark.parametrize("value", ["-9999", "7.5", "1e99", "nan"])
def test_an_ignored_value_that_the_type_does_not_have_is_nowhere(tmp_path: Path, value: str) -> None:
    cube = open_cube(cube_of(tmp_path, HEADER.replace("a cube}", f"a cube}}\ndata ignore value = {value}")))

    assert np.isfinite(cube.read_rows(0, 3)).all()


def test_what_the_user_says_replaces_what_the_header_says(tmp_path: Path) -> None:
    text = HEADER.replace("= Nanometers", "= Unknown").replace("reflectance scale factor = 1000\n", "")

    cube = open_cube(cube_of(tmp_path, text), CubeOptions(scale=10.0, wavelength_unit="nm"))

    assert cube.read_rows(2, 3)[0, 1, 3] == pytest.approx(2.3)
    np.testing.assert_allclose(cube.wavelengths_nm, [400.0, 500.0, 600.0, 700.0])


def test_a_cube_that_becomes_shorter_is_an_error_and_no_crash(tmp_path: Path) -> None:
    cube = open_cube(cube_of(tmp_path))
    cube.data.write_bytes(b"\0" * 20)

    with pytest.raises(InputError, match="became shorter"):
        cube.read_rows(2, 3)


def test_a_cube_without_its_binary_file_or_header_is_refused(tmp_path: Path) -> None:
    path = cube_of(tmp_path)
    path.with_suffix(".dat").unlink()

    with pytest.raises(InputError, match="expected the binary file beside it"):
        open_cube(path)
    with pytest.raises(InputError, match="No such file"):
        open_cube(tmp_path / "none.hdr")
    assert not is_cube(tmp_path / "spot.csv")


def test_a_pipe_in_the_place_of_a_header_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "cube.hdr")
    with pytest.raises(InputError, match="a pipe or a device"):
        open_cube(tmp_path / "cube.hdr")
