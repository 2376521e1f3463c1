"""`coupole export RESULT`, read by other people's readers, or by readers that are written here from a layout."""

from __future__ import annotations

import json
import re
import shutil
import struct
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cells
import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh
from checkers import gltf_messages, needs_checkers
from export_readers import readers_with
from export_readers.lit_models import lit_pixels, relative_errors, true_light
from lazily import lazily
from relight_cases import BASE_FROM_SUPPORT, Coat, moved, unit, waves, write_result

from coupole.exchange.formats import FORMATS, Source, formats_of
from coupole.exchange.of_results import adaptive_table
from coupole.exchange.of_results.adaptive_table import encode_adaptive
from coupole.exchange.of_results.bsdf import encode as encode_bsdf
from coupole.exchange.of_results.material_tables import Material
from coupole.exchange.of_results.measured_surface import read_surface
from coupole.exchange.of_results.merl import SCALES
from coupole.exchange.of_results.merl import encode as encode_merl
from coupole.reflectance.fits import MATERIALS
from coupole.reflectance.run_result import RunResult

MaterialX: Any = lazily("MaterialX")
PyMaterialXGenGlsl: Any = lazily("MaterialX.PyMaterialXGenGlsl")
PyMaterialXGenShader: Any = lazily("MaterialX.PyMaterialXGenShader")
mitsuba: Any = lazily("mitsuba")

COAT = Coat((0.2, 0.1, 0.05), (0.06, 0.05, 0.04), 0.36)
GLOSSY = Material("glossy", np.array([0.2, 0.15, 0.1]), np.array([0.05, 0.04, 0.03]), 0.2)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    return write_result(tmp_path_factory.mktemp("waves") / "result", waves(20), COAT)


def exported(result: RunResult, to: str, folder: Path, *options: str) -> list[Path]:
    ended = cells.here("export", result.folder, "--to", to, "--out", folder, *options, "--json")
    assert ended.code == 0, ended.err
    paths = sorted(folder.iterdir())
    assert ended.document["files"] == len(paths)
    return paths


def walter(way_in: np.ndarray, way_out: np.ndarray, material: Material) -> np.ndarray:
    """[n, 3] by Walter and others 2007 with Heitz's height-correlated shadowing (2014), from their Lambdas."""
    half = unit(way_in + way_out)
    alpha2 = material.alpha**2
    cos2 = half[:, 2] ** 2
    d = np.exp(-np.log(np.pi * alpha2 * cos2**2 * (1 + (1 / cos2 - 1) / alpha2) ** 2))

    def lamb(ways: np.ndarray) -> np.ndarray:
        result: np.ndarray = 0.5 * (np.sqrt(1 + alpha2 * (1 / ways[:, 2] ** 2 - 1)) - 1)
        return result

    lobe = d / ((1 + lamb(way_in) + lamb(way_out)) * 4 * way_in[:, 2] * way_out[:, 2])
    found: np.ndarray = material.kd + lobe[:, None] * material.ks
    return found


def directions(count: int, least: float, seed: int) -> np.ndarray:
    ways = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    ways[:, 2] = np.abs(ways[:, 2])
    return ways[ways[:, 2] > least]


def test_ply_has_the_mesh_and_each_triangles_material(result: RunResult, tmp_path: Path) -> None:
    (path,) = exported(result, "ply", tmp_path)
    mesh = trimesh.load(path, process=False)
    places = np.asarray(mesh.triangles)
    wanted = moved(np.linalg.inv(BASE_FROM_SUPPORT), result.corners_mm.reshape(-1, 3).astype(float))
    np.testing.assert_allclose(places, wanted.reshape(-1, 3, 3), atol=1e-3)
    faces = mesh.metadata["_ply_raw"]["face"]["data"]
    seen = result.triangles
    assert 0 < len(seen) < len(faces["alpha"])
    np.testing.assert_allclose(np.ravel(faces["kd_g"])[seen], 0.1, rtol=1e-6)
    np.testing.assert_allclose(np.ravel(faces["ks_b"])[seen], 0.04, rtol=1e-6)
    assert np.isfinite(np.ravel(faces["alpha"])).sum() == len(seen)
    assert b"comment simulated with Coupole" in path.read_bytes()[:200]


@pytest.mark.parametrize("to", readers_with("relit"))
def test_light_on_an_export_is_that_on_the_result(result: RunResult, tmp_path: Path, to: str) -> None:
    reader = readers_with("relit")[to]
    exported(result, "ply", tmp_path / "ply")
    if to != "ply":
        exported(result, to, tmp_path / to)
    surface = read_surface(result.folder)
    lit = lit_pixels(surface, 200, np.random.default_rng(1))
    errors = relative_errors(reader.relit(tmp_path / to, lit), true_light(surface, lit))
    assert len(errors) > 3 * 200
    assert np.quantile(errors, 0.95) < reader.MOST_LOST


@needs_checkers
def test_gltf_is_valid_to_the_validator_of_those_who_make_the_format(result: RunResult, tmp_path: Path) -> None:
    (path,) = exported(result, "gltf", tmp_path)
    assert gltf_messages(path) == []
    broken = tmp_path / "broken.glb"
    broken.write_bytes(path.read_bytes().replace(b'"VEC3"', b'"VEC2"', 1))
    assert gltf_messages(broken)


def test_gltf_has_the_materials_in_its_textures(result: RunResult, tmp_path: Path) -> None:
    (path,) = exported(result, "gltf", tmp_path)
    (mesh,) = trimesh.load(path).geometry.values()
    assert len(mesh.faces) == len(result.triangles)
    normals = np.asarray(mesh.triangles_center)
    assert np.ptp(normals, axis=0).max() < 0.07  # metres
    data = path.read_bytes()
    magic, version, size, length, kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    document = json.loads(data[20 : 20 + length])
    (material,) = document["materials"]
    specular = material["extensions"]["KHR_materials_specular"]

    def texel(texture: int) -> np.ndarray:
        view = document["bufferViews"][document["images"][document["textures"][texture]["source"]]["bufferView"]]
        start = 20 + length + 8 + view["byteOffset"]
        png = np.frombuffer(data[start : start + view["byteLength"]], np.uint8)
        value: np.ndarray = cv2.imdecode(png, cv2.IMREAD_COLOR)[0, 0, ::-1] / 255.0
        return value

    def linear(code: np.ndarray) -> np.ndarray:
        value: np.ndarray = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
        return value

    np.testing.assert_allclose((1 - max(COAT.ks)) * linear(texel(0)), np.pi * np.array(COAT.kd), rtol=0.02)
    assert texel(1)[1] ** 2 == pytest.approx(COAT.alpha, rel=0.01)
    f0 = 0.04 * linear(texel(2)) * specular["specularColorFactor"]
    np.testing.assert_allclose(f0, COAT.ks, rtol=0.02)


def test_materialx_is_a_valid_document_of_openpbr_with_the_materials_in_its_textures(
    result: RunResult, tmp_path: Path
) -> None:
    names = {path.name for path in exported(result, "materialx", tmp_path)}
    textures = {
        f"{name}.exr" for name in ("base_color", "specular_color", "specular_weight", "specular_roughness")
    }
    assert names == {"surface.mtlx", "surface.obj", *textures}
    library, document = MaterialX.createDocument(), MaterialX.createDocument()
    MaterialX.loadLibraries(
        MaterialX.getDefaultDataLibraryFolders(), MaterialX.getDefaultDataSearchPath(), library
    )
    document.setDataLibrary(library)
    MaterialX.readFromXmlFile(document, str(tmp_path / "surface.mtlx"))
    assert document.validate() == (True, "")
    whole = MaterialX.createDocument()
    MaterialX.readFromXmlFile(whole, str(tmp_path / "surface.mtlx"))
    whole.importLibrary(library)
    generator = PyMaterialXGenGlsl.GlslShaderGenerator.create()
    context = PyMaterialXGenShader.GenContext(generator)
    context.registerSourceCodeSearchPath(MaterialX.getDefaultDataSearchPath())
    (rendered,) = PyMaterialXGenShader.findRenderableElements(whole)
    assert "mx_dielectric_bsdf" in generator.generate("measured", rendered, context).getSourceCode("pixel")
    (material,) = document.getMaterialNodes()
    (shader,) = MaterialX.getShaderNodes(material)
    assert shader.getCategory() == "open_pbr_surface"
    assert document.getActiveColorSpace() == "lin_rec709"

    def texel(name: str) -> np.ndarray:
        file = shader.getConnectedNode(name).getInput("file").getValue()
        ((_, channel),) = OpenEXR.File(str(tmp_path / file)).channels().items()
        value: np.ndarray = np.asarray(channel.pixels)[0, 0]
        return value

    ior = shader.getInput("specular_ior").getValue()
    np.testing.assert_allclose((1 - max(COAT.ks)) * texel("base_color"), np.pi * np.array(COAT.kd), rtol=1e-6)
    f0 = ((ior - 1) / (ior + 1)) ** 2 * texel("specular_weight")
    assert f0 < 1.0  # of the layer under the tint, which keeps light from the base
    np.testing.assert_allclose(f0 * texel("specular_color"), COAT.ks, rtol=1e-6)
    assert texel("specular_color").max() == 1.0
    assert texel("specular_roughness") ** 2 == pytest.approx(COAT.alpha, rel=1e-6)
    mesh = trimesh.load(tmp_path / "surface.obj", process=False)
    x, y, z = moved(np.linalg.inv(BASE_FROM_SUPPORT), result.corners_mm[result.triangles].astype(float)).T
    np.testing.assert_allclose(np.asarray(mesh.triangles).T, np.stack([x, z, -y]) * 1e-3, atol=1e-6)
    side = np.ceil(np.sqrt(len(result.triangles)))
    first = np.asarray(mesh.visual.uv)[mesh.faces[0]]
    np.testing.assert_allclose(first, [[0.5 / side, 1 - 0.5 / side]] * 3, atol=1e-6)  # the top left texel


def test_a_name_of_many_dashes_leaves_materialx_well_formed(result: RunResult, tmp_path: Path) -> None:
    folder = tmp_path / "result"
    shutil.copytree(result.folder, folder)
    about = json.loads((folder / "result.json").read_text())
    about["runs"] = {"vase---2--": {}}
    (folder / "result.json").write_text(json.dumps(about))
    exported(RunResult(folder), "materialx", tmp_path / "out")
    document = ElementTree.parse(tmp_path / "out/surface.mtlx")
    assert document.getroot().tag == "materialx"


def test_exr_has_what_each_pixel_of_a_view_shows(result: RunResult, tmp_path: Path) -> None:
    (path,) = exported(result, "exr", tmp_path)
    parts = {part.name(): part.channels for part in OpenEXR.File(str(path), separate_channels=True).parts}
    assert set(parts) == {*("kd", "ks", "alpha", "normal", "place", "u_kd", "u_ks", "u_alpha", "u_normal")}
    shown = np.isfinite(parts["alpha"]["Y"].pixels)
    assert 0.2 < shown.mean() < 1.0
    np.testing.assert_allclose(parts["kd"]["R"].pixels[shown], 0.2, rtol=1e-6)
    height = parts["place"]["Z"].pixels[shown]
    assert -2.5 < height.min() < height.max() < 6.5  # of the waves, support frame
    assert np.isnan(parts["kd"]["G"].pixels[~shown]).all()


def missed_by_mitsuba(path: Path, material: Material, ways_in: np.ndarray, ways_out: np.ndarray) -> np.ndarray:
    """Median and 95 % of the relative error of its evaluation."""
    mitsuba.set_variant("scalar_rgb")
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    interaction, context = mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
    found = []
    for way_in, way_out in zip(ways_in, ways_out, strict=True):
        interaction.wi = mitsuba.Vector3f(*way_in)
        found.append(np.array(bsdf.eval(context, interaction, mitsuba.Vector3f(*way_out))))
    off = np.abs(np.array(found) / (walter(ways_in, ways_out, material) * ways_out[:, 2:]) - 1.0)
    missed: np.ndarray = np.quantile(off, [0.5, 0.95])
    return missed


def spread_of_drawn_light(path: Path) -> float:
    """Of what Mitsuba's samples of a direction weigh, its noise: standard deviation over mean."""
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    interaction, context = mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
    interaction.wi = mitsuba.Vector3f(np.sin(1.0), 0.0, np.cos(1.0))
    numbers = np.random.default_rng(1).uniform(size=(500, 3)).tolist()
    drawn = [bsdf.sample(context, interaction, n, mitsuba.Point2f(a, b))[1][1] for n, a, b in numbers]
    return float(np.std(drawn) / np.mean(drawn))


def test_mitsuba_makes_of_the_bsdf_what_it_was_made_from(tmp_path: Path) -> None:
    path = tmp_path / "glossy.bsdf"
    path.write_bytes(encode_bsdf(GLOSSY))
    ways_in, ways_out = (directions(3000, 0.1, seed)[:2000] for seed in (1, 2))
    assert (missed_by_mitsuba(path, GLOSSY, ways_in, ways_out) < [1e-4, 1e-3]).all()
    assert spread_of_drawn_light(path) < 0.1


def test_an_adaptive_bsdf_misses_what_it_says_and_is_small(tmp_path: Path) -> None:
    """A narrow lobe, of all directions and of those in it, against one eighth of the plain table's bytes."""
    narrow = Material("narrow", GLOSSY.kd, GLOSSY.ks, 0.05)
    path, plain = tmp_path / "narrow.bsdf", tmp_path / "plain.bsdf"
    path.write_bytes(encode_adaptive(narrow, 0.003))
    plain.write_bytes(encode_bsdf(narrow))
    assert len(path.read_bytes()) < len(plain.read_bytes()) / 8
    ways_in, ways_out = (directions(3000, 0.1, seed)[:1500] for seed in (8, 9))
    random = np.random.default_rng(10)
    share, phi = random.uniform(size=1500), random.uniform(0.0, 2.0 * np.pi, 1500)
    tilt = narrow.alpha * np.sqrt(share / (1.0 - share))
    half = unit(np.stack([tilt * np.cos(phi), tilt * np.sin(phi), np.ones(1500)], axis=1))
    mirrored = 2.0 * np.sum(ways_in * half, axis=1, keepdims=True) * half - ways_in
    high = mirrored[:, 2] > 0.1
    of_all = missed_by_mitsuba(path, narrow, ways_in, ways_out)
    of_lobe = missed_by_mitsuba(path, narrow, ways_in[high], mirrored[high])
    assert (of_all < [7e-4, 3.2e-3]).all()
    assert (of_lobe < [7e-4, 3.2e-3]).all()
    assert spread_of_drawn_light(path) < 0.1
    told = re.search(
        rb"by (\S+) in the median and (\S+) at 95 % of all directions, and by (\S+) and (\S+)", path.read_bytes()
    )
    assert told is not None
    np.testing.assert_allclose([float(one) for one in told.groups()], [*of_all, *of_lobe], rtol=0.2)


def test_an_adaptive_bsdf_that_cannot_be_is_refused(
    result: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    triangle = ("--triangle", str(result.triangles[0]))
    (path,) = exported(result, "bsdf", tmp_path / "rough", *triangle, "--adaptive", "0.01")
    assert len(path.read_bytes()) < 1e6
    monkeypatch.setattr(adaptive_table, "THETAS", (16, 24))
    monkeypatch.setattr(adaptive_table, "SIDES", (24, 32))
    asked = ("export", result.folder, "--to", "bsdf", *triangle, "--adaptive", "0.001", "--out", tmp_path / "fine")
    ended = cells.here(*asked)
    assert ended.code == 2
    assert re.search(
        r"--adaptive 0.001: triangle\d+: a table of 0 MB differs from its fit by", " ".join(ended.err.split())
    )


def test_a_merl_table_is_read_as_its_reader_does() -> None:
    """By angles of half vector and difference, as the database's own program has it."""
    data = encode_merl(GLOSSY)
    assert len(data) == 34_992_012
    assert np.frombuffer(data, "<i4", 3).tolist() == [90, 90, 180]
    table = np.frombuffer(data, "<f8", offset=12).reshape(3, 90, 90, 180)
    ways_in, ways_out = (directions(1500, 0.25, seed)[:1000] for seed in (3, 4))
    half = unit(ways_in + ways_out)
    theta_h, phi_h = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    x = np.cos(-phi_h) * ways_in[:, 0] - np.sin(-phi_h) * ways_in[:, 1]
    y = np.sin(-phi_h) * ways_in[:, 0] + np.cos(-phi_h) * ways_in[:, 1]
    z = np.cos(-theta_h) * ways_in[:, 2] - np.sin(-theta_h) * x
    x = np.sin(-theta_h) * ways_in[:, 2] + np.cos(-theta_h) * x
    theta_d, phi_d = np.arccos(z), np.arctan2(y, x) % np.pi
    at = (
        np.sqrt(theta_h / (np.pi / 2)) * 90,
        theta_d / (np.pi / 2) * 90,
        phi_d / np.pi * 180,
    )
    rows = tuple(np.minimum(values.astype(int), most) for values, most in zip(at, (89, 89, 179), strict=True))
    found = np.stack([table[channel][rows] * SCALES[channel] for channel in range(3)], axis=1)
    off = np.abs(found / walter(ways_in, ways_out, GLOSSY) - 1.0)
    assert np.median(off) < 0.01  # steps of two degrees
    assert np.quantile(off, 0.95) < 0.08
    assert (table[:, 89, 89, 0] == -1.0).all()


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (("--to", "dng"), f"expected one of {', '.join(formats_of(Source.RESULT))} for a result; found dng"),
        (("--to", "ply", "--fit", "sh"), f"expected {' or '.join(MATERIALS)}"),
        (
            ("--to", "ply", "--views", "top"),
            f"--views: is for --to {', '.join(name for name, one in FORMATS.items() if 'views' in one.options)}",
        ),
        (("--to", "ply", "--linear"), "--linear: is for --to tiff; found --to ply"),
        (("--to", "gltf", "--refined", "there"), "--refined: is for --to colmap"),
        (("--to", "ply", "--adaptive", "0.01"), "--adaptive: is for --to bsdf; found --to ply"),
        (("--to", "exr", "--licence", "CC BY 4.0"), "--licence: is for --to rocrate"),
        (("--to", "rocrate", "--author", "A. Person"), "--licence: RO-Crate requires a licence"),
        (("--to", "rocrate", "--licence", "CC0"), "--author: expected at least one"),
        (("--to", "rocrate", "--licence", "CC0", "--author", "A <x>"), "expected 'NAME'"),
        (
            ("--to", "rocrate", "--licence", "CC0", "--author", "A", "--author", "A at B"),
            "#person-A is named twice",
        ),
        (("--to", "rocrate", "--licence", "CC0", "--author", "A", "--in-place"), "--in-place writes into SOURCE"),
        (("--to", "rocrate", "--licence", "", "--author", "A"), "--licence: is empty"),
        (("--to", "ply", "--fit", ""), "--fit: is empty"),
        (("--to", "ply", "--planes", "0"), "--planes: is for --to relight"),
        (("--to", "bsdf"), "has no clusters; name triangles with --triangle"),
        (("--to", "merl", "--triangle", "99999"), "the mesh has 722, counted from 0"),
        (("--to", "alta"), "--triangle: expected the numbers of triangles"),
        (("--to", "ply", "--triangle", "3"), "--triangle: is for --to bsdf, merl, bird, alta; found --to ply"),
    ],
)
def test_what_cannot_be_exported_is_refused(
    result: RunResult, tmp_path: Path, options: tuple[str, ...], why: str
) -> None:
    ended = cells.here("export", result.folder, *options, "--out", tmp_path / "out")
    assert ended.code == 2
    assert why in " ".join(ended.err.split())


def test_a_file_in_place_of_the_folder_is_refused(result: RunResult, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    for out in (tmp_path / "mine.txt", tmp_path / "mine.txt/in"):
        ended = cells.here("export", result.folder, "--to", "ply", "--out", out)
        assert ended.code == 2
        assert "mine.txt is a file; expected a folder" in " ".join(ended.err.split())


def test_a_folder_with_files_is_left_alone(result: RunResult, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    ended = cells.here("export", result.folder, "--to", "ply", "--out", tmp_path)
    assert ended.code == 2
    assert "has files already" in ended.err
    again = cells.here("export", result.folder, "--to", "ply", "--out", tmp_path, "--overwrite")
    assert again.code == 0
    assert (tmp_path / "mine.txt").exists()
