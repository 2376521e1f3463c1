"""`ablation.html` of a result of runs: how the fits' errors grow with fewer LEDs, samples and coefficients."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coupole.pages.page_parts import Page, Picture, Section, Table
from coupole.pages.page_rendering import write_page
from coupole.reflectance.fits import FITS, Fit

PAGE = "ablation.html"


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page with the figures of `ablate_result`. Raises StorageError."""
    path = folder / PAGE
    write_page(path, _page(folder.resolve().name, document))
    return path


def _page(name: str, document: dict[str, Any]) -> Page:
    fits = list(FITS.values())
    return Page(
        title=f"{name}: fewer LEDs, samples, coefficients",
        pictures=[
            Picture("Mean error of each fit by the amount of data", plot_png(document["mae"], fits), is_broad=True)
        ],
        summary=f"Each fit was repeated with less data, for {document['triangles']:,} triangles spread over the "
        "object.",
        quality=quality(document["mae"], fits),
        next_step="Take the fit with the smallest error for the number of LEDs that you can afford; the tables "
        "have the figures.",
        sections=[
            *settings_told(document["mae"], fits),
            Section(
                "published",
                "Beside what is published",
                words=[
                    "Mean absolute error under the LEDs kept for the check, in % of the camera's range. All "
                    "fits are compared with the same samples.",
                    "Published (Lucat et al. 2025, 6.3 and 6.4): with half of the photos radial functions "
                    "have the "
                    "smallest error of the three fits that the paper compares (it has no GGX with radial "
                    "functions), and spherical "
                    "harmonics are "
                    "the least robust. Fewer harmonics are lower degrees; fewer radial functions are fewer "
                    "centres.",
                ],
            ),
        ],
    )


def settings_told(mae: dict[str, Any], fits: Sequence[Fit]) -> list[Section]:
    """Return a section with the errors of each setting."""
    return [
        Section(
            f"setting-{number}",
            setting[0].upper() + setting[1:],
            tables=[
                Table("Mean error, % of range", ("fit", *(f"{value:g}" for value, _ in steps)), _rows(steps, fits))
            ],
            notes=_notes(steps),
        )
        for number, (setting, steps) in enumerate(mae.items())
    ]


def quality(mae: dict[str, Any], fits: Sequence[Fit]) -> str:
    """Say which fit has the smallest error with the most LEDs."""
    setting, steps = next(iter(mae.items()))
    value, errors = max(steps, key=lambda step: float(step[0]))
    known_errors = {name: error for name, error in errors.items() if error is not None}
    if not known_errors:
        return "The error is not known, because no LEDs were kept for the check."
    titles = {fit.name: fit.title for fit in fits}
    best = min(known_errors, key=lambda name: known_errors[name])
    return (
        f"With the most data ({setting} {value:g}) {titles[best]} has the smallest error: "
        f"{100 * known_errors[best]:.3f} % of range."
    )


def _notes(steps: list[Any]) -> list[str]:
    missing = [f"{value:g}" for value, errors in steps if None in errors.values()]
    return [f"At {', '.join(missing)} there were not enough samples for all of the fits."] if missing else []


def _rows(steps: list[Any], fits: Sequence[Fit]) -> list[tuple[str, ...]]:
    rows = []
    for fit in fits:
        errors = (step[fit.name] for _, step in steps)
        rows.append((fit.title, *("" if error is None else f"{100 * error:.3f}" for error in errors)))
    return rows


def plot_png(mae: dict[str, Any], fits: Sequence[Fit]) -> bytes:
    """Draw the errors of each fit by each setting."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import StrMethodFormatter

    figure = Figure(figsize=(11, 4.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(mae), sharey=True, squeeze=False)[0]
    for ax, (setting, steps) in zip(axes, mae.items(), strict=True):
        for fit in fits:
            errors = [(value, 100 * of[fit.name]) for value, of in steps if of[fit.name] is not None]
            places = zip(*errors, strict=True) if errors else ([], [])
            ax.plot(*places, marker="o", label=fit.title, color=fit.colour)
        ax.set_xlabel(setting)
        ax.set_yscale("log")
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        ax.yaxis.set_minor_formatter(StrMethodFormatter("{x:g}"))
        ax.set_xticks([value for value, _ in steps], [f"{value:g}" for value, _ in steps])
        ax.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("mean error, % of range")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
