"""Planes of coefficients: computed for each pixel from its values under lights; and the pictures that viewers
compute from them.

Viewers show the sums unchanged; therefore values are encoded for displays (sRGB) before the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse.linalg
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.exchange.rti import light_functions
from coupole.exchange.rti.lit_views import LitView, Picture, Said

Floats = NDArray[np.float64]

RESOLUTION = 20
"""Number of nodes on a side of the bilinear grid; docs/decisions/0037-rti-exports.md explains why it is not 8."""
SIGMA = 0.125
"""Width of the Gaussians between lights, in unit vectors; the default of relight."""
CHECKED_PIXELS = 10_000
"""Number of pixels at which a file is compared with its view's pictures."""
_LEAST_SINGULAR = 1e-4


@dataclass(frozen=True)
class PlaneCode:
    """A pixel's planes are `weights` times its values, minus `offset`. Viewers show `base` plus `functions` times
    the planes."""

    weights: Floats
    """[lights, 3, planes]"""
    offset: Floats
    """[planes]"""
    functions: Floats
    """[lights, 3, planes] factors by which a viewer multiplies the planes, for each light."""
    base: Floats
    """[lights, 3]"""
    about: dict[str, Any]
    """Facts about the functions, for `info.json`."""
    ranges: tuple[float, ...] = ()
    """[planes] factors that scale the tables of functions to 8 bits; empty without tables."""

    def planes_of(self, view: LitView, say: Said) -> Picture:
        """Return the planes [h, w, planes] of a view."""
        planes = view.weighted_sums(self.weights, say)
        planes -= self.offset.astype(np.float32)
        return planes

    def misses_dn(self, samples: Picture, planes: Floats) -> float:
        """Rms error of planes [pixels, planes] against encoded values [lights, pixels, 3], in steps of 8 bits."""
        decoding = np.einsum("lcp,np->lnc", self.functions, planes) + self.base[:, None]
        return 255.0 * float(np.sqrt(np.mean((np.clip(decoding, 0.0, 1.0) - samples) ** 2)))


def eight_bits(values: Picture, low: Any, scale: Any) -> NDArray[np.uint8]:
    """Codes of values: 0 for `low`, 255 for `low + scale`; in single precision."""
    codes = values - np.asarray(low, np.float32)
    codes *= np.asarray(255.0 / scale, np.float32)
    np.clip(np.rint(codes, out=codes), 0.0, 255.0, out=codes)
    return codes.astype(np.uint8)


def of_terms(terms: Floats, name: str) -> PlaneCode:
    """Return the code of functions [lights, terms] that all pixels and channels share. Plane 3 t + c has term t of
    channel c, by least squares over the lights."""
    lights, count = terms.shape
    if np.linalg.matrix_rank(terms, tol=_LEAST_SINGULAR * np.sqrt(lights)) < count:
        raise InputError(f"{name}: {lights} lights at these directions do not determine {count} coefficients")
    inverse = np.linalg.pinv(terms)
    weights, functions = np.zeros((lights, 3, 3 * count)), np.zeros((lights, 3, 3 * count))
    for channel in range(3):
        weights[:, channel, channel::3] = inverse.T
        functions[:, channel, channel::3] = terms
    about = {"type": name, "colorspace": "rgb", "nplanes": 3 * count}
    return PlaneCode(weights, np.zeros(3 * count), functions, np.zeros((lights, 3)), about)


def of_principal_parts(samples: Picture, lights: Floats, name: str, planes: int) -> PlaneCode:
    """Return the code of principal components of encoded values [lights, pixels, 3] (relight's `mrgb`). Functions
    of light are tables of 8 bits, over the lights (`rbf`) or over the nodes of a grid (`bilinear`)."""
    count = len(lights)
    lit_samples = samples[:, samples.any(axis=(0, 2))]
    values = lit_samples.transpose(1, 0, 2).reshape(lit_samples.shape[1], -1)
    mean = values.mean(axis=0, dtype=np.float64)
    vectors = _principal(values - mean.astype(np.float32), planes)
    if name == "bilinear":
        nodes = light_functions.bilinear_nodes(lights, RESOLUTION)
        shares = light_functions.bilinear(lights, RESOLUTION)
        about: dict[str, Any] = {"type": name, "resolution": RESOLUTION}
    else:
        nodes, shares = np.eye(count), light_functions.gaussian(lights, lights, SIGMA)
        about = {"type": name, "sigma": SIGMA}
    tables = np.einsum("gl,plc->pgc", nodes, vectors.reshape(planes, count, 3))
    ranges = 127.0 / np.maximum(np.abs(tables).max(axis=(1, 2)), 1e-9)
    codes = np.rint(127.0 + tables * ranges[:, None, None])
    base_codes = np.rint(255.0 * np.clip(nodes @ mean.reshape(count, 3), 0.0, 1.0))
    about |= {"colorspace": "mrgb", "nplanes": planes, "lights": lights.round(6).ravel().tolist()}
    about["basis"] = np.concatenate([base_codes[None], codes]).astype(int).ravel().tolist()
    functions = np.einsum("lg,pgc->lcp", shares, (codes - 127.0) / ranges[:, None, None])
    weights = vectors.reshape(planes, count, 3).transpose(1, 2, 0)
    offset = np.einsum("lcp,lc->p", weights, mean.reshape(count, 3))
    return PlaneCode(weights, offset, functions, shares @ (base_codes / 255.0), about, tuple(ranges.tolist()))


def _principal(values: Picture, count: int) -> Floats:
    """[count, dimensions] principal components of values [pixels, dimensions], the largest first; zeros if there
    are fewer."""
    vectors = np.zeros((count, values.shape[1]))
    if count < min(values.shape):
        _, sizes, components = scipy.sparse.linalg.svds(values, k=count, random_state=0)
    else:
        _, sizes, components = np.linalg.svd(values, full_matrices=False)
    order = np.argsort(-sizes)[:count]
    vectors[: len(order)] = components[order]
    return vectors
