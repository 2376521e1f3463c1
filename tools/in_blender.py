"""Renders exports in Blender, in a separate Python with the package bpy; `prove_in_blender.py` starts it.

    PYTHON_WITH_BPY tools/in_blender.py JOB.json

This file imports nothing of Coupole. A job is a list of pictures. Each picture has the `file` to open (`.glb`,
`.obj`, `.usdz`), the camera (`at_m`, `look_at_m`, `field_of_view_deg` across the width, `size_px`; z up),
directions `towards` of distant lights, `samples` per pixel and a folder `out`. For each light, `out/0.exr` and so
on is written: float32, linear, R, G, B and A; a white diffuser that faces the light is 1. Only direct light of the
lamp counts. The result of Blender's importers is described in `out/imported.json`. With `turns_green`, the green
channel of normal maps is inverted; with `specular_times`, materials are corrected (`_mend`). A picture without a
file shows a smooth unit sphere of one material: `base_color`, `roughness`, `specular_tint`.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

WHITE_W_M2 = math.pi
"""Strength of a sun under which a white diffuser that faces it has radiance 1."""


def main() -> int:
    for picture in json.loads(Path(sys.argv[1]).read_text()):
        out = Path(picture["out"])
        out.mkdir(parents=True, exist_ok=True)
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if "file" in picture:
            _open(Path(picture["file"]))
            if "specular_times" in picture:
                _mend(Path(picture["file"]).parent, picture["specular_times"])
            if picture.get("turns_green"):
                _turn_green()
        else:
            _add_sphere(picture)
        (out / "imported.json").write_text(json.dumps(_describe_imports(), indent=1))
        scene = bpy.context.scene
        _set_up(scene, picture)
        for number, towards in enumerate(picture["towards"]):
            lamp = _add_sun(scene, towards)
            scene.render.filepath = str(out / f"{number}.exr")
            bpy.ops.render.render(write_still=True)
            bpy.data.objects.remove(lamp)
    return 0


def _open(path: Path) -> None:
    if path.suffix == ".glb":
        bpy.ops.import_scene.gltf(filepath=str(path))
    elif path.suffix == ".obj":
        bpy.ops.wm.obj_import(filepath=str(path))
    elif path.suffix == ".usdz":
        bpy.ops.wm.usd_import(filepath=str(path))
    else:
        raise SystemExit(f"{path}: expected .glb, .obj or .usdz")


def _turn_green() -> None:
    """Invert the green channel of all normal maps, as if it pointed down in the map."""
    for material in _materials():
        tree = material.node_tree
        for node in [node for node in tree.nodes if node.type == "NORMAL_MAP"]:
            turn = tree.nodes.new("ShaderNodeVectorMath")
            turn.operation = "MULTIPLY_ADD"
            turn.inputs[1].default_value, turn.inputs[2].default_value = (1.0, -1.0, 1.0), (0.0, 1.0, 0.0)
            tree.links.new(turn.inputs[0], node.inputs["Color"].links[0].from_socket)
            tree.links.new(node.inputs["Color"], turn.outputs[0])


def _mend(folder: Path, specular_times: float) -> None:
    """Do what Blender's importers of OBJ and USD leave out.

    `specular_times` turns the specular picture into tints, because Blender's importers take it for a level. The
    roughness map is marked as data, not as colour. OBJ's normal map is linked.
    """
    for material in _materials():
        tree = material.node_tree
        surface = next(node for node in tree.nodes if node.type == "BSDF_PRINCIPLED")
        pictures = {node.image.name: node for node in tree.nodes if node.type == "TEX_IMAGE"}
        pictures["roughness.png"].image.colorspace_settings.name = "Non-Color"
        for link in surface.inputs["Specular IOR Level"].links:
            tree.links.remove(link)
        surface.inputs["Specular IOR Level"].default_value = 0.5
        scale = tree.nodes.new("ShaderNodeVectorMath")
        scale.operation = "SCALE"
        scale.inputs["Scale"].default_value = specular_times
        tree.links.new(scale.inputs[0], pictures["specular.png"].outputs["Color"])
        tree.links.new(surface.inputs["Specular Tint"], scale.outputs[0])
        if not surface.inputs["Normal"].is_linked:
            normals, picture = tree.nodes.new("ShaderNodeNormalMap"), tree.nodes.new("ShaderNodeTexImage")
            picture.image = bpy.data.images.load(str(folder / "normal.png"))
            picture.image.colorspace_settings.name = "Non-Color"
            tree.links.new(normals.inputs["Color"], picture.outputs["Color"])
            tree.links.new(surface.inputs["Normal"], normals.outputs["Normal"])


def _add_sphere(picture: dict[str, Any]) -> None:
    """Add a smooth unit sphere. (Blender's own sphere with as many faces takes minutes.)"""
    rings, around = 192, 384
    places = [
        (math.sin(polar) * math.cos(turn), math.sin(polar) * math.sin(turn), math.cos(polar))
        for polar in (math.pi * ring / rings for ring in range(rings + 1))
        for turn in (2.0 * math.pi * step / around for step in range(around))
    ]
    faces = []
    for ring in range(rings):
        for step in range(around):
            a, b = ring * around + step, ring * around + (step + 1) % around
            faces += [(a, a + around, b + around), (a, b + around, b)]
    mesh = bpy.data.meshes.new("sphere")
    mesh.from_pydata(places, [], faces)
    mesh.normals_split_custom_set_from_vertices(places)
    material = bpy.data.materials.new("sphere")
    inputs = next(node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED").inputs
    inputs["Base Color"].default_value = [*picture["base_color"], 1.0]
    inputs["Specular Tint"].default_value = [*picture["specular_tint"], 1.0]
    inputs["Roughness"].default_value = picture["roughness"]
    inputs["IOR"].default_value = 1.5
    mesh.materials.append(material)
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("sphere", mesh))


def _materials() -> list[Any]:
    """Return the materials with nodes."""
    return [material for material in bpy.data.materials if material.node_tree is not None]


def _describe_imports() -> dict[str, Any]:
    """Return position and size of the meshes, and links and values of their materials."""
    meshes = []
    for solid in (solid for solid in bpy.data.objects if solid.type == "MESH"):
        corners = [solid.matrix_world @ Vector(corner) for corner in solid.bound_box]
        meshes.append(
            {
                "name": solid.name,
                "low_m": [min(corner[k] for corner in corners) for k in range(3)],
                "high_m": [max(corner[k] for corner in corners) for k in range(3)],
                "triangles": len(solid.data.polygons),
                "has_normals": solid.data.has_custom_normals,
            }
        )
    materials = {material.name: _inputs(material) for material in _materials()}
    return {"blender": bpy.app.version_string, "meshes": meshes, "materials": materials}


def _inputs(material: Any) -> dict[str, str]:
    """Return the inputs of the material's surface: values, or the pictures behind them."""
    value_of_input = {}
    for node in (node for node in material.node_tree.nodes if node.type == "BSDF_PRINCIPLED"):
        for socket in node.inputs:
            if socket.is_linked:
                value_of_input[socket.name] = " ".join(_behind(socket.links[0].from_node))
            elif hasattr(socket, "default_value"):
                value = socket.default_value
                value_of_input[socket.name] = f"{value:.4g}" if isinstance(value, float) else str(list(value))
    return value_of_input


def _behind(node: Any) -> list[str]:
    words = (
        [f"{node.type}:{node.image.name}:{node.image.colorspace_settings.name}"]
        if node.type == "TEX_IMAGE"
        else [node.type]
    )
    for socket in node.inputs:
        for link in socket.links:
            words += _behind(link.from_node)
    return words


def _set_up(scene: Any, picture: dict[str, Any]) -> None:
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.max_bounces = "CPU", picture["samples"], 0
    scene.cycles.use_adaptive_sampling, scene.cycles.use_denoising = False, False
    scene.cycles.pixel_filter_type, scene.cycles.filter_width = "BOX", 1.0
    scene.render.threads_mode, scene.render.threads = "FIXED", picture.get("threads", 2)
    scene.render.resolution_x, scene.render.resolution_y = picture["size_px"]
    scene.render.resolution_percentage = 100
    scene.render.film_transparent = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_mode, scene.render.image_settings.color_depth = "RGBA", "32"
    scene.view_settings.view_transform, scene.view_settings.look = "Raw", "None"
    lens = bpy.data.cameras.new("camera")
    lens.sensor_fit, lens.angle = "HORIZONTAL", math.radians(picture["field_of_view_deg"])
    lens.clip_start, lens.clip_end = 1e-4, 1e3
    camera = bpy.data.objects.new("camera", lens)
    at, look_at = Vector(picture["at_m"]), Vector(picture["look_at_m"])
    camera.location = at
    camera.rotation_euler = (look_at - at).to_track_quat("-Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera = camera


def _add_sun(scene: Any, towards: list[float]) -> Any:
    sun = bpy.data.lights.new("sun", "SUN")
    sun.angle, sun.energy = 0.0, WHITE_W_M2
    lamp = bpy.data.objects.new("sun", sun)
    lamp.rotation_euler = Vector(towards).to_track_quat("Z", "Y").to_euler()
    scene.collection.objects.link(lamp)
    return lamp


if __name__ == "__main__":
    sys.exit(main())
