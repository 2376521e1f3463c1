"""Texels of a result that is made without a run: stripes and bumps that its triangles do not have."""

from __future__ import annotations

import json

import numpy as np
from relight_cases import BASE_FROM_SUPPORT, GLOSSY, unit

from coupole.geometry import apply, inverse
from coupole.reflectance.fits import TEXELS
from coupole.reflectance.new_light.pictured_surface import surface_of_view
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.pixel_file import TexelFileHead, ViewTexels, texels_path, write_view_texels
from coupole.reflectance.texels.texel_size import TexelSize


def paint_texels(result: RunResult) -> None:
    """Give each pixel of the one view of a result a texel: kd in stripes of 5 mm, bumps of 6 mm across them."""
    (view,) = result.views
    surface = surface_of_view(result, view)
    pixels = np.flatnonzero((surface.triangle_of_pixel >= 0).reshape(-1))
    triangle, places_mm = surface.triangle_of_pixel.reshape(-1)[pixels], surface.places_mm.reshape(-1, 3)[pixels]
    x, y, _ = apply(inverse(BASE_FROM_SUPPORT), places_mm.astype(float)).T
    kd = np.array(GLOSSY.kd) * (2.0 + 1.5 * np.sin(2 * np.pi * x / 5.0))[:, None]
    along = BASE_FROM_SUPPORT[:3, 1]
    normals = unit(surface.normals[triangle] + 0.15 * np.cos(2 * np.pi * y / 6.0)[:, None] * along)
    covariance = np.full((len(pixels), 15), 0.0)
    covariance[:, [0, 2, 5, 9, 14]] = 1e-4
    texels = ViewTexels(
        pixels.astype(np.int32),
        *(values.astype(np.float32) for values in (normals, kd, np.full_like(kd, 0.1))),
        np.full(len(pixels), 0.2, np.float32),
        covariance.astype(np.float32),
    )
    path = texels_path(result, view)
    path.parent.mkdir()
    size_px = surface.triangle_of_pixel.shape[::-1]
    head = TexelFileHead("top", size_px, TexelSize(), 0.1, np.zeros(3), 0.0, is_simulated=True)
    write_view_texels(path, texels, head)
    (path.parent / "texels.json").write_text(json.dumps({"mae": {TEXELS: 0.01, "ggx": 0.1}}))
