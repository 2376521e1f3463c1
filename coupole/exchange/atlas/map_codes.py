"""Maps of a flat surface, encoded for picture files."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from coupole.errors import CoupoleError
from coupole.exchange.atlas.flat_surface import FlatSurface
from coupole.exchange.of_results.measured_surface import under_a_layer
from coupole.exchange.srgb import srgb
from coupole.storage.durable import write_synced

_UPRIGHT = (0.0, 0.0, 1.0)


def colour_map(flat: FlatSurface) -> NDArray[np.uint8]:
    """[side, side, 3] sRGB of pi kd, raised by the share that a specular layer takes."""
    return flat.map_of(_codes8(srgb(under_a_layer(flat.kd, flat.ks))))


def specular_map(flat: FlatSurface, scale: float) -> NDArray[np.uint8]:
    """[side, side, 3] sRGB of ks / `scale`."""
    return flat.map_of(_codes8(srgb(flat.ks / scale)))


def roughness_map(flat: FlatSurface) -> NDArray[np.uint8]:
    """[side, side, 1] square root of GGX's alpha."""
    return flat.map_of(_codes8(np.sqrt(flat.alpha))[:, None])


def sky_map(flat: FlatSurface) -> NDArray[np.uint8]:
    """[side, side, 1] share of the open sky: ambient occlusion."""
    return flat.map_of(_codes8(flat.open_sky)[:, None])


def packed_map(flat: FlatSurface) -> NDArray[np.uint8]:
    """[side, side, 3] open sky, roughness, no metal, in the order of glTF."""
    columns = (flat.open_sky, np.sqrt(flat.alpha), np.zeros_like(flat.alpha))
    return flat.map_of(_codes8(np.stack(columns, axis=1)))


def normal_map(flat: FlatSurface, bits: int) -> NDArray[np.uint8 | np.uint16]:
    """[side, side, 3] (n + 1) / 2 as integers of 8 or 16 bits; the normal of the mesh where there is no texel."""
    most = 2**bits - 1
    kind = np.uint8 if bits == 8 else np.uint16
    return flat.map_of(
        _normal_codes(flat.normals_in_frames, most).astype(kind), _normal_codes(np.array([_UPRIGHT]), most)[0]
    )


def png(picture: NDArray[np.integer]) -> bytes:
    """Encode a picture [h, w, 1 or 3], red first, as PNG of 8 or 16 bits."""
    if picture.dtype == np.uint8:
        buffer = io.BytesIO()
        Image.fromarray(picture if picture.shape[2] == 3 else picture[..., 0]).save(
            buffer, "PNG", compress_level=1
        )
        return buffer.getvalue()
    import cv2  # Pillow has no colour pictures of 16 bits

    pixels = np.ascontiguousarray(picture[..., ::-1])
    is_encoded, content = cv2.imencode(".png", pixels)
    if not is_encoded:
        raise CoupoleError(f"a map of {pixels.shape[1]} x {pixels.shape[0]} px could not be encoded as PNG")
    return bytes(content.tobytes())


def write_png(path: Path, picture: NDArray[np.integer]) -> Path:
    write_synced(path, png(picture))
    return path


def _codes8(values: NDArray[np.floating]) -> NDArray[np.uint8]:
    codes: NDArray[np.uint8] = np.rint(255.0 * np.clip(values, 0.0, 1.0)).astype(np.uint8)
    return codes


def _normal_codes(normals: NDArray[np.floating], most: int) -> NDArray[np.floating]:
    return np.asarray(np.rint((0.5 * normals + 0.5) * most))
