"""What tests/neighbours/test_napari.py runs as a process: npe2 and napari's model of a viewer open folders.

npe2 warns at import, which the tests' own process takes for an error. Arguments: folders. It prints one JSON
document.
"""

from __future__ import annotations

import json
import sys
import tempfile
from typing import Any

import npe2
import numpy as np
from napari.components import ViewerModel

manager = npe2.PluginManager.instance()
manager.discover()


def described(data: Any, attributes: dict[str, Any], kind: str) -> dict[str, Any]:
    """A layer as npe2 gave it."""
    if kind == "surface":
        vertices, faces, values = data
        shape = [len(vertices), len(faces), len(values)]
        sample = [float(np.nanmin(values)), float(np.nanmax(values))]
        extent = np.ptp(vertices, axis=0).tolist()
        return {"kind": kind, "name": attributes["name"], "shape": shape, "range": sample, "extent": extent}
    first = data[(0,) * (data.ndim - 2)]
    pixels = np.asarray(first)
    return {
        "kind": kind,
        "name": attributes["name"],
        "shape": list(data.shape),
        "is_lazy": not isinstance(data, np.ndarray),
        "sum": int(pixels.sum()) if np.isfinite(pixels).all() else None,
        "scale": attributes.get("scale"),
        "axes": attributes.get("axis_labels"),
        "metadata": attributes.get("metadata"),
    }


found: dict[str, Any] = {"plugin": manager.get_manifest("coupole").display_name}
viewer = ViewerModel()
for number, folder in enumerate(sys.argv[1:]):
    found[str(number)] = [described(*layer) for layer in npe2.read([folder], stack=False, plugin_name="coupole")]
    viewer.open(folder, plugin="coupole")
found["viewer"] = [[layer.name, type(layer).__name__] for layer in viewer.layers]
with tempfile.TemporaryDirectory() as other:
    try:
        npe2.read([other], stack=False, plugin_name="coupole")
    except ValueError as error:
        found["other"] = str(error)
print(json.dumps(found))
