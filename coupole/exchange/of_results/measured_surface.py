"""The surface that exporters get from a result of runs: the whole mesh, and the known material of each
triangle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.material_values import red_green_blue, standard_uncertainties
from coupole.geometry import apply, inverse
from coupole.reflectance.fits import MATERIALS, OF_TEXELS, TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.run_relighting import best_fit
from coupole.reflectance.run_result import RunResult, read_about
from coupole.reflectance.texels.pixel_file import read_texel_errors
from coupole.reflectance.texels.texel_cluster_file import describe_sharing
from coupole.storage import so_far

Floats = NDArray[np.float64]
Said = Callable[[str, int, int], None]
_LEAST_PASSED = 0.05
Y_UP_FROM_SUPPORT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation for programs of computer graphics, in which y is up."""


def _say_nothing(_step: str, _count: int, _total: int) -> None:
    """Report no progress."""


def _tell_nobody(_line: str) -> None:
    """Ignore a message."""


@dataclass(frozen=True)
class ExportChoice:
    """Options of an export, besides its format."""

    triangles: tuple[int, ...] = ()
    """Triangles that the user has named."""
    most_error: float | None = None
    """Greatest relative error of tables that adapt to their material; None for plain tables."""
    texel_mm: float | None = None
    """Width of a map's texels; None for the width of the views' pixels."""
    map_px: int | None = None
    """Greatest width of maps; None for no limit."""
    uv_mesh: Path | None = None
    """The same mesh with texture coordinates, which place the maps; None for charts of our own."""
    say: Said = _say_nothing
    tell: Callable[[str], None] = _tell_nobody
    """Function that takes a message for the user."""


@dataclass(frozen=True)
class MeasuredSurface:
    """Positions and directions are in the support frame (z up, mm). Values are NaN where no material is known."""

    result: RunResult
    fit: str
    """The fit of the materials, one of `fits.MATERIALS` or `fits.OF_TEXELS`. With texels, triangles have the
    materials of the best other fit."""
    about: dict[str, Any]
    """Content of result.json."""
    vertices_mm: Floats
    """[v, 3]"""
    triangles: NDArray[np.int64]
    """[n, 3] for all triangles of the mesh the rows of their vertices."""
    normals: Floats
    """[n, 3] fitted normals; normals of the mesh where no material is known."""
    kd: Floats
    """[n, 3] red, green, blue; 1/sr. f = kd + ks D V, GGX's D and the height-correlated V of `ggx`."""
    ks: Floats
    """[n, 3]"""
    alpha: Floats
    """[n] GGX's roughness."""
    uncertain: dict[str, Floats]
    """[n] standard uncertainties from all sources: `u_kd`, `u_ks`, `u_alpha` relative (the channels' mean),
    `u_normal` in rad."""
    options: ExportChoice = ExportChoice()
    sharing: str = ""
    """Sentence about the materials that texels share; empty for other fits."""

    @cached_property
    def has_material(self) -> NDArray[np.bool_]:
        """[n] triangles that have a material."""
        return np.isfinite(self.alpha) & np.isfinite(self.kd).all(axis=1)

    @property
    def has_maps(self) -> bool:
        """True if maps are written instead of one texel for each triangle, by formats that can do both."""
        return self.fit in OF_TEXELS or self.options.uv_mesh is not None

    @property
    def remark(self) -> str:
        """Remark in files about themselves, if their format allows it."""
        kind = "simulated" if self.about.get("simulated") else "measured"
        version, runs = self.about["software"]["coupole"], ", ".join(sorted(self.about["runs"]))
        origin = f"{kind} with Coupole {version}; fit {self.fit} of {runs}"
        return "; ".join(words for words in (origin, self.sharing, so_far.words(self.about)) if words)


def under_a_layer(kd: NDArray[np.floating], ks: NDArray[np.floating]) -> Floats:
    """[n, 3] colour, 0 to 1, of the diffuse part under a model's specular layer. It is pi kd, increased by the
    share that a layer with the brightest ks reflects at normal incidence."""
    passes = np.maximum(1.0 - ks.max(axis=1, keepdims=True), _LEAST_PASSED)
    return np.asarray(np.clip(np.pi * kd / passes, 0.0, 1.0))


def read_surface(
    folder: Path, fit: str | None = None, options: ExportChoice | None = None, *, takes_texels: bool = False
) -> MeasuredSurface:
    """Read the surface of a complete result. The material is that of the named fit, or of the fit with the
    smallest error; `takes_texels` tells whether this may be one of `OF_TEXELS`. Raises InputError if there is
    no such fit."""
    about = read_about(folder)
    result = RunResult(folder)
    name = fit or _best(result, takes_texels=takes_texels)
    if name not in (*MATERIALS, *OF_TEXELS):
        raise InputError(
            f"--fit: expected {' or '.join(MATERIALS)}, which are valid from every direction; got {name}"
        )
    if name in OF_TEXELS and not takes_texels:
        raise InputError(f"--fit {name}: is for formats with maps; this format has one material for each triangle")
    sharing = describe_sharing(folder) if name == TEXEL_CLUSTERS else ""
    of_triangles = best_fit(result, MATERIALS) if name in OF_TEXELS else name
    path = result.materials_path(of_triangles)
    if not path.exists():
        raise InputError(f"{folder}: has no fit {of_triangles}; `coupole reflectance fit {folder}` makes it")
    support_from_base = inverse(result.base_from_support)
    vertices, number = np.unique(result.corners_mm.reshape(-1, 3), axis=0, return_inverse=True)
    vertices_mm = apply(support_from_base, vertices.astype(np.float64))
    triangles = number.reshape(-1, 3)
    corners = vertices_mm[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    materials = result.materials(of_triangles)
    is_fitted = np.isfinite(materials.alpha)
    normals[result.triangles[is_fitted]] = materials.normals[is_fitted] @ support_from_base[:3, :3].T

    def everywhere(values: Floats) -> Floats:
        whole = np.full((len(triangles), *values.shape[1:]), np.nan)
        whole[result.triangles] = values
        return whole

    return MeasuredSurface(
        result,
        name,
        about,
        vertices_mm,
        triangles,
        normals,
        everywhere(red_green_blue(materials.kd)),
        everywhere(red_green_blue(materials.ks)),
        everywhere(materials.alpha),
        {key: everywhere(values) for key, values in standard_uncertainties(path).items()},
        options or ExportChoice(),
        sharing,
    )


def _best(result: RunResult, *, takes_texels: bool) -> str:
    """Return the material with the smallest error in the check. Texels come first, unless they were compared there
    and had a larger error."""
    of_triangles = best_fit(result, MATERIALS)
    mae = read_texel_errors(result.folder)
    texels_miss, triangles_miss = mae.get(TEXELS), mae.get(of_triangles)
    if not takes_texels or texels_miss is None:
        return of_triangles
    return TEXELS if triangles_miss is None or texels_miss < triangles_miss else of_triangles
