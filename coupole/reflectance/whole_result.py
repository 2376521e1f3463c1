"""A result of runs with everything that is requested: the materials of triangles, and the materials of texels."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.reflectance.block_work import Said
from coupole.reflectance.discarded_frames import refuse_texels
from coupole.reflectance.run_job import RunRequest, reflectance_of
from coupole.storage.run import Run

if TYPE_CHECKING:
    from coupole.reflectance.texels.texel_forecast import TexelForecast
    from coupole.reflectance.texels.texel_size import TexelSize


def fit_runs(
    request: RunRequest,
    out: Path,
    scheduler: str | None,
    progress: Said,
    *,
    texels: TexelSize | None,
    tell: Callable[[TexelForecast], None] | None = None,
) -> dict[str, Any]:
    """Make a result, or its missing parts; return the content of `result.json`.

    The forecast of the texels' time and size is given to `tell` before the work begins. Raises the errors of
    `reflectance_of`, and DiskFull if the disk cannot hold the texels.
    """
    forecast = None
    if texels is not None:
        from coupole.reflectance.texels.texel_forecast import foresee_texels, refuse_full_disk

        for run in request.runs:
            refuse_texels(Run(run), out)
        forecast = foresee_texels(request, out, texels)
        if forecast is not None:
            if tell is not None:
                tell(forecast)
            refuse_full_disk(forecast, out)
    about = reflectance_of(request, out, scheduler=scheduler, say=progress)
    if texels is not None:
        from coupole.reflectance.texels.texel_job import add_texels

        about |= {"texels": add_texels(request, out, texels, scheduler=scheduler, say=progress)}
        about["texels"]["foreseen"] = forecast and forecast.document()
    return about
