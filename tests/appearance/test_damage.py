"""Damage by light (CIE 157:2004) against colour-science's V(lambda), and against integrals in closed form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from cells import CellFolder

from coupole.appearance.spectra import damage
from coupole.appearance.spectra.damage import damage_w_per_lm
from coupole.appearance.spectra.light import observer
from coupole.appearance.spectra.measured import Measured
from coupole.errors import InputError
from coupole.plan.cell import read_cell

NM = np.arange(380.0, 781.0)


def spectrum(power: np.ndarray, nm: np.ndarray = NM) -> Measured:
    return Measured("lamp", nm, power, ())


def test_v_lambda_is_that_of_the_2_degree_observer() -> None:
    np.testing.assert_allclose(damage._V, observer("2 deg")[1], rtol=1e-4)


def line(nm: float) -> np.ndarray:
    return np.exp(-(((NM - nm) / 3.0) ** 2))


@pytest.mark.parametrize(("nm", "lm_per_w"), [(555.0, 683.0), (450.0, 683.0 * 0.038), (650.0, 683.0 * 0.107)])
def test_light_of_one_wavelength_damages_by_the_published_function(nm: float, lm_per_w: float) -> None:
    expected = np.exp(-0.0115 * (nm - 300.0)) / lm_per_w
    assert damage_w_per_lm(spectrum(line(nm))) == pytest.approx(expected, rel=0.02)


def test_the_equal_energy_spectrum_damages_by_the_integral_in_closed_form() -> None:
    damaging = (np.exp(-0.0115 * 80) - np.exp(-0.0115 * 480)) / 0.0115
    luminous = 683.0 * 106.857  # the 2-degree observer's V sums to 106.857 nm (CIE 15)
    assert damage_w_per_lm(spectrum(np.ones(401))) == pytest.approx(damaging / luminous, rel=1e-3)


def test_ultraviolet_in_the_file_counts() -> None:
    nm = np.arange(300.0, 781.0)
    assert damage_w_per_lm(spectrum(np.ones(481), nm)) > 1.8 * damage_w_per_lm(spectrum(np.ones(401)))


def test_a_spectrum_that_leaves_out_blue_or_light_is_refused() -> None:
    with pytest.raises(InputError, match="400 to 700 nm"):
        damage_w_per_lm(spectrum(np.ones(281), NM[120:]))
    with pytest.raises(InputError, match="visible light"):
        damage_w_per_lm(spectrum(np.zeros(401)))


def test_a_rig_that_names_its_lamps_spectra_knows_their_damage(tmp_path: Path) -> None:
    cell = CellFolder(tmp_path, write_now=False)
    rows = "".join(f"{nm:.0f};{power:.6f}\n" for nm, power in zip(NM, line(555.0), strict=True))
    (tmp_path / "leds.csv").write_text("nm;power\n" + rows)
    cell.rig_data["dome"]["spectrum"] = "leds.csv"
    cell.write()
    read = read_cell(cell.rig)
    assert read.led_damage_w_per_lm == pytest.approx(np.exp(-0.0115 * 255) / 683.0, rel=0.02)
    assert read.panel_damage_w_per_lm is None
    cell.rig_data["dome"]["panel_spectrum"] = "nowhere.csv"
    cell.write()
    with pytest.raises(InputError, match=r"rig\.yaml:\d+:\d+: dome\.panel_spectrum: cannot read the spectrum"):
        read_cell(cell.rig)
