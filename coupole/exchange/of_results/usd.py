"""USD: a .usdz of the mesh with UsdPreviewSurface and its maps, for USD's programs and telephones.

UsdPreviewSurface (Pixar, 2.6) is used in its specular workflow: the specular colour is the reflectance at normal
incidence, which is ks. The specular part grows towards grazing by Schlick's formula.
"""

from __future__ import annotations

import importlib
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from coupole.errors import InputError, StorageError
from coupole.exchange.atlas.flat_surface import FlatMesh, flatten
from coupole.exchange.of_results.measured_surface import Y_UP_FROM_SUPPORT, MeasuredSurface
from coupole.exchange.of_results.obj import MATERIAL, write_maps
from coupole.storage.durable import sync_folder

_ROOT = "/measured"


def write(surface: MeasuredSurface, folder: Path) -> list[Path]:
    """Write `surface.usdz`: metres, y up. Raises InputError without the package usd-core."""
    pxr = _library()
    flat = flatten(surface)
    most_ks = max(float(flat.ks.max()), 1e-6)
    path = folder / "surface.usdz"
    with tempfile.TemporaryDirectory(prefix=".usd.", dir=folder) as aside:
        maps = write_maps(flat, Path(aside), most_ks)
        stage = pxr.Usd.Stage.CreateNew(str(Path(aside) / "surface.usdc"))
        _describe(pxr, stage, surface)
        mesh = _add_mesh(pxr, stage, flat.mesh)
        material = _add_material(pxr, stage, {path.stem: path.name for path in maps}, most_ks)
        pxr.UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
        stage.GetRootLayer().Save()
        package = Path(aside) / path.name
        archives = pxr.Sdf if hasattr(pxr.Sdf, "ZipFileWriter") else pxr.Usd  # its name up to usd-core 25.5
        writer = archives.ZipFileWriter.CreateNew(str(package))
        for file in (Path(stage.GetRootLayer().realPath), *maps):  # the format demands the layer first
            writer.AddFile(str(file), file.name)
        if not writer.Save():
            raise StorageError(f"{path}: USD could not pack its files")
        package.replace(path)
    sync_folder(folder)
    return [path]


def _library() -> Any:
    """Return the package `pxr` with the modules that this file uses."""
    try:
        names = ("Gf", "Sdf", "Usd", "UsdGeom", "UsdShade", "Vt")
        return SimpleNamespace(**{name: importlib.import_module(f"pxr.{name}") for name in names})
    except ImportError as error:
        raise InputError("--to usd: needs the package usd-core: `pip install 'coupole[usd]'`") from error


def _describe(pxr: Any, stage: Any, surface: MeasuredSurface) -> None:
    pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.y)
    pxr.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = pxr.UsdGeom.Xform.Define(stage, _ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    stage.GetRootLayer().comment = surface.remark


def _add_mesh(pxr: Any, stage: Any, flat: FlatMesh) -> Any:
    mesh = pxr.UsdGeom.Mesh.Define(stage, f"{_ROOT}/surface")
    places = ((flat.places_mm @ Y_UP_FROM_SUPPORT.T) * 1e-3).astype(np.float32)
    mesh.CreateSubdivisionSchemeAttr(pxr.UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(pxr.Vt.Vec3fArray.FromNumpy(places))
    mesh.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.stack([places.min(axis=0), places.max(axis=0)])))
    mesh.CreateFaceVertexCountsAttr(pxr.Vt.IntArray.FromNumpy(np.full(len(flat.triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(pxr.Vt.IntArray.FromNumpy(flat.triangles.reshape(-1).astype(np.int32)))
    mesh.CreateNormalsAttr(pxr.Vt.Vec3fArray.FromNumpy((flat.normals @ Y_UP_FROM_SUPPORT.T).astype(np.float32)))
    mesh.SetNormalsInterpolation(pxr.UsdGeom.Tokens.vertex)
    upwards = (flat.map_places * [1.0, -1.0] + [0.0, 1.0]).astype(np.float32)
    places_in_maps = pxr.UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(
        "st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, pxr.UsdGeom.Tokens.vertex
    )
    places_in_maps.Set(pxr.Vt.Vec2fArray.FromNumpy(upwards))
    return mesh


def _add_material(pxr: Any, stage: Any, names: dict[str, str], most_ks: float) -> Any:
    types = pxr.Sdf.ValueTypeNames
    material = pxr.UsdShade.Material.Define(stage, f"{_ROOT}/{MATERIAL}")
    shader = pxr.UsdShade.Shader.Define(stage, f"{_ROOT}/{MATERIAL}/preview")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("useSpecularWorkflow", types.Int).Set(1)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    reader = pxr.UsdShade.Shader.Define(stage, f"{_ROOT}/{MATERIAL}/st")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", types.String).Set("st")
    inputs = {
        "diffuseColor": ("base_color", types.Color3f, "rgb", "sRGB", 1.0, 0.0),
        "specularColor": ("specular", types.Color3f, "rgb", "sRGB", most_ks, 0.0),
        "roughness": ("roughness", types.Float, "r", "raw", 1.0, 0.0),
        "occlusion": ("occlusion", types.Float, "r", "raw", 1.0, 0.0),
        "normal": ("normal", types.Normal3f, "rgb", "raw", 2.0, -1.0),
    }
    for name, (picture, kind, output, space, scale, bias) in inputs.items():
        texture = pxr.UsdShade.Shader.Define(stage, f"{_ROOT}/{MATERIAL}/{picture}")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", types.Asset).Set(f"./{names[picture]}")
        texture.CreateInput("sourceColorSpace", types.Token).Set(space)
        texture.CreateInput("scale", types.Float4).Set(pxr.Gf.Vec4f(scale, scale, scale, 1.0))
        texture.CreateInput("bias", types.Float4).Set(pxr.Gf.Vec4f(bias, bias, bias, 0.0))
        for axis in ("wrapS", "wrapT"):
            texture.CreateInput(axis, types.Token).Set("clamp")
        texture.CreateInput("st", types.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        shader.CreateInput(name, kind).ConnectToSource(texture.ConnectableAPI(), output)
    return material
