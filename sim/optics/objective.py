"""Effects of the simulated lens apart from its geometry (`sim.render.lens`): loss, vignetting, blur.

The lens is a thin lens of focal length f and f-number N, focused at s from its principal plane. The image distance
is f s/(s - f), and the magnification is m = f/(s - f).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from coupole.errors import InputError

Array = NDArray[np.float64]

CHANNEL_UM = (0.60, 0.54, 0.46)
"""Wavelengths that represent red, green and blue."""


@dataclass(frozen=True)
class Objective:
    """Optical properties. Defaults are the instrument's 35 mm at f/8; values marked "assumed" are typical."""

    focal_length_mm: float = 35.0
    focus_distance_mm: float = 334.0
    """Distance from the lens's principal plane to the plane in focus."""
    f_number: float = 8.0
    rim_radius: float = 3.0
    """Radius of the front rim, relative to the pupil's radius; stopped down to f/8 the rim is far outside
    (assumed)."""
    rim_shift: float = 4.0
    """Shift of the rim across the pupil, in radii of the pupil, for a tangent of 1 (assumed)."""
    lateral_colour: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Relative change of magnification of red, green and blue: 1e-4 is 0.2 pixel in a corner at full size."""

    def __post_init__(self) -> None:
        if not 0.0 < self.focal_length_mm < self.focus_distance_mm or self.f_number <= 0.0:
            raise InputError(
                f"simulated lens: expected a focus beyond the focal length of {self.focal_length_mm} mm and an "
                f"f-number above 0; found {self.focus_distance_mm} mm and f/{self.f_number}; "
                "set the camera's lens right"
            )

    @property
    def magnification(self) -> float:
        return self.focal_length_mm / (self.focus_distance_mm - self.focal_length_mm)

    @property
    def working_f_number(self) -> float:
        """N (1 + m): the cone of light at the sensor narrows with the lens's distance from it."""
        return self.f_number * (1.0 + self.magnification)


def vignetting(
    objective: Objective, tangent: ArrayLike, stop_shift_mm: tuple[ArrayLike, float] = (0.0, 0.0)
) -> Array:
    """Illuminance relative to the centre at a tangent of the angle to the axis: cos^4 and the rim's vignetting.

    `stop_shift_mm`: of a decentred stop, along the direction of the tangent and the length of the whole shift.
    """
    t = np.asarray(tangent, dtype=float)
    pupil_mm = 0.5 * objective.focal_length_mm / objective.f_number
    along, whole = np.asarray(stop_shift_mm[0]) / pupil_mm, stop_shift_mm[1] / pupil_mm
    rim = objective.rim_shift * t
    shift = np.sqrt(np.maximum(rim * rim - 2.0 * rim * along + whole * whole, 0.0))
    return np.asarray((1.0 + t * t) ** -2.0 * _overlap(objective.rim_radius, shift))


def defocus_px(objective: Objective, depth_mm: ArrayLike, pixel_pitch_um: float) -> Array:
    """Diameter of the circle of confusion, pixels, of points at a depth: f m/N |z - s|/z."""
    z = np.asarray(depth_mm, dtype=float)
    opening_mm = objective.focal_length_mm / objective.f_number
    circle_mm = opening_mm * objective.magnification * np.abs(z - objective.focus_distance_mm) / z
    return np.asarray(circle_mm * 1e3 / pixel_pitch_um)


def diffraction_px(objective: Objective, wavelength_um: ArrayLike, pixel_pitch_um: float) -> Array:
    """Standard deviation, pixels, of the normal distribution nearest to the Airy disk: 0.42 lambda N_w.

    Zhang, Zerubia, Olivo-Marin, Appl. Opt. 46, 1819 (2007): 0.21 lambda/NA, with NA = 1/(2 N_w).
    """
    return np.asarray(0.42 * np.asarray(wavelength_um) * objective.working_f_number / pixel_pitch_um)


def _overlap(rim: float, shift: Array) -> Array:
    """Fraction of a unit disk that is covered by a disk of radius `rim` with its centre `shift` away."""
    d = np.clip(shift, abs(1.0 - rim) + 1e-12, 1.0 + rim - 1e-12)
    in_unit = np.arccos(np.clip((d * d + 1.0 - rim * rim) / (2.0 * d), -1.0, 1.0))
    in_rim = np.arccos(np.clip((d * d + rim * rim - 1.0) / (2.0 * d * rim), -1.0, 1.0))
    kite = 0.5 * np.sqrt(np.maximum(0.0, (1.0 + rim - d) * (d + 1.0 - rim) * (d - 1.0 + rim) * (d + 1.0 + rim)))
    lens = (in_unit + rim * rim * in_rim - kite) / np.pi
    return np.where(shift <= abs(1.0 - rim), min(1.0, rim * rim), np.where(shift >= 1.0 + rim, 0.0, lens))
