"""The page of a recipe: shares, patches of target and recipe side by side under each light, spectra."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coupole.appearance.render import colour
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.heritage.analysis.colour_match import Match
from coupole.heritage.analysis.recipe_search import Found, Recipe
from coupole.pages.page_charts import Array, Curve, chart, patches
from coupole.pages.page_parts import Link, Page, Plot, Section, Table
from coupole.pages.page_rendering import render


def recipe_page(name: str, search: Found, matches: Sequence[Sequence[Match]]) -> str:
    """Return the page as HTML; `matches` are the matches of each of `search.recipes` under each light."""
    best, under = search.best, matches[search.chosen_index]
    bands = search.bands
    curves = [Curve("target", search.target[bands]), Curve("recipe", best.reflectance[bands], is_dashed=True)]
    fewer = [_row(mixture, of_one) for mixture, of_one in zip(search.recipes, matches, strict=True)]
    head = ("paints", "root mean square", *(f"dE00 {m.light}" for m in under), "shares")
    verdict = search.verdict()
    amounts = ", ".join(f"{100 * share:.0f} % {paint}" for paint, share in _by_share(best))
    return render(
        Page(
            title=f"{name}: recipe of {len(best.shares)} paints",
            pictures=[_patches(m) for m in under],
            summary=f"The colour is mixed from {amounts}, by amount of paint.",
            quality=f"{verdict[0].upper()}{verdict[1:]}.",
            next_step=[
                "Mix a little by the ",
                Link("#shares", "shares"),
                ", let it dry, and compare it with the target under the lights of the place where it will be "
                "shown.",
            ],
            sections=[
                Section("shares", "Shares", tables=[_shares(best)]),
                Section(
                    "spectra",
                    "Spectra",
                    figures=[chart("Reflectance in air", WAVELENGTHS_NM[bands], curves)],
                    figure_size="wide",
                ),
                Section(
                    "fewer", "With fewer paints", tables=[Table("Best recipes by number of paints", head, fewer)]
                ),
                Section("notes", "About the colours", words=[_SCREEN]),
            ],
        )
    )


_SCREEN = (
    "Patches are adapted to the screen's white (CAT16); colours outside its gamut are replaced by the nearest "
    "ones. dE00: "
    "CIEDE2000."
)


def _patches(match: Match) -> Plot:
    name = f"{match.light}, dE00 {match.delta_e00:.2f}"
    return patches(name, [("target", _srgb(match.target_xyz, match)), ("recipe", _srgb(match.recipe_xyz, match))])


def _by_share(recipe: Recipe) -> list[tuple[str, float]]:
    return sorted(recipe.shares.items(), key=lambda item: -item[1])


def _shares(best: Recipe) -> Table:
    rows = [
        (paint, f"{100 * share:.1f} %", f"{100 * best.half_widths[paint]:.1f} %")
        for paint, share in _by_share(best)
    ]
    return Table("Shares of the paint's amount", ("paint", "share", "+- 95 %"), rows)


def _row(recipe: Recipe, under: Sequence[Match]) -> list[str]:
    shares = ", ".join(f"{100 * share:.0f} % {paint}" for paint, share in recipe.shares.items())
    return [str(len(recipe.shares)), f"{recipe.rms:.4f}", *(f"{m.delta_e00:.2f}" for m in under), shares]


def _srgb(xyz: Array, match: Match) -> tuple[int, int, int]:
    screen_xyz = colour.adapted_xyz(xyz, match.white_xyz, "CAT16")
    pixels, _ = colour.displayed_srgb(np.asarray(screen_xyz)[None, None])
    red, green, blue = (int(value) for value in pixels[0, 0])
    return red, green, blue
