"""`coupole recipe TARGET`: which paints of a palette, in which shares, give a colour."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands.common import JsonOption, OverwriteOption, fail
from coupole.commands.layer import Instrument
from coupole.commands.option_groups import flatten_options
from coupole.errors import CoupoleError, InputError, StorageError, reason

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import Console

    from coupole.appearance.matter.glossy_face import Face
    from coupole.appearance.spectra.light import Observer
    from coupole.heritage.analysis.colour_match import Match
    from coupole.heritage.analysis.palette import Paint
    from coupole.heritage.analysis.recipe_search import Found, Recipe

_FEWER = 3
"""Number of solutions that are shown: with the chosen number of paints, one less, and two less."""

PaletteOption = Annotated[
    list[Path],
    typer.Option(
        "--palette",
        help="Folder of paint files, a paint file, or a library of K and S; repeat for more.",
        show_default=False,
    ),
]
PaintOption = Annotated[
    Path | None,
    typer.Option(
        "--paint", help="Write the mixture as a paint file (NAME.paint.csv), for scenes and restorations."
    ),
]


@flatten_options
def recipe(
    target: Annotated[Path, typer.Argument(help="Spectrum of the colour to match.", show_default=False)],
    palette: PaletteOption,
    light: Annotated[
        str, typer.Option("--light", help="Names of illuminants; the match is made under the first.")
    ] = "D65,A",
    at_most: Annotated[
        int, typer.Option("--at-most", min=1, max=8, help="Largest number of paints in a recipe.")
    ] = 4,
    noise: Annotated[
        float, typer.Option("--noise", min=1e-5, max=0.1, help="Standard uncertainty of the target's values.")
    ] = 0.005,
    *,
    instrument: Instrument,
    observer: Annotated[str, typer.Option(help="Standard observer: 10 deg or 2 deg.")] = "10 deg",
    out: Annotated[Path | None, typer.Option("--out", help="Write this page (HTML).")] = None,
    paint: PaintOption = None,
    overwrite: OverwriteOption = False,
    as_json: JsonOption = False,
) -> None:
    """Find a mixture of a palette's paints that matches a colour as an opaque layer: shares, match under several
    lights, error with one paint less.
    """
    from coupole.appearance.matter.glossy_face import face
    from coupole.exchange.target_folder import refuse_standing
    from coupole.heritage.analysis.mixed_paint import expect_paint_name, write_mixture
    from coupole.viewing.terminal import make_console

    console = make_console(quiet=as_json)
    try:
        if paint is not None:
            expect_paint_name(paint)
        if not overwrite:
            refuse_standing([path for path in (out, paint) if path is not None])
        names = [name.strip() for name in light.split(",") if name.strip()]
        if not names:
            raise InputError("--light: expected names of lights, such as D65,A; found none")
        geometry, seen_by = instrument.known_geometry(), _known_observer(observer)
        with console.status("mixing"):
            paints, search, matches = _search_recipes(
                target, palette, names, at_most, noise, face(instrument.binder_index, geometry), seen_by
            )
        document = _document(search, matches)
        if paint is not None:
            write_mixture(paint, search.best, paints, instrument.binder_index, target.name)
            document["paint"] = str(paint)
        if out is not None:
            _write(out, target.stem, search, matches)
            document["page"] = str(out)
    except CoupoleError as error:
        fail(error, as_json=as_json)
        raise
    if as_json:
        print(json.dumps(document))
    else:
        _say(search, matches, console)
        for path in (out, paint):
            if path is not None:
                console.print(str(path), markup=False)


# -- helpers --------------------------------------------------------------------------------------------------


def _known_observer(name: str) -> Observer:
    from typing import get_args

    from coupole.appearance.spectra.light import Observer

    standard_observer: Observer | None = next((choice for choice in get_args(Observer) if choice == name), None)
    if standard_observer is None:
        raise InputError(f"--observer: expected {', '.join(get_args(Observer))}; found {name!r}")
    return standard_observer


def _search_recipes(
    target: Path,
    palette: list[Path],
    lights: list[str],
    at_most: int,
    noise: float,
    face: Face,
    observer: Observer,
) -> tuple[tuple[Paint, ...], Found, list[tuple[Match, ...]]]:
    from coupole.heritage.analysis.colour_match import matches
    from coupole.heritage.analysis.layer_samples import spectrum_on_grid
    from coupole.heritage.analysis.palette import read_palette
    from coupole.heritage.analysis.recipe_search import find

    paints = read_palette(palette)
    try:
        search = find(spectrum_on_grid(target), paints, face, noise, at_most)
    except InputError as error:
        raise InputError(f"{target}: {error}" if str(target) not in str(error) else str(error)) from error
    under_lights = [matches(search.target, mixture.reflectance, lights, observer) for mixture in search.recipes]
    return paints, search, under_lights


def _document(search: Found, matches: Sequence[Sequence[Match]]) -> dict[str, Any]:
    return {
        "verdict": search.verdict(),
        "explained": search.is_explained,
        "chosen": search.chosen_index + 1,
        "noise": search.noise,
        "bands": int(search.bands.sum()),
        "told_within": {name: search.told_within(name) for name in search.best.shares},
        "rivals": list(search.rivals),
        "recipes": [_recipe_facts(mixture, under) for mixture, under in zip(search.recipes, matches, strict=True)],
    }


def _recipe_facts(recipe: Recipe, under: Sequence[Match]) -> dict[str, Any]:
    return {
        "paints": len(recipe.shares),
        "shares": recipe.shares,
        "half_widths": recipe.half_widths,
        "rms": recipe.rms,
        "misfit": recipe.misfit,
        "worst": recipe.worst,
        "worst_nm": recipe.worst_nm,
        "delta_e00": {m.light: m.delta_e00 for m in under},
        "metamerism": {m.light: m.metamerism for m in under},
    }


def _write(path: Path, name: str, search: Found, matches: Sequence[Sequence[Match]]) -> None:
    from coupole.heritage.result_pages.recipe_page import recipe_page

    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(recipe_page(name, search, matches), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}. Choose another folder, or free space.") from error


def _say(search: Found, matches: Sequence[Sequence[Match]], console: Console) -> None:
    from rich.table import Table

    best = search.best
    from coupole.heritage.analysis.recipe_search import TOLD_WITHIN

    table = Table(
        "paint",
        "share",
        "+- 95 %",
        f"{100 * TOLD_WITHIN:.0f} % told",
        box=None,
        padding=(0, 2, 0, 0),
        pad_edge=False,
    )
    for name, share in sorted(best.shares.items(), key=lambda item: -item[1]):
        within = search.told_within(name)
        words = "yes" if within <= TOLD_WITHIN else f"no, {100 * within:.0f} %"
        table.add_row(name, f"{100 * share:.1f} %", f"{100 * best.half_widths[name]:.1f} %", words)
    console.print(table)
    for match in matches[search.chosen_index]:
        metamerism = f", special index of metamerism {match.metamerism:.2f}" if match.metamerism else ""
        console.print(f"under {match.light}: dE00 {match.delta_e00:.2f}{metamerism}", markup=False)
    console.print(f"{search.verdict()}.", markup=False)
    for rival in search.rivals[:_FEWER]:
        shares = ", ".join(f"{100 * share:.0f} % {name}" for name, share in rival.items())
        console.print(
            f"not distinguishable from this recipe at a noise of {search.noise:g}: {shares}", markup=False
        )
    for number in range(search.chosen_index - 1, max(-1, search.chosen_index - _FEWER), -1):
        fewer = search.recipes[number]
        words = ", ".join(f"{100 * share:.0f} % {name}" for name, share in fewer.shares.items())
        costs = ", ".join(f"{match.delta_e00:.2f} under {match.light}" for match in matches[number])
        console.print(f"with {number + 1}: {words}; dE00 {costs}", markup=False)
