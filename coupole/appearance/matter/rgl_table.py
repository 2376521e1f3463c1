"""Measured materials in RGL's tensor files (`.bsdf`). The table adapts to its material (Dupuy and Jakob, An
adaptive parameterization for efficient material acquisition and rendering, ACM TOG 37(6), 2018; files of their
database).

The half vector is placed in the unit square by (sqrt(2 theta / pi), phi / (2 pi) + 1/2). For each direction of
incidence, the square is warped by a density over it, `vndf`: columns and rows of the values are evenly spaced in
the cumulative density. A value is f cos(theta_o), divided by ndf / (4 sigma) if `jacobian` says so.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.spectra.grid import Array
from coupole.errors import InputError

Floats32 = NDArray[np.float32]
Indices = NDArray[np.intp]
Weighted = list[tuple[Indices, Array]]
"""Slices of a table, each with its weight; [n] each."""
_MAGIC = b"tensor_file\0\1\0"
_DTYPES = {
    1: np.uint8, 2: np.int8, 3: np.uint16, 4: np.int16, 5: np.uint32, 6: np.int32, 7: np.uint64, 8: np.int64,
    9: np.float16, 10: np.float32, 11: np.float64,
}  # fmt: skip
_ISOTROPIC = 2
"""Largest number of azimuths of incidence in an isotropic table."""
_CHUNK = 1 << 15
"""Number of directions that are looked up together."""
_WHAT = "expected a material of RGL's tensor format"


@dataclass(frozen=True)
class RglTable:
    """A table as a `Brdf`: call it with unit directions [..., 3] to light and eye."""

    phi_i: Array
    """[P] azimuths of incidence, rad; one or two for isotropic materials."""
    theta_i: Array
    """[T] elevations of incidence, rad, in rising order."""
    ndf: Array
    """[h, w] values; rows are azimuths and columns are elevations, as in all planes here."""
    sigma: Array
    vndf: Array
    """[P, T, h, w]"""
    values: Floats32
    """[P, T, R, R, channels]"""
    wavelengths_nm: Array | None
    """[channels], or None for red, green and blue."""
    jacobian: bool
    description: str

    def __call__(self, wi: Array, wo: Array) -> Array:
        """f [..., channels], 1/sr; 0 where a direction is at or below the horizon."""
        wi, wo = np.broadcast_arrays(np.asarray(wi, np.float64), np.asarray(wo, np.float64))
        shape = wi.shape[:-1]
        wi, wo = wi.reshape(-1, 3), wo.reshape(-1, 3)
        reflectance = np.zeros((len(wi), self.values.shape[-1]))
        above = np.flatnonzero((wi[:, 2] > 0.0) & (wo[:, 2] > 0.0))
        for first in range(0, len(above), _CHUNK):
            chunk = above[first : first + _CHUNK]
            reflectance[chunk] = self._looked_up(wi[chunk], wo[chunk])
        return reflectance.reshape(*shape, -1)

    @property
    def isotropic(self) -> bool:
        return len(self.phi_i) <= _ISOTROPIC

    def seen_with(self, weights: Array) -> RglTable:
        """Return the same table with other channels: sums of its own channels, weighted by `weights` [new,
        channels]."""
        return replace(self, values=np.asarray(self.values @ weights.T, np.float32), wavelengths_nm=None)

    def _looked_up(self, wi: Array, wo: Array) -> Array:
        """[n, channels] values for directions [n, 3] above the horizon."""
        cosine = wo[:, 2:]
        wi, wo = self._in_the_measured_part(wi, wo)
        half = wi + wo
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        theta_i, phi_i = _elevation(wi), np.arctan2(wi[:, 1], wi[:, 0])
        theta_m, phi_m = _elevation(half), np.arctan2(half[:, 1], half[:, 0])
        if self.isotropic:
            phi_m = phi_m - phi_i
        u_m = np.stack([_of_theta(theta_m), _of_phi(phi_m) % 1.0], axis=1)
        slices = self._slices(phi_i, theta_i)
        values = _bilinear(self.values, slices, self._unwarped_positions(u_m, slices))
        if self.jacobian:
            u_i = np.stack([_of_theta(theta_i), _of_phi(phi_i)], axis=1)
            whole: Weighted = [(np.zeros(len(wi), np.intp), np.ones(len(wi)))]
            ndf, sigma = (
                _bilinear(plane[None, None, :, :, None], whole, u)
                for plane, u in ((self.ndf, u_m), (self.sigma, u_i))
            )
            values *= ndf / (4.0 * sigma)
        return np.asarray(np.maximum(values, 0.0) / cosine)

    def _in_the_measured_part(self, wi: Array, wo: Array) -> tuple[Array, Array]:
        """Return directions that are turned or mirrored into the measured range of incidence, if this range is a
        half or a quarter of all azimuths."""
        if self.isotropic:
            return wi, wo
        parts = round(2.0 * np.pi / float(self.phi_i[-1] - self.phi_i[0]))
        if parts <= 1:
            return wi, wo
        # Where the sign is that of the measured part, nothing changes.
        y = np.where(wi[:, 1] >= 0.0, -1.0, 1.0)
        x = np.where(wi[:, 0] >= 0.0, -1.0, 1.0) if parts == 4 else y
        signs = np.stack([x, y, np.ones(len(wi))], axis=1)
        return wi * signs, wo * signs

    def _slices(self, phi_i: Array, theta_i: Array) -> Weighted:
        """Return the numbers of slices, as flat indices of [P, T], with their weights."""
        slices: Weighted = []
        for row, share_of_row in _neighbours(self.phi_i, phi_i):
            for column, share in _neighbours(self.theta_i, theta_i):
                slices.append((row * len(self.theta_i) + column, share_of_row * share))
        return slices

    @cached_property
    def _cumulative(self) -> tuple[Array, Array, Array]:
        """Density [slices, h, w] of each slice, its integral along columns, and the integral of the rows' totals
        [slices, h]. All are normalised to a whole of 1, in units of the nodes' distances."""
        density = self.vndf.reshape(-1, *self.vndf.shape[2:])
        along = np.zeros_like(density)
        along[..., 1:] = np.cumsum(0.5 * (density[..., 1:] + density[..., :-1]), axis=2)
        rows = np.zeros(density.shape[:2])
        rows[:, 1:] = np.cumsum(0.5 * (along[:, 1:, -1] + along[:, :-1, -1]), axis=1)
        whole = rows[:, -1]
        return density / whole[:, None, None], along / whole[:, None, None], rows / whole[:, None]

    def _unwarped_positions(self, u: Array, slices: Weighted) -> Array:
        """[n, 2] positions of half vectors [n, 2] in the warped square: the share of the row's density to the
        left, and the share of all density below."""
        density, along, rows = self._cumulative
        height, width = density.shape[1:]
        column, x = _cell(u[:, 0], width)
        row, y = _cell(u[:, 1], height)

        def mix_slices(table: Array, *place: Indices) -> Array:
            return np.asarray(sum(share * table[number, *place] for number, share in slices))

        density_left, density_right = (
            (1.0 - y) * mix_slices(density, row, column + k) + y * mix_slices(density, row + 1, column + k)
            for k in (0, 1)
        )
        before = (1.0 - y) * mix_slices(along, row, column) + y * mix_slices(along, row + 1, column)
        last = np.full(len(u), width - 1)
        lower, upper = mix_slices(along, row, last), mix_slices(along, row + 1, last)
        total = (1.0 - y) * lower + y * upper
        in_row = (before + x * (density_left + 0.5 * x * (density_right - density_left))) / np.maximum(
            total, np.finfo(float).tiny
        )
        below = mix_slices(rows, row) + y * (lower + 0.5 * y * (upper - lower))
        return np.stack([in_row, below], axis=1)


def read_bsdf(path: Path) -> RglTable:
    """Read a file. Raises InputError if the file is missing, of another kind or cut short, or if its tables do not
    belong together."""
    fields = read_fields(path)

    def field(name: str, *shape: int | None) -> Array:
        if name not in fields:
            raise InputError(f"{path}: {_WHAT}; found no field `{name}` in it, but {', '.join(sorted(fields))}")
        array = fields[name]
        fits = array.ndim == len(shape) and all(w in (None, n) for n, w in zip(array.shape, shape, strict=True))
        if array.dtype != np.float32 or not fits or not array.size:
            shape_words = " x ".join("n" if length is None else str(length) for length in shape)
            raise InputError(
                f"{path}: field `{name}`: expected float32, {shape_words}; found {array.dtype}, "
                f"{' x '.join(map(str, array.shape))}; fetch or export it anew"
            )
        if not np.isfinite(array).all():
            raise InputError(
                f"{path}: field `{name}`: contains values that are not numbers; fetch or export it anew"
            )
        return array.astype(np.float64)

    phi_i, theta_i = field("phi_i", None), field("theta_i", None)
    spectral = "spectra" in fields
    wavelengths_nm = field("wavelengths", None) if spectral else None
    channels = 3 if wavelengths_nm is None else len(wavelengths_nm)
    grid = len(phi_i), len(theta_i)
    values = field("spectra" if spectral else "rgb", *grid, channels, None, None)
    density = {name: field(name, *shape) for name, shape in _densities(grid).items()}
    for name, nodes in (("phi_i", phi_i), ("theta_i", theta_i), ("wavelengths", wavelengths_nm)):
        if nodes is not None and (np.diff(nodes) <= 0.0).any():
            raise InputError(f"{path}: field `{name}`: expected rising values; fetch or export it anew")
    for name, table in (*density.items(), ("spectra" if spectral else "rgb", values)):
        if min(table.shape[-2:]) < 2 or (name != "ndf" and name in density and table.min() < 0.0):
            raise InputError(f"{path}: field `{name}`: expected planes of 2 x 2 or more, without values below 0")
    if (density["vndf"].mean(axis=(2, 3)) <= 0.0).any() or density["sigma"].min() <= 0.0:
        raise InputError(f"{path}: `vndf` or `sigma` is 0 where it must not be; fetch or export it anew")
    flag, description = fields.get("jacobian"), fields.get("description", np.zeros(0, np.uint8))
    if flag is None or flag.size != 1:
        raise InputError(f"{path}: field `jacobian`: expected one number, 0 or 1; fetch or export it anew")
    planes = np.ascontiguousarray(np.moveaxis(values.astype(np.float32), 2, -1))
    text = description.tobytes().decode("utf-8", "replace")
    return RglTable(
        phi_i, theta_i, density["ndf"], density["sigma"], density["vndf"], planes, wavelengths_nm, bool(flag[0]),
        text,
    )  # fmt: skip


def read_fields(path: Path) -> dict[str, NDArray[np.generic]]:
    """Read the fields of a tensor file by name, unchanged. Raises InputError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read the material: {error.strerror}") from error
    return _fields(path, data)


def _densities(grid: tuple[int, int]) -> dict[str, tuple[int | None, ...]]:
    return {"ndf": (None, None), "sigma": (None, None), "vndf": (*grid, None, None)}


def _fields(path: Path, data: bytes) -> dict[str, NDArray[np.generic]]:
    """Return the fields of a tensor file by name. Raises InputError."""
    if not data.startswith(_MAGIC):
        raise InputError(f"{path}: {_WHAT}, version 1.0, which begins with `tensor_file`; found {data[:12]!r}")
    fields: dict[str, NDArray[np.generic]] = {}
    try:
        (count,), at = struct.unpack_from("<I", data, len(_MAGIC)), len(_MAGIC) + 4
        for _ in range(count):
            (length,) = struct.unpack_from("<H", data, at)
            name = data[at + 2 : at + 2 + length].decode("ascii")
            ndim, kind, start = struct.unpack_from("<HBQ", data, at + 2 + length)
            at += 2 + length + 11
            shape = struct.unpack_from(f"<{ndim}Q", data, at)
            at += 8 * ndim
            fields[name] = np.frombuffer(data, _DTYPES[kind], math.prod(shape), start).reshape(shape)
    except (struct.error, ValueError, KeyError, OverflowError) as error:
        raise InputError(f"{path}: {_WHAT}; its head is damaged, or it was cut short; fetch it anew") from error
    return fields


# -- places in tables -----------------------------------------------------------------------------------------


def _elevation(ways: Array) -> Array:
    """[n] angles between unit directions [n, 3] and the normal, exact near the normal."""
    chord = np.sqrt(ways[:, 0] ** 2 + ways[:, 1] ** 2 + (ways[:, 2] - 1.0) ** 2)
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0)))


def _of_theta(theta: Array) -> Array:
    return np.asarray(np.sqrt(theta * (2.0 / np.pi)))


def _of_phi(phi: Array) -> Array:
    return np.asarray((phi + np.pi) / (2.0 * np.pi))


def _cell(u: Array, nodes: int) -> tuple[Indices, Array]:
    """Return the node at or below places [n] in 0 to 1, and the weight of the next node."""
    at = np.clip(u, 0.0, 1.0) * (nodes - 1)
    low = np.minimum(at.astype(np.intp), nodes - 2)
    return low, at - low


def _neighbours(nodes: Array, at: Array) -> Weighted:
    """Return the nodes around values [n], with their weights. Beyond the last node, this node has all weight."""
    if len(nodes) == 1:
        return [(np.zeros(len(at), np.intp), np.ones(len(at)))]
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = np.clip((at - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)
    return [(low, 1.0 - share), (low + 1, share)]


def _bilinear(planes: Array | Floats32, slices: Weighted, u: Array) -> Array:
    """[n, channels] interpolated values of planes [P, T, rows, columns, channels] at places [n, 2]: column, row,
    each 0 to 1."""
    height, width, channels = planes.shape[2:]
    flat = planes.reshape(-1, height, width, channels)
    column, x = _cell(u[:, 0], width)
    row, y = _cell(u[:, 1], height)
    totals = np.zeros((len(u), channels))
    for number, share in slices:
        for down, share_down in ((0, 1.0 - y), (1, y)):
            for right, share_right in ((0, 1.0 - x), (1, x)):
                weight = (share * share_down * share_right)[:, None]
                totals += weight * flat[number, row + down, column + right]
    return totals
