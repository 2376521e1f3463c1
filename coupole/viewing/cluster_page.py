"""`clusters.html` of a result of runs: which triangles share a material, and what is missed with it."""

from __future__ import annotations

import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from coupole.calibration.report import HEAD
from coupole.errors import StorageError
from coupole.reflectance.run_result import RunResult
from coupole.storage.durable import write_synced
from coupole.viewing.reflectance_page import STYLE, display, figure

PAGE = "clusters.html"
_TOLD = {
    "own": "triangles by their own material",
    "clustered": "the same by their cluster's",
    "harmonics": "the same by its harmonics of both directions",
    "borrowed": "triangles that have their cluster's for want of samples",
}


def write(folder: Path, document: dict[str, Any]) -> Path:
    """Write the page of what `cluster_result` said. Raises InputError without clusters, StorageError."""
    path = folder / PAGE
    try:
        write_synced(path, "".join(_page(folder, document)))
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def _page(folder: Path, document: dict[str, Any]) -> Iterator[str]:
    title = f"{html.escape(folder.resolve().name)}: clusters"
    yield f"{HEAD}<title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    yield (
        f"<p>{document['clusters']} materials for {document['triangles']} triangles, {document['borrowed']} of "
        "which had "
    )
    yield f"too few samples for one of their own; {document['without']} have none."
    yield "<table><tr><th><th>mean error under LEDs left out, % of range"
    for name, text in _TOLD.items():
        mae = document["mae"][name]
        yield f"<tr><th>{text}<td>{'' if mae is None else f'{100 * mae:.3f}'}"
    yield "</table>"
    if document["without_view"] is not None:
        kinds = ((text, document["mae_of_view"][name]) for name, text in _TOLD.items())
        errors = (f"{text} {100 * mae:.3f} %" for text, mae in kinds if mae is not None)
        yield f"<p>From the view {html.escape(document['without_view'])}, of which clusters had no samples: "
        yield f"{', '.join(errors)} (their own materials had them)."
    if document["mae_ratio"] is not None:
        yield f"<p>Ratio {document['mae_ratio']:.2f}; published: 1.7 (seed 003, figure 6, harmonics)."
    result = RunResult(folder)
    clusters = result.clusters
    colours = np.random.default_rng(5).uniform(0.2, 1.0, (len(clusters.alpha), 3))
    diffuse = clusters.kd if clusters.kd.shape[1] == 3 else np.repeat(clusters.kd, 3, axis=1)
    for view in result.views:
        with h5py.File(view.path, "r") as file:
            rows = file["seen"][()]
        number = clusters.cluster[np.searchsorted(result.triangles, view.triangles)]
        numbers = np.where(rows >= 0, number[rows], -1)
        yield f"<h2>View {html.escape(view.path.stem)}</h2>"
        for caption, values in (("clusters, any colours", colours), ("their diffuse part", diffuse)):
            picture = np.where(numbers[..., None] >= 0, values[numbers], 0.0).astype(np.float32)
            yield figure(caption, picture if values is colours else display(picture))
