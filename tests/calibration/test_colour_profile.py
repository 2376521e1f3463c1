"""The colour profile against colour-science, closed forms and LittleCMS."""

from __future__ import annotations

import ctypes
import io
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.calibration.colour.chart import KnownChart, read_chart
from coupole.calibration.colour.chart_values import read_chart_values
from coupole.calibration.colour.colorimetry import D50_WHITE, de00, lab_of, xyz_of, xyz_of_spectra
from coupole.calibration.colour.colour_profile import Balanced, Profile, covariance_of, fit_profile, leave_out
from coupole.calibration.colour.icc_profile import icc_profile
from coupole.calibration.colour.image_quality import TOLERANCES
from coupole.errors import InputError
from sim.objects import appearance
from sim.objects.colour_chart import DRAWN

Array = NDArray[np.float64]
CHART = Path(__file__).parents[2] / "configs/charts/drawn-24.yaml"
PAIRS = (
    ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
    ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
    ((50.0, 2.49, -0.001), (50.0, -2.49, 0.0011), 7.2195),
    ((50.0, -0.001, 2.49), (50.0, 0.0011, -2.49), 4.7461),
    ((2.0776, 0.0795, -1.135), (0.9033, -0.0636, -0.5514), 0.9082),
)
"""From the published test data of Sharma, Wu and Dalal, Color Research and Application 30, 2005."""


@pytest.fixture(scope="module")
def known() -> KnownChart:
    return read_chart(CHART)


@pytest.fixture(scope="module")
def seen(known: KnownChart) -> Balanced:
    """The simulated camera's channels of the chart, without noise."""
    signal = np.array([appearance.rgb(drawn.at(WAVELENGTHS_NM)) for drawn in DRAWN.values()])
    return Balanced(signal * (300.0, 500.0, 200.0), 1e-3 * signal, known.xyz, 0.3, known.neutral)


def test_ciede2000_has_its_published_values_and_those_of_colour_science() -> None:
    import colour

    for one, other, wanted in PAIRS:
        assert float(de00(np.array(other), np.array(one))) == pytest.approx(wanted, abs=1e-4)
    random = np.random.default_rng(1)
    lab = random.uniform((0, -90, -90), (100, 90, 90), (200, 3))
    near = lab + random.normal(0, 6, lab.shape)
    assert np.allclose(de00(near, lab), colour.delta_E(lab, near, method="CIE 2000"), atol=1e-9)
    assert np.allclose(xyz_of(lab_of(D50_WHITE * 0.003)), D50_WHITE * 0.003)


def test_the_chart_lists_the_simulators_spectra_and_their_xyz_is_that_of_colour_science(known: KnownChart) -> None:
    import colour

    functions = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    light = colour.SDS_ILLUMINANTS["D50"].copy().align(functions.shape)
    for number, drawn in enumerate(DRAWN.values()):
        shape = functions.shape
        spectrum = colour.SpectralDistribution(drawn.at(shape.wavelengths), shape.wavelengths)
        xyz = colour.sd_to_XYZ(spectrum, functions, light, method="Integration") / 100.0
        assert np.allclose(known.xyz[number], xyz, atol=4e-4)
    assert known.neutral == (18, 19, 20, 21, 22, 23)
    with pytest.raises(InputError, match="from 430 nm or below"):
        xyz_of_spectra(np.arange(450.0, 701.0, 10.0), np.ones((1, 26)))


def test_a_camera_that_is_a_linear_transform_of_the_observer_has_no_error(known: KnownChart) -> None:
    mixing = np.array([[2.0, 0.3, 0.1], [-0.4, 1.5, 0.2], [0.1, 0.2, 0.9]])
    seen = Balanced(
        known.xyz @ mixing.T, np.zeros_like(known.xyz), known.xyz, 0.0, known.neutral, D50_WHITE @ mixing.T
    )
    profile = fit_profile(seen, "matrix")
    assert de00(lab_of(profile.xyz(seen.signal)), known.lab).max() < 1e-5
    assert leave_out(seen, "matrix").worst < 1e-5
    wanted = np.linalg.inv(mixing) * (D50_WHITE @ mixing.T)
    assert np.allclose(profile.coefficients, wanted, atol=1e-6)


def test_the_matrix_is_better_than_any_near_it_and_keeps_white(seen: Balanced, known: KnownChart) -> None:
    profile = fit_profile(seen, "matrix")
    assert np.allclose(profile.coefficients.sum(axis=1), D50_WHITE, atol=1e-12)
    balanced = seen.signal / profile.white_signal

    def total(coefficients: Array) -> float:
        return float((de00(lab_of(balanced @ coefficients.T), known.lab) ** 2).sum())

    design = balanced[:, :2] - balanced[:, 2:]
    free, *_ = np.linalg.lstsq(design, known.xyz - balanced[:, 2:] * D50_WHITE)
    plain = np.column_stack([free.T, D50_WHITE - free.T.sum(axis=1)])
    assert total(profile.coefficients) < total(plain)
    random = np.random.default_rng(2)
    for _ in range(50):
        step = random.normal(0, 0.02, (3, 3))
        step -= step.mean(axis=1, keepdims=True)
        assert total(profile.coefficients) < total(profile.coefficients + step)


def test_errors_of_patches_left_out_are_larger_than_those_of_patches_used(
    seen: Balanced, known: KnownChart
) -> None:
    for form in ("matrix", "root-polynomial"):
        used = de00(lab_of(fit_profile(seen, form).xyz(seen.signal)), known.lab)
        left = leave_out(seen, form)
        assert used.mean() < left.mean < 2.0 * used.mean()
    strange = seen.signal.copy()
    strange[5] *= (3.0, 1.0, 1.0)
    spoilt = Balanced(strange, seen.u, seen.xyz, 0.3, seen.neutral)
    assert int(np.argmax(leave_out(spoilt, "matrix").de)) == 5


def test_both_parts_of_the_uncertainty_are_those_of_profiles_made_again(seen: Balanced, known: KnownChart) -> None:
    noise = 0.003 * seen.signal
    stated = Balanced(seen.signal, noise, known.xyz, 0.3, known.neutral)
    profile = fit_profile(stated, "matrix")
    by_noise, by_chart, _ = covariance_of(stated, profile)
    random = np.random.default_rng(3)

    def spread(again: Any) -> Array:
        return np.std([fit_profile(again(), "matrix").coefficients.ravel() for _ in range(60)], axis=0)

    shaken = spread(lambda: Balanced(random.normal(seen.signal, noise), noise, known.xyz, 0.3, known.neutral))
    other = spread(lambda: Balanced(seen.signal, noise, xyz_of(random.normal(known.lab, 0.3)), 0.3, known.neutral))
    assert np.all(np.abs(np.log(shaken / np.sqrt(np.diag(by_noise)))) < 0.35)
    assert np.all(np.abs(np.log(other / np.sqrt(np.diag(by_chart)))) < 0.35)


@pytest.mark.parametrize("form", ["matrix", "root-polynomial"])
def test_littlecms_finds_the_same_colours_through_the_icc_file(seen: Balanced, form: Any) -> None:
    from PIL import ImageCms

    matrix, chosen = fit_profile(seen, "matrix"), fit_profile(seen, form)
    made = icc_profile(chosen, matrix, "chart", datetime(2026, 1, 2, tzinfo=UTC))
    read = ImageCms.ImageCmsProfile(io.BytesIO(made))
    assert ImageCms.getProfileDescription(read).strip() == "chart"
    assert (read.profile.version, read.profile.device_class) == (pytest.approx(4.4), "scnr")
    balanced = seen.signal / chosen.white_signal
    assert np.abs(_by_littlecms(made, balanced) - lab_of(chosen.xyz_of_balanced(balanced))).max() < 0.1
    assert np.allclose(_by_littlecms(made, np.ones((1, 3))), (100.0, 0.0, 0.0), atol=0.02)


def _by_littlecms(profile: bytes, channels: Array) -> Array:
    """L*a*b* [n, 3] in floating point, relative colorimetric, by the library inside Pillow's wheel."""
    import PIL

    bundled = sorted((Path(PIL.__file__).parents[1] / "pillow.libs").glob("liblcms2*"))
    if not bundled:
        pytest.skip(f"Pillow has no LittleCMS of its own on {sys.platform}")
    library = ctypes.CDLL(str(bundled[0]))
    for function in (library.cmsOpenProfileFromMem, library.cmsCreateLab4Profile, library.cmsCreateTransform):
        function.restype = ctypes.c_void_p
    opened = ctypes.c_void_p(library.cmsOpenProfileFromMem(profile, len(profile)))
    lab = ctypes.c_void_p(library.cmsCreateLab4Profile(None))
    rgb_double, lab_double = ((1 << 22) | (space << 16) | (3 << 3) for space in (4, 10))
    transform = ctypes.c_void_p(library.cmsCreateTransform(opened, rgb_double, lab, lab_double, 1, 0x40))
    given, found = np.ascontiguousarray(channels), np.empty_like(channels)
    pointers = (ctypes.c_void_p(array.ctypes.data) for array in (given, found))
    library.cmsDoTransform(transform, *pointers, len(given))
    return found


def test_values_are_read_as_instruments_write_them(tmp_path: Path) -> None:
    lab = {"A1": (50.0, 20.0, -10.0), "A 2": (80.0, 0.0, 0.5)}
    cgats = (
        "CGATS.17\nBEGIN_DATA_FORMAT\nSAMPLE_ID LAB_L LAB_A LAB_B\nEND_DATA_FORMAT\nBEGIN_DATA\n"
        'A1 50.0 20.0 -10.0\n"A 2" 80 0 0.5\nEND_DATA\n'
    )
    files = {
        "x.txt": cgats,
        "x.csv": "name;L*;a*;b*\nA1;50,0;20,0;-10,0\nA 2;80;0;0,5\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
        found = read_chart_values(tmp_path / name)
        assert np.allclose([lab_of(found.xyz[patch]) for patch in lab], list(lab.values()), atol=1e-9)
    (tmp_path / "x.txt").write_text(cgats.replace("A1 50.0 20.0 -10.0", "A1 50.0 20.0"))
    with pytest.raises(InputError, match=r"x\.txt:6:1: expected 4 fields"):
        read_chart_values(tmp_path / "x.txt")


def test_percent_and_fractions_give_the_same_colours(tmp_path: Path) -> None:
    heads = "name," + ",".join(str(nm) for nm in range(400, 731, 10))
    values = np.linspace(0.2, 0.8, 34)
    found = []
    for factor in (1.0, 100.0):
        path = tmp_path / f"{factor}.csv"
        path.write_text(f"{heads}\nA1," + ",".join(f"{factor * value:.4f}" for value in values) + "\n")
        found.append(read_chart_values(path).xyz["A1"])
    assert np.allclose(found[0], found[1], atol=1e-5)
    path.write_text(f"{heads}\nA1," + ",".join(["1.9"] * 34) + "\n")
    with pytest.raises(InputError, match="percent or a fraction"):
        read_chart_values(path)


def test_levels_change_where_the_tolerances_say() -> None:
    assert TOLERANCES["tone"].level(2.0) == "ISO 19264-1 A, FADGI 3 stars"
    assert TOLERANCES["tone"].level(6.0) == "below ISO 19264-1 C, below FADGI 1 star"
    assert TOLERANCES["sampling_efficiency"].level(0.82) == "ISO 19264-1 B, FADGI 3 stars"


def test_a_profile_scales_with_the_exposure(seen: Balanced) -> None:
    profile: Profile = fit_profile(seen, "root-polynomial")
    assert np.allclose(profile.xyz(0.1 * seen.signal), 0.1 * profile.xyz(seen.signal))
