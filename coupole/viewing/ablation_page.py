"""`ablation.html` of a result of runs: how the fits' errors grow with fewer LEDs, samples and coefficients."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from coupole.calibration.report import HEAD
from coupole.errors import StorageError
from coupole.reflectance.fits import FITS
from coupole.storage.durable import write_synced
from coupole.viewing.reflectance_page import STYLE

PAGE = "ablation.html"


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page of what `ablate_result` found. Raises StorageError."""
    path = folder / PAGE
    try:
        write_synced(path, "".join(_page(folder.resolve().name, document)))
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def _page(name: str, document: dict[str, Any]) -> Iterator[str]:
    title = f"{html.escape(name)}: fewer LEDs, samples, coefficients"
    yield f"{HEAD}<title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    yield (
        "<p>Mean absolute error under the LEDs kept for the check, in % of the camera's range, of "
        f"{document['triangles']} triangles spread over the object. All fits are compared by the same samples."
    )
    picture = base64.b64encode(_plot_png(document["mae"])).decode()
    yield f'<img src="data:image/png;base64,{picture}" style="background:none;max-width:100%" alt="errors">'
    for setting, steps in document["mae"].items():
        yield f"<h2>{html.escape(setting)}</h2><table><tr><th>"
        yield "".join(f"<th>{value:g}" for value, _ in steps)
        for fit in FITS.values():
            yield f"<tr><th>{html.escape(fit.title)}"
            errors = [of[fit.name] for _, of in steps]
            yield "".join("<td>" if error is None else f"<td>{100 * error:.3f}" for error in errors)
        yield "</table>"
    yield (
        "<p>Published (seed 003, 6.3 and 6.4): with half of the photos radial functions miss least of the three "
        "that the paper compares (it has no GGX with radial functions), and spherical harmonics are the least "
        "robust. Fewer harmonics are lower degrees; fewer radial functions are fewer centres."
    )


def _plot_png(mae: dict[str, Any]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.5), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    for ax, (setting, steps) in zip(figure.subplots(1, len(mae), sharey=True), mae.items(), strict=True):
        for name, fit in FITS.items():
            errors = [(value, 100 * of[name]) for value, of in steps if of[name] is not None]
            places = zip(*errors, strict=True) if errors else ([], [])
            ax.plot(*places, marker="o", label=fit.title, color=fit.colour)
        ax.set_xlabel(setting)
        ax.set_yscale("log")
        ax.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("mean error, % of range")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
