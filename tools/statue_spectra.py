"""Spectra of the tutorial's statue: a library, films of paints on cards, and spots of the statue, with the truth.

Absorption has the assumed shapes of `coupole.appearance.matter.typical`, which are invented curves, not measured
pigments. Scattering is assumed; gold is from Johnson and Christy. Reflectances are computed here by the published
formulas of Kubelka and Munk, and of Saunderson for the face, without Coupole's own functions.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from coupole.appearance.matter import gilding, typical
from coupole.appearance.optics import indices

Array = NDArray[np.float64]
NM = np.arange(380, 781, 5)
U_LIBRARY, U_FILM, U_SPOT = 0.001, 0.002, 0.002
"""Standard deviations of a spectrum's values."""
FACE, INNER = 0.04, 0.5963
"""Reflectance of a binder of index 1.5 from outside along the normal, and for diffuse light from inside."""
BINDER_INDEX = 1.5
U_THICKNESS = 0.02
"""Relative standard uncertainty of a film's thickness."""
CARD_BLACK, CARD_WHITE = 0.02, 0.88
"""Reflectances of the card inside its varnish."""
SCATTERING_PER_MM = {"white": 90.0, "black": 8.0, "red": 45.0, "yellow": 30.0, "blue": 14.0}
THICKNESS_UM = {"white": 40.0, "black": 9.0, "red": 12.0, "yellow": 15.0, "blue": 16.0}
"""Films are thin enough to show the card."""
SHAPE_OF = {
    "white": "white_shape",
    "black": "black_shape",
    "red": "red_shape",
    "orange": "orange_shape",
    "dull red": "dull_red_shape",
    "yellow": "dull_yellow_shape",
    "blue": "blue_one_peak_shape",
    "deep blue": "blue_two_peaks_shape",
    "green": "green_shape",
    "dull green": "dull_green_shape",
}
FALL_NM = 250.0
"""Wavelength constant: scattering falls by exp(-nm / this), relative to that of its coarse part."""


@dataclass(frozen=True)
class Spot:
    """A place of the statue where a spectrum was taken."""

    name: str
    shares: dict[str, float]
    """Shares of paints."""


SPOTS = (
    Spot("mantle", {"blue": 0.85, "white": 0.15}),
    Spot("tunic", {"red": 0.85, "white": 0.15}),
    Spot("flesh", {"white": 0.88, "red": 0.07, "yellow": 0.05}),
)


def write_all(out: Path, random: np.random.Generator) -> None:
    """Write library, classes, films and spots into folders of `out` that exist."""
    _write_library(out / "library", random)
    _write_films(out / "films", random)
    _write_spots(out, random)


def k_over_s(paint: str) -> Array:
    """Return [81] the assumed curve of the paint."""
    inside = typical.reflectance(SHAPE_OF[paint]).values
    return np.asarray((1.0 - inside) ** 2 / (2.0 * inside))


def coefficients(paint: str) -> tuple[Array, Array]:
    """Return K and S [81] per mm."""
    s = SCATTERING_PER_MM[paint] * (0.8 + 0.2 * np.exp((550.0 - NM) / FALL_NM))
    return k_over_s(paint) * s, s


def opaque(k: Array, s: Array) -> Array:
    """Return the reflectance inside of a layer that hides its ground (Kubelka and Munk 1931)."""
    q = k / s
    return np.asarray(1.0 + q - np.sqrt(q**2 + 2.0 * q))


def film(k: Array, s: Array, thickness_mm: float, ground: float) -> Array:
    """Return the reflectance inside of a layer over a ground (Kubelka 1948)."""
    a = 1.0 + k / s
    b = np.sqrt(a**2 - 1.0)
    coth = 1.0 / np.tanh(b * s * thickness_mm)
    return np.asarray((1.0 - ground * (a - b * coth)) / (a - ground + b * coth))


def reflectance_in_air(inside: Array) -> Array:
    """Return the reflectance in air, gloss excluded (Saunderson 1942)."""
    return np.asarray((1.0 - FACE) * (1.0 - INNER) * inside / (1.0 - INNER * inside))


def gold_leaf(thickness_nm: float, bare_share: float) -> Array:
    """Return the total reflectance of a leaf on the papers' bole (a burnished leaf has no separate gloss)."""
    gilt = gilding.gilt(indices.gold(), thickness_nm, typical.bole(), bare_share=bare_share)
    specular, diffuse = gilding.reflectances(gilt)
    return np.asarray(specular + diffuse)


# -- files ----------------------------------------------------------------------------------------------------


def _write_library(folder: Path, random: np.random.Generator) -> None:
    """Write five batches of each paint, with different concentrations, and gold leaf of different thicknesses."""
    rows, classes = {}, {}
    for paint in SHAPE_OF:
        for number, strength in enumerate(np.geomspace(0.45, 2.2, 5), 1):
            q = strength * random.uniform(0.93, 1.07) * k_over_s(paint)
            rows[f"{paint} {number}"] = reflectance_in_air(opaque(q, np.ones_like(q)))
            classes[f"{paint} {number}"] = paint
    for number, (thickness_nm, bare) in enumerate(((60, 0.0), (90, 0.1), (120, 0.2), (160, 0.05), (200, 0.0)), 1):
        rows[f"gold leaf {number}"] = gold_leaf(thickness_nm, bare)
        classes[f"gold leaf {number}"] = "gold leaf"
    with (folder / "drawn.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["name", *NM])
        writer.writerows([name, *_noisy(values, U_LIBRARY, random)] for name, values in rows.items())
    with (folder / "classes.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([["name", "class"], *classes.items()])


def _write_films(folder: Path, random: np.random.Generator) -> None:
    """Write films on black and white cards, one file for `coupole layer` for each paint."""
    for ground, inside in (("black", CARD_BLACK), ("white", CARD_WHITE)):
        _write_spectrum(
            folder / f"card-{ground}.csv", reflectance_in_air(np.full(len(NM), inside)), U_FILM, random
        )
    for paint in SCATTERING_PER_MM:
        k, s = coefficients(paint)
        thickness_um = THICKNESS_UM[paint]
        thickness_mm = 1e-3 * thickness_um * (1.0 + random.normal(0.0, U_THICKNESS))
        lines = [f"name: {paint}", f"noise: {U_FILM}", f"binder_index: {BINDER_INDEX}", "films:"]
        for ground, inside in (("black", CARD_BLACK), ("white", CARD_WHITE)):
            name = f"{paint}-over-{ground}.csv"
            _write_spectrum(folder / name, reflectance_in_air(film(k, s, thickness_mm, inside)), U_FILM, random)
            lines.append(
                f"  - {{spectrum: {name}, over: card-{ground}.csv, thickness_um: {thickness_um:g}, "
                f"u_thickness_um: {U_THICKNESS * thickness_um:.2g}}}"
            )
        (folder / f"{paint}.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_spots(out: Path, random: np.random.Generator) -> None:
    for spot in SPOTS:
        k, s = (sum(share * coefficients(paint)[at] for paint, share in spot.shares.items()) for at in (0, 1))
        values = reflectance_in_air(opaque(np.asarray(k), np.asarray(s)))
        _write_spectrum(out / f"spectra/{spot.name}.csv", values, U_SPOT, random)
    _write_spectrum(out / "spectra/hair.csv", gold_leaf(110.0, 0.12), U_SPOT, random)
    # a synthetic dye of a later repair; no class of the library resembles it
    violet = np.interp(NM, [380, 430, 540, 640, 780], [0.35, 0.40, 0.08, 0.30, 0.60])
    _write_spectrum(out / "spectra/repair.csv", violet, U_SPOT, random)
    lines = ["# What the simulation put into the spectra. Shares are of the paints' volumes.", "recipes:"]
    for spot in SPOTS:
        shares = ", ".join(f"{paint}: {share:g}" for paint, share in spot.shares.items())
        lines.append(f"  {spot.name}: {{{shares}}}")
    lines += ["hair: {leaf_nm: 110, bare_share: 0.12}", "repair: a dye that the library lacks"]
    (out / "truth/spectra.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _write_spectrum(path: Path, values: Array, u: float, random: np.random.Generator) -> None:
    rows = [f"{nm};{value}" for nm, value in zip(NM, _noisy(values, u, random), strict=True)]
    head = ("# simulated, no instrument and no real object: drawn curves with noise", "wavelength_nm;reflectance")
    path.write_text("\n".join([*head, *rows]) + "\n", encoding="utf-8")


def _noisy(values: Array, u: float, random: np.random.Generator) -> list[str]:
    return [f"{value:.5f}" for value in np.clip(values + random.normal(0.0, u, values.shape), 0.0, 1.0)]
