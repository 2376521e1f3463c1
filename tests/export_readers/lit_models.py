"""Pixels of a result under lights, and the models of materials by which readers light them: pi f cos_i, 1 for
white from above."""

from __future__ import annotations

from dataclasses import dataclass, fields

import h5py
import numpy as np

from coupole.exchange.of_results.measured_surface import MeasuredSurface

Array = np.ndarray
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""z up from y up, for rows on its left."""
LIGHTS = 12
"""Lights of each pixel."""
_F0S, _ALPHAS, _COSINES, _STEPS = 12, 16, 16, 48
"""Nodes of a table of albedos, and steps of its integrals."""
_F0_OF_PRINCIPLED = 0.04


@dataclass(frozen=True)
class Lit:
    """Pixels under one light each."""

    triangles: Array
    lights: Array
    """[n, 3] unit, support frame."""
    cameras: Array
    """[n, 3]"""
    views: Array
    rows: Array
    columns: Array

    def of(self, rows_picked: Array) -> Lit:
        return Lit(*(getattr(self, field.name)[rows_picked] for field in fields(self)))


@dataclass(frozen=True)
class Materials:
    """[n] of pixels, in the parameters of the model that takes them."""

    normals: Array
    diffuse: Array
    specular: Array
    alpha: Array


def unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def lit_pixels(surface: MeasuredSurface, count: int, random: np.random.Generator) -> Lit:
    """`count` pixels of all views, with `LIGHTS` each, of which those within 80 degrees of their normals stay."""
    parts = []
    support_from_base = np.linalg.inv(surface.result.base_from_support)
    for view in surface.result.views:
        with h5py.File(view.path, "r") as file:
            triangle_of_pixel = file["seen"][()]
        number = np.where(triangle_of_pixel >= 0, view.triangles[triangle_of_pixel], 0)
        row, column = np.nonzero((triangle_of_pixel >= 0) & surface.has_material[number])
        subset = random.choice(len(row), count // len(surface.result.views), replace=False)
        row, column = row[subset], column[subset]
        triangles = number[row, column]
        camera = support_from_base[:3, :3] @ view.camera_mm + support_from_base[:3, 3]
        centres = surface.vertices_mm[surface.triangles[triangles]].mean(axis=1)
        parts.append((triangles, camera - centres, np.full(len(row), view.view, object), row, column))
    triangles, ways, views, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
    columns_per_light = [np.repeat(part, LIGHTS, axis=0) for part in (triangles, ways, views, rows, columns)]
    lights = random.normal(size=(len(columns_per_light[0]), 3))
    normals = surface.normals[columns_per_light[0]]
    lights += 1.5 * normals * np.linalg.norm(lights, axis=1, keepdims=True)
    lights, cameras = (unit(part) for part in (lights, columns_per_light[1]))
    cosines = np.stack([np.sum(part * normals, axis=1) for part in (lights, cameras)])
    in_range = (cosines > np.cos(np.radians(80.0))).all(axis=0)
    return Lit(*(part[in_range] for part in (columns_per_light[0], lights, cameras, *columns_per_light[2:])))


def true_light(surface: MeasuredSurface, lit: Lit) -> Array:
    """[n, 3] of the result itself."""
    columns = (surface.normals, surface.kd, surface.ks, surface.alpha)
    return ggx(Materials(*(column[lit.triangles] for column in columns)), lit)


def relative_errors(exported_values: Array, true_values: Array) -> Array:
    """Of values that are known and above nearly nothing."""
    usable = (true_values > 1e-6) & np.isfinite(exported_values)
    return np.asarray(np.abs(exported_values[usable] / true_values[usable] - 1.0))


def ggx(of: Materials, lit: Lit) -> Array:
    """[n, 3] kd + ks D V: Walter and others 2007, Heitz 2014."""
    nl, nv, nh, _ = _cosines(of, lit)
    lobe = (_d(nh, of.alpha) * _v(nl, nv, of.alpha))[:, None]
    radiance: Array = np.pi * nl[:, None] * (of.diffuse + lobe * of.specular)
    return radiance


def gltf(of: Materials, lit: Lit) -> Array:
    """glTF 2.0, appendix B, with KHR_materials_specular: `diffuse` is the base colour, `specular` F0."""
    nl, nv, nh, vh = _cosines(of, lit)
    fresnel = of.specular + (1.0 - of.specular) * (1.0 - vh[:, None]) ** 5
    lobe = (_d(nh, of.alpha) * _v(nl, nv, of.alpha))[:, None]
    base = of.diffuse / np.pi
    radiance: Array = np.pi * nl[:, None] * ((1.0 - fresnel.max(axis=1, keepdims=True)) * base + fresnel * lobe)
    return radiance


def openpbr(of: Materials, lit: Lit, f0: Array) -> Array:
    """OpenPBR as MaterialX builds it: a dielectric layer of reflectance `f0` [n], tinted by `specular`, with
    compensation for what is scattered more than once, over what it lets through to the base colour `diffuse`."""
    nl, nv, nh, vh = _cosines(of, lit)
    grid = np.linspace(0.0, 0.999, _F0S) ** 2
    once = _albedo(
        np.stack([np.sqrt(f0), of.alpha, nv], 1),
        np.stack([_albedos(normal_reflectance) for normal_reflectance in grid]),
    )
    white = _albedo(np.stack([np.ones(len(f0)), of.alpha, nv], 1), np.stack([_albedos(None)] * _F0S))
    fresnel = _fresnel(vh, f0)
    more = 1.0 + fresnel * (1.0 - white) / white
    lobe = _d(nh, of.alpha) * _v(nl, nv, of.alpha) * fresnel * more
    through = (1.0 - once * more)[:, None] * of.diffuse / np.pi
    radiance: Array = np.pi * nl[:, None] * (lobe[:, None] * of.specular + through)
    return radiance


def principled_bsdf(of: Materials, lit: Lit) -> Array:
    """Blender 5.0's Principled BSDF, by the kernels in its package: `specular` is F0, which Blender makes of an
    index of 1.5 and a tint. Fresnel's curve of that index leads from F0 to 1, light that is scattered more than
    once is added (Kulla and Conty 2017), and the base colour `diffuse` gets what the lobe's albedo leaves."""
    nl, nv, nh, vh = _cosines(of, lit)
    at = np.stack([np.ones(len(nv)), of.alpha, nv], 1)

    def towards_one(fresnel: Array) -> Array:
        return (fresnel - _F0_OF_PRINCIPLED) / (1.0 - _F0_OF_PRINCIPLED)

    def between_f0_and_one(share: Array | float) -> Array:
        column = np.reshape(share, (-1, 1))
        return np.asarray(of.specular + (1.0 - of.specular) * column)

    table = _albedos(None)
    cosines = np.linspace(0.02, 1.0, _COSINES)
    of_all = np.trapezoid(2.0 * cosines * table, cosines, axis=1)
    white = _albedo(at, np.stack([table] * _F0S))[:, None]
    mean = np.interp(of.alpha, np.linspace(0.02, 1.0, _ALPHAS), of_all)[:, None]
    once = _albedo(at, np.stack([_albedos(_F0_OF_PRINCIPLED)] * _F0S)) / white[:, 0]
    of_one_bounce = between_f0_and_one(towards_one(np.array(0.5 / (4.08567 + 1.00071 * 1.5))))
    of_more = of_one_bounce * mean / (1.0 - of_one_bounce * (1.0 - mean))
    more = 1.0 + of_more * (1.0 - white) / white
    lobe = (_d(nh, of.alpha) * _v(nl, nv, of.alpha))[:, None] * between_f0_and_one(
        towards_one(_fresnel(vh, _F0_OF_PRINCIPLED))
    )
    largest_albedo = (between_f0_and_one(towards_one(once)) * more * white).max(axis=1, keepdims=True)
    radiance: Array = np.pi * nl[:, None] * (lobe * more + (1.0 - largest_albedo) * of.diffuse / np.pi)
    return radiance


def lab_differences(rendered_rgb: Array, true_rgb: Array) -> Array:
    """[n] dE00 of linear sRGB, white 1, cut off above it."""
    import colour

    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    labs = (
        colour.XYZ_to_Lab(colour.RGB_to_XYZ(np.clip(part, 0.0, 1.0), "sRGB", white), white)
        for part in (rendered_rgb, true_rgb)
    )
    return np.asarray(colour.delta_E(*labs, method="CIE 2000"))


def _cosines(of: Materials, lit: Lit) -> tuple[Array, Array, Array, Array]:
    """Return the cosines of light, camera and half vector to the normal, and of camera to half vector."""
    half = lit.lights + lit.cameras
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    normals = of.normals / np.linalg.norm(of.normals, axis=1, keepdims=True)
    pairs = ((lit.lights, normals), (lit.cameras, normals), (half, normals), (lit.cameras, half))
    nl, nv, nh, vh = (np.clip(np.sum(first * second, axis=1), 1e-4, 1.0) for first, second in pairs)
    return nl, nv, nh, vh


def _d(nh: Array, alpha: Array) -> Array:
    density: Array = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1.0) + 1.0) ** 2)
    return density


def _v(nl: Array, nv: Array, alpha: Array) -> Array:
    """Smith's shadowing with correlated heights, over 4 nl nv."""
    a2 = alpha**2
    share: Array = 0.5 / (nl * np.sqrt(nv**2 * (1.0 - a2) + a2) + nv * np.sqrt(nl**2 * (1.0 - a2) + a2))
    return share


def _fresnel(cosine: Array, f0: Array | float) -> Array:
    """Return Fresnel's reflectance of a dielectric that reflects `f0` at normal incidence."""
    root = np.sqrt(np.minimum(f0, 0.999))
    ior = (1.0 + root) / (1.0 - root)
    g = np.sqrt(ior**2 - 1.0 + cosine**2)
    near, far = g - cosine, g + cosine
    share: Array = 0.5 * (near / far) ** 2 * (1.0 + ((far * cosine - 1.0) / (near * cosine + 1.0)) ** 2)
    return share


def _albedos(f0: float | None) -> Array:
    """[alphas, cosines] of light that the lobe reflects, of Fresnel 1 without `f0`; by Heitz' sampling of visible
    normals (2018), on a grid of its two numbers."""
    u, v = ((np.arange(_STEPS) + 0.5) / _STEPS for _ in range(2))
    radius, phi = (part.ravel() for part in np.meshgrid(np.sqrt(u), 2 * np.pi * v, indexing="ij"))
    albedos = np.empty((_ALPHAS, _COSINES))
    for i, alpha in enumerate(np.linspace(0.02, 1.0, _ALPHAS)):
        for j, nv in enumerate(np.linspace(0.02, 1.0, _COSINES)):
            way = np.array([alpha * np.sqrt(1.0 - nv**2), 0.0, nv])
            way /= np.linalg.norm(way)
            s = 0.5 * (1.0 + way[2])
            across = radius * np.cos(phi)
            along = (1.0 - s) * np.sqrt(1.0 - across**2) + s * radius * np.sin(phi)
            up = np.sqrt(np.maximum(0.0, 1.0 - across**2 - along**2))
            side = np.array([0.0, 1.0, 0.0])
            normal = across[:, None] * side + along[:, None] * np.cross(way, side) + up[:, None] * way
            half = normal * [alpha, alpha, 1.0]
            half /= np.linalg.norm(half, axis=1, keepdims=True)
            vh = half @ [np.sqrt(1.0 - nv**2), 0.0, nv]
            nl = 2.0 * vh * half[:, 2] - nv
            a2 = alpha**2
            lambda_v = 0.5 * (np.sqrt(1.0 + a2 * (1.0 / nv**2 - 1.0)) - 1.0)
            above = np.maximum(nl, 1e-6)
            lambda_l = 0.5 * (np.sqrt(1.0 + a2 * (1.0 / above**2 - 1.0)) - 1.0)
            transmission = np.where(nl > 0.0, (1.0 + lambda_v) / (1.0 + lambda_v + lambda_l), 0.0)
            albedos[i, j] = np.mean(transmission * (1.0 if f0 is None else _fresnel(vh, f0)))
    return albedos


def _albedo(at: Array, table: Array) -> Array:
    """[n] of a table at [n, 3] root of F0, alpha, cosine."""
    from scipy.interpolate import RegularGridInterpolator

    nodes = [np.linspace(*ends) for ends in ((0.0, 0.999, _F0S), (0.02, 1.0, _ALPHAS), (0.02, 1.0, _COSINES))]
    low, high = np.array([[nodes[0][0], 0.02, 0.02], [nodes[0][-1], 1.0, 1.0]])
    return np.asarray(RegularGridInterpolator(nodes, table)(np.clip(at, low, high)))
