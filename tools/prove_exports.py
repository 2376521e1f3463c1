"""Losses of exports of a result: pixels are lit anew from each file, and compared with the result it came from.

    python tools/prove_exports.py [RESULT] [--pixels 4000] [--write]

Without a result one is made, of a run of a glossy relief in the simulated cell.

Pixels of the measured views are lit by a dozen distant lights each. Files are read by other people's libraries or,
where there are none, by their layout; their models (glTF 2.0 appendix B with KHR_materials_specular, OpenPBR as
MaterialX 1.39 builds it) are written anew here. White under a light from above has the value 1. Tables of single
materials are made of eight triangles; samples are compared with those of the result. `--write` puts the table
into docs/reference/exports.md. Exits with 1 if a format that should lose nothing loses more than 1e-4.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import mitsuba
import numpy as np
import OpenEXR
import trimesh
from rich.console import Console

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/runs")]

from relief_cells import DIFFUSE, F0, RECORDS, ROUGHNESS, shipped_cell  # noqa: E402

from coupole.exchange.of_results.export_result import export_result  # noqa: E402
from coupole.exchange.of_results.measured_surface import ExportChoice, MeasuredSurface, read_surface  # noqa: E402
from coupole.exchange.of_results.merl import SCALES, SIZE  # noqa: E402
from coupole.reflectance.run_job import RunRequest, reflectance_of  # noqa: E402
from export_models import Lit, Materials, ggx, gltf, lab_differences, openpbr  # noqa: E402
from smallest import add_smallest  # noqa: E402

LIGHTS, TRIANGLES = 12, 8
LOSSLESS = ("ply", "exr", "alta", "bird")
MOST = 1e-4
ADAPTIVE = 0.003
"""Largest error asked of adaptive tables, for 95 % of the directions."""
DOCUMENT, BEGIN, END = ROOT / "docs/reference/exports.md", "<!-- figures -->\n", "<!-- end of figures -->\n"
Row = tuple[np.ndarray, np.ndarray]
"""Values found and wanted, [n, 3]."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, nargs="?")
    parser.add_argument("--pixels", type=int, default=4000)
    parser.add_argument("--write", action="store_true", help="put the table into the documentation")
    add_smallest(parser, pixels=100)
    arguments = parser.parse_args()
    lines = ["| `--to` | relative error, median | 95 % | dE00, mean | 95 % |", "|---|---|---|---|---|"]
    worst = 0.0
    with tempfile.TemporaryDirectory(prefix="coupole-exports-") as name:
        result = arguments.result or _make_result(Path(name))
        for to, (exported_values, true_values) in _compare_exports(result, Path(name), arguments.pixels).items():
            usable = (true_values > 1e-6) & np.isfinite(exported_values)
            off = np.abs(exported_values[usable] / true_values[usable] - 1.0)
            median, high = np.quantile(off, [0.5, 0.95])
            finite = np.isfinite(exported_values).all(axis=1)
            colours = (
                lab_differences(exported_values[finite], true_values[finite])
                if to not in ("alta", "bird")
                else None
            )
            cells = ("", "") if colours is None else (f"{colours.mean():.3f}", f"{np.quantile(colours, 0.95):.3f}")
            lines.append(f"| `{to}` | {median:.1e} | {high:.1e} | {cells[0]} | {cells[1]} |")
            worst = max(worst, high if to in LOSSLESS else 0.0)
    table = "\n".join(lines) + "\n"
    print(table, end="")
    if arguments.write:
        before, _, rest = DOCUMENT.read_text().partition(BEGIN)
        DOCUMENT.write_text(before + BEGIN + table + END + rest.partition(END)[2])
    return int(worst > MOST)


def _make_result(folder: Path) -> Path:
    cell = shipped_cell(folder, material={"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS})
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(outcome.err)
    records = tuple(sorted(RECORDS.glob("*.yaml")))
    reflectance_of(RunRequest((cell.run_folder,), calibrations=records), folder / "result")
    return folder / "result"


def _compare_exports(result: Path, folder: Path, count: int) -> dict[str, Row]:
    console = Console(stderr=True)
    surface = read_surface(result)
    random = np.random.default_rng(1)
    lit = _lit(surface, count, random)
    true_values = ggx(_of_surface(surface, lit), lit)
    sampled_triangles = tuple(
        map(int, random.choice(np.flatnonzero(surface.has_material), TRIANGLES, replace=False))
    )
    row_of_export: dict[str, Row] = {}
    readers: dict[str, Callable[[Path, Lit], np.ndarray]] = {
        "ply": _read_ply, "exr": _read_exr, "gltf": _read_gltf, "materialx": _read_materialx,
    }  # fmt: skip
    for to, reader in readers.items():
        with console.status(to):
            export_result(result, to, folder / to)
            row_of_export[to] = reader(folder / to, lit), true_values
    for name, to, most_error, evaluate in (
        ("bsdf", "bsdf", None, _bsdf),
        (f"bsdf --adaptive {ADAPTIVE}", "bsdf", ADAPTIVE, _bsdf),
        ("merl", "merl", None, _merl),
    ):
        with console.status(name):
            choice = ExportChoice(sampled_triangles, most_error)
            export_result(result, to, folder / name, options=choice)
            rows = [_of_table(surface, folder / name, number, evaluate, random) for number in sampled_triangles]
            values, true = zip(*rows, strict=True)
            row_of_export[name] = np.concatenate(values), np.concatenate(true)
    for to in ("alta", "bird"):
        export_result(result, to, folder / to, options=ExportChoice(sampled_triangles))
        row_of_export[to] = _of_samples(surface, folder / to, sampled_triangles, to)
    return row_of_export


def _lit(surface: MeasuredSurface, count: int, random: np.random.Generator) -> Lit:
    """Pixels of all views, with lights within 80 degrees of their normals."""
    parts = []
    support_from_base = np.linalg.inv(surface.result.base_from_support)
    for view in surface.result.views:
        with h5py.File(view.path, "r") as file:
            triangle_of_pixel = file["seen"][()]
        number = np.where(triangle_of_pixel >= 0, view.triangles[triangle_of_pixel], 0)
        row, column = np.nonzero((triangle_of_pixel >= 0) & surface.has_material[number])
        subset = random.choice(len(row), count // len(surface.result.views), replace=False)
        row, column = row[subset], column[subset]
        triangles = number[row, column]
        camera = support_from_base[:3, :3] @ view.camera_mm + support_from_base[:3, 3]
        centres = surface.vertices_mm[surface.triangles[triangles]].mean(axis=1)
        parts.append((triangles, camera - centres, np.full(len(row), view.view, object), row, column))
    triangles, ways, views, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
    columns_per_light = [np.repeat(part, LIGHTS, axis=0) for part in (triangles, ways, views, rows, columns)]
    lights = random.normal(size=(len(columns_per_light[0]), 3))
    normals = surface.normals[columns_per_light[0]]
    lights += 1.5 * normals * np.linalg.norm(lights, axis=1, keepdims=True)
    lights, cameras = (unit(part) for part in (lights, columns_per_light[1]))
    cosines = np.stack([np.sum(part * normals, axis=1) for part in (lights, cameras)])
    in_range = (cosines > np.cos(np.radians(80.0))).all(axis=0)
    return Lit(*(part[in_range] for part in (columns_per_light[0], lights, cameras, *columns_per_light[2:])))


def unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _of_surface(surface: MeasuredSurface, lit: Lit) -> Materials:
    columns = (surface.normals, surface.kd, surface.ks, surface.alpha)
    return Materials(*(column[lit.triangles] for column in columns))


# -- readers of the whole surface -----------------------------------------------------------------------------


def _read_ply(folder: Path, lit: Lit) -> np.ndarray:
    faces = trimesh.load(folder / "surface.ply", process=False).metadata["_ply_raw"]["face"]["data"]
    names = ("kd_r", "kd_g", "kd_b", "ks_r", "ks_g", "ks_b", "alpha", "nx", "ny", "nz")
    columns = {name: np.ravel(faces[name]).astype(float)[lit.triangles] for name in names}
    kd, ks = (np.stack([columns[f"{name}_{c}"] for c in "rgb"], axis=1) for name in ("kd", "ks"))
    return ggx(Materials(np.stack([columns[f"n{c}"] for c in "xyz"], 1), kd, ks, columns["alpha"]), lit)


def _read_exr(folder: Path, lit: Lit) -> np.ndarray:
    radiance = np.empty((len(lit.triangles), 3))
    for view in sorted(set(lit.views)):
        parts = {part.name(): part.channels for part in OpenEXR.File(str(folder / f"{view}.exr"), True).parts}
        in_view = lit.views == view
        here = lit.of(in_view)

        def pixels(part: str, names: str, parts: dict[str, Any] = parts, here: Lit = here) -> np.ndarray:
            planes = [parts[part][name].pixels[here.rows, here.columns] for name in names]
            return np.stack(planes, axis=1).astype(float)

        alpha = pixels("alpha", "Y")[:, 0]
        values = Materials(pixels("normal", "XYZ"), pixels("kd", "RGB"), pixels("ks", "RGB"), alpha)
        radiance[in_view] = ggx(values, here)
    return radiance


def _read_gltf(folder: Path, lit: Lit) -> np.ndarray:
    data = (folder / "surface.glb").read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]

    def block(number: int) -> bytes:
        view = document["bufferViews"][number]
        return binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def texels(texture: int) -> np.ndarray:
        png = block(document["images"][document["textures"][texture]["source"]]["bufferView"])
        bgr = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None, "a texture is no picture"
        return bgr[..., ::-1].reshape(-1, 3) / 255.0

    row = np.searchsorted(_known_triangles(folder), lit.triangles)
    normals = np.frombuffer(block(1), "<f4").reshape(-1, 3, 3)[row, 0].astype(float) @ Y_UP
    specular = document["materials"][0]["extensions"]["KHR_materials_specular"]
    f0 = 0.04 * np.array(specular["specularColorFactor"]) * _linear(texels(2)[row])
    return gltf(Materials(normals, _linear(texels(0)[row]), f0, texels(1)[row, 1] ** 2), lit)


def _read_materialx(folder: Path, lit: Lit) -> np.ndarray:
    import MaterialX

    document = MaterialX.createDocument()
    MaterialX.readFromXmlFile(document, str(folder / "surface.mtlx"))
    (shader,) = document.getNodes("open_pbr_surface")

    def texels(name: str) -> np.ndarray:
        file = document.getNode(shader.getInput(name).getNodeName()).getInput("file").getValue()
        ((_, channel),) = OpenEXR.File(str(folder / file)).channels().items()
        return np.asarray(channel.pixels, float).reshape(channel.pixels.shape[0] ** 2, -1)

    uv, normals = _first_corners((folder / "surface.obj").read_text())
    side = round(len(texels("specular_roughness")) ** 0.5)
    place = np.floor((1 - uv[:, 1]) * side).astype(int) * side + np.floor(uv[:, 0] * side).astype(int)
    row = np.searchsorted(_known_triangles(folder), lit.triangles)
    normals = normals[row] @ Y_UP
    names = ("base_color", "specular_color", "specular_weight", "specular_roughness")
    base, tint, weight, roughness = (texels(name)[place[row]] for name in names)
    ior = shader.getInput("specular_ior").getValue()
    f0 = ((ior - 1.0) / (ior + 1.0)) ** 2 * weight[:, 0]
    return openpbr(Materials(normals, base, tint, roughness[:, 0] ** 2), lit, f0)


def _first_corners(obj: str) -> tuple[np.ndarray, np.ndarray]:
    """Texture coordinate and normal of each face's first corner."""
    lines = [line.split() for line in obj.splitlines()]
    uv, normals = (np.array([line[1:] for line in lines if line[0] == key], float) for key in ("vt", "vn"))
    corners = np.array([line[1].split("/") for line in lines if line[0] == "f"], int) - 1
    return uv[corners[:, 1]], normals[corners[:, 2]]


Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_NUMBERS: dict[Path, np.ndarray] = {}


def _known_triangles(folder: Path) -> np.ndarray:
    """Triangles that have a material, by the PLY beside."""
    ply = folder.parent / "ply/surface.ply"
    if ply not in _NUMBERS:
        faces = trimesh.load(ply, process=False).metadata["_ply_raw"]["face"]["data"]
        _NUMBERS[ply] = np.flatnonzero(np.isfinite(np.ravel(faces["alpha"])))
    return _NUMBERS[ply]


def _linear(code: np.ndarray) -> np.ndarray:
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


# -- tables of single materials -------------------------------------------------------------------------------

Evaluate = Callable[[Path, np.ndarray, np.ndarray], np.ndarray]


def _of_table(
    surface: MeasuredSurface, folder: Path, number: int, evaluate: Evaluate, random: np.random.Generator
) -> Row:
    ways = unit(random.normal(size=(2, 4000, 3)))
    ways[..., 2] = np.abs(ways[..., 2])
    light, camera = ways[:, (ways[..., 2] > 0.2).all(axis=0)][:, :1000]
    up = np.tile([0.0, 0.0, 1.0], (len(light), 1))
    material = [
        np.repeat(values[number][None], len(light), 0) for values in (surface.kd, surface.ks, surface.alpha)
    ]
    nothing = np.zeros(len(light), np.int64)
    true_values = ggx(Materials(up, *material), Lit(nothing, light, camera, nothing, nothing, nothing))
    (path,) = folder.glob(f"triangle{number}.*")
    return evaluate(path, light, camera), true_values


def _bsdf(path: Path, light: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Mitsuba's; it gives f times the cosine of the second direction, here the light's."""
    mitsuba.set_variant("scalar_rgb")
    bsdf = mitsuba.load_dict({"type": "measured", "filename": str(path)})
    interaction, context = mitsuba.SurfaceInteraction3f(), mitsuba.BSDFContext()
    rows = []
    for light_direction, camera_direction in zip(light, camera, strict=True):
        interaction.wi = mitsuba.Vector3f(*camera_direction)
        rows.append(np.array(bsdf.eval(context, interaction, mitsuba.Vector3f(*light_direction))))
    return np.pi * np.array(rows)


def _merl(path: Path, light: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Return the nearest value, as the database's own reader does."""
    table = np.frombuffer(path.read_bytes(), "<f8", offset=12).reshape(3, *SIZE)
    half = unit(light + camera)
    theta_h, phi_h = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    x = np.cos(phi_h) * light[:, 0] + np.sin(phi_h) * light[:, 1]
    y = -np.sin(phi_h) * light[:, 0] + np.cos(phi_h) * light[:, 1]
    z = np.cos(theta_h) * light[:, 2] + np.sin(theta_h) * x
    x = np.cos(theta_h) * x - np.sin(theta_h) * light[:, 2]
    theta_d, phi_d = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x) % np.pi
    at = (np.sqrt(theta_h / (np.pi / 2)) * 90, theta_d / (np.pi / 2) * 90, phi_d / np.pi * 180)
    rows = tuple(np.minimum(values.astype(int), most - 1) for values, most in zip(at, SIZE, strict=True))
    f = np.stack([table[channel][rows] * SCALES[channel] for channel in range(3)], axis=1)
    return np.asarray(np.pi * f * light[:, 2:])


def _of_samples(surface: MeasuredSurface, folder: Path, chosen_triangles: tuple[int, ...], to: str) -> Row:
    """Each value beside the nearest of the result's, as neither file says which LED a sample is from; [n, 1]."""
    exported_values, true_values = [], []
    for number in chosen_triangles:
        for channel, name in enumerate(("red", "green", "blue")[: surface.result.channels]):
            f = []
            for view in surface.result.views:
                if number in view.triangles:
                    with h5py.File(view.path, "r") as file:
                        f.append(file["f"][int(np.searchsorted(view.triangles, number)), :, channel])
            sample_values = np.sort(np.concatenate(f))
            sample_values = sample_values[np.isfinite(sample_values)]
            path = folder / f"triangle{number}_{name}.{'alta' if to == 'alta' else 'brdf'}"
            if to == "alta":
                values = np.loadtxt(path, ndmin=2)[:, 3]
            else:
                values = np.array(json.loads(path.read_text())["data"]["BRDF"]["values"])
            after = np.clip(np.searchsorted(sample_values, values), 1, len(sample_values) - 1)
            nearest = np.where(
                values - sample_values[after - 1] < sample_values[after] - values,
                sample_values[after - 1],
                sample_values[after],
            )
            exported_values.append(values)
            true_values.append(nearest)
    return np.concatenate(exported_values)[:, None], np.concatenate(true_values)[:, None]


if __name__ == "__main__":
    sys.exit(main())
