"""`ablation.html` of a result of runs: how the fits' errors grow with fewer LEDs, samples and coefficients."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from coupole.pages.page_parts import Page, Picture, Section, Table
from coupole.pages.page_rendering import write_page
from coupole.reflectance.fits import FITS

PAGE = "ablation.html"


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page with the figures of `ablate_result`. Raises StorageError."""
    path = folder / PAGE
    write_page(path, _page(folder.resolve().name, document))
    return path


def _page(name: str, document: dict[str, Any]) -> Page:
    tables = [
        Section(
            f"setting-{number}",
            setting[0].upper() + setting[1:],
            tables=[Table("Mean error, % of range", ("fit", *(f"{value:g}" for value, _ in steps)), _rows(steps))],
            notes=_notes(steps),
        )
        for number, (setting, steps) in enumerate(document["mae"].items())
    ]
    return Page(
        title=f"{name}: fewer LEDs, samples, coefficients",
        pictures=[
            Picture("Mean error of each fit by the amount of data", _plot_png(document["mae"]), is_broad=True)
        ],
        summary=f"Each fit was repeated with less data, for {document['triangles']:,} triangles spread over the "
        "object.",
        quality=_quality(document["mae"]),
        next_step="Take the fit with the smallest error for the number of LEDs that you can afford; the tables "
        "have the figures.",
        sections=[
            *tables,
            Section(
                "published",
                "Beside what is published",
                words=[
                    "Mean absolute error under the LEDs kept for the check, in % of the camera's range. All "
                    "fits are compared with the same samples.",
                    "Published (seed 003, 6.3 and 6.4): with half of the photos radial functions have the "
                    "smallest error of the three fits that the paper compares (it has no GGX with radial "
                    "functions), and spherical "
                    "harmonics are "
                    "the least robust. Fewer harmonics are lower degrees; fewer radial functions are fewer "
                    "centres.",
                ],
            ),
        ],
    )


def _quality(mae: dict[str, Any]) -> str:
    setting, steps = next(iter(mae.items()))
    value, errors = max(steps, key=lambda step: float(step[0]))
    known_errors = {name: error for name, error in errors.items() if error is not None}
    if not known_errors:
        return "The error is not known, because no LEDs were kept for the check."
    best = min(known_errors, key=lambda name: known_errors[name])
    return (
        f"With the most data ({setting} {value:g}) {FITS[best].title} has the smallest error: "
        f"{100 * known_errors[best]:.3f} % of range."
    )


def _notes(steps: list[Any]) -> list[str]:
    missing = [f"{value:g}" for value, errors in steps if None in errors.values()]
    return [f"At {', '.join(missing)} there were not enough samples for all of the fits."] if missing else []


def _rows(steps: list[Any]) -> list[tuple[str, ...]]:
    rows = []
    for fit in FITS.values():
        errors = (step[fit.name] for _, step in steps)
        rows.append((fit.title, *("" if error is None else f"{100 * error:.3f}" for error in errors)))
    return rows


def _plot_png(mae: dict[str, Any]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import StrMethodFormatter

    figure = Figure(figsize=(11, 4.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for ax, (setting, steps) in zip(figure.subplots(1, len(mae), sharey=True), mae.items(), strict=True):
        for name, fit in FITS.items():
            errors = [(value, 100 * of[name]) for value, of in steps if of[name] is not None]
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
