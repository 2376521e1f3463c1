"""Sources of uncertainty in samples of a view, read from its file, for bounds, tables and exports."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from coupole.errors import InputError
from coupole.reflectance.extraction.frame_veils import GLARE, U_GLARE
from coupole.reflectance.extraction.sample_codes import REACHED
from coupole.reflectance.run_result import INTER_REFLECTION, RunResult, ViewSamples, u_inter_reflection
from coupole.reflectance.sample_uncertainty import Places, Sources

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

_SIDES = 8
"""Number of sides of a triangle on which neighbouring triangles are searched."""
_SMALL_BYTES = 64 * 2**20
"""Greatest size of a table that is read at once."""
_BESIDE = 1.2
"""Least distance of a searched neighbour, divided by the square root of the triangle's area."""


@dataclass(frozen=True)
class ChannelSamples:
    """Samples of one channel on a grid of triangles and LEDs of a view, flattened row by row."""

    rows: Integers
    """[n] numbers of rows of the view's file."""
    leds: Integers
    """[n] places in the view's LEDs."""
    f: Floats
    """[n] 1/sr; NaN where there is no sample."""
    places: Places
    sources: Sources

    def at(self, row_numbers: Integers) -> ChannelSamples:
        rows, leds, f = self.rows[row_numbers], self.leds[row_numbers], self.f[row_numbers]
        return ChannelSamples(rows, leds, f, self.places.at(row_numbers), self.sources.at(row_numbers))

    @property
    def known_places(self) -> Integers:
        """Places of the samples that have a value."""
        return np.flatnonzero(np.isfinite(self.f) & np.isfinite(self.sources.u_noise))


def channel_samples(
    result: RunResult,
    view: ViewSamples,
    rows: Integers,
    leds: Integers,
    channel: int | None,
    scan_noise_um: float,
    beside: Beside | None = None,
) -> ChannelSamples:
    """Return the samples of some rows of a view's file, in rising order, and some of its LEDs. If no channel is
    named, they are the uncertainties of the channels' mean, as if the errors of all channels had the same sign.
    `beside` has the `triangles_beside` of the rows, if they were found before. Raises InputError for a file that
    an earlier version made.
    """
    beside = beside or triangles_beside(result, view, rows)
    with h5py.File(view.path, "r") as file:
        lateral_u_mm, led_u_mm = float(file.attrs["lateral_u_mm"]), float(file.attrs["led_u_mm"])
        file_rows = np.unique(np.append(rows, beside.rows))
        channels = range(result.channels) if channel is None else (channel,)

        def tables(name: str) -> Floats:
            return np.stack([_table(file[name], file_rows, leds, channel_number) for channel_number in channels])

        each_f, row_places = tables("f"), np.searchsorted(file_rows, rows)
        f, shares = each_f.mean(axis=0), np.abs(each_f) / np.maximum(np.abs(each_f).sum(axis=0), 1e-30)
        u_noise = np.sum(shares * tables("u_own"), axis=0)
        dark = _table(file["codes"], file_rows, leds, None) != REACHED
        indirect, glare = _u_taken_off(
            file, tables, shares, file[U_GLARE][()][leds][:, channels] if GLARE in file else None
        )
        u_response = file["u_response"][()][rows][:, channels].mean(axis=1)
        u_own, u_shared = (
            file[name][()][leds][:, channels].mean(axis=1) for name in ("led_u_own", "led_u_shared")
        )
        incidence = _cosines(file["centres_mm"][:][file_rows], file["normals"][:][file_rows], view.led_mm[leds])
    signal, u_signal = np.where(dark, 0.0, f * incidence), np.where(dark, 0.0, u_noise)
    u_place = beside.uncertainty(
        signal, u_signal, row_places, np.searchsorted(file_rows, beside.rows), lateral_u_mm
    )
    grid = (len(rows), len(leds))

    def along(values: Floats, shape: tuple[int, ...]) -> Floats:
        return np.broadcast_to(values.reshape(shape), grid).ravel().astype(np.float64)

    sources = Sources(
        u_noise[row_places].ravel(),
        along(u_response, (-1, 1)),
        indirect[row_places].ravel(),
        u_place.ravel(),
        along(u_own, (1, -1)),
        along(u_shared, (1, -1)),
        np.full(grid, scan_noise_um).ravel(),
        np.full(grid, led_u_mm).ravel(),
        glare[row_places].ravel(),
    )
    row, led = (places.ravel() for places in np.meshgrid(rows, leds, indexing="ij"))
    corners = result.corners_mm[view.triangles[row]].astype(np.float64)
    return ChannelSamples(
        row, led, f[row_places].ravel(), Places(corners, view.led_mm[led], view.led_normals[led]), sources
    )


@dataclass(frozen=True)
class Beside:
    """Triangles that pixels may show instead of others."""

    rows: Integers
    """[n, sides] rows of the view's file; a triangle's own row where it has no neighbour."""
    square_mm2: Floats
    """[n, sides] square of the distance across the line of sight."""

    def uncertainty(
        self, signal: Floats, u_noise: Floats, own_places: Integers, beside: Integers, lateral_u_mm: float
    ) -> Floats:
        """[n, leds] relative standard uncertainty of `signal` [used, leds], in any unit, of triangles at places
        `own_places` [n], by their neighbours at places `beside` [n, sides]. The squared difference from a
        neighbour, without the part from noise, is multiplied by the squared shift over the squared distance; this
        ratio is at most 1. The uncertainty is 1 where no neighbour is known."""
        own_signal, noise = signal[own_places], (signal[own_places] * u_noise[own_places]) ** 2
        share = np.minimum(2.0 * lateral_u_mm**2 / np.maximum(self.square_mm2, 1e-12), 1.0)
        total, count = np.zeros(own_signal.shape), np.zeros(own_signal.shape)
        for side in range(beside.shape[1]):
            neighbour_signal = signal[beside[:, side]]
            apart = (
                (neighbour_signal - own_signal) ** 2 - noise - (neighbour_signal * u_noise[beside[:, side]]) ** 2
            )
            is_known = np.isfinite(apart) & (self.square_mm2[:, side] > 0.0)[:, None]
            total += np.where(is_known, share[:, side, None] * apart, 0.0)
            count += is_known
        with np.errstate(divide="ignore", invalid="ignore"):
            u_relative: Floats = np.sqrt(np.maximum(total / np.maximum(count, 1), 0.0)) / np.abs(own_signal)
        return np.where(count > 0, u_relative, 1.0)


@lru_cache(maxsize=4)
def _centres(path: Path, stamp: tuple[int, int]) -> tuple[Floats, Floats, cKDTree]:
    """Return the centres of a view's triangles, mm; the projection centre; and a tree of the centres. `stamp`, the
    file's number and time, differs if another result was made in the same folder."""
    with h5py.File(path, "r") as file:
        centres_mm = file["centres_mm"][()]
        return centres_mm, file["camera_mm"][()], cKDTree(centres_mm)


def triangles_beside(result: RunResult, view: ViewSamples, rows: Integers) -> Beside:
    """Return triangles on all sides of `rows`, in the plane across the line of sight. They are as far away as a
    picture is likely to be shifted, but at least as far as the neighbouring triangles. Raises InputError for a
    file that an earlier version made.
    """
    with h5py.File(view.path, "r") as file:
        if "lateral_u_mm" not in file.attrs:
            raise InputError(f"{view.path}: an earlier version made it; make the result again")
        lateral_u_mm = float(file.attrs["lateral_u_mm"])
    areas_mm2 = result.areas_mm2[view.triangles]
    about_file = view.path.stat()
    centres_mm, camera_mm, tree = _centres(view.path, (about_file.st_ino, about_file.st_mtime_ns))
    own_centres_mm = centres_mm[rows]
    towards = camera_mm - own_centres_mm
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    right = np.cross(towards, np.where(np.abs(towards[:, [2]]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(right, towards)
    far_mm = np.maximum(np.sqrt(2.0) * lateral_u_mm, _BESIDE * np.sqrt(areas_mm2[rows]))
    neighbours = np.empty((len(rows), _SIDES), np.int64)
    square_mm2 = np.zeros(neighbours.shape)
    for side in range(_SIDES):
        angle = 2.0 * np.pi * side / _SIDES
        shift = far_mm[:, None] * (np.cos(angle) * right + np.sin(angle) * up)
        away_mm, neighbours[:, side] = tree.query(own_centres_mm + shift)
        apart = centres_mm[neighbours[:, side]] - own_centres_mm
        across = apart - np.sum(apart * towards, axis=1)[:, None] * towards
        there = away_mm < far_mm  # past the edge of what the view sees there is nothing
        square_mm2[:, side] = np.where(there, np.sum(across**2, axis=1), 0.0)
    return Beside(neighbours, square_mm2)


def _u_taken_off(
    file: h5py.File, tables: Callable[[str], Floats], shares: Floats, u_veils: Floats | None
) -> tuple[Floats, Floats]:
    """[rows, leds] relative standard uncertainties from subtracted inter-reflection and from subtracted glare:
    means of the channels, weighted by their `shares` [channels, rows, leds]. `u_veils` [leds, channels] are the
    uncertainties of the glare in the LEDs' frames."""
    indirect, glare = np.zeros(shares.shape[1:]), np.zeros(shares.shape[1:])
    if INTER_REFLECTION in file:
        indirect = np.sum(shares * u_inter_reflection(tables(INTER_REFLECTION).astype(np.float16)), axis=0)
    if u_veils is not None:
        glare = np.sum(shares * np.nan_to_num(tables(GLARE)) * u_veils.T[:, None], axis=0)
    return indirect, glare


def _cosines(centres_mm: Floats, normals: Floats, led_mm: Floats) -> Floats:
    """[n, leds] cosines of incidence."""
    ways = led_mm - centres_mm[:, None]
    cosines: Floats = np.einsum("nlk,nk->nl", ways, normals) / np.linalg.norm(ways, axis=2)
    return cosines


def _table(data: h5py.Dataset, rows: Integers, leds: Integers, channel: int | None) -> Floats:
    """[rows, leds] table, of one channel if there are channels. A small table is read at once; a large one is read
    by rows or by LEDs, whichever reads less of the file."""
    channel_index = () if channel is None else (channel,)
    first = int(rows[0])
    some = slice(first, int(rows[-1]) + 1)
    if (some.stop - first) * data.shape[1] * data.dtype.itemsize <= _SMALL_BYTES:
        piece = data[(some, slice(None), *channel_index)]
        return np.asarray(piece[np.ix_(rows - first, leds)], np.float64)
    if len(rows) * data.shape[1] < len(leds) * data.shape[0]:
        return np.stack([data[(int(row), slice(None), *channel_index)][leds] for row in rows]).astype(np.float64)
    return np.stack([data[(some, int(led), *channel_index)][rows - first] for led in leds], axis=1).astype(
        np.float64
    )
