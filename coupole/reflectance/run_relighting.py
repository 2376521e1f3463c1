"""Views of a run under new lights, from a fit to its triangles."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.kernels.lanes import LANES
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.fits import (
    ANYWHERE,
    CLUSTERED,
    FITS,
    GGX_NORMAL,
    MATERIALS,
    PAIR_HARMONICS,
    RELIT,
    TEXELS,
    ViewFit,
)
from coupole.reflectance.new_light.beams import Beam, Lighting, lighting_of
from coupole.reflectance.new_light.light_kinds import AnyLight
from coupole.reflectance.new_light.mirrored import add_mirrored
from coupole.reflectance.new_light.pictured_surface import (
    FreeCamera,
    Surface,
    in_strips,
    surface_from,
    surface_of_view,
)
from coupole.reflectance.new_light.shading import (
    MIRROR_SHARE,
    Coats,
    Picture,
    add_beam,
    add_beams,
    add_values,
    alike,
    coats_of,
)
from coupole.reflectance.new_light.shadow_edges import trace_beam
from coupole.reflectance.pair_harmonics import pair_values
from coupole.reflectance.parts_in_threads import first_alone
from coupole.reflectance.run_result import RunResult, ViewSamples, read_about
from coupole.reflectance.texels.gathered import TexelView, gather, open_views
from coupole.reflectance.texels.pixel_file import ViewTexels, read_texel_errors
from coupole.reflectance.texels.texel_cluster_file import READ_TEXELS
from coupole.reflectance.triangle_fit import TriangleMaterials, TriangleSamples, model_values

Say = Callable[[int, int], None]
SAMPLES = 256
"""Number of beams of an area or an environment."""
_FAR_MM = 1e5
"""Distance at which distant light is placed for a slice."""
_TRIANGLES = 1 << 13


def best_fit(result: RunResult, among: Collection[str] = FITS) -> str:
    """The fit with the smallest error under the LEDs kept for the check; GGX with its normal if none were kept."""
    mae_of_fits = read_about(result.folder)["mae"].items()
    known_mae = {name: mae for name, mae in mae_of_fits if mae is not None and name in among}
    return min(known_mae, key=known_mae.__getitem__, default=GGX_NORMAL.name)


@dataclass(frozen=True)
class Slices:
    """A fit to one view alone."""

    fit: ViewFit
    coefficients: NDArray[np.float32]
    under: TriangleMaterials | None
    """Materials to which the slices are added."""


@dataclass(frozen=True)
class Pairs:
    """Harmonics of both directions, by the clusters of triangles."""

    normals: NDArray[np.float64]
    cluster: NDArray[np.int32]
    coefficients: NDArray[np.float32]


@dataclass(frozen=True)
class Texels:
    """Materials of the picture's own pixels; roughness is 0 for a pixel without material."""

    materials: TriangleMaterials
    covariance: NDArray[np.floating]
    """[n, 15] lower halves, as in files."""
    of_pixel: NDArray[np.int32]
    """[h, w] number of each pixel's material; -1 where no surface is seen."""

    @cached_property
    def coats(self) -> Coats:
        """Materials in the form that shading uses."""
        return coats_of(self.materials)


@dataclass(frozen=True)
class RelitScene:
    """A picture's surface and its materials, which can be lit by any lights."""

    result: RunResult
    fit: str
    surface: Surface
    reflecting: Coats | Slices | Pairs | Texels
    """Reflectance of the surface's triangles, or of its pixels."""
    views: tuple[ViewSamples, ...]
    """Views in the order in which they are searched for LEDs."""
    mesh: PacketMesh
    """Mesh that casts shadows."""

    @property
    def material_of_pixel(self) -> NDArray[np.int32]:
        """[h, w] place of a pixel's material among the materials of the scene; -1 where no surface is seen."""
        return self.reflecting.of_pixel if isinstance(self.reflecting, Texels) else self.surface.triangle_of_pixel

    def with_materials(self, materials: TriangleMaterials) -> RelitScene:
        """Return the same scene with other materials, of triangles or of texels."""
        if isinstance(self.reflecting, Texels):
            return replace(self, reflecting=replace(self.reflecting, materials=materials))
        return replace(self, reflecting=coats_of(materials))

    def picture(
        self,
        lights: Sequence[AnyLight],
        samples: int = SAMPLES,
        *,
        into: Picture | None = None,
        say: Say = lambda done, of: None,
    ) -> Picture:
        """[h, w, channels] radiance, linear, in the unit of `coupole.reflectance.new_light.light_kinds`; 0 where
        no triangle with a material is seen. It does not include inter-reflection.

        Each area and environment is divided into `samples` beams. The picture is made in the memory of `into`, an
        earlier picture that is no longer needed. Raises InputError for a light that the result does not have.
        """
        paper = read_about(self.result.folder).get("emission") == "paper"
        base_from_support, channels = self.result.base_from_support, self.result.channels
        lighting = lighting_of(lights, self.views, base_from_support, channels, samples, paper=paper)
        picture = np.zeros((*self.surface.triangle_of_pixel.shape, channels), np.float32) if into is None else into
        if into is not None:
            in_strips(len(into), lambda rows: into[rows].fill(0.0))
        if isinstance(self.reflecting, Slices | Pairs):
            self._by_values(picture, lighting, self.reflecting, say)
        else:
            self._by_materials(picture, lighting, self.reflecting, max(1, samples // MIRROR_SHARE), say)
        return picture

    def _by_materials(
        self, picture: Picture, lighting: Lighting, reflecting: Coats | Texels, lobe_rays: int, say: Say
    ) -> None:
        if isinstance(reflecting, Texels):
            surface, coats = self.surface.by_texels(reflecting.of_pixel), reflecting.coats
        else:
            surface, coats = self.surface, reflecting
        work = len(lighting.beams) + len(lighting.emitters)
        codes = np.zeros((LANES, *self.surface.triangle_of_pixel.shape), np.uint8)
        count = 0
        for beams in alike(lighting.beams):
            alone = len(beams) == 1 and beams[0].density == 0.0
            for lane, beam in enumerate(beams):
                trace_beam(self.mesh, self.surface, beam, codes[lane])
                count += 1
                say(count, work)
            if alone:
                add_beam(picture, surface, coats, codes[0], beams[0])
            else:
                add_beams(picture, surface, coats, codes, beams, lobe_rays)
        for number, emitter in enumerate(lighting.emitters):
            add_mirrored(picture, surface, coats, self.mesh, emitter, lobe_rays)
            say(len(lighting.beams) + number + 1, work)

    def _by_values(self, picture: Picture, lighting: Lighting, reflecting: Slices | Pairs, say: Say) -> None:
        codes = np.zeros(self.surface.triangle_of_pixel.shape, np.uint8)
        for number, beam in enumerate(lighting.beams):
            trace_beam(self.mesh, self.surface, beam, codes)
            add_values(picture, self.surface, self._triangle_values(reflecting, beam), codes, beam)
            say(number + 1, len(lighting.beams))

    def _triangle_values(self, reflecting: Slices | Pairs, beam: Beam) -> NDArray[np.float32]:
        """[triangles, channels] f cos_i, 1/sr, at the triangles' centres."""
        centres_mm = self.surface.centres_mm
        place_mm = beam.place if beam.near else centres_mm.mean(axis=0) + _FAR_MM * beam.place
        values = np.zeros((len(centres_mm), self.result.channels), np.float32)

        def of(first: int) -> None:
            part = slice(first, first + _TRIANGLES)
            count = len(centres_mm[part])
            light = TriangleSamples(
                np.zeros((count, 1, values.shape[1]), np.float32),
                place_mm[None],
                np.zeros(1, np.int64),
                self.surface.camera_mm[None],
                centres_mm[part],
                self.surface.normals[part],
                np.ones(count),
            )
            values[part] = np.nan_to_num(_values_of(reflecting, light, part)[:, 0])

        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            list(pool.map(first_alone(of), range(0, len(centres_mm), _TRIANGLES)))
        return values


def _values_of(reflecting: Slices | Pairs, light: TriangleSamples, part: slice) -> NDArray[np.float32]:
    """[b, 1, channels] f cos_i of some of the surface's triangles."""
    if isinstance(reflecting, Pairs):
        return pair_values(light, reflecting.normals[part], reflecting.cluster[part], reflecting.coefficients)
    under = None
    if reflecting.under is not None:
        under = model_values(light, reflecting.under.at(np.arange(part.start, part.start + len(light.values))))
    return reflecting.fit.values(light, reflecting.coefficients[part], under)


def scene_of_view(result: RunResult, view: str | None = None, fit: str | None = None) -> RelitScene:
    """Return the scene of a measured view and a fit. By default these are the first view, and the fit with the
    smallest error under the LEDs kept for the check. Raises InputError for a view or a fit that does not exist."""
    names = [run_view.view for run_view in result.views]
    if view is not None and view not in names:
        raise InputError(f"--view: expected one of {', '.join(names)}; got {view!r}")
    _refuse_unknown(fit)
    pictured_view = result.views[0 if view is None else names.index(view)]
    name = fit or best_with_texels(result)
    surface = surface_of_view(result, pictured_view)
    order = (pictured_view, *(run_view for run_view in result.views if run_view is not pictured_view))
    mesh = PacketMesh(result.corners_mm, compact=False)
    if name in READ_TEXELS:
        texels = _texels_of(READ_TEXELS[name](result, pictured_view), surface)
        return RelitScene(result, name, surface, texels, order, mesh)
    known_fit = FITS.get(name)
    if not isinstance(known_fit, ViewFit):
        return RelitScene(result, name, surface, _from_anywhere(result, name, surface), order, mesh)
    if not result.slices_path(name, pictured_view).exists():
        raise InputError(f"{result.folder}: has no fit {name}; `coupole reflectance fit {result.folder}` makes it")
    under = None if known_fit.over is None else materials_of(result, known_fit.over.name, surface)
    return RelitScene(
        result, name, surface, Slices(known_fit, result.slices(name, pictured_view), under), order, mesh
    )


def scene_from(result: RunResult, camera: FreeCamera, fit: str | None = None) -> RelitScene:
    """Return the scene that a camera at any place sees. Raises InputError for a fit that is not valid from there
    or does not exist, and if the camera sees nothing."""
    _refuse_unknown(fit)
    if fit is not None and fit not in ANYWHERE:
        raise InputError(
            f"--fit: {fit} holds for the view that it was fitted to; with --from expected {', '.join(ANYWHERE)}"
        )
    name = fit or best_with_texels(result, MATERIALS)
    mesh = PacketMesh(result.corners_mm, compact=False)
    surface = surface_from(result, mesh, camera)
    if name in READ_TEXELS:
        texels = _gathered_texels(open_views(result, READ_TEXELS[name]), surface)
        return RelitScene(result, name, surface, texels, result.views, mesh)
    return RelitScene(result, name, surface, _from_anywhere(result, name, surface), result.views, mesh)


def best_with_texels(result: RunResult, among: Collection[str] = FITS) -> str:
    """Return the name of texels if their error is smaller than the error of the best fit of triangles, in the same
    pixels; else the best fit `among` those named."""
    texel_errors = read_texel_errors(result.folder)
    known_mae = {name: mae for name, mae in texel_errors.items() if mae is not None}
    best = min(known_mae, key=known_mae.__getitem__, default=None)
    return TEXELS if best == TEXELS else best_fit(result, among)


def _texels_of(texels: ViewTexels, surface: Surface) -> Texels:
    is_seen = surface.triangle_of_pixel >= 0
    of_pixel = np.where(is_seen, texels.in_picture(is_seen.shape) + np.int32(1), np.int32(-1))
    values = (texels.normals, texels.kd, texels.ks, texels.alpha, texels.covariance)
    normals, kd, ks, alpha, covariance = (
        np.concatenate([np.zeros_like(rows[:1]), rows]).astype(np.float64) for rows in values
    )
    return Texels(TriangleMaterials(normals, kd, ks, alpha, np.zeros_like(alpha)), covariance, of_pixel)


def _gathered_texels(views: Sequence[TexelView], surface: Surface) -> Texels:
    """Return the texels of a picture from any camera: a material for each of its pixels."""
    seen = surface.triangle_of_pixel >= 0
    gathered = gather(views, surface.places_mm[seen])
    of_pixel = np.full(seen.shape, -1, np.int32)
    of_pixel[seen] = np.arange(np.count_nonzero(seen))
    return Texels(gathered.materials, gathered.covariance, of_pixel)


def _refuse_unknown(fit: str | None) -> None:
    if fit is not None and fit not in RELIT:
        raise InputError(f"--fit: expected one of {', '.join(RELIT)}; got {fit!r}")


def _from_anywhere(result: RunResult, name: str, surface: Surface) -> Coats | Pairs:
    if name != PAIR_HARMONICS:
        return coats_of(materials_of(result, name, surface))
    normals = materials_of(result, CLUSTERED, surface).normals
    places = np.searchsorted(result.triangles, surface.triangles)
    return Pairs(normals, result.clusters.cluster[places], result.clusters.harmonics)


def materials_of(result: RunResult, name: str, surface: Surface) -> TriangleMaterials:
    """Return the materials of the surface's triangles. Raises InputError if there are none."""
    places = np.searchsorted(result.triangles, surface.triangles)
    fit_name = GGX_NORMAL.name if name == CLUSTERED else name
    if not result.materials_path(fit_name).exists():
        raise InputError(
            f"{result.folder}: has no fit {fit_name}; `coupole reflectance fit {result.folder}` makes it"
        )
    materials = result.materials(fit_name, places)
    if name == CLUSTERED:
        materials = result.clusters.at(materials, surface.normals, places)
    return materials
