"""LEDs that are not steady Lambertian squares: a measured lobe, lobes that vary, tilted dies, a primary lens, and
lamps that warm."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from sim.render.emitter import Emitter

_TILT, _EXPONENT = 11, 12
"""Numbers of the seed's random streams."""
_LEAST_COSINE = 0.02
Floats = NDArray[np.float64]


class LightStranger(BaseModel):
    """Deviations in how the dome's LEDs radiate."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    lobe: tuple[tuple[float, float], ...] = ()
    """Pairs of angle from the die's normal, deg, and luminous intensity in any unit, as a goniometer measures
    them. Intensity is linear between them, and zero beyond the last. The flux stays the table's. Empty: the
    cosine."""
    die_tilt_deg: Annotated[float, Field(ge=0, le=30)] = 0.0
    """Standard deviation of each die's turn about two axes of its board. The die's position stays."""
    exponent_spread: Annotated[float, Field(ge=0, lt=0.3)] = 0.0
    """Standard deviation over the dies of the exponent of the cosine, which is 1 on average. The flux stays."""
    seed: int = 1
    warming: Annotated[float, Field(gt=-1, lt=1)] = 0.0
    """Share of the light that the LEDs lose while they warm."""
    warming_frames: Annotated[float, Field(gt=0)] = 500.0
    """Number of frames after which 63 % of that share are lost."""
    primary_lens_mm: float = 0.0
    """Shift of the die's image by the lens on the die, at right angles to the die's normal and towards the viewer,
    divided by the sine of the angle to the normal."""

    @field_validator("lobe")
    @classmethod
    def _from_the_normal_on(cls, lobe: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
        angles = [angle for angle, _ in lobe]
        rising = all(a < b for a, b in pairwise(angles))
        if lobe and (angles[0] != 0.0 or not rising or angles[-1] > 90.0 or min(i for _, i in lobe) < 0.0):
            raise ValueError("expected angles that rise from 0 to at most 90 deg, and intensities of 0 or more")
        return lobe

    def tilted_normals(self, normals: Floats, ids: NDArray[np.int64]) -> Floats:
        """Unit normals [n, 3] of the dies of LEDs `ids` on boards with these normals."""
        if not self.die_tilt_deg:
            return normals
        tilted_normals = normals.copy()
        for row, led in enumerate(ids):
            off = np.tan(np.radians(self.die_tilt_deg))
            lean = off * np.random.default_rng((self.seed, _TILT, int(led))).standard_normal(3)
            tilted_normals[row] += lean - (lean @ normals[row]) * normals[row]
        return np.asarray(tilted_normals / np.linalg.norm(tilted_normals, axis=1, keepdims=True))

    @property
    def has_lobe(self) -> bool:
        """True if light does not leave every die by the cosine law."""
        return bool(self.lobe or self.exponent_spread)

    def exponent(self, led: int) -> float:
        """Exponent by which an LED's lobe departs from the lobe of all LEDs."""
        return float(self.exponent_spread * np.random.default_rng((self.seed, _EXPONENT, led)).standard_normal())

    def warmth(self, frame: int) -> float:
        """Factor of the light at a frame."""
        return 1.0 - self.warming * (1.0 - float(np.exp(-frame / self.warming_frames)))

    def over_cosine(self, emitter: Emitter, points_mm: NDArray[np.float32], led: int) -> NDArray[np.float32]:
        """[n] factor of the light of an LED at points [n, 3] relative to the light of the same flux by the cosine
        law."""
        away = points_mm - emitter.centre_mm
        cosine = np.clip(away @ emitter.normal / np.linalg.norm(away, axis=1), _LEAST_COSINE, 1.0)
        own = self.exponent(led)
        own_lobe = (1.0 + 0.5 * own) * cosine**own
        return np.asarray(own_lobe * self.intensity(np.degrees(np.arccos(cosine))) / cosine, np.float32)

    def intensity(self, angle_deg: Floats) -> Floats:
        """Return the intensity relative to pi times the flux: the cosine without a lobe, otherwise the lobe with
        the same flux."""
        if not self.lobe:
            return np.asarray(np.cos(np.radians(angle_deg)))
        at_deg, relative_intensity = np.array(self.lobe).T
        grid = np.linspace(0.0, np.pi / 2, 1801)
        lobe = np.interp(np.degrees(grid), at_deg, relative_intensity, right=0.0)
        flux = 2.0 * np.trapezoid(lobe * np.sin(grid), grid)
        return np.asarray(np.interp(angle_deg, at_deg, relative_intensity, right=0.0) / flux)

    def seen_from(self, emitter: Emitter, eye_mm: Floats) -> Emitter:
        """Return the die's image that an eye sees through the primary lens."""
        away = eye_mm - emitter.centre_mm
        away = away / np.linalg.norm(away)
        across = away - (away @ emitter.normal) * emitter.normal
        return replace(emitter, centre_mm=emitter.centre_mm + self.primary_lens_mm * across)
