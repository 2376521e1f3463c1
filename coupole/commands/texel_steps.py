"""Steps of `coupole reflectance` for the texels of a result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from coupole.commands.reflectance_options import SourcesOfResult
from coupole.errors import InputError

Said = Callable[[str, int, int], None]


def ablate_texels_of(
    result: Path, runs: list[Path], sources: SourcesOfResult, memory_bytes: int, say: Said
) -> dict[str, Any]:
    """Ablate texels. Raises InputError without runs."""
    from coupole.reflectance.result_pages import texel_ablation_page
    from coupole.reflectance.texels.texel_ablation import ablate_texels

    if not runs:
        raise InputError(
            "--texels: needs the frames; give the runs of the result, and its records, such as "
            f"`coupole reflectance ablate {result} RUN --texels --calibrations calibrations`"
        )
    document = ablate_texels(sources.request(runs, result, memory_bytes), result, say=say)
    return {**document, "report": str(texel_ablation_page.write(result, document))}


def cluster_texels_of(
    result: Path, clusters: int | None, memory_bytes: int, degrees: int, without_view: str | None, say: Said
) -> dict[str, Any]:
    """Group texels. Raises InputError for options that only samples of triangles have a meaning for."""
    from coupole.reflectance.pair_harmonics import USUAL_DEGREES
    from coupole.reflectance.result_pages import texel_cluster_page
    from coupole.reflectance.texels.texel_clusters import cluster_texels

    if without_view is not None or degrees != USUAL_DEGREES:
        raise InputError(
            "--without-view, --degrees: are for clusters of triangles, which are fitted to samples; clusters of "
            "texels are means of their materials"
        )
    document = cluster_texels(result, clusters, memory_bytes, say=say)
    return {**document, "report": str(texel_cluster_page.write(result, document))}
