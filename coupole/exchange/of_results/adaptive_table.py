"""A table in RGL's format that adapts to its material: the smallest one whose error is at most the wanted one.

The stored value is f cos(theta_o) divided by `ndf`, the part that depends only on the half vector's own elevation;
a reader multiplies by it again. `ndf` is small, because it depends on one angle: 2 x 2048 nodes. The quotient
changes little within a lobe. Angles of incidence are dense near the horizon, where f changes most with them. Their
number, their density near the horizon, and the number of half vectors grow until the table, as readers interpolate
it, has at most the wanted error. Half vectors are not warped by `vndf`, because this gave larger errors (decision
38).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter.rgl_table import RglTable
from coupole.appearance.matter.rgl_writing import (
    cosine_weighted,
    drawn_by,
    fields_of,
    half_vectors,
    nodes_for_linear_reading,
    tensors,
)
from coupole.errors import InputError
from coupole.exchange.of_results.material_tables import Material
from coupole.exchange.of_results.measured_surface import Floats

THETAS = (16, 24, 32, 48, 64, 96, 128)
SIDES = (24, 32, 48, 64, 96, 128, 192)
CROWDINGS = (1.0, 1.3)
"""Values of c: angles of incidence are pi/2 (1 - (1 - t)^c) for even steps t."""
SHARE = 0.95
"""Share of the pairs of directions whose error must be at most the wanted one."""
_NDF_NODES = 2048
_PAIRS, _LOWEST_Z = 2000, 0.1


@dataclass(frozen=True)
class Checked:
    """Pairs of directions, and the material's reflectance there."""

    ways_in: Floats
    """[n, 3]"""
    ways_out: Floats
    f: Floats
    """[n, 3]"""

    def misses(self, table: RglTable) -> Floats:
        """Return the relative errors [n, 3] of a table."""
        return np.asarray(np.abs(table(self.ways_in, self.ways_out) - self.f) / np.maximum(self.f, 1e-12))


@dataclass(frozen=True)
class AdaptiveTable:
    """A material tabulated at some numbers of angles of incidence and half vectors."""

    material: Material
    thetas: int
    side: int
    crowding: float

    @cached_property
    def theta_i(self) -> NDArray[np.float32]:
        steps = np.linspace(0.0, 1.0, self.thetas)
        return np.asarray(0.5 * np.pi * (1.0 - (1.0 - steps) ** self.crowding), np.float32)

    @cached_property
    def ndf(self) -> NDArray[np.float32]:
        """[2, nodes] the channels' mean of kd + ks D / 4, with GGX's D of the half vector's elevation."""
        cosine = np.cos(0.5 * np.pi * np.linspace(0.0, 1.0, _NDF_NODES) ** 2)
        alpha2 = self.material.alpha**2
        facets = alpha2 / (np.pi * (1.0 - cosine**2 * (1.0 - alpha2)) ** 2)
        density = self.material.kd.mean() + 0.25 * self.material.ks.mean() * facets
        return np.repeat(np.maximum(density, 1e-6)[None], 2, axis=0).astype(np.float32)

    @cached_property
    def _values(self) -> NDArray[np.float32]:
        return cosine_weighted(self.material.reflectance, self.theta_i, half_vectors(self.side))

    @cached_property
    def rgb(self) -> NDArray[np.float32]:
        """[1, theta_i, 3, rows, columns]"""
        elevations = np.linspace(0.0, 1.0, self.side)
        over = np.interp(elevations, np.linspace(0.0, 1.0, _NDF_NODES), self.ndf[0])
        return nodes_for_linear_reading((self._values / over).astype(np.float32), self.theta_i)

    @property
    def size_bytes(self) -> int:
        """Size of the file in bytes, without its small fields."""
        return 4 * 4 * self.thetas * self.side**2

    def decoded_table(self) -> RglTable:
        """Return the table in the form that readers of the file have."""
        planes = np.ascontiguousarray(np.moveaxis(self.rgb, 2, -1))
        flat = np.ones((1, self.thetas, 2, 2))
        quarter = np.full((2, 2), 0.25)
        theta_i = self.theta_i.astype(np.float64)
        return RglTable(
            np.zeros(1),
            theta_i,
            self.ndf.astype(np.float64),
            quarter,
            flat,
            planes,
            None,
            jacobian=True,
            description="",
        )

    def encode(self, text: str) -> bytes:
        fields = fields_of(self.theta_i, self.rgb, drawn_by(self._values, self.theta_i), text)
        return tensors({**fields, "ndf": self.ndf, "sigma": np.full((2, 2), 0.25, np.float32)})


def encode_adaptive(material: Material, most_error: float, description: str = "") -> bytes:
    """Return the file, whose description states its error. Raises InputError if no table is large enough."""
    pairs = tuple(_pairs(material))
    table, errors = _smallest(material, most_error, pairs)
    text = (
        f"{material.name}; differs from the fit by {errors[0]:.1e} in the median and {errors[1]:.1e} at 95 % of "
        f"all directions, and by {errors[2]:.1e} and {errors[3]:.1e} of the directions in its lobe; {description}"
    )
    return table.encode(text)


def _smallest(
    material: Material, most_error: float, check_pairs: tuple[Checked, ...]
) -> tuple[AdaptiveTable, Floats]:
    """Return a table with at most the wanted error. The table grows from the smallest by the step that reduces the
    error most for its bytes."""
    table = AdaptiveTable(material, THETAS[0], SIDES[0], CROWDINGS[0])
    errors = _relative_errors(table, check_pairs)
    while errors[1::2].max() > most_error:
        trials = [(larger, _relative_errors(larger, check_pairs)) for larger in _larger(table)]
        if not trials:
            raise InputError(
                f"--adaptive {most_error:g}: {material.name}: a table of {table.size_bytes / 1e6:.0f} MB "
                f"differs from its fit by {errors[1::2].max():.1e} or more in 5 % of the directions; choose a "
                "larger value"
            )
        worst = errors[1::2].max()
        gains = [
            np.log(worst / trial_errors[1::2].max()) / np.log(larger.size_bytes / table.size_bytes)
            for larger, trial_errors in trials
        ]
        table, errors = trials[int(np.argmax(gains))]
    return table, errors


def _larger(table: AdaptiveTable) -> Iterator[AdaptiveTable]:
    """Yield tables with the next number of angles of incidence, of half vectors, or of both, for each density."""
    thetas = [n for n in THETAS if n > table.thetas][:1]
    sides = [n for n in SIDES if n > table.side][:1]
    for crowding in CROWDINGS:
        for more in thetas:
            yield replace(table, thetas=more, crowding=crowding)
        for more in sides:
            yield replace(table, side=more, crowding=crowding)
        for more, side in zip(thetas, sides, strict=False):
            yield replace(table, thetas=more, side=side, crowding=crowding)


def _relative_errors(table: AdaptiveTable, check_pairs: tuple[Checked, ...]) -> Floats:
    """Median and `SHARE` quantile of the relative errors, for each set of pairs."""
    reflectance = table.decoded_table()
    return np.concatenate([np.quantile(pairs.misses(reflectance), [0.5, SHARE]) for pairs in check_pairs])


def _pairs(material: Material) -> Iterator[Checked]:
    """Yield sets of pairs of directions: first uniformly distributed ones, then ones near the mirror direction,
    with half vectors drawn from GGX's D."""
    random = np.random.default_rng(1)
    ways = random.normal(size=(2, 2 * _PAIRS, 3))
    ways[..., 2] = np.abs(ways[..., 2])
    ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
    share = random.uniform(size=2 * _PAIRS)
    theta, phi = (
        np.arctan(material.alpha * np.sqrt(share / (1.0 - share))),
        2.0 * np.pi * random.uniform(size=len(share)),
    )
    half = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1)
    mirror_ways = 2.0 * np.sum(ways[0] * half, axis=-1, keepdims=True) * half - ways[0]
    for ways_out in (ways[1], mirror_ways):
        high = (ways[0, :, 2] > _LOWEST_Z) & (ways_out[:, 2] > _LOWEST_Z)
        pair = ways[0][high][:_PAIRS], ways_out[high][:_PAIRS]
        yield Checked(*pair, material.reflectance(*pair))
