"""The sun's place and light against another library's ephemeris, the papers' times and a published spectrum."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest

from coupole.appearance.render.spectra import luminous
from coupole.appearance.spectra import sun
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.appearance.spectra.light_series import read_series
from coupole.errors import InputError

PARIS = (48.853, 2.349, 35.0)
SUMMER = timezone(timedelta(hours=2))


def evening(hour: int, minute: int) -> datetime:
    return datetime(2009, 7, 15, hour, minute, tzinfo=SUMMER)


def by_ephem(
    when: datetime, latitude_deg: float, longitude_deg: float, pressure_mbar: float
) -> tuple[float, float]:
    """Elevation and azimuth by PyEphem (VSOP87), in degrees."""
    import ephem

    here = ephem.Observer()
    here.lat, here.lon, here.pressure = np.radians(latitude_deg), np.radians(longitude_deg), pressure_mbar
    here.temp, here.date = 12.0, ephem.Date(when.astimezone(UTC).replace(tzinfo=None))
    body = ephem.Sun(here)
    return float(np.degrees(body.alt)), float(np.degrees(body.az))


@pytest.mark.parametrize(("when", "refracted_deg"), [(evening(21, 9), 5.02), (evening(21, 33), 1.74)])
def test_the_sun_of_the_papers_evening_stands_where_it_stood(when: datetime, refracted_deg: float) -> None:
    found = sun.place(when, *PARIS)
    assert found.refracted_elevation_deg == pytest.approx(refracted_deg, abs=0.05)
    assert 297.0 < found.azimuth_deg < 302.0


def test_places_are_those_of_another_ephemeris() -> None:
    random = np.random.default_rng(7)
    compared = 0
    while compared < 25:
        when = datetime(2000, 1, 1, tzinfo=UTC) + timedelta(hours=float(random.uniform(0, 350_000)))
        latitude_deg, longitude_deg = float(random.uniform(-66, 66)), float(random.uniform(-180, 180))
        geometric_deg, azimuth_deg = by_ephem(when, latitude_deg, longitude_deg, 0.0)
        if not 2.0 < geometric_deg < 85.0:
            continue
        compared += 1
        found = sun.place(when, latitude_deg, longitude_deg)
        refracted_deg, _ = by_ephem(when, latitude_deg, longitude_deg, 1013.0)
        assert found.refracted_elevation_deg == pytest.approx(refracted_deg, abs=0.02)
        around_deg = (found.azimuth_deg - azimuth_deg + 180.0) % 360.0 - 180.0
        assert around_deg * np.cos(np.radians(geometric_deg)) == pytest.approx(0.0, abs=0.01)


def test_light_travels_away_from_the_refracted_sun() -> None:
    found = sun.place(evening(21, 33), *PARIS)
    to_sun = -found.direction(y_azimuth_deg=0.0)  # x east, y north, z up
    assert np.degrees(np.arcsin(to_sun[2])) == pytest.approx(1.74, abs=0.05)
    assert np.degrees(np.arctan2(to_sun[0], to_sun[1])) % 360.0 == pytest.approx(301.8, abs=0.1)
    straight = found.direction(y_azimuth_deg=found.azimuth_deg - 180.0)
    assert straight[:2] == pytest.approx([0.0, np.cos(np.radians(found.refracted_elevation_deg))], abs=1e-9)


def test_a_sun_that_is_down_and_a_time_without_offset_are_refused() -> None:
    with pytest.raises(InputError, match="expected the sun above the horizon, found it at -"):
        sun.place(evening(23, 30), *PARIS)
    with pytest.raises(InputError, match="offset from UTC"):
        sun.place(datetime(2009, 7, 15, 21, 9), *PARIS)


def test_the_suns_spectrum_at_air_mass_1_5_is_that_of_astm_g173() -> None:
    from pvlib.spectrum import get_reference_spectra

    published = get_reference_spectra(standard="ASTM G173-03")["direct"]  # of SMARTS 2, not of SPECTRL2
    mean_of_5_nm = [
        published[(published.index >= nm - 5.0) & (published.index <= nm + 5.0)].mean() for nm in WAVELENGTHS_NM
    ]
    elevation_deg = 90.0 - 48.19
    at_sea = sun.SunPlace(elevation_deg, 180.0, 80, 101_325.0)
    found = sun.clear_sky(at_sea, sun.Air(aerosol_depth_500nm=0.084))
    ratio = found.sun / np.array(mean_of_5_nm)
    assert np.quantile(np.abs(ratio - 1.0), 0.9) < 0.06
    assert luminous(found.sun) / luminous(np.array(mean_of_5_nm)) == pytest.approx(1.0, abs=0.03)


def test_a_low_sun_is_yellower_and_weaker_minute_by_minute() -> None:
    spectra = [sun.clear_sky(sun.place(evening(21, minute), *PARIS), sun.Air()).sun for minute in (9, 18, 33)]
    amounts = [float(luminous(spectrum)) for spectrum in spectra]
    blue_in_red = [spectrum[14] / spectrum[54] for spectrum in spectra]  # 450 and 650 nm
    assert amounts == sorted(amounts, reverse=True)
    assert blue_in_red == sorted(blue_in_red, reverse=True)


def series(folder: Path, header: str = "nm,2009-07-15T21:09+02:00,2009-07-15T21:19+02:00") -> Path:
    path = folder / "sun.csv"
    path.write_text(
        "\n".join([header, *(f"{nm},{0.4 + nm * 1e-3},{0.2 + nm * 1e-3}" for nm in range(380, 785, 5))])
    )
    return path


def test_a_measured_series_is_read_between_its_times(tmp_path: Path) -> None:
    found = read_series(series(tmp_path))
    assert found.at(evening(21, 9)) == pytest.approx(0.4 + WAVELENGTHS_NM * 1e-3)
    assert found.at(evening(21, 14)) == pytest.approx(0.3 + WAVELENGTHS_NM * 1e-3)
    with pytest.raises(InputError, match=r"expected a time from 2009-07-15T21:09:00\+02:00"):
        found.at(evening(21, 20))


@pytest.mark.parametrize(
    ("header", "says"),
    [
        ("nm,2009-07-15T21:09,2009-07-15T21:19", "offset from UTC, found 2009-07-15T21:09;"),
        ("nm,first,second", "found 'first'"),
        ("nm,2009-07-15T21:19+02:00,2009-07-15T21:09+02:00", "rising times"),
        ("nm", "at least two times"),
    ],
)
def test_a_series_without_plain_times_is_refused_at_its_first_line(tmp_path: Path, header: str, says: str) -> None:
    with pytest.raises(InputError, match=says) as refused:
        read_series(series(tmp_path, header))
    assert "sun.csv:1: " in str(refused.value)
