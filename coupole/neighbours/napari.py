"""napari's reader of runs and results: folders that are dropped into its window become layers.

This module imports nothing of napari: npe2 finds `get_reader` through `napari.yaml`, and layers are plain tuples
of data, attributes and kind. It needs napari and the extra `napari`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coupole.scripting.opened_result import PicturesResult, Result, open_result
from coupole.scripting.opened_run import Run, RunView
from coupole.scripting.view_dataset import stack_frames

LayerData = tuple[Any, dict[str, Any], str]
_RUN, _RESULT = "run.json", "result.json"


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[LayerData]] | None:
    """Return the reader for the folder of a run or a result, or for its run.json or result.json; None for any
    other path."""
    if not isinstance(path, str):
        return get_reader(path[0]) if len(path) == 1 else None
    folder = _folder(path)
    if (folder / _RUN).is_file():
        return _layers_of_run
    return _layers_of_result if (folder / _RESULT).is_file() else None


def layers_of_view(view: RunView) -> LayerData:
    """Return an image [light, exposure, y, x] of a view's proven frames, DN; each frame is read when it is shown.

    If a light lacks an exposure or occurs twice, the image is [shot, y, x]. `scale` is the nominal size of a pixel
    on the plane in focus, mm. `metadata` describes each step of the sliders.
    """
    frames = [view[label] for label in view.shots]
    pixels = stack_frames(frames)
    axes: tuple[str, ...] = ("shot",)
    names = [frame.label.rpartition("/")[0] for frame in frames]
    lights, exposures = list(dict.fromkeys(names)), list(dict.fromkeys(frame.exposure_us for frame in frames))
    by_place = {
        (name, frame.exposure_us): number for number, (name, frame) in enumerate(zip(names, frames, strict=True))
    }
    if len(by_place) == len(frames) == len(lights) * len(exposures):
        order = [by_place[light, exposure_us] for light in lights for exposure_us in exposures]
        frames, pixels, axes = [frames[number] for number in order], pixels[order], ("light", "exposure")
        pixels = pixels.reshape(len(lights), len(exposures), *frames[0].shape)
    pixel_mm = view.pixel_mm
    attributes = {
        "name": view.name,
        "scale": (*[1.0] * len(axes), *[pixel_mm or 1.0] * 2),
        "axis_labels": (*axes, "y", "x"),
        "contrast_limits": (view.black_dn, view.white_dn),
        "metadata": {
            "shots": [frame.shot for frame in frames],
            "leds": [frame.led for frame in frames],
            "exposures_us": [frame.exposure_us for frame in frames],
            "pattern": view.pattern,
            "pixel_mm": pixel_mm,
            "proof": frames[0].proof,
        },
    }
    return pixels, attributes, "image"


def layers_of_result(result: Result | PicturesResult) -> list[LayerData]:
    """Return the layers of a result.

    For runs these are surfaces of the mesh, mm, in the support frame, with diffuse albedo, normals, roughness and
    the uncertainty of the normals. For pictures they are one image of each fitted quantity.
    """
    return _surfaces(result) if isinstance(result, Result) else _maps(result)


def _surfaces(result: Result) -> list[LayerData]:
    """Return the surfaces. napari has values at corners, therefore each face has three corners of its own. Its
    axes are z, y, x."""
    materials = result.materials()
    is_known = np.isfinite(materials.kd).all(axis=1)
    support_from_base = np.linalg.inv(result.base_from_support)
    corners_mm = result.vertices_mm[result.faces[is_known]].reshape(-1, 3)
    points_mm = (corners_mm @ support_from_base[:3, :3].T + support_from_base[:3, 3])[:, ::-1]
    faces = np.arange(len(points_mm)).reshape(-1, 3)
    normals = materials.normals[is_known] @ support_from_base[:3, :3].T
    albedo = np.pi * materials.kd[is_known]
    tilt_deg = np.degrees(np.sqrt(result.covariances()[is_known, 0, 0]))

    def layer(name: str, values: NDArray[Any], unit: str, colours: NDArray[Any] | None = None) -> LayerData:
        data = (points_mm, faces, np.repeat(values, 3).astype(np.float32))
        attributes: dict[str, Any] = {"name": name, "metadata": {"unit": unit, "frame": "support", "length": "mm"}}
        if colours is not None:
            attributes["vertex_colors"] = np.repeat(np.clip(colours, 0.0, 1.0), 3, axis=0).astype(np.float32)
        return data, attributes | {"visible": name == "albedo"}, "surface"

    return [
        layer("albedo", albedo.mean(axis=1), "1", albedo / max(np.quantile(albedo, 0.99), 1e-9)),
        layer("normals", normals[:, 2], "1", (normals + 1.0) / 2.0),
        layer("alpha", materials.alpha[is_known], "1"),
        layer("uncertainty of normals", tilt_deg, "degree"),
    ]


def _maps(result: PicturesResult) -> list[LayerData]:
    quantities = {"normals": (result.normals() + 1.0) / 2.0, **result.materials()}
    layers: list[LayerData] = []
    for name, picture in quantities.items():
        if picture.ndim not in (2, 3):
            continue
        is_rgb = picture.ndim == 3 and picture.shape[2] == 3
        data = picture if picture.ndim == 2 or is_rgb else np.moveaxis(picture, 2, 0)
        layers.append((data, {"name": name, "rgb": is_rgb, "visible": name == "normals"}, "image"))
    return layers


def _layers_of_run(path: str | Sequence[str]) -> list[LayerData]:
    run = Run(_folder(path))
    return [layers_of_view(view) for view in run.values() if view.shots]


def _layers_of_result(path: str | Sequence[str]) -> list[LayerData]:
    return layers_of_result(open_result(_folder(path)))


def _folder(path: str | Sequence[str]) -> Path:
    given_path = Path(path if isinstance(path, str) else path[0])
    return given_path.parent if given_path.name in (_RUN, _RESULT) else given_path
