"""Arrays of numbers as text in a page, which its scripts read (`page/blocks.js`).

Bytes of equal significance are stored together (first all first bytes, then all second bytes, ...), because
neighbouring numbers have similar higher bytes. The result is compressed by zlib and encoded in base64.
"""

from __future__ import annotations

import base64
import io
import json
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

TYPES = ("uint8", "uint16", "uint32", "float16", "float32")
LOG_LEAST, LOG_STEPS = 1e-4, 254
"""Codes of `log_coded`: the value of code 1, and number of steps from there to `LOG_RATIO` times that value."""
LOG_RATIO = 1e5
_LARGEST_HALF = 65504.0
_SAME_SIZE = 0
"""Pillow's setting that stores colours at the resolution of brightness."""
SCRIPT_BEGINS = "coupoleBlock("
"""Text with which the script of each block begins."""


def in_script(value: object) -> str:
    """Return JSON that is safe inside a script element."""
    return json.dumps(value, ensure_ascii=False).replace("<", "\\u003c")


@dataclass(frozen=True)
class Block:
    """A named array, as text, and the facts needed to read it."""

    name: str
    text: str
    dtype: str
    shape: tuple[int, ...]

    @property
    def script(self) -> str:
        """Text of the script tag that passes this block to the page."""
        about = in_script({"name": self.name, "dtype": self.dtype, "shape": self.shape})
        return f'{SCRIPT_BEGINS}{about},"{self.text}");\n'


@dataclass(frozen=True)
class Look:
    """Contents of a page."""

    about: dict[str, Any]
    """Facts about the page that its scripts know; docs/reference/page.md."""
    blocks: tuple[Block, ...]
    """Blocks that the page's picture needs."""
    later: tuple[Block, ...] = ()
    """Blocks that a page reads only when they are needed."""
    first: tuple[Block, ...] = ()
    """Small blocks for a first picture. Each is named `first-` and the name of the block whose place it takes."""
    errors: dict[str, str] = field(default_factory=dict)
    """Errors caused by short codes, by the name of the quantity."""


def block_of(name: str, values: NDArray[Any]) -> Block:
    """Make a block of values, whose type is one of `TYPES`."""
    if values.dtype.name not in TYPES:
        raise ValueError(f"{name}: a page reads {', '.join(TYPES)}, not {values.dtype.name}")
    small = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<")))
    rows = small.reshape(-1).view(np.uint8).reshape(-1, values.dtype.itemsize).T
    content = zlib.compress(np.ascontiguousarray(rows).tobytes(), 6)
    return Block(name, base64.b64encode(content).decode("ascii"), values.dtype.name, values.shape)


def jpeg_of(name: str, picture: NDArray[np.uint8], quality: int) -> Block:
    """Make a block of a picture [h, w] or [h, w, 3] (red first), as JPEG with full resolution of colours. JPEG
    changes values slightly."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=quality, subsampling=_SAME_SIZE)
    return Block(name, base64.b64encode(buffer.getvalue()).decode("ascii"), "jpeg", picture.shape)


def log_coded(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Codes 1 to 255 of values from 1e-4 to 10 in steps of 4.6 %, with an error of at most 2.3 %; code 0 where
    there is no value. Values outside are set to the nearer end.
    """
    is_finite = np.isfinite(values)
    inside = np.clip(np.where(is_finite, values, LOG_LEAST), LOG_LEAST, LOG_LEAST * LOG_RATIO)
    codes = 1.0 + np.rint(np.log(inside / LOG_LEAST) / np.log(LOG_RATIO) * LOG_STEPS)
    return np.where(is_finite, codes, 0.0).astype(np.uint8)


def octahedral(normals: NDArray[np.float64]) -> NDArray[np.uint16]:
    """[n, 2] codes of unit vectors [n, 3]: the faces of an octahedron unfolded into a square (Meyer et al., On
    floating-point normal vectors, 2010), with an error of at most 0.004 degrees. Vectors that are not finite
    become z."""
    unit = np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, [0.0, 0.0, 1.0])
    unit = unit / np.abs(unit).sum(axis=1, keepdims=True)
    flat = unit[:, :2]
    sign = np.where(flat >= 0.0, 1.0, -1.0)
    flat = np.where(unit[:, 2:] < 0.0, (1.0 - np.abs(flat[:, ::-1])) * sign, flat)
    codes: NDArray[np.uint16] = np.rint((flat * 0.5 + 0.5) * 65535.0).astype(np.uint16)
    return codes


def halves(values: NDArray[np.float64]) -> NDArray[np.float16]:
    """Half-precision codes of values of 0 and more, with an error of at most 0.05 % or 3e-8, whichever is larger;
    0 where there is no value."""
    return np.clip(np.nan_to_num(values), 0.0, _LARGEST_HALF).astype(np.float16)
