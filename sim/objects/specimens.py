"""Materials that are not a sum of Lambert and GGX, with spectra of `appearance.matter`, for the closed loop of
reflectance. Each is a reflectance that depends on both directions. A table has it for the camera's channels.

All figures are assumed. Materials are isotropic: cloth is the mean over its threads' directions.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import numpy as np

from coupole.appearance.matter import brdf, four_flux, layered, makie, tabulated, typical
from coupole.appearance.matter.brdf import Brdf
from coupole.appearance.matter.glossy_face import Face
from coupole.appearance.matter.hemisphere import albedo
from coupole.appearance.optics import fresnel, indices
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import BANDS, Array
from coupole.errors import InputError
from sim.objects.fabric import weave
from sim.optics.led_light import LedModel, camera_weights
from sim.scene.brdf_table import tabulate
from sim.scene.surface import Material

_THREAD_PLACES, _THREAD_TURNS = 8, 6
"""Number of normals of the weave along each side of its cell, and number of turns of the cloth. Their mean is
used."""
_THREAD_LOBE = 0.3
"""Width of a thread's gloss, rad."""
_RED_LACQUER = Face(np.asarray((1.0 - 0.04) * (1.0 - 0.6)), np.asarray(0.6), np.zeros(()))
"""Its face reflects 4 % from without and 60 % from within."""


def tabulated_finish() -> Brdf:
    """Return a metallic paint as Durikovic et al. 2002 measure one: a table about the mirror direction, with
    Beckmann facets on a body of rough diffuse grains."""
    grains = typical.reflectance("dull_yellow_shape").values

    def paint_brdf(wi: Array, wo: Array) -> Array:
        body = brdf.oren_nayar(wi, wo, reflectance=0.6 * grains, roughness=0.6)
        return np.asarray(body + 0.12 * brdf.cook_torrance(wi, wo, slope=0.28, fresnel=_gold))

    return partial(tabulated.tabulated_brdf, table=tabulated.tabulate(paint_brdf, np.linspace(0.0, 88.0, 12)))


def layered_paint() -> Brdf:
    """A red body under varnish."""
    coat = layered.coat(layered.sheet((), indices.BINDER), 0.22)
    return partial(layered.layered_brdf, coat=coat, body=typical.reflectance("red_shape"))


def makie_ground() -> Brdf:
    """Gold powder on red lacquer: a share of metal by its alpha, the rest diffuse (Durikovic et al. 2002, section
    4)."""
    powder = partial(brdf.cook_torrance, slope=0.32, fresnel=_gold)
    residual = _RED_LACQUER.reflectance_in_air(typical.reflectance("orange_shape")).values
    return partial(makie.makie_brdf, alpha=0.3, residual=0.7 * residual, metallic=powder)


def four_flux_varnish() -> Brdf:
    """A turbid varnish on blue under a glossy face (Dumazet et al. 2008, section 3.4). Directional light crosses
    the layer at its refracted angle. Outgoing light has the same angles as incoming light, so that the material is
    reciprocal."""
    index, rough = indices.BINDER, 0.3
    blue = typical.reflectance("blue_one_peak_shape").values
    cosines = np.linspace(0.02, 1.0, 50)
    longer = 1.0 / fresnel.cos_inside(cosines, 1.0, index).real[:, None]
    layer = four_flux.Layer(0.3, 2.0, 0.2 * longer, 6.0 * longer, 1.5 * longer, 0.08)
    diffuse, _ = four_flux.reflectances(layer, four_flux.Background(blue, blue))
    entering = (1.0 - fresnel.reflectance(cosines, index))[:, None] * np.sqrt(diffuse)
    inner = float(fresnel.diffuse_internal(index))
    leaving = (1.0 - inner) / (1.0 - inner * blue)

    def through(z: Array) -> Array:
        place = (np.clip(z, cosines[0], 1.0) - cosines[0]) / (cosines[1] - cosines[0])
        low = np.minimum(place.astype(int), len(cosines) - 2)
        share = (place - low)[..., None]
        return np.asarray(entering[low] * (1.0 - share) + entering[low + 1] * share)

    def varnish(wi: Array, wo: Array) -> Array:
        gloss = brdf.ggx(wi, wo, roughness=rough, fresnel=fresnel.of_index(np.full(BANDS, index)))
        return np.asarray(gloss + leaving * through(wi[..., 2]) * through(wo[..., 2]) / np.pi)

    return varnish


def woven_cloth() -> Brdf:
    """Return linen whose threads are finer than a pixel. It is the mean over the threads' normals
    (`fabric.weave`), each rough and with some gloss. Threads that face away from light or eye are dark. The other
    facets hide each other by the excess of their area (Ashikhmin, Premoze and Shirley, A microfacet-based BRDF
    generator, 2000). The result is the mean over all turns of the cloth."""
    places = (np.arange(_THREAD_PLACES) + 0.5) / _THREAD_PLACES
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    normals, shade = weave(grid, 1.0)
    linen = np.interp(np.linspace(0.0, 1.0, BANDS), [0.0, 1.0], [0.25, 0.6])
    turns = np.pi * np.arange(_THREAD_TURNS) / _THREAD_TURNS

    spins = np.array([[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in turns])
    threads = np.concatenate([np.column_stack([normals[:, :2] @ spin.T, normals[:, 2]]) for spin in spins])
    shares, bright = 1.0 / (threads[:, 2] * len(threads)), np.tile(shade, len(turns))

    def cloth(wi: Array, wo: Array) -> Array:
        half, _ = brdf.half_vector(wi, wo)
        total, gloss, area_lit, area_seen = (np.zeros(wi.shape[:-1]) for _ in range(4))
        for thread, share, factor in zip(threads, shares, bright, strict=True):
            lit, visible = np.maximum(wi @ thread, 0.0), np.maximum(wo @ thread, 0.0)
            total += factor * share * lit * visible
            gloss += share * lit * visible * np.exp(2.0 * (half @ thread - 1.0) / _THREAD_LOBE**2)
            area_lit += share * lit
            area_seen += share * visible
        body = total[..., None] * linen + 0.04 / _THREAD_LOBE**2 * gloss[..., None]
        return np.asarray(body / (np.pi * np.maximum(area_lit * area_seen, 1e-6))[..., None])

    return cloth


def _gold(cosine: Array) -> Array:
    """Schlick's approximation of gold's reflectance."""
    normal = fresnel.reflectance(1.0, indices.gold())
    return np.asarray(normal + (1.0 - normal) * (1.0 - np.asarray(cosine)[..., None]) ** 5)


SPECIMENS: dict[str, Callable[[], Brdf]] = {
    "tabulated": tabulated_finish,
    "layered": layered_paint,
    "makie": makie_ground,
    "four-flux": four_flux_varnish,
    "fabric": woven_cloth,
}


@cache
def specimen(name: str) -> Material:
    """Return one of `SPECIMENS` as a material of the simulated scene. Its diffuse reflectance is the share of
    light that it reflects at 45 degrees; it is used only for light from surface to surface. Raises InputError for
    another name."""
    if name not in SPECIMENS:
        raise InputError(f"specimen: expected one of {', '.join(SPECIMENS)}; found {name!r}; choose one of them")
    specimen_brdf = SPECIMENS[name]()
    weights = camera_weights(LedModel(), light.camera())
    red, green, blue = np.clip(
        albedo(specimen_brdf, np.array([np.sqrt(0.5)]), nodes=24)[0] @ weights.T, 1e-6, 1.0
    ).tolist()
    return Material(name, (red, green, blue), table=tabulate(specimen_brdf, weights))
