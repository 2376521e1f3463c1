"""`texel_clusters.html` of a result of runs: the texels that share a material, and the errors with these
materials."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from coupole.pages.page_parts import Code, Page, Section, Table, anchor
from coupole.pages.page_rendering import write_page
from coupole.reflectance.result_pages.cluster_page import cluster_figures
from coupole.reflectance.run_result import RunResult
from coupole.reflectance.texels.pixel_file import read_view_texels
from coupole.reflectance.texels.texel_cluster_file import read_texel_clusters

PAGE = "texel_clusters.html"
_TOLD = {"own": "texels by their own material", "clustered": "the same texels by their cluster's material"}


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page with the figures of `cluster_texels`. Raises InputError without clusters, StorageError."""
    path = folder / PAGE
    write_page(path, _page(folder, document))
    return path


def _page(folder: Path, document: dict[str, Any]) -> Page:
    name, result = folder.resolve().name, RunResult(folder)
    clusters = read_texel_clusters(folder)
    views = []
    for view in result.views:
        with h5py.File(view.path, "r") as file:
            shape = file["seen"].shape
        texel_of_pixel = read_view_texels(result, view).in_picture(shape)
        numbers = np.append(clusters.cluster[view.path.stem], np.int32(-1))[texel_of_pixel]
        views.append((view.path.stem, cluster_figures(view.path.stem, numbers, clusters.kd)))
    own_mae, cluster_mae = (document["mae"][kind] for kind in _TOLD)
    rows = [
        (words, "" if (mae := document["mae"][kind]) is None else f"{100 * mae:.3f}")
        for kind, words in _TOLD.items()
    ]
    return Page(
        title=f"{name}: {document['clusters']} materials for {document['texels']:,} texels",
        pictures=views[0][1] if views else [],
        summary=f"{document['texels']:,} texels were grouped into {document['clusters']} materials. Each texel "
        "keeps its own normal.",
        quality="The error is not known, because no LEDs were kept for the check."
        if own_mae is None or cluster_mae is None
        else f"With its cluster's material a texel is off by {100 * cluster_mae:.3f} % of range, with its own by "
        f"{100 * own_mae:.3f} %.",
        next_step=[
            "See them under another light: ",
            Code(f"coupole reflectance relight {name} --fit texel_clusters --direction 1,0,0.5 --to relit.png"),
            ". Find fewer or more materials: ",
            Code(f"coupole reflectance cluster {name} --texels --clusters {max(1, document['clusters'] // 2)}"),
            ".",
        ],
        sections=[
            Section(
                "errors",
                "Under LEDs left out",
                tables=[Table("Mean error under LEDs kept for the check", ("texels", "% of range"), rows)],
            ),
            *(Section(f"view-{anchor(view)}", f"View {view}", figures=figures) for view, figures in views[1:]),
        ],
    )
