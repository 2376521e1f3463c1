"""The mixture of a recipe as a paint file, which scenes and restorations use like a measured paint."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from ruamel.yaml.comments import CommentedMap

from coupole.appearance.matter.paint_file import ENDING, PaintFile, Unit, encode
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array
from coupole.errors import InputError, StorageError, reason
from coupole.heritage.analysis.layer_fit import COVERAGE_FACTOR
from coupole.heritage.analysis.palette import Paint
from coupole.heritage.analysis.recipe_search import Recipe


def expect_paint_name(path: Path) -> None:
    """Raise InputError unless the path has the name of a paint file."""
    if not path.name.endswith(ENDING) or path.name == ENDING:
        raise InputError(f"--paint {path}: expected a name that ends in {ENDING}, such as sleeve{ENDING}")


def write_mixture(path: Path, recipe: Recipe, palette: Sequence[Paint], binder_index: float, colour: str) -> None:
    """Write K and S of a recipe's mixture, sums by share (Duncan 1949), in the bands that all its paints have.

    The uncertainties are those of the paints' K and S. The uncertainties of the shares are in the head. The
    shares are correlated, so that together they change K and S less than each share alone. Raises InputError if
    the paints share too few bands, StorageError.
    """
    paints = {paint.name: paint for paint in palette if paint.name in recipe.shares}
    unit: Unit = "per mm" if next(iter(paints.values())).unit == "per mm" else "relative"
    shares = np.array([recipe.shares[name] for name in paints])
    of_paints = list(paints.values())
    k = _sum_by_share([paint.absorption for paint in of_paints], shares)
    s = _sum_by_share([paint.scattering for paint in of_paints], shares)
    u_k = np.sqrt(_sum_by_share([paint.u_absorption**2 for paint in of_paints], shares**2))
    u_s = np.sqrt(_sum_by_share([paint.u_scattering**2 for paint in of_paints], shares**2))
    bands = np.isfinite(k) & np.isfinite(s) & np.isfinite(recipe.reflectance)
    head = {
        "mixed_for": colour,
        "shares": _on_one_line(recipe.shares),
        "u_shares": _on_one_line({name: width / COVERAGE_FACTOR for name, width in recipe.half_widths.items()}),
        "misfit": round(recipe.misfit, 3),
    }
    name = path.name.removesuffix(ENDING)
    nm = WAVELENGTHS_NM[bands]
    mixture = PaintFile(name, unit, binder_index, nm, k[bands], s[bands], u_k[bands], u_s[bands], head)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(encode(mixture), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}. Choose another folder, or free space.") from error


def _on_one_line(numbers: Mapping[str, float]) -> CommentedMap:
    """Return numbers as YAML in braces: lines of a paint file's head have no indentation."""
    mapping = CommentedMap({name: round(number, 5) for name, number in numbers.items()})
    mapping.fa.set_flow_style()
    return mapping


def _sum_by_share(values: Sequence[Array], weights: Array) -> Array:
    """Return a weighted sum [81]; NaN where a paint is not known."""
    return np.asarray(np.sum([weight * value for weight, value in zip(weights, values, strict=True)], axis=0))
