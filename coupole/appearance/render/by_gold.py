"""A picture of gold in the sun, by paths, and by photons for light that paths find only by chance
(`photon_map`)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.optics import fresnel
from coupole.appearance.render import bands, objects
from coupole.appearance.render.caustic import Reflectance, Sun
from coupole.appearance.render.lights import Distant, PlainLight
from coupole.appearance.render.materials import Diffuse, Gilt, Material, Metal, metal_of
from coupole.appearance.render.model import unit
from coupole.appearance.render.panes import Pane
from coupole.appearance.render.photon_map import Matt, Mirror, Room, seen_by_gold
from coupole.appearance.render.pieces import Ball
from coupole.appearance.render.rendering import Spectral, open_renderer
from coupole.appearance.render.scene_file import Camera, Gathered, PlainScene
from coupole.appearance.render.spectra import Constant, matt, power, scaled_power
from coupole.appearance.render.wall import gold_reflectance
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

Progress = Callable[[int, int], None]
_RAYS = 2
"""Number of rays that each pixel has along each of its sides."""
_BLACK = Diffuse(kind="diffuse", reflectance=Constant(kind="constant", value=0.0))


def render(scene: PlainScene, gathering: Gathered, camera: Camera, folder: Path, progress: Progress) -> Spectral:
    """Return radiance as the sum of three parts. Other lights are rendered by paths. The suns are rendered by
    paths: with black gold where matt surfaces are seen, and with all materials where gold is seen. Sunlight that
    gold sends onto matt surfaces is rendered by photons.

    Raises InputError for materials that are not supported for photons.
    """
    suns = tuple(light for light in scene.lights if isinstance(light, Distant))
    other_lights = tuple(light for light in scene.lights if not isinstance(light, Distant))
    room = _room(scene, folder)
    band_numbers = bands.rendered_bands(scene.bands.step_nm)
    by_photons, is_gold = seen_by_gold(
        room,
        [_sun(light, scene, folder) for light in suns],
        eye_rays(camera),
        band_numbers,
        gathering,
        scene.seed,
        progress,
    )
    shape = (camera.height_px, camera.width_px, _RAYS**2, -1)
    photon_radiance = by_photons.reshape(shape).mean(axis=2)
    gold = is_gold.reshape(shape).mean(axis=(2, 3))[..., None]
    whole = _paths(scene, suns, camera, folder)
    matt = _paths(_without_gold(scene, folder), suns, camera, folder)
    around = _paths(scene, other_lights, camera, folder).stokes[0] if other_lights else 0.0
    radiance = around + np.where(gold >= 0.5, whole.stokes[0], matt.stokes[0] + photon_radiance)
    return Spectral(whole.wavelengths_nm, radiance[None].astype(np.float32), whole.samples, whole.noise)


def eye_rays(camera: Camera) -> tuple[Array, NDArray[np.float64]]:
    """Return starts and directions [h w 4, 3] of a camera's rays, four for each pixel, row by row."""
    ahead = np.subtract(camera.target_mm, camera.position_mm) / np.linalg.norm(
        np.subtract(camera.target_mm, camera.position_mm)
    )
    right = np.cross(ahead, camera.up)
    right /= np.linalg.norm(right)
    above = np.cross(right, ahead)
    parts = (np.arange(_RAYS) + 0.5) / _RAYS
    columns = (np.arange(camera.width_px)[:, None] + parts) / camera.width_px
    rows = (np.arange(camera.height_px)[:, None] + parts) / camera.height_px
    half = np.tan(np.radians(camera.field_deg() / 2))
    x = half * (2.0 * columns - 1.0)
    y = half * (1.0 - 2.0 * rows) * camera.height_px / camera.width_px
    ways = (ahead + x[None, :, None, :, None] * right + y[:, None, :, None, None] * above).reshape(-1, 3)
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return np.broadcast_to(np.asarray(camera.position_mm, dtype=float), ways.shape).copy(), ways


def _paths(scene: PlainScene, lights: tuple[PlainLight, ...], camera: Camera, folder: Path) -> Spectral:
    lit = scene.model_copy(update={"lights": lights, "polarisation": False})
    with open_renderer(lit, folder) as renderer:
        return renderer.render(camera)


def _sun(light: Distant, scene: PlainScene, folder: Path) -> Sun:
    irradiance = scaled_power(power(light.spectrum, folder), light.illuminance_lux)
    means = bands.around_nodes(irradiance, scene.bands.step_nm)
    return Sun(np.array(unit(light.direction)), light.width_deg, means)


def _room(scene: PlainScene, folder: Path) -> Room:
    surfaces: list[Mirror | Matt] = []
    for thing in scene.objects:
        for piece in objects.pieces(thing, folder):
            corners = _ball(piece) if isinstance(piece, Ball) else piece.corners_mm
            surfaces.append(_surface(piece.material, corners, folder, scene.name))
    if not any(isinstance(surface, Mirror) for surface in surfaces):
        raise InputError(
            f"{scene.name}: `gathered` expected an object of `gilt` or `metal`, found none; leave it out"
        )
    return Room(surfaces)


def _surface(material: Material | Pane, corners_mm: Array, folder: Path, name: str) -> Mirror | Matt:
    if isinstance(material, Diffuse):
        return Matt(corners_mm, matt(material.reflectance, folder).values)
    if isinstance(material, Gilt):
        return Mirror(corners_mm, gold_reflectance(material, folder), material.roughness)
    if isinstance(material, Metal) and material.depth_mm is None:
        return Mirror(corners_mm, _bare(material, folder), material.roughness)
    raise InputError(
        f"{name}: `gathered` expected materials `diffuse`, `gilt` and bare `metal`, found `{material.kind}`; "
        "choose another material, or leave `gathered` out"
    )


def _bare(material: Metal, folder: Path) -> Reflectance:
    index = metal_of(material, folder)
    return lambda cosines: fresnel.reflectance(cosines, index)


def _ball(ball: Ball) -> Array:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=5, radius=ball.radius_mm)
    return np.asarray(mesh.triangles, dtype=float) + ball.centre_mm


def _without_gold(scene: PlainScene, folder: Path) -> PlainScene:
    def black(thing: objects.Object) -> objects.Object:
        update = {
            name: _BLACK for name in type(thing).model_fields if isinstance(getattr(thing, name), (Gilt, Metal))
        }
        return thing.model_copy(update=update)

    dark = scene.model_copy(update={"objects": tuple(black(thing) for thing in scene.objects)})
    for thing in dark.objects:
        if any(isinstance(piece.material, (Gilt, Metal)) for piece in objects.pieces(thing, folder)):
            raise InputError(f"{scene.name}: `gathered` does not know the gold of `{thing.kind}`; leave it out")
    return dark
