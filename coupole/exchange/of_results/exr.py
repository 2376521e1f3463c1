"""OpenEXR, several parts in a file, float32: the values at each pixel of a measured view."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from coupole.errors import StorageError, reason
from coupole.exchange.of_results.measured_surface import MeasuredSurface
from coupole.geometry import apply, inverse
from coupole.reflectance.new_light.pictured_surface import surface_of_view


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """`VIEW.exr`, with parts `kd` (R, G, B; 1/sr), `ks` (R, G, B), `alpha`, `normal` and `place` (X, Y, Z; support
    frame, mm), `u_kd`, `u_ks`, `u_alpha` (relative), `u_normal` (rad). NaN where nothing is known."""
    support_from_base = inverse(surface.result.base_from_support)
    paths = []
    for view in surface.result.views:
        view_surface = surface_of_view(surface.result, view)
        number = np.where(view_surface.triangle_of_pixel >= 0, view.triangles[view_surface.triangle_of_pixel], -1)

        def picture(values: NDArray[np.float64], number: NDArray[np.int64] = number) -> NDArray[np.float32]:
            pixels = values[number].astype(np.float32)
            pixels[number < 0] = np.nan
            return np.ascontiguousarray(pixels)

        places = apply(support_from_base, view_surface.places_mm.reshape(-1, 3).astype(np.float64))
        parts = {
            "kd": _channels("RGB", picture(surface.kd)),
            "ks": _channels("RGB", picture(surface.ks)),
            "alpha": {"Y": picture(surface.alpha)},
            "normal": _channels("XYZ", picture(surface.normals)),
            "place": _channels("XYZ", places.reshape(view_surface.places_mm.shape).astype(np.float32)),
            **{name: {"Y": picture(values)} for name, values in surface.uncertain.items()},
        }
        paths.append(_write(folder / f"{view.view}.exr", parts, surface.remark))
    return paths


def _channels(names: str, values: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    return {name: np.ascontiguousarray(values[..., number]) for number, name in enumerate(names)}


def _write(path: Path, parts: dict[str, dict[str, NDArray[np.float32]]], remark: str) -> Path:
    partial = path.with_name(f".{path.name}.part")
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "comments": remark}
    try:
        exr_parts = [OpenEXR.Part({**head, "name": name}, channels, name) for name, channels in parts.items()]
        OpenEXR.File(exr_parts).write(str(partial))
        partial.replace(path)
    except (OSError, RuntimeError) as error:
        raise StorageError(f"{path}: {reason(error)}") from error
    finally:
        partial.unlink(missing_ok=True)
    return path
