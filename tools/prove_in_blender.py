"""Opens exports of a result in Blender, and compares Blender's pictures with those of `relight --from`.

    python tools/prove_in_blender.py [RESULT] [--to gltf usd obj] [--install [WHEEL]] [--blender PYTHON]
        [--pictures FOLDER] [--uv MESH]

Without RESULT, a result is made in the simulated cell: the relief with paint and bumps that its mesh does not have
(`detailed_result` of the tests). Blender's importers open the files. Cycles renders them on the CPU
(`in_blender.py`, in a separate process) under five distant lights, with direct light only. White is the brightness
of the brightest hundredth, as in `tests/runs/test_texel_maps.py`. Only pixels that are lit in both pictures are
compared. The parts that the importers of OBJ and USD leave out are then linked by the tool, and the pictures are
compared again. Blender does not read MaterialX's documents.

Blender's Principled BSDF differs from the model of the fit. It is implemented independently in
`tests/export_readers/lit_models.py`, compared with a sphere of Blender, and applied to the pixels of our picture.
So a table separates the difference of the models (`ours - model`) from that of file and importer (`model -
Blender`). Last, the green channel of the normal map is inverted, which the comparison must detect.

`--install` makes an environment with the package bpy 5.0.1 under `.tools/blender` (1 GB; it needs Python 3.11),
from a wheel if one is named. `--blender` names another Python that has the package. Exits with 1 in three cases:
glTF, or another format after completion, differs by more than 1.5 (CIEDE2000, mean of the five lights); Blender's
sphere differs from the model by more than 0.1; or an inverted normal map is not detected.
"""

from __future__ import annotations

import argparse
import importlib
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenEXR
from rich.console import Console

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/runs")]

from export_readers.lit_models import Lit, Materials, lab_differences, principled_bsdf  # noqa: E402
from relief_cells import detailed_result  # noqa: E402

from coupole.errors import InputError  # noqa: E402
from coupole.exchange.of_results.export_result import export_result  # noqa: E402
from coupole.exchange.of_results.measured_surface import ExportChoice, under_a_layer  # noqa: E402
from coupole.exchange.srgb import srgb  # noqa: E402
from coupole.reflectance.fits import TEXELS  # noqa: E402
from coupole.reflectance.new_light.light_kinds import DistantLight  # noqa: E402
from coupole.reflectance.new_light.pictured_surface import FreeCamera  # noqa: E402
from coupole.reflectance.run_relighting import RelitScene, Texels, scene_from  # noqa: E402
from coupole.reflectance.run_result import RunResult  # noqa: E402
from smallest import add_smallest  # noqa: E402

HOME = ROOT / ".tools/blender"
PACKAGE = "bpy==5.0.1"
MOST = 1.5
"""Largest mean CIEDE2000 over the five lights: of glTF as imported, and of USD and OBJ after completion."""
MOST_OF_SPHERE = 0.1
"""Largest mean CIEDE2000 between Blender's sphere and Blender's model as implemented here."""
LEAST_TURNED = 1.5
"""Least factor by which an inverted normal map increases the difference; with less, the comparison would be
blind."""
LIGHTS = ((-1.0, 0.0, 0.5), (1.0, 0.3, 0.7), (0.0, 1.0, 0.6), (0.2, -1.0, 1.0), (0.0, 0.1, 1.0))
CAMERA = FreeCamera(np.array([60.0, -120.0, 280.0]), np.array([30.0, 0.0, 5.0]), (240, 180), 20.0)
MENDED = ("usd", "obj")
"""Formats whose import lacks parts that this tool can link."""
FILES = {"gltf": "surface.glb", "usd": "surface.usdz", "obj": "surface.obj"}
Array = np.ndarray
Vector = tuple[float, float, float]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, nargs="?")
    parser.add_argument("--to", nargs="+", choices=list(FILES), default=list(FILES))
    parser.add_argument("--blender", type=Path, default=HOME / "bin/python", help="a Python that has bpy")
    parser.add_argument("--install", nargs="?", const=PACKAGE, metavar="WHEEL", help="make .tools/blender first")
    parser.add_argument("--samples", type=int, default=16, help="of a pixel")
    parser.add_argument("--pictures", type=Path, help="folder for pictures, ours beside Blender's")
    parser.add_argument("--uv", type=Path, help="the mesh with texture coordinates, in which maps are laid out")
    parser.add_argument("--lights", type=int, default=len(LIGHTS), help="of the five, from the first")
    add_smallest(parser, to=["gltf"], samples=4, lights=1)
    arguments = parser.parse_args()
    if arguments.install:
        _install(arguments.install)
    if not arguments.blender.exists():
        print(f"{arguments.blender}: is not there; give --install once, or --blender", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory(prefix="coupole-blender-") as name:
        result = arguments.result or detailed_result(Path(name))[1]
        return _prove(arguments, result, Path(name))


def _install(package: str) -> None:
    python = shutil.which("python3.11")
    if python is None:
        raise SystemExit("--install: needs python3.11 on the PATH, the only one that the package bpy 5.0.1 is for")
    subprocess.run([python, "-m", "venv", "--clear", str(HOME)], check=True)
    subprocess.run([str(HOME / "bin/python"), "-m", "pip", "install", "--progress-bar", "on", package], check=True)


def _prove(arguments: argparse.Namespace, result: Path, folder: Path) -> int:
    console, lights = Console(stderr=True), LIGHTS[: arguments.lights]
    with console.status("our pictures"):
        scene = scene_from(RunResult(result), replace(CAMERA, size_px=(2 * 240, 2 * 180)), TEXELS)
        our_rgb = [_halve(scene.picture([DistantLight(towards=towards)])) for towards in lights]
        model_rgb = [_halve(_by_blenders_model(scene, towards)) for towards in lights]
    jobs = [_job(folder / "sphere", lights, arguments.samples, **SPHERE)]
    complete_words: dict[str, dict[str, Any]] = {}
    for to in arguments.to:
        with console.status(f"--to {to}"):
            export_result(result, to, folder / to, options=ExportChoice(uv_mesh=arguments.uv))
        words: dict[str, Any] = {"file": str(folder / to / FILES[to])}
        jobs.append(_job(folder / f"{to} as imported", lights, arguments.samples, **words))
        if to in MENDED:
            words = words | {"specular_times": _specular_times(folder / to / FILES[to])}
            jobs.append(_job(folder / f"{to} completed", lights, arguments.samples, **words))
        complete_words.setdefault(Path(jobs[-1]["out"]).name, words)
    turned_name, words = next(iter(complete_words.items()))
    jobs.append(_job(folder / "turned", lights, arguments.samples, **words, turns_green=True))
    _run_blender(arguments.blender, jobs, folder, console)
    sphere = _sphere_difference(folder / "sphere", lights)
    print(f"sphere: Blender - model {sphere:.3f}")
    print("| file | dE00, mean, by light | mean | `ours - model` | `model - Blender` | dark in Blender alone |")
    print("|---|---|---|---|---|---|")
    means = {}
    for name in [Path(job["out"]).name for job in jobs[1:]]:
        blender_rgb = [_picture(folder / name / f"{number}.exr")[..., :3] for number in range(len(lights))]
        by_light, dark_shares = zip(*map(_difference, blender_rgb, our_rgb), strict=True)
        by_model, by_file = _mean_difference(model_rgb, our_rgb), _mean_difference(blender_rgb, model_rgb)
        means[name] = float(np.mean(by_light))
        values = ", ".join(f"{value:.2f}" for value in by_light)
        figures = f"{means[name]:.2f} | {by_model:.2f} | {by_file:.2f} | {np.mean(dark_shares):.1%}"
        print(f"| {name} | {values} | {figures} |")
        if arguments.pictures:
            _keep(arguments.pictures / f"{name}.png", our_rgb, blender_rgb, model_rgb)
            shutil.copy(folder / name / "imported.json", arguments.pictures / f"{name}.json")
    is_seen = means["turned"] > LEAST_TURNED * means[turned_name]
    is_far = len(lights) == len(LIGHTS) and any(means[name] > MOST for name in complete_words)
    return int(is_far or sphere > MOST_OF_SPHERE or not is_seen)


# -- Blender --------------------------------------------------------------------------------------------------

SPHERE: dict[str, Any] = {"base_color": [0.5, 0.35, 0.2], "roughness": 0.55, "specular_tint": [1.25, 1.25, 1.25]}
_DISTANCE_M, _FIELD_DEG = 100.0, 1.2
"""Distance of the camera from the sphere of 1 m radius: the rays are nearly parallel."""


def _job(out: Path, lights: Sequence[Sequence[float]], samples: int, **words: Any) -> dict[str, Any]:
    """Return the job of a picture of the result, or of the sphere if no file is named."""
    job = {"out": str(out), "towards": lights, "samples": samples, **words}
    if "file" not in words:
        place = {"at_m": [0.0, 0.0, _DISTANCE_M], "look_at_m": [0.0, 0.0, 0.0], "field_of_view_deg": _FIELD_DEG}
        return job | place | {"size_px": [120, 120]}
    assert CAMERA.look_at_mm is not None
    return job | {
        "at_m": (CAMERA.at_mm / 1e3).tolist(),
        "look_at_m": (CAMERA.look_at_mm / 1e3).tolist(),
        "field_of_view_deg": CAMERA.field_of_view_deg,
        "size_px": CAMERA.size_px,
    }


def _specular_times(path: Path) -> float:
    """Factor from the codes of `specular.png` to tints of an index of 1.5."""
    if path.suffix == ".usdz":
        stage = importlib.import_module("pxr.Usd").Stage.Open(str(path))
        picture = stage.GetPrimAtPath("/measured/measured_surface/specular")
        return float(picture.GetAttribute("inputs:scale").Get()[0]) / 0.04
    lines = path.with_suffix(".mtl").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("Ks ")) / 0.04


def _run_blender(python: Path, jobs: list[dict[str, Any]], folder: Path, console: Console) -> None:
    """Render, and print Blender's output, including its importers' warnings."""
    (folder / "job.json").write_text(json.dumps(jobs))
    words = [str(python), "-u", str(ROOT / "tools/in_blender.py"), str(folder / "job.json")]
    count, total = 0, sum(len(job["towards"]) for job in jobs)
    with (
        console.status(f"Blender: 0 of {total} pictures") as status,
        subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as blender,
    ):
        assert blender.stdout is not None
        for line in blender.stdout:
            if " | Saved: " not in line:
                print(line, end="", file=sys.stderr)
                continue
            count += 1
            status.update(f"Blender: {count} of {total} pictures")
    if blender.returncode:
        raise SystemExit(f"{python}: Blender ended with {blender.returncode}")


def _picture(path: Path) -> Array:
    """[h, w, 4]"""
    return np.asarray(OpenEXR.File(str(path)).channels()["RGBA"].pixels, np.float64)


# -- comparison -----------------------------------------------------------------------------------------------


def _halve(picture: Array) -> Array:
    height, width, channels = picture.shape
    return np.asarray(picture.reshape(height // 2, 2, width // 2, 2, channels).mean(axis=(1, 3)))


def _difference(blender_rgb: Array, our_rgb: Array) -> tuple[float, float]:
    """Mean CIEDE2000 of the pixels that are lit in both pictures, and the share of our lit pixels that are dark in
    Blender's."""
    is_lit, is_lit_there = (our_rgb > 0.0).any(axis=2), (blender_rgb > 0.0).any(axis=2)
    white, lit_in_both = np.percentile(our_rgb[is_lit], 99), is_lit & is_lit_there
    differences = lab_differences(blender_rgb[lit_in_both] / white, our_rgb[lit_in_both] / white)
    return float(np.mean(differences)), float((is_lit & ~is_lit_there).sum() / is_lit.sum())


def _mean_difference(pictures: list[Array], references: list[Array]) -> float:
    return float(np.mean([_difference(*pair)[0] for pair in zip(pictures, references, strict=True)]))


def _by_blenders_model(scene: RelitScene, towards: Vector) -> Array:
    """[h, w, 3] our picture, with Blender's model for the materials of its lit pixels."""
    picture = scene.picture([DistantLight(towards=towards)])
    if not isinstance(scene.reflecting, Texels):
        raise InputError("the result has no texels")
    is_lit = (picture > 0.0).any(axis=2)
    materials, rows = scene.reflecting.materials, scene.reflecting.of_pixel[is_lit]
    ways = scene.surface.camera_mm - scene.surface.places_mm[is_lit]
    light = scene.result.base_from_support[:3, :3] @ np.array(towards)
    base = under_a_layer(materials.kd[rows], materials.ks[rows])
    of = Materials(materials.normals[rows], base, np.minimum(materials.ks[rows], 1.0), materials.alpha[rows])
    radiance = np.zeros_like(picture)
    radiance[is_lit] = principled_bsdf(of, _lit(light, ways))
    return radiance


def _lit(light: Array, ways: Array) -> Lit:
    nothing = np.zeros(len(ways), np.int64)
    ways = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    lights = np.tile(light / np.linalg.norm(light), (len(ways), 1))
    return Lit(nothing, lights, ways, nothing, nothing, nothing)


def _sphere_difference(folder: Path, lights: Sequence[Sequence[float]]) -> float:
    """Mean CIEDE2000 between Blender's sphere and the model, where camera and light are within 75 degrees of the
    normal."""
    differences = []
    for number, towards in enumerate(lights):
        blender_rgb = _picture(folder / f"{number}.exr")[..., :3]
        side = len(blender_rgb)
        step = (2.0 * np.arange(side) + 1.0 - side) / side * np.tan(np.radians(_FIELD_DEG / 2.0))
        x, y = np.meshgrid(step, -step)
        ways = np.stack([x, y, -np.ones_like(x)], axis=-1)
        ways /= np.linalg.norm(ways, axis=-1, keepdims=True)
        near = -_DISTANCE_M * ways[..., 2]
        root = near**2 - (_DISTANCE_M**2 - 1.0)
        places = [0.0, 0.0, _DISTANCE_M] + (near - np.sqrt(np.maximum(root, 0.0)))[..., None] * ways
        light = np.array(towards) / np.linalg.norm(towards)
        least = np.cos(np.radians(75.0))
        is_compared = (root > 0.0) & (places @ light > least) & (-(places * ways).sum(axis=2) > least)
        normals = places[is_compared]
        base, f0 = (
            np.tile(values, (len(normals), 1))
            for values in (SPHERE["base_color"], 0.04 * np.array(SPHERE["specular_tint"]))
        )
        of = Materials(normals, base, f0, np.full(len(normals), float(SPHERE["roughness"]) ** 2))
        differences.append(
            lab_differences(blender_rgb[is_compared], principled_bsdf(of, _lit(light, -ways[is_compared])))
        )
    return float(np.mean(np.concatenate(differences)))


def _keep(path: Path, our_rgb: list[Array], blender_rgb: list[Array], model_rgb: list[Array]) -> None:
    """Write a row for each light: our picture, Blender's, Blender's model on our pixels, and ten times the
    difference between the last two."""
    rows = []
    for our_picture, blender_picture, model in zip(our_rgb, blender_rgb, model_rgb, strict=True):
        white = np.percentile(our_picture[(our_picture > 0.0).any(axis=2)], 99)
        panels = [
            our_picture / white,
            blender_picture / white,
            model / white,
            0.2 + 5.0 * (blender_picture - model) / white,
        ]
        rows.append(np.concatenate([srgb(np.clip(panel, 0.0, 1.0)) for panel in panels], axis=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.rint(255.0 * np.concatenate(rows)[..., ::-1]).astype(np.uint8))


if __name__ == "__main__":
    sys.exit(main())
