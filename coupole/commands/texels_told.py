"""Size of texels from the command line, and messages before texels are made."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from coupole.reflectance.texels.texel_size import TexelSize, size_refused
from coupole.viewing.terminal import bytes_text, duration_text

if TYPE_CHECKING:
    from coupole.reflectance.texels.texel_forecast import TexelForecast


def read_size(text: str) -> TexelSize:
    """Return the size that `--texels` names. Raises InputError."""
    if text == "auto":
        return TexelSize()
    try:
        return TexelSize(float(text))
    except ValueError:
        raise size_refused(text) from None


def lines_of(forecast: TexelForecast, machine_bytes: int) -> Iterator[str]:
    """Yield the messages that the user sees before texels are made, on a machine with so much memory."""
    views, size_mm = forecast.views, forecast.size.mm
    sides = sorted({view.side_px for view in views})
    pixels = "single pixels" if sides == [1] else f"{' and '.join(f'{n} x {n}' for n in sides)} pixels each"
    number, widths = _two_figures(forecast.texels), _range([view.texel_mm for view in views])
    in_views = f"{len(views)} view{'s' if len(views) > 1 else ''}"
    yield f"texels: some {number:,} in {in_views}, {pixels}, {widths} mm on the surface"
    memory, disk = bytes_text(forecast.memory_bytes), bytes_text(forecast.disk_bytes)
    duration = duration_text(forecast.time_s)
    yield (
        f"they need about {memory} of memory and {disk} of disk; after the fits of triangles they take "
        f"{duration} on this machine"
    )
    if forecast.memory_bytes > machine_bytes:
        yield (
            f"this machine has {bytes_text(machine_bytes)} of memory: the work may end because memory is short; "
            "larger texels (--texels MM) and a smaller --memory need less"
        )
    if size_mm is not None and size_mm > forecast.edge_mm:
        yield (
            f"texels of {size_mm:g} mm are larger than the mesh's triangles, whose edge is "
            f"{forecast.edge_mm:.2g} mm (median): without --texels, each triangle has a material too"
        )


def _range(values: list[float]) -> str:
    low, high = f"{min(values):.2g}", f"{max(values):.2g}"
    return low if low == high else f"{low} to {high}"


def _two_figures(count: int) -> int:
    return int(round(count, 1 - math.floor(math.log10(count)))) if count else 0
