"""The relief of `relight_cases` in an independent renderer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from relight_cases import Coat, waves

from coupole.reflectance.new_light.pictured_surface import FreeCamera


class Mitsuba:
    """In the support frame."""

    def __init__(self, folder: Path, camera: FreeCamera, coat: Coat) -> None:
        import mitsuba as mi
        import trimesh

        mi.set_variant("scalar_rgb")
        corners = waves()
        mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
        mesh.export(folder / "relief.ply")
        assert camera.look_at_mm is not None
        self.size, self.coat, self.mesh, self.mi = camera.size_px, coat, str(folder / "relief.ply"), mi
        look = mi.ScalarTransform4f().look_at(camera.at_mm.tolist(), camera.look_at_mm.tolist(), [0, 0, 1])
        film = {"type": "hdrfilm", "width": self.size[0], "height": self.size[1]}
        film["rfilter"] = {"type": "box"}
        self.sensor = {"type": "perspective", "fov": camera.field_of_view_deg, "fov_axis": "x", "near_clip": 1.0}
        self.sensor |= {"to_world": look, "film": film}

    def render(self, light: dict[str, Any], samples: int) -> np.ndarray:
        """Sum of both parts of the coat, without light from surface to surface."""
        reflectance = {"type": "rgb", "value": [float(np.pi * one) for one in self.coat.kd]}
        diffuse = {"type": "diffuse", "reflectance": reflectance}
        mirror = {
            "type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": self.coat.alpha,
            "specular_reflectance": {"type": "rgb", "value": list(self.coat.ks)},
        }  # fmt: skip
        total = np.zeros((*self.size[::-1], 3))
        for bsdf in (diffuse, mirror):
            relief = {"type": "ply", "filename": self.mesh, "face_normals": True, "bsdf": bsdf}
            scene = {
                "type": "scene", "sensor": self.sensor, "relief": relief, "light": light,
                "integrator": {"type": "direct", "hide_emitters": True},
            }  # fmt: skip
            total += np.array(self.mi.render(self.mi.load_dict(scene), spp=samples))[..., :3]
        return total
