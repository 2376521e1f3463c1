"""`clusters.html` of a result of runs: the triangles that share a material, and the errors with these
materials."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.pages.maps import colour_picture, eye_map
from coupole.pages.page_parts import Code, Figure, Page, Section, Table, anchor
from coupole.pages.page_rendering import write_page
from coupole.reflectance.run_result import RunResult

PAGE = "clusters.html"
_GROUND = np.array([0x10, 0x12, 0x14]) / 255
"""Colour of maps for the eye where no triangle is seen."""
_TOLD = {
    "own": "triangles by their own material",
    "clustered": "the same triangles by their cluster's material",
    "harmonics": "the same triangles by their cluster's harmonics of both directions",
    "borrowed": "triangles that borrow their cluster's material, because they have too few samples",
}


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page with the figures of `cluster_result`. Raises InputError without clusters, StorageError."""
    path = folder / PAGE
    write_page(path, _page(folder, document))
    return path


def _page(folder: Path, document: dict[str, Any]) -> Page:
    name = folder.resolve().name
    views = list(_views(RunResult(folder)))
    return Page(
        title=f"{name}: {document['clusters']} materials for {document['triangles']:,} triangles",
        pictures=views[0][1] if views else [],
        summary=f"{document['triangles']:,} triangles were grouped into {document['clusters']} materials; "
        f"{document['borrowed']:,} had too few samples for a material of their own, {document['without']:,} "
        "have none.",
        quality=_quality(document),
        next_step=[
            "See it without holes: ",
            Code(f"coupole reflectance relight {name} --fit clusters --to relit.exr"),
            ".",
        ],
        sections=[
            Section("errors", "Under LEDs left out", tables=[_errors(document)], notes=_notes(document)),
            *(Section(f"view-{anchor(view)}", f"View {view}", figures=figures) for view, figures in views[1:]),
        ],
    )


def _quality(document: dict[str, Any]) -> str:
    own_mae, cluster_mae = (document["mae"][name] for name in ("own", "clustered"))
    if own_mae is None or cluster_mae is None:
        return "The error is not known, because no LEDs were kept for the check."
    return (
        f"With its cluster's material a triangle is off by {100 * cluster_mae:.3f} % of range, with its own by "
        f"{100 * own_mae:.3f} %."
    )


def _errors(document: dict[str, Any]) -> Table:
    rows = []
    for name, words in _TOLD.items():
        mae = document["mae"][name]
        rows.append((words, "" if mae is None else f"{100 * mae:.3f}"))
    return Table("Mean error under LEDs kept for the check", ("triangles", "% of range"), rows)


def _notes(document: dict[str, Any]) -> list[str]:
    notes = []
    if document["without_view"] is not None:
        kinds = ((words, document["mae_of_view"][name]) for name, words in _TOLD.items())
        errors = ", ".join(f"{words} {100 * mae:.3f} %" for words, mae in kinds if mae is not None)
        notes.append(
            f"From the view {document['without_view']}, whose samples the clusters did not use: {errors} (the "
            f"triangles' own materials used these samples)."
        )
    if document["mae_ratio"] is not None:
        notes.append(
            f"Ratio {document['mae_ratio']:.2f}; published: 1.7 (Lucat et al. 2025, figure 6, harmonics)."
        )
    return notes


def _views(result: RunResult) -> Iterator[tuple[str, Sequence[Figure]]]:
    """Yield each view's name and its `cluster_figures`."""
    clusters = result.clusters
    for view in result.views:
        with h5py.File(view.path, "r") as file:
            rows = file["seen"][()]
        number = clusters.cluster[np.searchsorted(result.triangles, view.triangles)]
        name = view.path.stem
        yield name, cluster_figures(name, np.where(rows >= 0, number[rows], -1), clusters.kd)


def cluster_figures(name: str, numbers: NDArray[np.integer], kd: NDArray[np.floating]) -> Sequence[Figure]:
    """Return a view's clusters [h, w] (-1 for none) in arbitrary colours on the ground of maps, and their diffuse
    part; `kd` is [clusters, channels]."""
    colours = np.random.default_rng(5).uniform(0.2, 1.0, (len(kd), 3))
    diffuse = kd if kd.shape[1] == 3 else np.repeat(kd, 3, axis=1)
    is_known = numbers[..., None] >= 0
    return [
        colour_picture(f"{name}: clusters, any colours", np.where(is_known, colours[numbers], _GROUND)),
        eye_map(f"{name}: diffuse kd of the clusters", np.where(is_known, diffuse[numbers], np.nan)),
    ]
