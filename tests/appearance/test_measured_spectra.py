"""Exports of spectrophotometers, read or refused, and put on the grid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from coupole.appearance.spectra import resampling
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.appearance.spectra.measured import Measured, Unit, parse_spectrum, read_spectrum
from coupole.errors import InputError

NM = np.arange(360.0, 801.0, 10.0)


def export(
    nm: np.ndarray, values: np.ndarray, *, separator: str, comma: bool, percent: bool, falling: bool, header: str
) -> str:
    rows = [
        f"{wavelength:.1f}{separator}{(100.0 if percent else 1.0) * value:.5f}"
        for wavelength, value in zip(nm, values, strict=True)
    ]
    text = "\n".join(reversed(rows) if falling else rows) + "\n"
    return header + (text.replace(".", ",") if comma else text)


def refused(text: str, *, unit: Unit = "auto", column: int | None = None) -> str:
    with pytest.raises(InputError) as caught:
        parse_spectrum(text, "s.csv", unit=unit, column=column)
    return str(caught.value)


@settings(deadline=None, max_examples=60)
@given(
    values=st.lists(st.floats(0.01, 0.99), min_size=len(NM), max_size=len(NM)),
    layout=st.sampled_from(
        [
            ("\t", True),
            ("\t", False),
            (";", True),
            (";", False),
            (",", False),
            (", ", False),
            (" ", True),
            (" ", False),
        ]
    ),
    percent=st.booleans(),
    falling=st.booleans(),
    header=st.sampled_from(
        ["", "# red cushion\n", "nm{0}R\n", "Date: 2008-05-12\nIntegration{0}4000\n\nnm{0}R %\n"]
    ),
)
def test_exports_of_any_layout_are_read_as_they_were_meant(
    values: list[float], layout: tuple[str, bool], percent: bool, falling: bool, header: str
) -> None:
    separator, comma = layout
    text = export(
        NM,
        np.array(values),
        separator=separator,
        comma=comma,
        percent=percent or "%" in header,
        falling=falling,
        header=header.format(separator),
    )

    spectrum = parse_spectrum(text, "s.csv", unit="percent" if percent or "%" in header else "fraction")

    assert spectrum.wavelengths_nm == pytest.approx(NM)
    assert spectrum.values == pytest.approx(np.array(values), abs=1e-5)


@settings(deadline=None)
@given(text=st.text(alphabet="0123456789.,;\t \n+-eE#nm%", max_size=200))
def test_any_text_is_read_or_refused(text: str) -> None:
    try:
        spectrum = parse_spectrum(text, "s.csv")
    except InputError as error:
        assert str(error).startswith("s.csv")  # noqa: PT017
    else:
        assert np.all(np.diff(spectrum.wavelengths_nm) > 0.0)
        assert np.all(np.isfinite(spectrum.values))


def test_an_ocean_optics_export_is_read_between_its_marks(tmp_path: Path) -> None:
    file = tmp_path / "cushion.txt"
    file.write_bytes(
        "SpectraSuite Data File\n++++++\nDate: 2008\nIntegration Time (µsec): 100000 (USB2)\n"
        ">>>>>Begin Processed Spectral Data<<<<<\n400,12\t12,5\n400,50\t12,7\n400,88\t12,9\n"
        ">>>>>End Processed Spectral Data<<<<<\n".encode("latin-1")
    )

    spectrum = read_spectrum(file)

    assert spectrum.name == "cushion"
    assert spectrum.wavelengths_nm == pytest.approx([400.12, 400.5, 400.88])
    assert spectrum.values == pytest.approx([0.125, 0.127, 0.129])


def test_a_file_in_utf_16_is_read(tmp_path: Path) -> None:
    file = tmp_path / "s.csv"
    file.write_text("nm;R\n400;0.1\n410;0.2\n420;0.3\n", encoding="utf-16")

    assert read_spectrum(file).values == pytest.approx([0.1, 0.2, 0.3])


def test_values_far_above_one_are_percent_and_values_up_to_one_are_fractions() -> None:
    assert parse_spectrum("400;12\n410;80\n420;4\n", "s.csv").values == pytest.approx([0.12, 0.8, 0.04])
    assert parse_spectrum("400;0.12\n410;0.8\n420;0.04\n", "s.csv").values == pytest.approx([0.12, 0.8, 0.04])


def test_a_header_that_says_percent_is_believed() -> None:
    assert parse_spectrum("nm;R [%]\n400;0.5\n410;0.8\n420;0.4\n", "s.csv").values.max() == pytest.approx(0.008)


def test_the_power_of_a_light_is_taken_as_it_is() -> None:
    assert parse_spectrum("400;1250\n410;1300\n420;0\n", "s.csv", unit="power").values.max() == 1300.0


def test_one_of_several_columns_is_read() -> None:
    text = "nm;black;white\n400;0.05;0.8\n410;0.06;0.8\n420;0.05;0.8\n"

    assert parse_spectrum(text, "s.csv", column=1).values == pytest.approx([0.05, 0.06, 0.05])


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("400,0,12,5\n410,0,12,6\n420,0,12,7\n", 1, "commas may separate columns here or mark decimals"),
        ("400;12,5\n410;12.6\n420;12,7\n", 2, "decimal points and decimal commas"),
        ("400;1.2\n410;1.8\n420;1.1\n", 2, "may be percent or a fraction"),
        ("400;12;13\n410;12;13\n420;12;13\n", 1, "found 2; say which column"),
        ("400;12\n410;12\n405;12\n", 3, "found 405 after 410"),
        ("400;12\n410;12\n410;12\n", 3, "found 410 after 410"),
        ("400;12\n410;n/a\n420;12\n430;11\n", 2, "expected numbers separated by semicolons"),
        ("400;12\n410;12;13\n420;12\n", 2, "expected 2 numbers as in line 1"),
        ("nm;R\n0.40;12\n0.41;12\n0.42;12\n", 2, "expected a wavelength in nm"),
        ("400;12\n410;-30\n420;12\n", 2, "expected a reflectance"),
        ("400;1e999\n410;12\n420;12\n", 1, "expected a reflectance"),
        ("humidity 40 %\nnm;R\n400;0.4\n410;0.5\n420;0.3\n", 4, "may be percent or a fraction"),
    ],
)
def test_what_is_not_clear_is_refused_with_its_line(text: str, line: int, reason: str) -> None:
    message = refused(text)

    assert message.startswith(f"s.csv:{line}:1: ")
    assert reason in message


def test_a_file_without_a_spectrum_is_refused() -> None:
    assert "expected 3 or more lines" in refused("hello\n400;1\n")


def test_a_column_that_is_not_there_is_refused() -> None:
    assert "expected column 1 to 1, found 4" in refused("400;12\n410;12\n420;12\n", column=4)


def sampled(step_nm: float, first_nm: float = 360.0, last_nm: float = 800.0) -> Measured:
    nm = np.arange(first_nm, last_nm + 1e-9, step_nm)
    return Measured("edge", nm, edge(nm), ())


def edge(nm: np.ndarray) -> np.ndarray:
    """A red paint's edge, 20 nm wide."""
    return 0.05 + 0.8 / (1.0 + np.exp((590.0 - nm) / 20.0))


def test_samples_on_the_grid_are_kept() -> None:
    found = resampling.on_grid(sampled(5.0))

    assert found.values == pytest.approx(edge(WAVELENGTHS_NM), abs=1e-12)
    assert found.error == 0.0


@pytest.mark.parametrize("step_nm", [10.0, 20.0])
def test_coarse_samples_are_interpolated_within_the_error_stated(step_nm: float) -> None:
    found = resampling.on_grid(sampled(step_nm))

    truly = np.abs(found.values - edge(WAVELENGTHS_NM)).max()
    assert truly <= found.error
    assert found.error < 0.02


def test_fine_noisy_samples_are_averaged() -> None:
    nm = np.arange(350.0, 800.0, 0.4)
    noisy = Measured("noisy", nm, edge(nm) + 0.01 * np.random.default_rng(8).standard_normal(len(nm)), ())

    found = resampling.on_grid(noisy)

    assert np.std(found.values - edge(WAVELENGTHS_NM)) < 0.004
    assert found.error > 0.005


@settings(deadline=None, max_examples=40)
@given(values=st.lists(st.integers(0, 10_000).map(lambda v: v / 10_000), min_size=45, max_size=45))
def test_interpolation_stays_between_its_samples(values: list[float]) -> None:
    found = resampling.on_grid(Measured("any", NM, np.array(values), ())).values

    low, high = np.minimum(values[:-1], values[1:]), np.maximum(values[:-1], values[1:])
    place = np.minimum(np.searchsorted(NM, WAVELENGTHS_NM, side="right") - 1, len(low) - 1)
    assert np.all((found >= low[place] - 1e-12) & (found <= high[place] + 1e-12))


def test_what_was_not_measured_is_not_a_number() -> None:
    found = resampling.on_grid(sampled(10.0, 400.0, 700.0))

    measured = (WAVELENGTHS_NM >= 399.0) & (WAVELENGTHS_NM <= 701.0)
    assert np.array_equal(np.isfinite(found.values), measured)


def test_a_gap_stays_a_gap() -> None:
    whole = sampled(10.0)
    kept = (whole.wavelengths_nm <= 500.0) | (whole.wavelengths_nm >= 560.0)

    found = resampling.on_grid(Measured("gap", whole.wavelengths_nm[kept], whole.values[kept], ()))

    assert np.array_equal(
        WAVELENGTHS_NM[np.isnan(found.values)], WAVELENGTHS_NM[(np.abs(WAVELENGTHS_NM - 530.0) < 29.0)]
    )


def test_missing_ends_are_held_only_when_asked_to() -> None:
    held = resampling.fill_missing(resampling.on_grid(sampled(10.0, 400.0, 700.0)))

    assert held[0] == pytest.approx(edge(np.array(400.0)))
    assert held[-1] == pytest.approx(edge(np.array(700.0)))


def test_a_spectrum_of_the_infrared_is_refused() -> None:
    with pytest.raises(InputError, match="visible light"):
        resampling.on_grid(sampled(10.0, 900.0, 1000.0))
