"""Files of a merged bracket: OpenEXR with linear values, and a picture of the camera's response."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from coupole.errors import InputError, StorageError, reason
from coupole.exchange.bracket.camera_response import NODES, Response
from coupole.exchange.bracket.exposure_merging import Merged

_COLOURS = ("tab:red", "tab:green", "tab:blue")


def write_exr(path: Path, merged_picture: Merged, comment: str) -> None:
    """Write channels R, G, B; `u.R`, `u.G`, `u.B`, relative standard uncertainties, inf for bounds; and
    `saturated`, `dark` and `contradicting`, which are 1 where a channel or a photograph has this property. Raises
    StorageError."""
    channels: dict[str, Any] = {}
    for number, name in enumerate("RGB"):
        channels[name] = np.ascontiguousarray(merged_picture.radiance[..., number])
        channels[f"u.{name}"] = np.ascontiguousarray(merged_picture.uncertainty[..., number])
    channels["saturated"] = merged_picture.saturation_mask.any(axis=2).astype(np.float32)
    channels["dark"] = merged_picture.dark.any(axis=2).astype(np.float32)
    channels["contradicting"] = merged_picture.contradicting.any(axis=0).astype(np.float32)
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "comments": comment}
    part = path.with_name(f".{path.name}.part")
    try:
        OpenEXR.File(head, channels).write(str(part))
        part.replace(path)
    except (OSError, RuntimeError) as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    finally:
        part.unlink(missing_ok=True)


def read_known(path: Path) -> NDArray[np.float32]:
    """[h, w, 3] R, G, B of an OpenEXR, NaN where `saturated` or `dark` is set. Raises InputError."""
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        picture = np.stack([np.asarray(channels[name].pixels, np.float32) for name in "RGB"], axis=2)
    except (OSError, RuntimeError, KeyError) as error:
        raise InputError(
            f"{path}: expected an OpenEXR with R, G, B, as `coupole bracket` writes it; {error}"
        ) from error
    for state in ("saturated", "dark"):
        if state in channels:
            picture[np.asarray(channels[state].pixels) > 0.0] = np.nan
    return picture


def draw_response(path: Path, response: Response, title: str) -> None:
    """Write a PNG of exposure by value, with 95 % intervals. Raises StorageError."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.4), layout="constrained")
    axes: Any = figure.add_subplot()
    z = np.linspace(0.0, 1.0, NODES)
    for number, (name, colour) in enumerate(zip(("red", "green", "blue"), _COLOURS, strict=True)):
        curve, sigma = response.log_exposure[:, number], response.uncertainty[:, number]
        is_finite = np.isfinite(sigma) & (z > 0.0)
        axes.plot(z[is_finite], np.exp(curve[is_finite]), color=colour, label=name)
        bounds = [np.exp(curve[is_finite] + sign * 1.96 * sigma[is_finite]) for sign in (-1, 1)]
        axes.fill_between(z[is_finite], *bounds, color=colour, alpha=0.2, linewidth=0)
    axes.set(
        xlabel="value / largest value",
        ylabel="exposure / exposure at half of the largest value",
        yscale="log",
        title=title,
    )
    axes.grid(alpha=0.3)
    axes.legend()
    try:
        figure.savefig(path, dpi=110)
    except OSError as error:
        raise StorageError(f"{path}: {reason(error)}") from error
