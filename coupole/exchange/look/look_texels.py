"""Maps of texels for a page: square tiles that the page reads one after the other, and means that its triangles
show until their tiles are there.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.atlas.flat_surface import FlatSurface
from coupole.exchange.look.look_blocks import Block, block_of, halves, jpeg_of, log_coded, octahedral
from coupole.exchange.srgb import srgb

MOST_PX = 4096
"""Greatest width of a page's maps, px, which every graphics card and browser supports."""
TILE_PX = 1024
NOWHERE = 0xFFFFFFFF
"""Value of the place in the maps for a corner that has no place there."""
_QUALITY = 92
_STEPS = 4095
"""Number of codes of a coordinate of a normal: 12 bits."""


@dataclass(frozen=True)
class LookTexels:
    """Texels in the form that a page needs: maps in tiles, and means for its triangles."""

    about: dict[str, Any]
    remark: str
    map_places: NDArray[np.uint32]
    """[n, 3] places of the corners of the mesh's triangles: column, and row by 65536, each as a share of 65535; or
    `NOWHERE`."""
    of_triangles: dict[str, NDArray[Any]]
    """Numbers of triangles [n, ...]: means of their texels; 0 for triangles without texels."""
    blocks: list[Block]
    """Tiles, in the order in which a page needs them."""


def look_texels(flat: FlatSurface, count: int, prefix: str = "") -> LookTexels:
    """Make the texels of a page from maps, for a mesh of `count` triangles; the names of the blocks begin with
    `prefix`."""
    peaks = [max(float(np.quantile(values, 0.9999)), 1e-6) for values in (flat.kd, flat.ks)]
    about: dict[str, Any] = {"side_px": flat.side_px, "tile_px": TILE_PX, "peaks": peaks, "tiles": []}
    blocks = []
    for column, row, tile in _tiles(flat, peaks, prefix):
        blocks += tile
        place = {"column": column, "row": row, "blocks": [block.name for block in tile]}
        about["tiles"].append({**place, "size_px": list(tile[1].shape[1::-1])})
    remark = (
        f"{np.count_nonzero(flat.texel_of_place >= 0):,} texels of {flat.texel_mm:.3g} mm, "
        f"{100 * flat.measured_share:.0f} % from pixels of the views, the others from triangles"
    )
    return LookTexels(about, remark, _places_of_corners(flat, count), _means(flat, count), blocks)


def _places_of_corners(flat: FlatSurface, count: int) -> NDArray[np.uint32]:
    codes = np.rint(flat.mesh.map_places * 65535.0).astype(np.uint32)
    places = np.full((count, 3), NOWHERE, np.uint32)
    places[flat.mesh.numbers] = (codes[:, 0] | codes[:, 1] << np.uint32(16))[flat.mesh.triangles]
    return places


def _means(flat: FlatSurface, count: int) -> dict[str, NDArray[Any]]:
    counts = np.bincount(flat.numbers, minlength=count)

    def mean(values: NDArray[np.floating]) -> NDArray[np.float64]:
        sums = [np.bincount(flat.numbers, column, count) for column in values.T]
        return np.asarray(np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None])

    has_texel = counts > 0
    alpha = mean(flat.alpha[:, None])
    return {
        "normals": octahedral(mean(flat.normals) + 1e-9),
        "kd": halves(mean(flat.kd)),
        "ks": halves(mean(flat.ks)),
        "gloss": halves(np.concatenate([alpha, np.zeros_like(alpha)], axis=1)),
        "uncertainty": np.where(has_texel[:, None], log_coded(mean(flat.uncertain)), 0).astype(np.uint8),
    }


def _tiles(flat: FlatSurface, peaks: list[float], prefix: str) -> Iterator[tuple[int, int, list[Block]]]:
    """Column and row of each tile that is not empty, and its blocks: shape, kd and ks."""
    shape = _shape_codes(flat)
    colours = [
        np.rint(255.0 * srgb(values / peak)).astype(np.uint8)
        for values, peak in zip((flat.kd, flat.ks), peaks, strict=True)
    ]
    for top in range(0, flat.side_px, TILE_PX):
        for first_column in range(0, flat.side_px, TILE_PX):
            texels = flat.texel_of_place[top : top + TILE_PX, first_column : first_column + TILE_PX]
            if not (texels >= 0).any():
                continue
            name = f"{prefix}texels-{top // TILE_PX}-{first_column // TILE_PX}"
            is_known = (texels >= 0)[..., None]
            planes = np.where(is_known, shape[texels], 0).transpose(2, 0, 1)
            blocks = [block_of(f"{name}-shape", np.ascontiguousarray(planes))]
            for kind, codes in zip(("kd", "ks"), colours, strict=True):
                ground = np.rint(codes[texels[texels >= 0]].mean(axis=0)).astype(np.uint8)
                blocks.append(jpeg_of(f"{name}-{kind}", np.where(is_known, codes[texels], ground), _QUALITY))
            yield first_column, top, blocks


def _shape_codes(flat: FlatSurface) -> NDArray[np.uint8]:
    """[k, 4] codes of texels: the upper 8 bits of the two octahedral coordinates of the normal, their lower 4 bits
    together, and 1 to 255 for the root of alpha, 0 to 1."""
    coordinates = np.rint(octahedral(flat.normals.astype(np.float64)) / 65535.0 * _STEPS).astype(np.uint16)
    codes = np.empty((len(coordinates), 4), np.uint8)
    codes[:, :2] = coordinates >> 4
    codes[:, 2] = (coordinates[:, 0] & 15) << 4 | coordinates[:, 1] & 15
    codes[:, 3] = 1 + np.rint(254.0 * np.sqrt(np.clip(flat.alpha, 0.0, 1.0)))
    return codes
