"""The page of a recipe: shares, patches of target and recipe side by side under each light, spectra."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coupole.appearance.render import colour
from coupole.appearance.spectra.grid import WAVELENGTHS_NM
from coupole.heritage.analysis.colour_match import Match
from coupole.heritage.analysis.recipe_search import Found, Recipe
from coupole.viewing.page_parts import page, section, table, text
from coupole.viewing.spectra_drawing import Array, Curve, chart, patches


def recipe_page(name: str, search: Found, matches: Sequence[Sequence[Match]]) -> str:
    """HTML; `matches` are those of each of `search.recipes` under each light."""
    best, under = search.best, matches[search.chosen_index]
    body = f"<h1>{text(name)}: recipe</h1><p>{text(search.verdict())}.</p>"
    shares = [
        [text(paint), f"{100 * share:.1f} %", f"{100 * best.half_widths[paint]:.1f} %"]
        for paint, share in sorted(best.shares.items(), key=lambda item: -item[1])
    ]
    body += section("shares", "Shares", table("of the paint's amount", ("paint", "share", "+- 95 %"), shares))
    patch_pairs = [
        (
            f"{m.light}, dE00 {m.delta_e00:.2f}",
            [("target", _srgb(m.target_xyz, m)), ("recipe", _srgb(m.recipe_xyz, m))],
        )
        for m in under
    ]
    note = "Adapted to the screen's white (CAT16); colours outside its gamut are nearest ones."
    body += section("colours", "Side by side", f'{patches(patch_pairs)}<p class="note">{note}</p>')
    bands = search.bands
    curves = [Curve("target", search.target[bands]), Curve("recipe", best.reflectance[bands], is_dashed=True)]
    body += section("spectra", "Spectra", chart("Reflectance in air", WAVELENGTHS_NM[bands], curves))
    lights = [m.light for m in under]
    rows = [_row(mixture, of_one) for mixture, of_one in zip(search.recipes, matches, strict=True)]
    head = ("paints", "root mean square", *(f"dE00 {light}" for light in lights), "shares")
    body += section("fewer", "With fewer paints", table("best recipes by number of paints", head, rows))
    return page(f"{name}: recipe", body)


def _row(recipe: Recipe, under: Sequence[Match]) -> list[str]:
    shares = ", ".join(f"{100 * share:.0f} % {text(paint)}" for paint, share in recipe.shares.items())
    return [str(len(recipe.shares)), f"{recipe.rms:.4f}", *(f"{m.delta_e00:.2f}" for m in under), shares]


def _srgb(xyz: Array, match: Match) -> tuple[int, int, int]:
    screen_xyz = colour.adapted_xyz(xyz, match.white_xyz, "CAT16")
    pixels, _ = colour.displayed_srgb(np.asarray(screen_xyz)[None, None])
    red, green, blue = (int(value) for value in pixels[0, 0])
    return red, green, blue
