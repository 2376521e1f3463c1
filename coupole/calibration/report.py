"""The report of a calibration: one page (HTML) and one picture (PNG).

The picture asks the four questions that residuals can answer: do they follow a pattern over the field (then the
lens model is too poor), is the whole field covered, does one image stand out, are they normal (then intervals
hold)? For a hand-eye calibration the robot's errors by pose take the place of the last.
"""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from coupole.calibration.adjustment import coverage_factor
from coupole.calibration.record import Parameter, Record
from coupole.calibration.workflow import FIELD_CELLS, Shown
from coupole.errors import StorageError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:.5em 0}td,th{padding:.15em 1em .15em 0;text-align:left}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}
.bad{color:#b00}.ok{color:#070}img{max-width:100%}code{font-size:13px}
"""
_BLUE, _RED, _GREY, _DARK = "#2a6f97", "#c1121f", "#b8bec5", "#333333"
_MOST_ARROWS = 4000
_MOST_BARS_NAMED = 24


def write_report(folder: Path, shown: Shown) -> tuple[Path, Path]:
    """Write `NAME.html` and `NAME.png`; returns both paths. Raises StorageError."""
    picture = draw(shown)
    page, png = folder / f"{shown.record.name}.html", folder / f"{shown.record.name}.png"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        png.write_bytes(picture)
        page.write_text(_page(shown.record, picture), encoding="utf-8")
    except OSError as error:
        raise StorageError(f"{folder}: cannot write the report: {error.strerror}. Free its disk.") from error
    return page, png


def draw(shown: Shown) -> bytes:
    """The picture as PNG, 1600 x 1200."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 12), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    record = shown.record
    verdict = "accepted" if record.passed else "NOT ACCEPTED"
    what = f"{record.kind} calibration {record.name}: {len(shown.names)} images, {verdict}"
    figure.suptitle(what + (" (simulated)" if record.simulated else ""), fontsize=16, color=_DARK)
    _draw_field(axes[0, 0], shown)
    _draw_coverage(axes[0, 1], shown)
    _draw_images(axes[1, 0], shown)
    if shown.pose_errors is None:
        _draw_distribution(axes[1, 1], shown)
    else:
        _draw_robot(axes[1, 1], shown)
    for ax in axes.flat:
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(colors=_DARK)
        ax.title.set_fontsize(13)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw_field(ax: Axes, shown: Shown) -> None:
    """Residual vectors where they were seen, enlarged; long ones red."""
    pixels, residuals = np.concatenate(shown.pixels), np.concatenate(shown.residuals_px)
    step = max(1, len(pixels) // _MOST_ARROWS)
    pixels, residuals = pixels[::step], residuals[::step]
    length = np.linalg.norm(residuals, axis=1)
    width, height = shown.size_px
    enlarged = _round(0.02 * width / max(shown.pixel_px, 1e-6))
    long = length > 3.0 * shown.pixel_px
    for part, colour in ((~long, _BLUE), (long, _RED)):
        ax.quiver(
            *pixels[part].T,
            *residuals[part].T * enlarged,
            angles="xy",
            scale_units="xy",
            scale=1,
            width=0.0012,
            color=colour,
        )
    key_px = _round(2 * shown.pixel_px, 1)
    ax.plot([0.04 * width, 0.04 * width + key_px * enlarged], [0.96 * height] * 2, color=_DARK, lw=3)
    ax.text(0.04 * width, 0.94 * height, f"{key_px:g} px", color=_DARK)
    ax.set(
        xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="x (px)", ylabel="y (px)",
        title=f"Residuals, {enlarged:g} times enlarged; beyond 3 sigma in red",
    )  # fmt: skip


def _draw_coverage(ax: Axes, shown: Shown) -> None:
    """How many corners were seen in each part of the field."""
    pixels = np.concatenate(shown.pixels)
    width, height = shown.size_px
    cells = np.floor(pixels * FIELD_CELLS / shown.size_px).astype(int)
    count = np.zeros(FIELD_CELLS[::-1])
    np.add.at(count, (cells[:, 1], cells[:, 0]), 1)
    ax.imshow(count, extent=(0, width, height, 0), cmap="Blues", vmin=0, aspect="equal")
    for (row, column), corners in np.ndenumerate(count):
        at = ((column + 0.5) * width / FIELD_CELLS[0], (row + 0.5) * height / FIELD_CELLS[1])
        bright = "white" if corners > 0.6 * count.max() else _DARK
        style: dict[str, Any] = {"color": bright} if corners else {"color": _RED, "weight": "bold"}
        ax.text(*at, f"{corners:.0f}", ha="center", va="center", **style)
    ax.set(title="Corners seen in each part of the field", xlabel="x (px)", ylabel="y (px)")


def _draw_images(ax: Axes, shown: Shown) -> None:
    """Root mean square residual of each image, and what noise alone gives."""
    rms = [np.sqrt(np.mean(np.sum(r**2, axis=1))) for r in shown.residuals_px]
    expected = shown.pixel_px * np.sqrt(2)
    place = np.arange(len(rms))
    ax.bar(place, rms, color=[_RED if value > 2 * expected else _BLUE for value in rms], width=0.8)
    ax.axhline(expected, color=_DARK, ls="--", lw=1)
    ax.annotate(
        f"noise of a corner: {shown.pixel_px:.3g} px in x and y",
        (1.0, expected),
        xycoords=("axes fraction", "data"),
        ha="right",
        va="bottom",
        color=_DARK,
        bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1},
    )
    every = max(1, -(-len(rms) // _MOST_BARS_NAMED))
    ax.set_xticks(place[::every], [_short(name) for name in shown.names[::every]], rotation=60, ha="right")
    ax.set(title="Residual of each image, root mean square", ylabel="px", xlim=(-0.7, len(rms) - 0.3))


def _draw_distribution(ax: Axes, shown: Shown) -> None:
    """Residuals over their noise beside the normal distribution."""
    normal = np.concatenate(shown.residuals_px).ravel() / max(shown.pixel_px, 1e-12)
    grid = np.linspace(-4.5, 4.5, 181)
    ax.hist(np.clip(normal, -4.5, 4.5), bins=60, density=True, color=_GREY, range=(-4.5, 4.5))
    ax.plot(grid, np.exp(-(grid**2) / 2) / np.sqrt(2 * np.pi), color=_BLUE, lw=2)
    inside = np.mean(np.abs(normal) < 1.96)
    ax.set(
        title=f"Residuals over their noise; {inside:.1%} within 1.96 (normal: 95 %)",
        xlabel="residual / sigma", yticks=[], xlim=(-4.5, 4.5),
    )  # fmt: skip
    ax.spines["left"].set_visible(False)


def _draw_robot(ax: Axes, shown: Shown) -> None:
    """What each pose is off by, position to the left and turn to the right."""
    assert shown.pose_errors is not None
    off_mm = np.linalg.norm(shown.pose_errors[:, :3], axis=1)
    off_deg = np.linalg.norm(shown.pose_errors[:, 3:], axis=1)
    place = np.arange(len(off_mm))
    ax.bar(place - 0.2, off_mm, 0.4, color=_BLUE, label="position (mm)")
    ax.set_ylabel("mm", color=_BLUE)
    right = ax.twinx()
    right.bar(place + 0.2, off_deg, 0.4, color=_GREY, label="turn (deg)")
    right.set_ylabel("deg", color="#6c757d")
    right.spines[["top"]].set_visible(False)
    noise = {n.name: n for n in shown.record.noise}
    position, turn = noise["robot position"], noise["robot orientation"]
    ax.set_title(
        "Errors of the robot by pose (blue position, grey turn)\n"
        f"found {position.found:.3g} mm, {turn.found:.3g} deg; "
        f"stated {position.stated:.3g} mm, {turn.stated:.3g} deg"
    )
    every = max(1, -(-len(place) // _MOST_BARS_NAMED))
    ax.set_xticks(place[::every], [_short(name) for name in shown.names[::every]], rotation=60, ha="right")


def _short(name: str) -> str:
    return name if len(name) <= 18 else f"{name[:8]}..{name[-8:]}"


def _round(value: float, digits: int = 1) -> float:
    return float(f"{value:.{digits}g}")


# -- the page ---------------------------------------------------------------------------------------------


def _page(record: Record, picture: bytes) -> str:
    name = html.escape(f"{record.kind} calibration {record.name}")
    simulated = "<p>Simulated: no real camera.</p>" if record.simulated else ""
    data = base64.b64encode(picture).decode()
    remarks = "".join(f"<li>{html.escape(remark)}" for remark in record.remarks)
    return (
        f"<!doctype html><meta charset=utf-8><title>{name}</title><style>{_STYLE}</style><h1>{name}</h1>"
        f"{simulated}{_limits(record)}<h2>Result</h2>{_transforms(record)}{_parameters(record)}{_noise(record)}"
        + (f"<h2>Remarks</h2><ul>{remarks}</ul>" if remarks else "")
        + f'<h2>Residuals</h2><img src="data:image/png;base64,{data}" alt="residuals">{_validity(record)}'
    )


def _table(head: str, rows: list[str]) -> str:
    return f"<table><tr>{head}{''.join(f'<tr>{row}' for row in rows)}</table>"


def _limits(record: Record) -> str:
    verdict = "<p class=ok><b>Accepted.</b>" if record.passed else "<p class=bad><b>Not accepted.</b>"
    rows = [
        f"<td>{html.escape(limit.what)}<td class=n>{limit.found:.3g}<td class=n>{limit.limit:.3g}"
        f"<td>{limit.unit}<td class={'ok>met' if limit.passed else 'bad>missed'}"
        for limit in record.limits
    ]
    return verdict + _table("<th>limit<th class=n>found<th class=n>at most<th><th>", rows)


def _transforms(record: Record) -> str:
    rows = []
    for name, pose in record.transforms.items():
        numbers = [*(f"{v:.4f}" for v in pose.translation_mm), *(f"{v:.5f}" for v in pose.abc_deg)]
        rows.append(f"<td>{html.escape(name)}" + "".join(f"<td class=n>{n}" for n in numbers))
    head = "<th>transform" + "".join(
        f"<th class=n>{h}" for h in ("x mm", "y mm", "z mm", "A deg", "B deg", "C deg")
    )
    return _table(head, rows) if rows else ""


def _parameters(record: Record) -> str:
    rows = [_parameter(parameter) for parameter in record.parameters]
    rows += [
        f"<td>{html.escape(n)}<td class=n>{v:.6g}<td class=n>held<td><td><td>" for n, v in record.fixed.items()
    ]
    head = (
        "<th>parameter<th class=n>value<th class=n>expanded uncertainty (95 %)<th class=n>k"
        "<th class=n>degrees of freedom<th>most of it from"
    )
    return _table(head, rows)


def _parameter(parameter: Parameter) -> str:
    k = float(coverage_factor(parameter.degrees_of_freedom))
    value = "" if parameter.value is None else f"{parameter.value:.{_decimals(k * parameter.u)}f}"
    freedom = f"{parameter.degrees_of_freedom:.0f}" if parameter.degrees_of_freedom < 1e5 else "many"
    return (
        f"<td>{html.escape(parameter.name)}<td class=n>{value}<td class=n>{k * parameter.u:.2g}<td class=n>{k:.2f}"
        f"<td class=n>{freedom}<td>{html.escape(parameter.dominated_by)}"
    )


def _decimals(uncertainty: float) -> int:
    """So many that two digits of the uncertainty can be seen in the value."""
    return int(np.clip(1 - np.floor(np.log10(max(uncertainty, 1e-12))), 0, 12))


def _noise(record: Record) -> str:
    rows = [
        f"<td>{html.escape(n.name)}<td class=n>{n.found:.3g}<td class=n>{f'{n.stated:.3g}' if n.stated else ''}"
        f"<td>{n.unit}<td class=n>{n.redundancy:.0f}"
        for n in record.noise
    ]
    return _table("<th>noise of<th class=n>found<th class=n>stated<th><th class=n>redundancy", rows)


def _validity(record: Record) -> str:
    holds = record.validity.model_dump(exclude_none=True)
    rows = [
        f"<td>{html.escape(key.replace('_', ' '))}<td>{html.escape(str(value))}" for key, value in holds.items()
    ]
    rows += [f"<td>{html.escape(i.name)}<td><code>{i.sha256}</code>" for i in record.inputs]
    rows += [
        f"<td>made<td>{record.created:%Y-%m-%d %H:%M} UTC by {html.escape(record.software)}",
        f"<td>record<td><code>{record.sha256}</code>",
    ]
    return "<h2>Validity and inputs</h2>" + _table("<th><th>", rows)
