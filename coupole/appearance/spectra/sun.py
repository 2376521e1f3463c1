"""The sun's place, its direct light and the light of a clear sky, from date, time and place.

The place is by NREL's algorithm (Reda and Andreas, Solar Energy 76, 577, 2004) with its refraction. The spectra
are by Bird and Riordan, J. Climate Appl. Meteorol. 25, 87, 1986 (SPECTRL2), over the air mass of Kasten and Young
at the refracted elevation. Both are computed by pvlib, which is imported on first use (this takes seconds).
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError

WIDTH_DEG = 0.533
"""Mean apparent diameter of the sun; it varies by 1.7 % in a year."""


@dataclass(frozen=True)
class SunPlace:
    """Place of the sun for an observer. Azimuths are counted from north towards east."""

    refracted_elevation_deg: float
    """Elevation of the disk's centre as seen through the air, from which the light comes."""
    azimuth_deg: float
    day_of_year: int
    pressure_pa: float
    """Pressure of the standard atmosphere at the observer's altitude."""

    def direction(self, y_azimuth_deg: float) -> Array:
        """[3], unit vector in which light travels, in a frame with z up and y towards `y_azimuth_deg`."""
        up = np.radians(self.refracted_elevation_deg)
        right_of_y = np.radians(self.azimuth_deg - y_azimuth_deg)
        level = np.cos(up)
        return -np.array([level * np.sin(right_of_y), level * np.cos(right_of_y), np.sin(up)])


@dataclass(frozen=True)
class Air:
    """Contents of a clear atmosphere. Defaults are those of ASTM G173, except for a thinner aerosol."""

    aerosol_depth_500nm: float = 0.1
    """Optical depth of the aerosol at 500 nm (rural; exponent 1.14): 0.05 very clear, 0.4 hazy."""
    water_cm: float = 1.42
    ozone_atm_cm: float = 0.344
    ground_albedo: float = 0.2


@dataclass(frozen=True)
class ClearSky:
    """Spectral irradiances [81], W/(m^2 nm)."""

    sun: Array
    """Direct light on a surface that faces the sun."""
    sky: Array
    """Light of the sky on a horizontal surface."""


def place(when: datetime, latitude_deg: float, longitude_deg: float, altitude_m: float = 0.0) -> SunPlace:
    """Return the sun's place. Raises InputError if `when` has no offset from UTC, or if the sun is down."""
    if when.tzinfo is None:
        raise InputError(
            f"{when.isoformat()}: expected a time with its offset from UTC, such as {when.isoformat()}+02:00"
        )
    pvlib, pandas = _pvlib()
    position = pvlib.solarposition.get_solarposition(
        pandas.DatetimeIndex([when]), latitude_deg, longitude_deg, altitude=altitude_m
    ).iloc[0]
    if position["apparent_elevation"] <= 0.0:
        raise InputError(
            f"{when} at {latitude_deg:g}, {longitude_deg:g}: expected the sun above the horizon, found it "
            f"at {position['apparent_elevation']:.1f} degrees; choose another time"
        )
    return SunPlace(
        float(position["apparent_elevation"]),
        float(position["azimuth"]),
        int(when.timetuple().tm_yday),
        float(pvlib.atmosphere.alt2pres(altitude_m)),
    )


def clear_sky(sun: SunPlace, air: Air) -> ClearSky:
    """Return the light under a sky without clouds.

    The model was compared with measurements up to about six air masses (10 degrees). At lower elevations it is
    extrapolated.
    """
    pvlib, _ = _pvlib()
    zenith_deg = 90.0 - sun.refracted_elevation_deg
    spectra = pvlib.spectrum.spectrl2(
        apparent_zenith=zenith_deg,
        aoi=zenith_deg,
        surface_tilt=0.0,
        ground_albedo=air.ground_albedo,
        surface_pressure=sun.pressure_pa,
        relative_airmass=pvlib.atmosphere.get_relative_airmass(zenith_deg),
        precipitable_water=air.water_cm,
        ozone=air.ozone_atm_cm,
        aerosol_turbidity_500nm=air.aerosol_depth_500nm,
        dayofyear=sun.day_of_year,
    )

    def on_grid(values: Any) -> Array:
        return np.interp(WAVELENGTHS_NM, spectra["wavelength"], np.ravel(values))

    return ClearSky(on_grid(spectra["dni"]), on_grid(spectra["dhi"]))


def _pvlib() -> tuple[Any, Any]:
    import pandas
    import pvlib

    return pvlib, pandas
