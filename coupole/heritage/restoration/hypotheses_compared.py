"""Colour difference of two hypotheses: CIEDE2000 for each pixel of the object, and for each part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.render.colour import Eye
from coupole.appearance.spectra import light

_LIGHT, _STRONG = np.array([0.93, 0.93, 0.91]), np.array([0.35, 0.0, 0.35])
_AROUND = np.array([0.16, 0.16, 0.17])
FULL_DE00 = 50.0
"""Colour difference that is shown at full strength."""


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference between two pictures of one camera."""

    de00: NDArray[np.float64]
    """[h, w] colour differences; NaN where the object is not seen."""
    of_parts: dict[str, dict[str, Any]]
    """Figures of each visible part: `pixels`, `mean_de00` over them (noise increases it), and `de00_of_means`, the
    difference of the mean colours."""


def compare_pictures(
    xyz: NDArray[np.float32],
    other_xyz: NDArray[np.float32],
    part_of_pixel: NDArray[np.int16],
    names: tuple[str, ...],
    eye: Eye,
    white_cd_m2: float,
) -> Difference:
    """Compare two pictures [h, w, 3] in cd/m^2 for an eye that is adapted to `white_cd_m2` of the first light's
    colour.

    `part_of_pixel` [h, w] are rows of `names`, negative where the object is not seen. CIEDE2000 (Luo, Cui, Rigg,
    Color Res. Appl. 26(5), 2001) is computed by colour-science.
    """
    de00 = np.full(part_of_pixel.shape, np.nan)
    on = part_of_pixel >= 0
    pair = [light.lab(picture[on].astype(float) / white_cd_m2, eye.white) for picture in (xyz, other_xyz)]
    de00[on] = _ciede2000(*pair)
    rows = part_of_pixel[on]
    figures: dict[str, dict[str, Any]] = {}
    for row, name in enumerate(names):
        of_part = rows == row
        if of_part.any():
            means = [picture[on][of_part].mean(axis=0, dtype=float) / white_cd_m2 for picture in (xyz, other_xyz)]
            labs = [light.lab(mean[None], eye.white) for mean in means]
            figures[name] = {
                "pixels": int(of_part.sum()),
                "mean_de00": round(float(de00[on][of_part].mean()), 2),
                "de00_of_means": round(float(_ciede2000(*labs)[0]), 2),
            }
    return Difference(de00, figures)


def difference_picture(de00: NDArray[np.float64]) -> NDArray[np.uint8]:
    """[h, w, 3] picture: light where there is no difference, violet at `FULL_DE00`, dark where the object is not
    seen."""
    share = np.clip(np.nan_to_num(de00) / FULL_DE00, 0.0, 1.0)[..., None]
    colours = np.where(np.isnan(de00)[..., None], _AROUND, _LIGHT + share * (_STRONG - _LIGHT))
    return np.rint(255.0 * colours).astype(np.uint8)


def _ciede2000(lab: NDArray[np.float64], other_lab: NDArray[np.float64]) -> NDArray[np.float64]:
    import colour

    return np.asarray(colour.difference.delta_E_CIE2000(lab, other_lab), float)
