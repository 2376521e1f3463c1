"""Uncertainty of relit pictures, from the uncertainty of their materials."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.reflectance.fits import MATERIALS, TEXELS
from coupole.reflectance.ggx import UNKNOWNS
from coupole.reflectance.new_light.light_kinds import AnyLight
from coupole.reflectance.new_light.shading import Picture
from coupole.reflectance.run_relighting import SAMPLES, RelitScene, Say, Texels, materials_of
from coupole.reflectance.run_result import RunResult, whole_covariances
from coupole.reflectance.run_result_files import refuse_without_uncertainty
from coupole.reflectance.texels.pixel_file import texel_uncertainty, views_with_texels
from coupole.reflectance.triangle_fit import TriangleMaterials, turned_normals

Floats = NDArray[np.float64]
_LONGEST_STEP = 0.02
"""Longest step of tilts (rad) and of alpha's logarithm, to both sides. It is small enough for a derivative and
large enough for float32. Pictures are linear in kd and ks."""
_NOT_LINEAR = (0, 1, 4)


def uncertainty_of_picture(
    scene: RelitScene, lights: Sequence[AnyLight], samples: int = SAMPLES, *, say: Say = lambda done, of: None
) -> NDArray[np.float32]:
    """[h, w, channels] standard uncertainty (68 %) of `scene.picture(lights, samples)`, in its unit. It combines,
    linearly, the uncertainties of each triangle's normal, kd, ks and roughness, of the responses of its pixels,
    and of the power of all LEDs. It is 0 where no material is seen, and NaN where the material's uncertainty is
    not known. It does not include effects that the fit cannot represent (a lobe other than GGX, inter-reflection),
    nor any error of the requested lights.

    The picture is made again with materials moved along each independent part of their covariance. This takes
    eleven times as long as the picture alone. Raises InputError for a fit that has no covariance.
    """
    refuse_uncertain(scene.result, scene.fit)
    materials, covariance, wider, common = _uncertain_texels(scene) if scene.fit == TEXELS else _uncertain(scene)
    scales, vectors = np.linalg.eigh(np.nan_to_num(covariance))
    roots = vectors * np.sqrt(np.maximum(scales, 0.0))[:, None]
    count = 2 * UNKNOWNS + 1

    def picture(reflecting: TriangleMaterials, number: int, into: Picture | None = None) -> Picture:
        scene_picture = scene.with_materials(reflecting).picture(lights, samples, into=into)
        say(number + 1, count)
        return scene_picture

    straight = picture(materials, 0)
    step_pictures = np.empty_like(straight), np.empty_like(straight)
    of_pixel = scene.material_of_pixel
    # -1, for nothing, takes the last
    square = (straight * np.append(common, 0.0)[of_pixel][..., None]) ** 2
    for part in range(UNKNOWNS):
        deviation = roots[:, :, part]
        shorter = _LONGEST_STEP / np.maximum(np.abs(deviation[:, _NOT_LINEAR]).max(axis=1), _LONGEST_STEP)
        up, down = (
            picture(
                _stepped_materials(materials, wider, sign * shorter[:, None] * deviation),
                1 + 2 * part + (sign > 0),
                into,
            )
            for sign, into in zip((-1.0, 1.0), step_pictures, strict=True)
        )
        square += ((up - down) / (2.0 * np.append(shorter, 1.0)[of_pixel][..., None])) ** 2
    has_covariance = np.append(np.isfinite(covariance).all(axis=(1, 2)), True)[of_pixel]
    u_picture = np.where(has_covariance[..., None] | (straight == 0.0), np.sqrt(square), np.nan)
    return u_picture.astype(np.float32)


def refuse_uncertain(result: RunResult, fit: str) -> None:
    """Raise InputError if the uncertainty of pictures from this fit is not known."""
    if fit == TEXELS:
        return
    if fit not in MATERIALS:
        raise InputError(f"--uncertainty: {fit} has none; choose --fit {' or '.join((*MATERIALS, TEXELS))}")
    if not result.materials_path(fit).exists():
        raise InputError(f"{result.folder}: has no fit {fit}; `coupole reflectance fit {result.folder}` makes it")
    with h5py.File(result.materials_path(fit), "r") as file:
        refuse_without_uncertainty(result.materials_path(fit), file)


Uncertain = tuple[TriangleMaterials, Floats, Floats, Floats]


def _uncertain(scene: RelitScene) -> Uncertain:
    """Return for the surface's triangles: the materials; the covariance [n, 5, 5] of tilts and logarithms; the
    uncertainty [n, 2, channels] of kd and of ks of each channel, as a multiple of the uncertainty of the channels'
    mean; the relative uncertainty [n] that all light from a triangle shares."""
    places = np.searchsorted(scene.result.triangles, scene.surface.triangles)
    covariance = scene.result.material_covariances(scene.fit, places)
    of_means = np.sqrt(np.einsum("nii->ni", covariance)[:, 2:4, None])
    with h5py.File(scene.result.materials_path(scene.fit), "r") as file:
        of_channels = np.stack([file["u_kd"][()], file["u_ks"][()]], axis=1)[places]
        common = np.hypot(file["u_triangle"][()][places], file["u_shared"][()])
    materials = materials_of(scene.result, scene.fit, scene.surface)
    return materials, covariance, np.nan_to_num(of_channels / np.maximum(of_means, 1e-12)), common


def _uncertain_texels(scene: RelitScene) -> Uncertain:
    """Return the same values as `_uncertain` for the picture's texels. Each channel of a texel is assumed to be as
    uncertain as the channels' mean."""
    assert isinstance(scene.reflecting, Texels)
    texels, (u_pixel, u_shared) = (
        scene.reflecting.materials,
        texel_uncertainty(scene.result, views_with_texels(scene.result)[0]),
    )
    covariance = whole_covariances(scene.reflecting.covariance)
    common = np.full(len(covariance), np.hypot(u_pixel, u_shared))
    return texels, covariance, np.ones((len(covariance), 2, texels.kd.shape[1])), common


def _stepped_materials(materials: TriangleMaterials, wider: Floats, step: Floats) -> TriangleMaterials:
    """Return materials whose tilts and logarithms have moved by a small step [n, 5]. Channels move together; the
    step of each is multiplied by `wider` [n, 2, channels] (of kd, of ks), the ratio of its uncertainty to the
    uncertainty of the channels' mean."""
    return dataclasses.replace(
        materials,
        normals=turned_normals(materials.normals, step[:, :2]),
        kd=materials.kd * (1.0 + step[:, 2:3] * wider[:, 0]),
        ks=materials.ks * (1.0 + step[:, 3:4] * wider[:, 1]),
        alpha=materials.alpha * np.exp(step[:, 4]),
    )
