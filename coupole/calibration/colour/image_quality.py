"""Figures of image quality that heritage imaging asks for (as ISO 19264-1), with published levels.

Levels are those of a public comparison of the two guidelines (skandalski.pl/tabela-fadgi-iso-metamorfoze): ISO
19264-1:2021 levels A, B, C, and FADGI 2023 stars for bound general collections. The texts of the standards were
not available. If the comparison has no tolerance for a figure, the figure has no level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from coupole.calibration.colour.chart_signals import ChartPicture, pixels_inside, samples_of, values_at
from coupole.calibration.colour.colorimetry import lab_of
from coupole.calibration.colour.colour_profile import Profile
from coupole.calibration.colour.slanted_edge import SlantedEdge, slanted_edge
from coupole.calibration.rotations import Floats
from coupole.errors import InputError

_STEP = 1e-4
_NYQUIST = 0.5
_BLOCKS = (9, 7)
"""Numbers of blocks across and down the picture, for uniformity."""


@dataclass(frozen=True)
class Figure:
    """One figure and its meaning."""

    name: str
    value: float
    unit: str
    description: str


@dataclass(frozen=True)
class Tolerance:
    """Limits of ISO's levels A, B, C and of FADGI's 4, 3, 2, 1 stars: the largest allowed values, or the least
    allowed ones if `at_least`. ISO's limits may be reached; FADGI's must not be reached."""

    iso: tuple[float, ...]
    fadgi: tuple[float, ...]
    at_least: bool = False

    def level(self, value: float) -> str:
        """Return the level in words, such as `ISO 19264-1 A, FADGI 4 stars`."""
        levels = []
        if self.iso:
            letters = [
                letter for letter, most in zip("ABC", self.iso, strict=True) if self._within(value, most, True)
            ]
            levels.append(f"ISO 19264-1 {letters[0]}" if letters else "below ISO 19264-1 C")
        if self.fadgi:
            stars = [
                n for n, most in zip((4, 3, 2, 1), self.fadgi, strict=True) if self._within(value, most, False)
            ]
            levels.append(f"FADGI {stars[0]} star{'s' if stars[0] > 1 else ''}" if stars else "below FADGI 1 star")
        return ", ".join(levels)

    def _within(self, value: float, bound: float, inclusive: bool) -> bool:
        if self.at_least:
            return value >= bound if inclusive else value > bound
        return value <= bound if inclusive else value < bound


TOLERANCES: Mapping[str, Tolerance] = {
    "tone": Tolerance((2.0, 3.0, 4.0), (1.5, 3.0, 4.5, 6.0)),
    "white_balance": Tolerance((3.0, 4.0, 5.0), (2.0, 4.0, 6.0, 8.0)),
    "colour_mean": Tolerance((4.0, 5.0, 5.0), (2.0, 3.5, 5.0, 6.5)),
    "colour_90": Tolerance((), (4.0, 7.0, 10.0, 13.0)),
    "colour_max": Tolerance((10.0, 15.0, 15.0), ()),
    "noise": Tolerance((1.6, 2.0, 2.2), (1.0, 2.0, 3.0, 4.0)),
    "sampling_efficiency": Tolerance((0.85, 0.80, 0.70), (0.90, 0.80, 0.70, 0.60), at_least=True),
}
"""Tolerances by the name of a figure. The other figures have no tolerance that could be verified."""


def sentence_of(figure: Figure) -> str:
    """Return a figure in words, with its level."""
    unit = f" {figure.unit}" if figure.unit else ""
    tolerance = TOLERANCES.get(figure.name)
    level = tolerance.level(figure.value) if tolerance else "no verified tolerance"
    return f"{figure.description}: {figure.value:.3g}{unit} ({level})"


def colour_figures(de: Floats) -> list[Figure]:
    """Return figures of the CIEDE2000 of patches that were left out."""
    return [
        Figure("colour_mean", float(de.mean()), "dE00", "colour error of patches left out, mean"),
        Figure("colour_90", float(np.quantile(de, 0.9)), "dE00", "colour error of patches left out, 90 %"),
        Figure("colour_max", float(de.max()), "dE00", "colour error of patches left out, largest"),
    ]


def tone_figures(found_lab: Floats, known_lab: Floats, neutral: Sequence[int]) -> list[Figure]:
    """Return figures of the greys' lightness and hue, from L*a*b* [patches, 3] as found and as known."""
    off = (found_lab - known_lab)[list(neutral)]
    return [
        Figure("tone", float(np.abs(off[:, 0]).max()), "L*", "tone (OECF), largest departure of a grey's L*"),
        Figure("white_balance", float(np.hypot(off[:, 1], off[:, 2]).max()), "a*b*", "white balance, worst grey"),
    ]


def noise_figures(mean: Floats, pixel_sd: Floats, profile: Profile, neutral: Sequence[int]) -> list[Figure]:
    """Return the standard deviation of L* over the pixels of a grey, and its signal over noise, for one frame. The
    three colours of a pixel count as independent, because a RAW frame measures them at three places."""
    grey = mean[list(neutral)]
    slopes = np.empty_like(grey)
    for channel in range(3):
        step = _STEP * grey * np.eye(3)[channel]
        rise = lab_of(profile.xyz(grey + step))[:, 0] - lab_of(profile.xyz(grey - step))[:, 0]
        slopes[:, channel] = rise / (2.0 * _STEP)
    sd = np.sqrt(((slopes * pixel_sd[list(neutral)]) ** 2).sum(axis=1))
    brightest = int(np.argmax(grey[:, 1]))
    snr = 1.0 / pixel_sd[list(neutral)][brightest, 1]
    return [
        Figure("noise", float(sd.max()), "L*", "noise of one frame, standard deviation of L*, worst grey"),
        Figure("snr", float(snr), "", "signal over noise of a green pixel on the brightest grey"),
    ]


def edges_of(picture: ChartPicture, names: Sequence[str]) -> dict[str, tuple[SlantedEdge, ...]]:
    """Return each edge in red, green and blue. Raises InputError for edges outside the picture, and like
    `slanted_edge`."""
    edges = {}
    for name, polygon in zip(names, picture.edges_px, strict=True):
        inside = pixels_inside(polygon, picture.signal.shape)
        if inside is None:
            raise InputError(f"{picture.name}: the edge {name} is outside the picture; correct its place")
        colours = []
        for c, channel in enumerate("RGB"):
            take = samples_of(picture, channel, inside)
            rows, columns = inside[0][take], inside[1][take]
            values, full = values_at(picture, c, (rows, columns))
            if full.any():
                raise InputError(f"{picture.name}: the edge {name} is saturated; expose less, or leave it out")
            colours.append(slanted_edge(columns.astype(float), rows.astype(float), values, f"{name}, {channel}"))
        edges[name] = tuple(colours)
    return edges


def edge_figures(edges: Mapping[str, Sequence[SlantedEdge]]) -> list[Figure]:
    """Return the sharpness in green, which is the sharpness of the worst edge, and the largest shift between
    colours."""
    green = [colours[1] for colours in edges.values()]
    shifts = [abs(_shift(colours[k], colours[1])) for colours in edges.values() for k in (0, 2)]
    mtf50, mtf10 = (min(min(edge.frequency_at(share), 1.0) for edge in green) for share in (0.5, 0.1))
    return [
        Figure("mtf50", mtf50, "cycles/pixel", "SFR falls to 50 % at"),
        Figure("mtf10", mtf10, "cycles/pixel", "SFR falls to 10 % at"),
        Figure(
            "sampling_efficiency", min(1.0, mtf10 / _NYQUIST), "", "sampling efficiency, 10 % SFR over Nyquist"
        ),
        Figure("registration", max(shifts), "px", "registration of red and blue against green, across edges"),
    ]


def _shift(edge: SlantedEdge, green: SlantedEdge) -> float:
    """Return the distance of an edge from green's edge along the normal, at the middle of green's pixels, px."""
    return edge.offset_px - float(edge.normal @ (green.middle_px - edge.middle_px)) - green.offset_px


def uniformity_figure(white: ChartPicture, shape: tuple[int, int] = _BLOCKS) -> Figure:
    """Return the largest difference of L* in green between blocks of a picture of a white sheet. Its brightest
    block has L* 100."""
    rows, columns = np.mgrid[: white.signal.shape[0], : white.signal.shape[1]]
    inside = (rows.ravel(), columns.ravel())
    take = samples_of(white, "G", inside)
    values, _ = values_at(white, 1, (inside[0][take], inside[1][take]))
    across = inside[1][take] * shape[0] // white.signal.shape[1]
    down = inside[0][take] * shape[1] // white.signal.shape[0]
    number = down * shape[0] + across
    means = np.bincount(number, values) / np.bincount(number)
    lightness = 116.0 * np.cbrt(np.maximum(means / means.max(), 0.0)) - 16.0
    return Figure("uniformity", float(np.ptp(lightness)), "L*", "uniformity over a white sheet, before correction")
