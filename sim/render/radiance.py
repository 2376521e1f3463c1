"""Radiance of the sites of a view towards the camera under one LED, or under a panel.

L = f E with f = diffuse / pi + D G F / (4 n.l n.v): Lambert and GGX with Smith's separable G (Walter et al. 2007,
Eqs. 33 and 34) and Schlick's F, as in `surface.Material`, or f from a material's table. E is that of the whole
square emitter. If f comes from a table, or if the lobe is wide, f is evaluated towards the emitter's centre. If
the roughness is below `FINE_ROUGHNESS`, f is evaluated towards four Gauss points, weighted by their light. Below
about 0.01, where the lobe is as narrow as the emitter's angular size (0.4 deg at 1 m), four points are too few. A
side is dark if the emitter's centre is behind its plane.
"""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from coupole.kernels import kernel
from sim.render.camera_view import View
from sim.render.emitter import Emitter, packed_emitter, per_lumen
from sim.scene.brdf_table import look_up

FINE_ROUGHNESS = 0.3
_CHUNK = 2048
_GAUSS = 1.0 / np.sqrt(3.0)


def led_radiance(
    view: View,
    materials: NDArray[np.float64],
    tables: NDArray[np.float32],
    emitter: Emitter,
    emission: str,
    places: NDArray[np.int32] | None = None,
    reached_bits: NDArray[np.uint8] | None = None,
) -> NDArray[np.float32]:
    """[sites, 3] lm/(m^2 sr), red green blue. `reached_bits` are the bits of `Shadows.reached_bits`, `places` the
    indices. Without them nothing is in the light's way.

    `paper` applies the emitter's cosine, towards the site, twice (Lucat et al. 2025, Eq. 2).
    """
    radiance = np.empty((len(view.points_mm), 3), np.float32)
    _shade(
        view.points_mm,
        view.triangle,
        view.normals,
        view.shading_normals,
        view.diffuse,
        view.material,
        view.eye_mm,
        None if view.fine is None else view.fine.texture,
        None if view.fine is None else view.fine.normals,
        materials,
        tables,
        packed_emitter(emitter),
        emission == "paper",
        places,
        reached_bits,
        radiance,
    )
    return radiance


def albedo(view: View, materials: NDArray[np.float64]) -> NDArray[np.float32]:
    """[sites, 3] albedo for light from all directions: the diffuse reflectance plus the reflectance along the
    normal.
    """
    diffuse = view.diffuse[view.triangle]
    if view.fine is not None:
        diffuse *= view.fine.texture[:, None]
    return np.asarray(diffuse + materials[view.material, 3:6].astype(np.float32)[view.triangle])


def panel_radiance(view: View, materials: NDArray[np.float64], panel_lux: float) -> NDArray[np.float32]:
    """[sites, 3] under an ideal flat white panel: the same irradiance everywhere, from all directions."""
    return np.asarray(np.float32(panel_lux / np.pi) * albedo(view, materials))


@kernel(parallel=True)
def _shade(  # type: ignore[no-untyped-def]
    points,
    triangle,
    normals,
    shading_normals,
    diffuse,
    material,
    eye,
    texture,
    turned_normals,
    materials,
    tables,
    led,
    paper,
    places,
    reached_bits,
    out,
):
    count = len(out)
    for chunk in numba.prange(-(-count // _CHUNK)):
        shares, work = np.empty(4), np.empty((2, 8, 3))
        for i in range(chunk * _CHUNK, min(count, (chunk + 1) * _CHUNK)):
            out[i, 0], out[i, 1], out[i, 2] = 0.0, 0.0, 0.0
            if reached_bits is not None and not (reached_bits[places[i] >> 3] >> (places[i] & 7)) & 1:
                continue
            hit_triangle, factor = triangle[i], 1.0
            px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            tx, ty, tz = led[0] - px, led[1] - py, led[2] - pz
            if (
                tx * normals[hit_triangle, 0] + ty * normals[hit_triangle, 1] + tz * normals[hit_triangle, 2]
                <= 0.0
            ):
                continue
            normal = shading_normals[hit_triangle]
            if turned_normals is not None:
                factor, normal = texture[i], turned_normals[i]
            nx, ny, nz = np.float64(normal[0]), np.float64(normal[1]), np.float64(normal[2])
            if tx * nx + ty * ny + tz * nz <= 0.0:
                continue
            lux = led[12] * per_lumen(px, py, pz, nx, ny, nz, led, shares, work)
            if paper:
                lux *= -(tx * led[3] + ty * led[4] + tz * led[5]) / np.sqrt(tx * tx + ty * ty + tz * tz)
            surface = materials[material[hit_triangle]]
            if surface[7] >= 0.0:
                table = tables[int(surface[7])]
                _shade_by_table(px, py, pz, tx, ty, tz, nx, ny, nz, eye, table, lux * factor, out[i])
                for k in range(3):
                    out[i, k] *= diffuse[hit_triangle, k] / surface[k]
                continue
            for k in range(3):
                out[i, k] = lux * factor * diffuse[hit_triangle, k] / np.pi
            if surface[6] > 0.0 and lux > 0.0:
                _add_gloss(px, py, pz, tx, ty, tz, nx, ny, nz, eye, surface, led, shares, lux, out[i])


@kernel
def _shade_by_table(px, py, pz, tx, ty, tz, nx, ny, nz, eye, table, lux, out):  # type: ignore[no-untyped-def]
    """Write into `out` [3] the radiance from a material's table for `lux` from (tx, ty, tz)."""
    vx, vy, vz = eye[0] - px, eye[1] - py, eye[2] - pz
    far, away = np.sqrt(tx * tx + ty * ty + tz * tz), np.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx / away, vy / away, vz / away
    if vx * nx + vy * ny + vz * nz <= 0.0:
        return
    look_up(table, nx, ny, nz, tx / far, ty / far, tz / far, vx, vy, vz, out)
    for k in range(3):
        out[k] *= lux


@kernel
def _add_gloss(px, py, pz, tx, ty, tz, nx, ny, nz, eye, surface, led, shares, lux, out):  # type: ignore[no-untyped-def]
    """Add to `out` [3] the radiance of the specular part of `surface`, a row of the scene's materials, for
    `lux`."""
    vx, vy, vz, alpha = eye[0] - px, eye[1] - py, eye[2] - pz, surface[6]
    distance = np.sqrt(vx * vx + vy * vy + vz * vz)
    vx, vy, vz = vx / distance, vy / distance, vz / distance
    if vx * nx + vy * ny + vz * nz <= 0.0:
        return
    if alpha >= FINE_ROUGHNESS:
        base_lobe, grazing = _lobe(tx, ty, tz, nx, ny, nz, vx, vy, vz, alpha)
    else:
        base_lobe, grazing = _mean_lobe(tx, ty, tz, nx, ny, nz, vx, vy, vz, alpha, led, shares)
    for k in range(3):
        out[k] += lux * (surface[3 + k] * base_lobe + (1.0 - surface[3 + k]) * grazing)


@kernel
def _mean_lobe(tx, ty, tz, nx, ny, nz, vx, vy, vz, alpha, led, shares):  # type: ignore[no-untyped-def]
    """`_lobe` towards the Gauss points of an emitter centred at (tx, ty, tz), weighted by `shares` [4]."""
    base_lobe, grazing = 0.0, 0.0
    total = shares[0] + shares[1] + shares[2] + shares[3]
    for k in range(4):
        if shares[k] > 0.0:
            u, v = (_GAUSS, -_GAUSS)[k & 1], (_GAUSS, -_GAUSS)[k >> 1]
            x, y, z = tx + u * led[6] + v * led[9], ty + u * led[7] + v * led[10], tz + u * led[8] + v * led[11]
            base_part, grazing_part = _lobe(x, y, z, nx, ny, nz, vx, vy, vz, alpha)
            base_lobe += base_part * shares[k] / total
            grazing += grazing_part * shares[k] / total
    return base_lobe, grazing


@kernel
def _lobe(tx, ty, tz, nx, ny, nz, vx, vy, vz, alpha):  # type: ignore[no-untyped-def]
    """D G / (4 n.l n.v) towards a light at (tx, ty, tz), and the same times Schlick's (1 - h.v)^5."""
    distance = np.sqrt(tx * tx + ty * ty + tz * tz)
    lx, ly, lz = tx / distance, ty / distance, tz / distance
    hx, hy, hz = lx + vx, ly + vy, lz + vz
    length = np.sqrt(hx * hx + hy * hy + hz * hz)
    cos_l, cos_v = nx * lx + ny * ly + nz * lz, nx * vx + ny * vy + nz * vz
    if cos_l <= 0.0 or length == 0.0:
        return 0.0, 0.0
    cos_h = (nx * hx + ny * hy + nz * hz) / length
    cos_hv = (vx * hx + vy * hy + vz * hz) / length
    alpha2 = alpha * alpha
    # sin^2 from the cross product: 1 - cos^2 would distort the peak of a smooth surface by rounding.
    cx, cy, cz = ny * hz - nz * hy, nz * hx - nx * hz, nx * hy - ny * hx
    width = cos_h * cos_h * alpha2 + (cx * cx + cy * cy + cz * cz) / (length * length)
    d = alpha2 / (np.pi * width * width)
    # G1 / (2 n.l) = 1 / (n.l + sqrt(alpha^2 + (1 - alpha^2) n.l^2)), and the same for v.
    masked_l = 1.0 / (cos_l + np.sqrt(alpha2 + (1.0 - alpha2) * cos_l * cos_l))
    masked_v = 1.0 / (cos_v + np.sqrt(alpha2 + (1.0 - alpha2) * cos_v * cos_v))
    value = d * masked_l * masked_v
    far = 1.0 - cos_hv
    return value, value * far * far * far * far * far
