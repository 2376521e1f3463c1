"""Maps of texels in other formats: for their own checkers, and for a renderer with tangents of its own."""

from __future__ import annotations

import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cells
import cv2
import numpy as np
import OpenEXR
import pytest
import scipy
import trimesh
from checkers import gltf_messages, needs_checkers
from lazily import lazily
from maps_in_mitsuba import ExportedMaps
from relief_cells import Made
from skimage.color import deltaE_ciede2000, rgb2lab

from coupole.exchange.atlas.flat_surface import flatten
from coupole.exchange.of_results.measured_surface import ExportChoice, read_surface
from coupole.exchange.srgb import srgb
from coupole.reflectance.fits import TEXEL_CLUSTERS, TEXELS
from coupole.reflectance.new_light.light_kinds import DistantLight
from coupole.reflectance.new_light.pictured_surface import FreeCamera
from coupole.reflectance.run_relighting import scene_from
from coupole.reflectance.run_result import RunResult

MaterialX: Any = lazily("MaterialX")
Usd: Any = lazily("pxr.Usd")
UsdGeom: Any = lazily("pxr.UsdGeom")
UsdShade: Any = lazily("pxr.UsdShade")
UsdValidation: Any = lazily("pxr.UsdValidation")


def exported(made: Made, to: str, folder: Path, *options: str) -> Path:
    ended = cells.here("export", made[1], "--to", to, "--out", folder, *options, "--json")
    assert ended.code == 0, ended.err
    return folder


@pytest.fixture(scope="module")
def clustered(detailed: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A copy of the result whose texels share a few materials."""
    out = Path(shutil.copytree(detailed[1], tmp_path_factory.mktemp("clustered") / "result"))
    ended = cells.here("reflectance", "cluster", out, "--texels", "--clusters", "24", "--json")
    assert ended.code == 0, ended.err
    return detailed[0], out, ended.document


LIGHTS = ((-1.0, 0.0, 0.5), (1.0, 0.3, 0.7), (0.0, 1.0, 0.6), (0.2, -1.0, 1.0), (0.0, 0.1, 1.0))


def differences(
    maps: ExportedMaps, result: Path, fit: str, lights: tuple[tuple[float, float, float], ...] = LIGHTS
) -> list[float]:
    """Mean CIEDE2000, under each light, of another renderer's picture from the command's, rendered twice as large:
    where both show something lit, which they do nearly everywhere."""
    camera = FreeCamera(np.array([60.0, -120.0, 280.0]), np.array([30.0, 0.0, 5.0]), (240, 180), 20.0)
    scene = scene_from(RunResult(result), replace(camera, size_px=(480, 360)), fit)
    found = []
    for towards in lights:
        theirs = maps.render(camera, np.array(towards) / np.linalg.norm(towards), 16)
        ours = scene.picture([DistantLight(towards=towards)]).reshape(180, 2, 240, 2, 3).mean(axis=(1, 3))
        known, shared = (ours > 0.0).any(axis=2), (theirs > 0.0).any(axis=2)
        assert (known & ~shared).sum() < 0.05 * known.sum()
        known &= shared
        white = np.percentile(ours[known], 99)
        colours = [rgb2lab(srgb(np.clip(picture / white, 0.0, 1.0))) for picture in (ours, theirs)]
        found.append(float(np.mean(deltaE_ciede2000(*colours)[known])))
    return found


@pytest.fixture(scope="module")
def model(detailed: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The object's mesh as a modelling program may have it: in metres, y up, its triangles mixed, and seen from
    above in its texture."""
    surface = read_surface(detailed[1])
    random = np.random.default_rng(4)
    faces = random.permutation(surface.triangles)
    low, size = surface.vertices_mm.min(axis=0), np.ptp(surface.vertices_mm, axis=0)[:2].max()
    uv = 0.02 + 0.96 * (surface.vertices_mm - low)[:, :2] / size
    y_up = 1e-3 * surface.vertices_mm[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    mesh = trimesh.Trimesh(y_up, faces, visual=trimesh.visual.TextureVisuals(uv=uv), process=False)
    path = tmp_path_factory.mktemp("model") / "model.ply"
    path.write_bytes(mesh.export(file_type="ply"))
    return path


@pytest.mark.parametrize("has_own_charts", [False, True])
def test_maps_look_in_another_renderer_as_the_picture_that_relight_makes(
    detailed: Made, model: Path, tmp_path: Path, has_own_charts: bool
) -> None:
    """With the map's green turned round, they do not. On new charts, and on those of a model."""
    options = ("--uv", str(model)) if has_own_charts else ()
    maps = ExportedMaps.read(exported(detailed, "obj", tmp_path / "obj", *options))
    found = differences(maps, detailed[1], TEXELS)
    assert np.mean(found) < 1.5, found
    turned = replace(maps, normal=maps.normal * [1.0, -1.0, 1.0] + [0.0, 1.0, 0.0])
    assert differences(turned, detailed[1], TEXELS, LIGHTS[-1:])[0] > 1.5 * found[-1]


@pytest.mark.parametrize("to", ["obj", "gltf"])
def test_shared_materials_look_in_another_renderer_as_relight_shows_them(
    clustered: Made, tmp_path: Path, to: str
) -> None:
    """Nearer than to the texels' own materials."""
    folder = exported(clustered, to, tmp_path / to, "--fit", TEXEL_CLUSTERS)
    maps = ExportedMaps.read(folder) if to == "obj" else ExportedMaps.read_gltf(folder)
    found = differences(maps, clustered[1], TEXEL_CLUSTERS)
    assert np.mean(found) < 1.5, found
    assert differences(maps, clustered[1], TEXELS, LIGHTS[-1:])[0] > 1.3 * found[-1]


@needs_checkers
def test_gltf_and_usd_with_shared_materials_are_valid(clustered: Made, tmp_path: Path) -> None:
    folders = [exported(clustered, to, tmp_path / to, "--fit", TEXEL_CLUSTERS) for to in ("gltf", "usd")]
    assert gltf_messages(folders[0] / "surface.glb") == []
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    stage = Usd.Stage.Open(str(folders[1] / "surface.usdz"))
    assert [found.GetMessage() for found in context.Validate(stage)] == []


@needs_checkers
def test_gltf_with_maps_is_valid_and_has_them(detailed: Made, tmp_path: Path) -> None:
    path = exported(detailed, "gltf", tmp_path / "gltf") / "surface.glb"
    assert gltf_messages(path) == []
    (mesh,) = trimesh.load(path).geometry.values()
    material = mesh.visual.material
    size = material.baseColorTexture.size
    assert size == material.normalTexture.size == material.metallicRoughnessTexture.size
    assert min(size) > 300
    normals = np.asarray(material.normalTexture, float)[..., :3] / 127.5 - 1.0
    tilt_deg = np.degrees(np.arccos(np.clip(normals[..., 2], -1.0, 1.0)))
    assert 2.0 < np.percentile(tilt_deg[tilt_deg > 0.7], 50) < 12.0  # bumps of 6 degrees, and triangles of 1 mm


def test_usd_with_maps_is_valid_to_its_own_validators(detailed: Made, tmp_path: Path) -> None:
    path = exported(detailed, "usd", tmp_path / "usd") / "surface.usdz"
    context = UsdValidation.ValidationContext(UsdValidation.ValidationRegistry().GetOrLoadAllValidators())
    stage = Usd.Stage.Open(str(path))
    assert [found.GetMessage() for found in context.Validate(stage)] == []
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/measured/surface"))
    with zipfile.ZipFile(path) as archive:
        assert {Path(name).name for name in archive.namelist()} == {
            "surface.usdc", "base_color.png", "specular.png", "roughness.png", "occlusion.png", "normal.png",
        }  # fmt: skip
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    (surface,) = material.ComputeSurfaceSource()[:1]
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    width_mm = 1e3 * np.ptp(np.asarray(mesh.GetPointsAttr().Get()), axis=0)
    assert 20.0 < width_mm[0] < 120.0
    assert "simulated" in stage.GetRootLayer().comment
    broken = Usd.Stage.CreateInMemory()
    UsdGeom.Mesh.Define(broken, "/surface")
    assert context.Validate(broken)


def test_materialx_with_maps_is_valid(detailed: Made, tmp_path: Path) -> None:
    folder = exported(detailed, "materialx", tmp_path / "materialx")
    library, document = MaterialX.createDocument(), MaterialX.createDocument()
    MaterialX.loadLibraries(
        MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), library
    )
    document.setDataLibrary(library)
    MaterialX.readFromXmlFile(document, str(folder / "surface.mtlx"))
    assert document.validate() == (True, "")
    pixels = OpenEXR.File(str(folder / "normal.exr")).channels()["RGB"].pixels
    lengths = np.linalg.norm(2.0 * pixels[pixels.any(axis=2)] - 1.0, axis=1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)


def test_normals_stand_in_the_frames_of_a_mirrored_texture(detailed: Made, model: Path, tmp_path: Path) -> None:
    """By the ways of u and v on each triangle, as they follow from its corners alone."""
    theirs = trimesh.load(model, process=False)
    uv = np.asarray(theirs.visual.uv) * [-1.0, 1.0] + [1.0, 0.0]
    mirrored = trimesh.Trimesh(
        theirs.vertices, theirs.faces, visual=trimesh.visual.TextureVisuals(uv=uv), process=False
    )
    (tmp_path / "mirrored.obj").write_text(mirrored.export(file_type="obj", digits=9))
    for path, hand in ((model, 1.0), (tmp_path / "mirrored.obj", -1.0)):
        flat = flatten(read_surface(detailed[1], TEXELS, ExportChoice(uv_mesh=path), takes_texels=True))
        mesh, corners = flat.mesh, flat.mesh.triangles
        assert (mesh.handedness == hand).mean() > 0.99
        ab, ac = (mesh.places_mm[corners[:, k]] - mesh.places_mm[corners[:, 0]] for k in (1, 2))
        ab_uv, ac_uv = (mesh.map_places[corners[:, k]] - mesh.map_places[corners[:, 0]] for k in (1, 2))
        inverse = np.linalg.inv(np.stack([ab_uv, ac_uv], axis=1))
        ways = np.einsum("nij,njk->nik", inverse, np.stack([ab, ac], axis=1))
        along, up = ways[:, 0], -ways[:, 1]
        row_of = np.full(mesh.numbers.max() + 1, -1)
        row_of[mesh.numbers] = np.arange(len(mesh.numbers))
        of_texel = row_of[flat.numbers]
        outward = mesh.normals[corners[of_texel]].mean(axis=1)
        made = sum(
            flat.normals_in_frames[:, k, None] * (way / np.linalg.norm(way, axis=1, keepdims=True))
            for k, way in enumerate((along[of_texel], up[of_texel], outward))
        )
        made /= np.linalg.norm(made, axis=1, keepdims=True)
        off_deg = np.degrees(np.arccos(np.clip(np.einsum("kx,kx->k", made, flat.normals), -1.0, 1.0)))
        tilt_deg = np.degrees(np.arccos(np.clip(flat.normals_in_frames[:, 2], -1.0, 1.0)))
        assert np.median(off_deg) < 0.25 * np.median(tilt_deg)


def test_what_a_model_lacks_is_left_out_and_told(detailed: Made, model: Path, tmp_path: Path) -> None:
    mesh = trimesh.load(model, process=False)
    mesh.update_faces(np.arange(len(mesh.faces)) < 0.8 * len(mesh.faces))
    (tmp_path / "cut.ply").write_bytes(mesh.export(file_type="ply"))
    out = tmp_path / "obj"
    ended = cells.here(
        "export", detailed[1], "--to", "obj", "--out", out, "--uv", tmp_path / "cut.ply", "--fit", "ggx"
    )
    assert ended.code == 0, ended.err
    told = re.search(
        r"([\d,]+) of ([\d,]+) measured triangles are not in cut.ply: left out", " ".join(ended.err.split())
    )
    assert told is not None
    lost, total = (int(words.replace(",", "")) for words in told.groups())
    faces = [line for line in (out / "surface.obj").read_text().splitlines() if line.startswith("f ")]
    assert 0.17 < lost / total < 0.23
    assert len(faces) <= total - lost


@needs_checkers
def test_gltf_by_a_models_own_texture_is_valid_and_as_large_as_asked(
    detailed: Made, model: Path, tmp_path: Path
) -> None:
    folder = exported(
        detailed, "gltf", tmp_path / "gltf", "--uv", str(model), "--texel-mm", "0.25", "--fit", "ggx_normal"
    )
    assert gltf_messages(folder / "surface.glb") == []
    (mesh,) = trimesh.load(folder / "surface.glb").geometry.values()
    theirs = trimesh.load(model, process=False)
    width_mm = 1e3 * np.ptp(np.asarray(theirs.vertices), axis=0).max()
    flat_px = width_mm / 0.96 / 0.25  # slopes want some more
    assert flat_px <= mesh.visual.material.normalTexture.size[0] < 1.15 * flat_px
    tree = scipy.spatial.KDTree(np.asarray(theirs.vertices))
    distance, number = tree.query(np.asarray(mesh.vertices))
    assert distance.max() < 1e-6
    np.testing.assert_allclose(mesh.visual.uv, np.asarray(theirs.visual.uv)[number], atol=1e-5)


def width_px(folder: Path) -> int:
    return len(np.asarray(cv2.imread(str(folder / "normal.png"))))


def test_maps_are_as_large_as_asked(detailed: Made, tmp_path: Path) -> None:
    exported(detailed, "obj", tmp_path / "small", "--map-px", "256")
    assert width_px(tmp_path / "small") <= 256
    exported(detailed, "obj", tmp_path / "coarse", "--texel-mm", "0.4")
    exported(detailed, "obj", tmp_path / "fine", "--texel-mm", "0.2")
    coarse, fine = (width_px(tmp_path / name) for name in ("coarse", "fine"))
    assert 1.6 < fine / coarse < 2.1


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--to", "ply", "--fit", "texels"), "texels: is for formats with maps"),
        (("--to", "ply", "--map-px", "512"), "--map-px: is for --to gltf, obj, usd, ktx2, materialx"),
        (("--to", "obj", "--texel-mm", "0.001"), "give --texel-mm"),
        (("--to", "ply", "--uv", "model.obj"), "--uv: is for --to gltf, obj, usd, ktx2, materialx"),
        (("--to", "obj", "--uv", "configs/objects/relief.ply"), "has no texture coordinates"),
    ],
)
def test_maps_that_cannot_be_are_refused(
    detailed: Made, tmp_path: Path, options: tuple[str, ...], told: str
) -> None:
    ended = cells.here("export", detailed[1], "--out", tmp_path / "out", *options)
    assert ended.code == 2
    assert told in " ".join(ended.err.split())
    assert not list((tmp_path / "out").glob("*"))
