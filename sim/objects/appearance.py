"""Materials of virtual objects: spectra of `appearance.matter`, as the camera sees them under the dome's LEDs.

Each material is reduced to a diffuse reflectance, a reflectance at normal incidence and a roughness per channel
(`sim.scene.surface.Material`). The value 1 is a perfect diffuser: Spectralon itself has 0.99.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from coupole.appearance.matter import gilding, kubelka_munk, lacquer, typical
from coupole.appearance.matter.glossy_face import InternalReflectance, face
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.spectra import channels, light
from coupole.appearance.spectra.grid import BANDS, Array, Complex
from sim.optics.led_light import LedModel, camera_weights
from sim.scene.surface import Material, Rgb

SPECTRALON = Material("Spectralon", (0.99, 0.99, 0.99))
"""Labsphere's SRS-99: 99 % over the whole visible range."""
GREY_CARD = Material("grey card", (0.18, 0.18, 0.18))
"""18 % by definition."""
MATT_WHITE = Material("matt white", (0.90, 0.90, 0.90))
BLACK_TRAP = Material("black trap", (2e-4, 2e-4, 2e-4))
"""Opening of a deep hollow lined with black velvet (assumed): light that gets in hardly comes out."""
WHITE_PRINT = Material("white of a printed board", (0.85, 0.85, 0.85))
BLACK_PRINT = Material("black of a printed board", (0.035, 0.035, 0.035))
"""Matt print on aluminium composite; both values are assumed, the ratio is that of offset print."""
CHROME = Material("chrome", (0.0, 0.0, 0.0), (0.55, 0.55, 0.55), 0.02)
"""Chromium has n = 3.1, k = 3.3 near 550 nm (Johnson and Christy, Phys. Rev. B 9, 5056, 1974): Fresnel gives 0.55,
with little change over the visible. The roughness is a polished ball's (assumed)."""
STONE = Material("stone", (0.62, 0.55, 0.42))
"""Warm limestone (assumed); the demonstration object's."""
RETROREFLECTIVE = Material("retro-reflective film", (0.90, 0.90, 0.90))
"""Retro-reflective film as it looks under light that does not come from the camera: a white diffuser (assumed)."""


def rgb(spectral: ArrayLike) -> Rgb:
    """Red, green, blue of a reflectance [81], white being 1."""
    red, green, blue = channels.channel_values(np.broadcast_to(np.asarray(spectral, float), BANDS), _weights())
    return float(red), float(green), float(blue)


def paint(
    name: str, *, thickness_mm: float = np.inf, ground: ArrayLike = 0.0, scattering_per_mm: float = 30.0
) -> Material:
    """Return a pigment of `typical` in a glossy binder, as a layer over a ground of reflectance `ground` [81]
    inside it.

    Kubelka-Munk with Saunderson. `scattering_per_mm` is S, the same at all wavelengths: 30 hides a ground
    at about 0.1 mm (assumed).
    """
    opaque = typical.reflectance(name).values
    inside = opaque
    if np.isfinite(thickness_mm):
        absorption = kubelka_munk.k_over_s(opaque) * scattering_per_mm
        rho, tau = kubelka_munk.layer(absorption, scattering_per_mm, thickness_mm)
        inside = kubelka_munk.over(rho, tau, ground)
    return Material(
        f"{name}",
        rgb(face(indices.BINDER).reflectance_in_air(InternalReflectance(inside)).values),
        _normal(indices.BINDER),
        0.25,
    )


def gilt(thickness_nm: float, *, bare_fraction: float = 0.0, roughness: float = 0.12) -> Material:
    """Gold leaf on bole (`appearance.matter.gilding`): its specular part, and the bole visible through it.

    `bare_fraction` is the fraction bared by holes and cracks; a roughness of 0.12 is well burnished (assumed).
    """
    gilt_layers = gilding.gilt(indices.gold(), thickness_nm, typical.bole(), bare_share=bare_fraction)
    specular, diffuse = gilding.reflectances(gilt_layers)
    return Material(f"gold leaf, {thickness_nm:g} nm", rgb(diffuse), rgb(specular), roughness)


def metal(name: str, index: Complex, roughness: float) -> Material:
    """A bare metal of complex index [81]."""
    return Material(name, (0.0, 0.0, 0.0), rgb(fresnel.reflectance(1.0, index)), roughness)


def metal_in_lacquer(name: str, index: Complex, depth_mm: float, roughness: float) -> Material:
    """Metal at a depth in clear urushi, with absorption along the normal on both passes."""
    absorption = lacquer.urushi_absorption()
    transmission = lacquer.transmittance(depth_mm, 1.0, absorption) ** 2 * (1.0 - _dielectric(indices.URUSHI)) ** 2
    f0 = rgb(transmission * fresnel.reflectance(1.0, index, indices.URUSHI))
    return Material(name, (0.0, 0.0, 0.0), f0, roughness)


def black_lacquer(roughness: float = 0.04) -> Material:
    """Polished black urushi: a clear specular surface over a body of 0.6 % (assumed)."""
    return Material("black urushi", (0.006, 0.006, 0.006), _normal(indices.URUSHI), roughness)


def glossy(name: str, diffuse: Rgb, roughness: float) -> Material:
    """A coloured body under a clear coat of index 1.5; light reflected by the coat does not reach the body."""
    f0 = _normal(indices.BINDER)
    red, green, blue = (d * (1.0 - f) for d, f in zip(diffuse, f0, strict=True))
    return Material(name, (red, green, blue), f0, roughness)


def _dielectric(index: float) -> float:
    return float(fresnel.reflectance(1.0, index))


def _normal(index: float) -> Rgb:
    """Reflectance of a transparent medium at normal incidence."""
    f = _dielectric(index)
    return f, f, f


@cache
def _weights() -> Array:
    return camera_weights(LedModel(), light.camera())
