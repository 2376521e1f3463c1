"""PTM: a polynomial texture map (PTM 1.2, LRGB) of one view, for viewers of RTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.exchange.rti import light_functions
from coupole.exchange.rti.lit_views import LitView, Picture, Said
from coupole.exchange.rti.plane_codes import CHECKED_PIXELS, eight_bits, of_terms
from coupole.storage.durable import write_synced

Floats = NDArray[np.float64]

_PTM_ORDER = (3, 5, 4, 1, 2, 0)
"""Places of x2, y2, xy, x, y, 1 among the terms of `light_functions.ptm`."""
_BLOCK = 1 << 16
"""Number of pixels whose colours are computed together."""


def write(view: LitView, path: Path, say: Said) -> float:
    """Write polynomials of luminance, and a colour for each pixel, the bottom row first (Malzbender and others,
    PTM file format, 1.2). Return the rms error against the view's own pictures, in steps of 8 bits.

    Raises InputError if the lights do not determine the polynomials.
    """
    width, height = view.size_px
    terms = light_functions.ptm(view.directions)
    code = of_terms(terms, "ptm")
    coefficients = code.planes_of(view, say).reshape(-1, 6, 3)
    luminance, colours = np.empty((len(coefficients), 6), np.float32), np.empty((len(coefficients), 3), np.uint8)
    for first in range(0, len(coefficients), _BLOCK):
        block = slice(first, first + _BLOCK)
        terms_of_block, colour = _one_colour(coefficients[block], np.linalg.qr(terms).R)
        luminance[block], colours[block] = terms_of_block[:, _PTM_ORDER], np.rint(255.0 * colour)
    scale, bias, codes = _with_whole_bias(luminance)
    header = ["PTM_1.2", "PTM_FORMAT_LRGB", str(width), str(height)]
    header += [" ".join(f"{value:.9g}" for value in scale), " ".join(map(str, bias))]
    bottom_first = (plane.reshape(height, width, -1)[::-1].tobytes() for plane in (codes, colours))
    write_synced(path, "\n".join([*header, ""]).encode("ascii") + b"".join(bottom_first))
    some = view.some_pixels(CHECKED_PIXELS)
    decoding = np.empty(codes[some].shape)
    decoding[:, _PTM_ORDER] = (codes[some] - bias.astype(np.float64)) * scale / 255.0
    planes = decoding[..., None] * (colours[some] / 255.0)[:, None]
    return code.misses_dn(view.samples(some, say), planes.reshape(len(planes), -1))


def _one_colour(term_planes: Picture, triangular: Floats) -> tuple[Floats, Floats]:
    """Luminance [pixels, 6] and colour [pixels, 3], with 1 as largest channel, whose product is nearest to
    `term_planes` [pixels, 6, 3] over the lights.

    They are the first singular vectors of R `term_planes`; `triangular` is R of the QR decomposition of the terms.
    """
    projections = np.einsum("ij,pjc->pic", triangular.astype(np.float32), term_planes)
    products = np.einsum("pic,pid->pcd", projections, projections)
    vectors = np.linalg.eigh(products)[1][..., -1].astype(np.float64)
    vectors *= np.where(vectors.sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    vectors = np.maximum(vectors, 0.0)
    largest = vectors.max(axis=1, keepdims=True)
    colour = np.where(largest > 0.0, vectors / np.maximum(largest, 1e-12), 1.0)
    luminance = np.einsum("pjc,pc->pj", term_planes, colour) / np.sum(colour * colour, axis=1, keepdims=True)
    return luminance, colour


def _with_whole_bias(values: Picture) -> tuple[Floats, NDArray[np.int64], NDArray[np.uint8]]:
    """Scales [6], biases [6] and codes of values [pixels, 6] = (code - bias) scale / 255. The biases of a PTM are
    whole codes, so that 0 has a code."""
    low = 255.0 * np.minimum(values.min(axis=0), 0.0).astype(np.float64)
    high = 255.0 * np.maximum(values.max(axis=0), 0.0).astype(np.float64)
    scale = np.maximum(high - low, 1e-3) / 254.0
    bias = np.ceil(-low / scale).astype(np.int64)
    codes = np.empty(values.shape, np.uint8)
    for term in range(values.shape[1]):
        codes[:, term] = eight_bits(values[:, term], -bias[term] * scale[term] / 255.0, scale[term])
    return scale, bias, codes
