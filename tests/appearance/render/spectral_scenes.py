"""Small scenes for tests of the spectral renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from coupole.appearance.render.rendering import Spectral, open_renderer
from coupole.appearance.render.scene_file import Scene

HERE = Path()


def scene(objects: list[dict[str, Any]], lights: list[dict[str, Any]], **others: Any) -> Scene:
    """A scene seen from above by a narrow camera of 8 x 8 pixels, unless `others` say otherwise."""
    camera = {
        "name": "main",
        "position_mm": [0, 0, 500],
        "target_mm": [0, 0, 0],
        "up": [0, 1, 0],
        "optics": {"kind": "field", "degrees": 2},
        "width_px": 8,
        "height_px": 8,
    }
    default = {"schema_version": 1, "name": "test", "cameras": [camera], "samples": 16, "depth": 2}
    return Scene.model_validate({**default, "objects": objects, "lights": lights, **others})


def rendered(wanted: Scene) -> Spectral:
    with open_renderer(wanted, HERE) as renderer:
        return renderer.render(wanted.cameras[0])


def plane(material: dict[str, Any], size_mm: float = 1000.0) -> dict[str, Any]:
    return {"kind": "plane", "width_mm": size_mm, "depth_mm": size_mm, "material": material}


def constant(value: float) -> dict[str, Any]:
    return {"kind": "constant", "value": value}


def everywhere(spectrum: dict[str, Any], luminance_cd_m2: float = 100.0) -> dict[str, Any]:
    return {"kind": "environment", "luminance_cd_m2": luminance_cd_m2, "spectrum": spectrum}


def illuminant(name: str) -> dict[str, Any]:
    return {"kind": "illuminant", "name": name}


def camera(elevation_deg: float, **others: Any) -> dict[str, Any]:
    """A narrow camera 500 mm from the origin, above the x axis."""
    import math

    angle = math.radians(elevation_deg)
    return {
        "name": "main",
        "position_mm": [500 * math.cos(angle), 0, 500 * math.sin(angle)],
        "target_mm": [0, 0, 0],
        "up": [0, 0, 1] if elevation_deg < 90 else [0, 1, 0],
        "optics": {"kind": "field", "degrees": 0.2},
        "width_px": 8,
        "height_px": 8,
        **others,
    }
