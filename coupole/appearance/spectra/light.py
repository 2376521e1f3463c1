"""Illuminants, LEDs and observers on the grid, from colour-science (data of the CIE), and tristimulus values.

The library takes seconds to import: it is imported on first use of its data.
"""

from __future__ import annotations

import warnings
from functools import cache
from typing import Any, Literal

import numpy as np

from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError

Observer = Literal["10 deg", "2 deg"]
_OBSERVERS = {
    "10 deg": "CIE 1964 10 Degree Standard Observer",
    "2 deg": "CIE 1931 2 Degree Standard Observer",
}
# CIE 15: XYZ to linear sRGB (IEC 61966-2-1), for white D65 seen by the 2-degree observer.
_SRGB_FROM_XYZ = np.array(
    [[3.2406255, -1.5372080, -0.4986286], [-0.9689307, 1.8757561, 0.0415175], [0.0557101, -0.2040211, 1.0569959]]
)


@cache
def illuminant(name: str) -> Array:
    """Relative spectral power [81], 100 at 560 nm: E, A (Planck's law, CIE 15) or another name of the CIE
    (D65)."""
    if name == "E":
        power = np.full_like(WAVELENGTHS_NM, 100.0)
    elif name == "A":
        planck = WAVELENGTHS_NM**-5.0 / np.expm1(1.435e7 / (2848.0 * WAVELENGTHS_NM))
        power = 100.0 * planck / planck[np.searchsorted(WAVELENGTHS_NM, 560.0)]
    else:
        power = _on_grid(_choose(_colour().SDS_ILLUMINANTS, "illuminant", name))
    power.setflags(write=False)
    return power


@cache
def observer(name: Observer = "10 deg") -> Array:
    """Colour matching functions [3, 81] of the CIE 1964 10-degree or the 1931 2-degree observer."""
    if name not in _OBSERVERS:
        raise InputError(f"observer: expected one of {', '.join(_OBSERVERS)}; found {name!r}; choose one of them")
    functions = _on_grid(_colour().MSDS_CMFS[_OBSERVERS[name]]).T.copy()
    functions.setflags(write=False)
    return functions


@cache
def led(name: str) -> Array:
    """Relative spectral power [81] of a light source that colour-science knows, such as 'LED-B3' of the CIE or
    'Phosphor LED YAG'; its peak is 1."""
    colour = _colour()
    sources = {**colour.SDS_LIGHT_SOURCES, **colour.SDS_ILLUMINANTS}
    power = _on_grid(_choose(sources, "light source", name))
    power /= power.max()
    power.setflags(write=False)
    return power


@cache
def camera(name: str = "Nikon 5100 (NPL)") -> Array:
    """Relative sensitivities [3, 81] (red, green, blue) of a camera that colour-science knows.

    They were measured by the NPL, and replace the curves of a sensor that has not been measured.
    """
    sensitivities = _on_grid(_choose(_colour().MSDS_CAMERA_SENSITIVITIES, "camera", name)).T.copy()
    sensitivities.setflags(write=False)
    return sensitivities


def tristimulus(reflectance: Array, power: Array, functions: Array) -> Array:
    """XYZ [..., 3] of reflectances [..., 81], Y = 1 for the perfect white (CIE 15, sums over 5 nm)."""
    weights = power * functions / (power @ functions[1])
    return np.asarray(reflectance @ weights.T)


def lab(xyz: Array, white: Array) -> Array:
    """CIE 1976 L*, a*, b* [..., 3]."""
    ratio = np.asarray(xyz, dtype=float) / white
    f = np.where(ratio > (6.0 / 29.0) ** 3, np.cbrt(ratio), ratio * (29.0 / 6.0) ** 2 / 3.0 + 4.0 / 29.0)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def linear_srgb(xyz: Array) -> Array:
    """Linear sRGB [..., 3] of XYZ (white D65, 2-degree observer). Values are outside 0 to 1 for colours outside
    the gamut."""
    return np.asarray(np.asarray(xyz, dtype=float) @ _SRGB_FROM_XYZ.T)


def _choose(choices: Any, quantity: str, name: str) -> Any:
    if name not in choices:
        raise InputError(
            f"{quantity}: expected one of {', '.join(sorted(choices))}; found {name!r}; choose one of them"
        )
    return choices[name]


def _on_grid(distribution: Any) -> Array:
    """Values [81], or [81, n], at the grid's wavelengths, 0 beyond the table.

    Nearly all tables have steps of 1 or 5 nm and are used unchanged; coarser ones are interpolated linearly.
    """
    wavelengths, values = np.asarray(distribution.wavelengths), np.asarray(distribution.values, dtype=float)
    columns = [
        np.interp(WAVELENGTHS_NM, wavelengths, column, left=0.0, right=0.0)
        for column in values.reshape(len(wavelengths), -1).T
    ]
    return np.stack(columns, axis=-1).reshape(-1, *values.shape[1:])


@cache
def _colour() -> Any:
    with warnings.catch_warnings():
        # The library warns at every import if matplotlib is missing; its plots are not used here.
        warnings.filterwarnings("ignore", message='"Matplotlib" related')
        import colour

    return colour
