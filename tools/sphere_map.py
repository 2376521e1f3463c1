"""The sphere map of a glossy finish under several lights, on meshes that follow its lobes (Durikovic et al. 2002,
section 3.3).

For a distant eye and distant lights, reflected radiance depends only on the normal. The map gives it for each
normal, as a sphere shows it. Each light has its own mesh, and the maps are added. Its lines have constant angles
theta and phi of the table (`tabulated`): with s' at theta and phi about the eye's direction, the normal bisects
the angle between s' and the light. The lines of theta are those of the table, which are dense where the lobe is
steep. So nothing is interpolated over theta when a map is made. Both halves of a mesh, on either side of the plane
through eye and light, are the same.

Nodes have the reflected radiance divided by the cosine to the light. The cosine is computed at each normal,
because it is less linear. Within 6 degrees of a horizon the map may have a large error, because the table ends
there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coupole.appearance.matter.tabulated import SpecularTable
from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError
from coupole.kernels import kernel

PHI_NODES = 25
"""Nodes of half a mesh in phi, from 0 to pi."""
_LEAST_COSINE = 0.03
"""Nodes that the eye does not see have the values of this cosine, for interpolation at the eye's horizon."""


@dataclass(frozen=True)
class SphereMap:
    """Radiance as a function of the normal."""

    to_eye: Array
    """[3], unit."""
    to_lights: Array
    """[lights, 3], unit."""
    theta: Array
    """[theta], radians, of all meshes."""
    radiance: Array
    """[lights, theta, PHI_NODES, bands] radiance at the meshes' nodes, divided by the cosine to the light."""

    @property
    def vertices(self) -> int:
        """Number of shaded vertices of all meshes."""
        return int(np.prod(self.radiance.shape[:3]))

    def at(self, normals: Array) -> Array:
        """Return radiance [n, bands] of normals [n, 3], linear between nodes; 0 for normals that the eye does not
        see."""
        total = np.zeros((len(normals), self.radiance.shape[3]))
        faces_eye = normals @ self.to_eye > 0.0
        for to_light, nodes in zip(self.to_lights, self.radiance, strict=True):
            cosine = normals @ to_light
            mirror = 2.0 * cosine[:, None] * normals - to_light
            first = _in_plane(self.to_eye, to_light)
            along, across = mirror @ self.to_eye, mirror @ first
            side = mirror @ np.cross(self.to_eye, first)
            theta = np.arctan2(np.hypot(across, side), along)
            phi = np.arctan2(np.abs(side), across) / np.pi * (PHI_NODES - 1)
            low = np.clip(np.searchsorted(self.theta, theta) - 1, 0, len(self.theta) - 2)
            column = np.minimum(phi.astype(int), PHI_NODES - 2)
            up = np.clip((theta - self.theta[low]) / (self.theta[low + 1] - self.theta[low]), 0.0, 1.0)[:, None]
            right = (phi - column)[:, None]
            lower = (1.0 - right) * nodes[low, column] + right * nodes[low, column + 1]
            upper = (1.0 - right) * nodes[low + 1, column] + right * nodes[low + 1, column + 1]
            lit = np.where(faces_eye, np.maximum(cosine, 0.0), 0.0)[:, None]
            total += lit * ((1.0 - up) * lower + up * upper)
        return total

    def picture(self, side_px: int) -> Array:
        """Return [side, side, bands] of a sphere in orthographic projection, seen by an eye with z above it."""
        right, above = _axes_of(self.to_eye)
        steps = (np.arange(side_px) + 0.5) / side_px * 2.0 - 1.0
        x, y = np.meshgrid(steps, -steps)
        inside = x**2 + y**2 < 1.0
        z = np.sqrt(1.0 - x[inside] ** 2 - y[inside] ** 2)
        normals = x[inside][:, None] * right + y[inside][:, None] * above + z[:, None] * self.to_eye
        image = np.zeros((side_px, side_px, self.radiance.shape[3]))
        image[inside] = self.at(normals)
        return image


def sphere_map(table: SpecularTable, to_eye: Array, to_lights: Array, irradiance: Array) -> SphereMap:
    """Return the map for an eye in the direction `to_eye` [3] and lights [k, 3], whose `irradiance` [k, bands] is
    that on a surface facing them. Raises InputError for other shapes."""
    bands = table.log_cosines.shape[3]
    eye, lights = _unit(np.asarray(to_eye, float)), _unit(np.atleast_2d(np.asarray(to_lights, float)))
    power = np.ascontiguousarray(np.atleast_2d(np.asarray(irradiance, float)))
    if eye.shape != (3,) or lights.shape[1:] != (3,) or power.shape != (len(lights), bands):
        raise InputError(
            f"sphere map: expected an eye [3], lights [k, 3] and irradiances [k, {bands}]; found {eye.shape}, "
            f"{lights.shape} and {power.shape}"
        )
    theta = table.theta[table.theta < np.pi]
    firsts = np.stack([_in_plane(eye, light) for light in lights])
    radiance = np.empty((len(lights), len(theta), PHI_NODES, bands))
    _shade(eye, lights, firsts, power, table.incidence, theta, table.log_cosines, radiance)
    return SphereMap(eye, lights, theta, radiance)


@kernel(fastmath=True)
def _shade(eye, lights, firsts, power, incidence, theta, table, radiance):  # type: ignore[no-untyped-def]
    count, bands = table.shape[2], table.shape[3]
    cosines_phi = np.cos(np.arange(PHI_NODES) * np.pi / (PHI_NODES - 1))
    for k in range(len(lights)):
        to_eye = np.sum(lights[k] * eye)
        to_first = np.sum(lights[k] * firsts[k])
        for row in range(len(theta)):
            c, s = np.cos(theta[row]), np.sin(theta[row])
            for column in range(PHI_NODES):
                # s' by its components along the eye and in the plane of eye and light; n bisects the angle between
                # s' and the light.
                between = c * to_eye + s * cosines_phi[column] * to_first
                half = np.sqrt(max(0.5 * (1.0 + between), 1e-12))
                nl, nv = half, (to_eye + c) / (2.0 * half)
                for band in range(bands):
                    radiance[k, row, column, band] = 0.0
                for order in range(2):
                    # The value is computed twice, with light and eye exchanged: the mean is reciprocal.
                    here, there = (nl, nv) if order == 0 else (nv, nl)
                    here = min(max(here, _LEAST_COSINE), 1.0)
                    sine = np.sqrt(1.0 - here * here) * s
                    turn = min(max((there - here * c) / sine, -1.0), 1.0) if sine > 1e-9 else 1.0
                    angle = np.arccos(here)
                    low = min(max(np.searchsorted(incidence, angle) - 1, 0), max(len(incidence) - 2, 0))
                    high = min(low + 1, len(incidence) - 1)
                    share = 0.0
                    if high > low:
                        share = min(max((angle - incidence[low]) / (incidence[high] - incidence[low]), 0.0), 1.0)
                    for band in range(bands):
                        before, now, total = turn, 1.0, 0.0
                        for power_of in range(count):
                            lower, upper = table[low, row, power_of, band], table[high, row, power_of, band]
                            total += now * (lower + share * (upper - lower))
                            before, now = now, 2.0 * turn * now - before
                        radiance[k, row, column, band] += 0.5 * power[k, band] * np.exp(total)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _in_plane(to_eye: Array, to_light: Array) -> Array:
    """Return the unit vector perpendicular to the eye's direction, in the plane of eye and light."""
    across = to_light - (to_light @ to_eye) * to_eye
    size = float(np.linalg.norm(across))
    return np.asarray(across / size) if size > 1e-9 else _axes_of(to_eye)[0]


def _axes_of(to_eye: Array) -> tuple[Array, Array]:
    """Return right and up of a picture."""
    up = np.array([0.0, 0.0, 1.0]) if abs(to_eye[2]) < 1.0 - 1e-9 else np.array([0.0, 1.0, 0.0])
    right = _unit(np.cross(up, to_eye))
    return right, np.cross(to_eye, right)
