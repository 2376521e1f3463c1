"""`texel_ablation.html` of a result of runs: how the errors of texels grow with fewer LEDs and samples."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coupole.pages.page_parts import Page, Picture, Section, Table
from coupole.pages.page_rendering import write_page
from coupole.reflectance.fits import GGX_NORMAL, TEXELS, Fit
from coupole.reflectance.result_pages.ablation_page import plot_png, quality, settings_told

PAGE = "texel_ablation.html"
_FITS = (Fit(TEXELS, "texels", "#0072b2"), Fit(GGX_NORMAL.name, "their triangles", GGX_NORMAL.colour))


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page with the figures of `ablate_texels`. Raises StorageError."""
    path = folder / PAGE
    write_page(path, _page(folder.resolve().name, document))
    return path


def _page(name: str, document: dict[str, Any]) -> Page:
    return Page(
        title=f"{name}: texels with fewer LEDs and samples",
        pictures=[
            Picture(
                "Mean error of texels and of their triangles by the amount of data",
                plot_png(document["mae"], _FITS),
                is_broad=True,
            )
        ],
        summary=f"{sum(document['texels'].values()):,} texels in patches of all views, and the triangles that "
        "they see, were fitted again with less data.",
        quality=quality(document["mae"], _FITS),
        next_step="Choose the number of LEDs by the error that you can accept; the tables have the figures.",
        sections=[
            *settings_told(document["mae"], _FITS),
            _known_share(document["share_with_material"]),
            Section(
                "compared",
                "What is compared",
                words=[
                    "Mean absolute error under the LEDs kept for the check, in % of the camera's range, in the "
                    "texels where both have a value. The fits of texels begin at the materials of triangles with "
                    "fitted normals. These are fitted again with the same LEDs, and are shown for comparison.",
                ],
            ),
        ],
    )


def _known_share(shares: dict[str, Any]) -> Section:
    tables = [
        Table(
            setting[0].upper() + setting[1:],
            ("", *(f"{value:g}" for value, _ in steps)),
            [("texels with a material, %", *(f"{100 * share:.1f}" for _, share in steps))],
        )
        for setting, steps in shares.items()
    ]
    return Section("known", "How many texels get a material", tables=tables)
