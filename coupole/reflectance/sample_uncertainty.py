"""Uncertainty of samples of reflectance: in closed form for each, and by Monte Carlo through the whole measurement
equation, source by source (Lucat et al. 2025, 6.1; JCGM 101).

A sample is f = S / (P L cos): the signal S over the LED's power P, the geometry L of its emission and distance,
and the cosine of incidence. Relative errors are normal: a for the signal in the numerator, b for all factors of
the denominator. The cosine's error comes from the tilt that noise of the scanner's vertices gives a triangle. The
ratio of two such values is asymmetric; its bounds are Fieller's (1954).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from coupole.reflectance.extraction.lamp_sight import lit_by

Floats = NDArray[np.float64]

SOURCES = {
    "u_noise": "noise of the frames",
    "u_response": "own responses of pixels",
    "u_indirect": "inter-reflection taken off",
    "u_place": "where pixels look",
    "u_own": "power of each LED",
    "u_shared": "power of all LEDs, response, fall-off, drift",
    "vertex_um": "vertices of the mesh",
    "led_mm": "places of the LEDs",
    "u_glare": "veiling glare taken off",
}
"""Names of the fields of `Sources`, with what each of them means."""


@dataclass(frozen=True)
class Sources:
    """Standard uncertainties of n samples."""

    u_noise: Floats
    """[n] relative."""
    u_response: Floats
    """[n] relative uncertainty from the responses of the pixels that a triangle covers."""
    u_indirect: Floats
    """[n] relative uncertainty from the subtracted inter-reflection."""
    u_place: Floats
    """[n] relative uncertainty from the surface beside a triangle that pixels may see."""
    u_own: Floats
    """[n] relative uncertainty from an LED's own power."""
    u_shared: Floats
    """[n] relative uncertainty from errors that all LEDs share."""
    vertex_um: Floats
    """[n] uncertainty of each coordinate of a vertex; coordinates are independent."""
    led_mm: Floats
    """[n] uncertainty of each coordinate of an LED."""
    u_glare: Floats
    """[n] relative uncertainty from the subtracted veil."""

    @property
    def u_signal(self) -> Floats:
        """[n] relative."""
        parts = (self.u_noise, self.u_response, self.u_indirect, self.u_place, self.u_glare)
        u_relative: Floats = np.sqrt(np.sum(np.square(parts), axis=0))
        return u_relative

    def without(self, source: str) -> Sources:
        """Return the same uncertainties with one of `SOURCES` at 0."""
        return replace(self, **{source: np.zeros_like(getattr(self, source))})

    def at(self, row_numbers: NDArray[np.int64]) -> Sources:
        return Sources(*(getattr(self, field.name)[row_numbers] for field in fields(self)))


@dataclass(frozen=True)
class Places:
    """Places of n measured samples, mm, base frame."""

    corners_mm: Floats
    """[n, 3, 3] corners of their triangles."""
    led_mm: Floats
    """[n, 3]"""
    led_normals: Floats
    """[n, 3] unit."""

    def at(self, row_numbers: NDArray[np.int64]) -> Places:
        return Places(*(getattr(self, field.name)[row_numbers] for field in fields(self)))


def bounds(places: Places, sources: Sources, quantile: float) -> tuple[Floats, Floats]:
    """[n] lower and upper bounds of the true reflectance over the measured one, at `quantile` standard deviations
    of a normal distribution. The upper bound is infinite if the incidence is too grazing for a bound."""
    centres, normals = _centres_and_normals(places.corners_mm)
    ways = places.led_mm - centres
    distances = np.linalg.norm(ways, axis=1)
    towards = ways / distances[:, None]
    cosine = np.sum(towards * normals, axis=1)
    tilt = tilt_covariance(places.corners_mm, sources.vertex_um)
    by_tilt2 = np.einsum("ni,nij,nj->n", towards, tilt, towards) / cosine**2
    by_place2 = (sources.led_mm / distances) ** 2 * (4.0 + 1.0 / cosine**2 - 1.0)
    below2 = quantile**2 * (by_tilt2 + by_place2 + sources.u_own**2 + sources.u_shared**2)
    above2 = quantile**2 * sources.u_signal**2
    root = np.sqrt(np.maximum(1.0 - (1.0 - below2) * (1.0 - above2), 0.0))
    # a tilt to any side makes the mean of the cosine smaller
    longer = np.sqrt(1.0 + np.trace(tilt, axis1=1, axis2=2))
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = (1.0 - root) / (1.0 - below2), (1.0 + root) / (1.0 - below2)
    low = np.where((below2 < 1.0) | (above2 < 1.0), low, 0.0)  # neither says anything
    return longer * low, np.where(below2 < 1.0, longer * high, np.inf)


def tilt_covariance(corners_mm: Floats, vertex_um: Floats) -> Floats:
    """[n, 3, 3] covariance, rad^2, of the tilt of triangles from errors of their vertices. A vertex that is higher
    by h tilts the normal by -h times the gradient of its barycentric coordinate. This gradient is 1 over the
    triangle's height at the vertex."""
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    twice_area = np.linalg.norm(across, axis=1, keepdims=True)
    normals = across / twice_area
    covariance = np.zeros((len(corners_mm), 3, 3))
    for corner in range(3):
        opposite = corners_mm[:, (corner + 2) % 3] - corners_mm[:, (corner + 1) % 3]
        gradient = np.cross(normals, opposite) / twice_area
        covariance += gradient[:, :, None] * gradient[:, None, :]
    return covariance * ((vertex_um * 1e-3) ** 2)[:, None, None]


class MonteCarlo:
    """Random draws of power, vertices and LEDs for n places. Tables from the same draws differ only by their
    sources, and share the values that these do not change."""

    def __init__(self, places: Places, draws: int, random: np.random.Generator, *, paper: bool = False) -> None:
        self._places, self._paper = places, paper
        self._shape = len(places.corners_mm), draws
        self._vertices, self._leds = (random.standard_normal((*self._shape, *more)) for more in ((3, 3), (3,)))
        self._signal, self._own, self._shared = (random.standard_normal(self._shape) for _ in range(3))
        self._by_sources: dict[tuple[bytes, bytes], Floats] = {}

    def ratios(self, sources: Sources) -> Floats:
        """[n, draws] true over measured reflectance: the drawn signal is divided by the irradiance from the drawn
        power, vertices and LEDs. Draws in which the light would come from below are NaN."""
        places = self._places
        measured_geometry = _geometry(places.corners_mm, places.led_mm, places.led_normals, self._paper)
        key = sources.vertex_um.tobytes(), sources.led_mm.tobytes()
        if key not in self._by_sources:
            self._by_sources[key] = self._drawn_geometry(sources)
        geometry = self._by_sources[key]
        signal = 1.0 + sources.u_signal[:, None] * self._signal
        power = (1.0 + sources.u_own[:, None] * self._own) * (1.0 + sources.u_shared[:, None] * self._shared)
        with np.errstate(divide="ignore"):
            ratios: Floats = signal * measured_geometry[:, None] / (power * geometry)
        ratios[geometry <= 0.0] = np.nan
        return ratios

    def _drawn_geometry(self, sources: Sources) -> Floats:
        places, (count, _) = self._places, self._shape
        vertices_mm = (sources.vertex_um * 1e-3).reshape(count, 1, 1, 1) * self._vertices
        corners = places.corners_mm[:, None] + vertices_mm
        leds = places.led_mm[:, None] + sources.led_mm.reshape(count, 1, 1) * self._leds
        axes = np.broadcast_to(places.led_normals[:, None], leds.shape)
        flat = _geometry(corners.reshape(-1, 3, 3), leds.reshape(-1, 3), axes.reshape(-1, 3), self._paper)
        return flat.reshape(self._shape)


def _geometry(corners_mm: Floats, led_mm: Floats, led_normals: Floats, paper: bool) -> Floats:
    """Return the irradiance [n] for a power of 1."""
    centres, normals = _centres_and_normals(corners_mm)
    ways = led_mm - centres
    cosine = np.sum(ways * normals, axis=1) / np.linalg.norm(ways, axis=1)
    geometry: Floats = _lit_each(centres, led_mm, led_normals, paper) * cosine
    return geometry


@kernel
def _lit_each(centres, led_mm, led_normals, paper):  # type: ignore[no-untyped-def]
    lit, towards = np.empty(len(centres)), np.empty(3)
    for n in range(len(centres)):
        lit[n] = lit_by(centres[n], led_mm[n], led_normals[n], paper, towards)
    return lit


def _centres_and_normals(corners_mm: Floats) -> tuple[Floats, Floats]:
    across = np.cross(corners_mm[:, 1] - corners_mm[:, 0], corners_mm[:, 2] - corners_mm[:, 0])
    return corners_mm.mean(axis=1), across / np.linalg.norm(across, axis=1, keepdims=True)
