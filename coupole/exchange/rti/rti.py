"""RTI: hemispherical harmonics (HSH 1.2) of one view, for viewers of RTI."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from coupole.exchange.rti import light_functions
from coupole.exchange.rti.lit_views import LitView, Said
from coupole.exchange.rti.plane_codes import CHECKED_PIXELS, eight_bits, of_terms
from coupole.storage.durable import write_synced


def write(view: LitView, path: Path, say: Said) -> float:
    """Write nine hemispherical harmonics for each channel, the top row first. Return the rms error against the
    view's own pictures, in steps of 8 bits.

    The layout is that of RTIBuilder's fitter: header lines, scales and biases in float32, and nine bytes for each
    channel of each pixel.
    """
    width, height = view.size_px
    code = of_terms(light_functions.hsh(view.directions), "hsh")
    planes = code.planes_of(view, say).reshape(-1, 9, 3)
    bias = planes.min(axis=(0, 2)).astype("<f4")
    scale = np.maximum(planes.max(axis=(0, 2)) - bias, 1e-6).astype("<f4")
    codes = np.empty((len(planes), 3, 9), np.uint8)
    for term in range(9):
        codes[..., term] = eight_bits(planes[:, term], bias[term], scale[term])
    header = f"#HSH1.2\r\n3\r\n{width} {height} 3\r\n9 2 1\r\n".encode("ascii")
    write_synced(path, header + scale.tobytes() + bias.tobytes() + codes.tobytes())
    some = view.some_pixels(CHECKED_PIXELS)
    decoding = (codes[some] / 255.0 * scale + bias).transpose(0, 2, 1)
    return code.misses_dn(view.samples(some, say), decoding.reshape(len(decoding), -1))
