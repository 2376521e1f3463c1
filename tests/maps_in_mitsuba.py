"""An exported OBJ or glTF with its maps in an independent renderer, which makes tangents of its own."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from coupole.reflectance.new_light.pictured_surface import FreeCamera


@dataclass(frozen=True)
class ExportedMaps:
    """A folder of `coupole export`, with its maps as numbers."""

    mesh: Path
    """An OBJ: metres, y up."""
    kd: np.ndarray
    """[h, w, 3] pi kd."""
    ks: np.ndarray
    alpha: np.ndarray
    normal: np.ndarray
    """[h, w, 3] codes, 0 to 1."""

    @classmethod
    def read(cls, folder: Path) -> ExportedMaps:
        """Read what `--to obj` has written."""
        library = (folder / "surface.mtl").read_text().splitlines()
        most_ks = float(next(line for line in library if line.startswith("Ks ")).split()[1])
        ks = most_ks * linear(codes(folder / "specular.png"))
        kd = linear(codes(folder / "base_color.png")) * (1 - ks.max(axis=2, keepdims=True))
        mesh = folder / "surface.obj"
        return cls(mesh, kd, ks, codes(folder / "roughness.png") ** 2, codes(folder / "normal.png"))

    @classmethod
    def read_gltf(cls, folder: Path) -> ExportedMaps:
        """Read what `--to gltf` has written, from its layout. Its mesh is also written beside it, as an OBJ."""
        data = (folder / "surface.glb").read_bytes()
        length = int.from_bytes(data[12:16], "little")
        document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
        (primitive,), (material,) = document["meshes"][0]["primitives"], document["materials"]

        def block(number: int) -> bytes:
            view = document["bufferViews"][number]
            return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

        def floats(name: str) -> np.ndarray:
            accessor = document["accessors"][primitive["attributes"][name]]
            values = np.frombuffer(block(accessor["bufferView"]), "<f4")
            return values.reshape(accessor["count"], -1).astype(float)

        def picture(texture: dict[str, int]) -> np.ndarray:
            image = document["images"][document["textures"][texture["index"]]["source"]]
            return shares_of(cv2.imdecode(np.frombuffer(block(image["bufferView"]), np.uint8), cv2.IMREAD_COLOR))

        rows = np.frombuffer(block(document["accessors"][primitive["indices"]]["bufferView"]), "<u4") + 1
        lines = [f"v {x} {y} {z}" for x, y, z in floats("POSITION")]
        lines += [f"vn {x} {y} {z}" for x, y, z in floats("NORMAL")]
        lines += [f"vt {u} {1.0 - v}" for u, v in floats("TEXCOORD_0")]
        lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in rows.reshape(-1, 3)]
        mesh = folder / "surface.obj"
        mesh.write_text("\n".join(lines) + "\n")
        specular = material["extensions"]["KHR_materials_specular"]
        ks = np.array(specular["specularColorFactor"]) * linear(picture(specular["specularColorTexture"])) * 0.04
        layers = material["pbrMetallicRoughness"]
        kd = linear(picture(layers["baseColorTexture"])) * (1 - ks.max(axis=2, keepdims=True))
        alpha = picture(layers["metallicRoughnessTexture"])[..., 1] ** 2
        return cls(mesh, kd, ks, alpha, picture(material["normalTexture"]))

    def render(self, camera: FreeCamera, towards: np.ndarray, samples: int) -> np.ndarray:
        """[h, w, 3] under light from afar in which a white diffuser that faces it is 1. Both parts of the
        material, without light from surface to surface; camera and light are in the support frame."""
        import mitsuba as mi

        mi.set_variant("scalar_rgb")
        assert camera.look_at_mm is not None
        width, height = camera.size_px
        look = mi.ScalarTransform4f().look_at(
            (y_up(camera.at_mm) / 1e3).tolist(), (y_up(camera.look_at_mm) / 1e3).tolist(), [0, 1, 0]
        )
        film: dict[str, Any] = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
        sensor: dict[str, Any] = {
            "type": "perspective",
            "fov": camera.field_of_view_deg,
            "fov_axis": "x",
            "near_clip": 1e-3,
        }
        light: dict[str, Any] = {"type": "directional", "direction": (-y_up(towards)).tolist()}
        light["irradiance"] = {"type": "rgb", "value": [np.pi] * 3}
        mirror: dict[str, Any] = {"type": "roughconductor", "material": "none", "distribution": "ggx"}
        mirror |= {"alpha": texture(self.alpha[..., None]), "specular_reflectance": texture(self.ks)}
        total = np.zeros((height, width, 3))
        diffuse: dict[str, Any] = {"type": "diffuse", "reflectance": texture(self.kd)}
        for part in (diffuse, mirror):
            bsdf = {"type": "normalmap", "normalmap": texture(self.normal), "bsdf": part}
            scene = {
                "type": "scene",
                "integrator": {"type": "direct", "hide_emitters": True},
                "sensor": {**sensor, "to_world": look, "film": film},
                "surface": {"type": "obj", "filename": str(self.mesh), "bsdf": bsdf},
                "light": light,
            }
            total += np.array(mi.render(mi.load_dict(scene), spp=samples))[..., :3]
        return total


def texture(values: np.ndarray) -> dict[str, Any]:
    import mitsuba as mi

    bitmap = mi.Bitmap(np.ascontiguousarray(values.astype(np.float32)))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}


def codes(path: Path) -> np.ndarray:
    return shares_of(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def shares_of(found: Any) -> np.ndarray:
    """Codes of a picture, of 0 to 1, red first."""
    picture: np.ndarray = np.asarray(found)
    shares: np.ndarray = picture / float(np.iinfo(picture.dtype).max)
    return shares[..., ::-1] if shares.ndim == 3 else shares


def linear(srgb: np.ndarray) -> np.ndarray:
    values: np.ndarray = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return values


def y_up(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([x, z, -y])
