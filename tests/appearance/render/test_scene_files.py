"""Scene files: what is refused, what is shipped, and what a rendering writes."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import REPO

from coupole.appearance.render import studio
from coupole.appearance.render.materials import bsdf, paint_inside
from coupole.appearance.render.rendering import open_renderer
from coupole.appearance.render.scene_file import remarks
from coupole.commands.render_scene import read_scene, render, render_scene
from coupole.errors import InputError, StorageError

ROOT = REPO
SHIPPED = sorted((ROOT / "configs" / "scenes").glob("*.yaml"))
SLOW = {"arcature", "layers-and-wear", "makie-box", "nashiji-bowl", "sunset-film", "sunset-gilding"}
SMALL = """\
schema_version: 1
name: small
cameras:
  - name: main
    position_mm: [0, -100, 100]
    target_mm: [0, 0, 0]
    optics: {kind: lens, focal_length_mm: 35, pixel_pitch_um: 700}
    width_px: 16
    height_px: 12
objects:
  - kind: plane
    width_mm: 500
    depth_mm: 500
    material: {kind: diffuse, reflectance: {kind: constant, value: 0.5}}
lights:
  - {kind: leds, dome: DOME, ids: [0, 7]}
bands: {step_nm: 40}
samples: 2
depth: 2
"""


def written(folder: Path, text: str = SMALL) -> Path:
    path = folder / "small.yaml"
    path.write_text(text.replace("DOME", str(ROOT / "configs" / "domes" / "coupole.csv")))
    return path


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=pytest.mark.full if path.stem in SLOW else ()) for path in SHIPPED],
)
def test_every_shipped_scene_renders(path: Path, tmp_path: Path) -> None:
    document, scene = read_scene(path)
    small = studio.reduced_scene(scene, samples=1, width_px=16, step_nm=40)
    if small.caustic is not None:
        small = small.model_copy(update={"caustic": small.caustic.model_copy(update={"photons": 20_000})})
    if small.film is not None:
        small = small.model_copy(update={"film": small.film.model_copy(update={"every_s": 1440.0})})
    if small.turntable is not None:
        small = small.model_copy(update={"turntable": small.turntable.model_copy(update={"frames": 2})})
    summary = render_scene(document, small, tmp_path, lambda camera, done, total: None)
    assert summary["synthetic"] is True
    for seen in summary["cameras"].values():
        assert np.all(np.array(seen["mean_cd_m2"]) > 0.0)
        assert all((tmp_path / file).exists() for file in seen["files"].values())


@pytest.mark.parametrize(
    ("wrong", "place", "words"),
    [
        (("samples: 2", "sampels: 2"), "18:1", "sampels"),
        (("value: 0.5", "value: 1.5"), "14:", "1"),
        (("kind: leds", "kind: lamps"), "16:", "lamps"),
        (("dome: DOME", "dome: nowhere.csv"), "16:24", "no such file"),
        (("step_nm: 40", "step_nm: 7"), "17:", "7"),
        (("target_mm: [0, 0, 0]", "target_mm: [0, -100, 0]"), "4:", "up"),
    ],
)
def test_a_wrong_scene_is_refused_with_its_place(
    wrong: tuple[str, str], place: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as refused:
        read_scene(written(tmp_path, SMALL.replace(*wrong)))
    assert f"small.yaml:{place}" in str(refused.value)
    assert words in str(refused.value)


def test_pigments_names_of_old_scene_files_are_read_with_a_remark(tmp_path: Path) -> None:
    old = SMALL.replace("{kind: constant, value: 0.5}", "{kind: pigment, name: azurite}")
    old = old.replace("lights:", "  - {kind: paint_wedge, pigment: malachite}\nlights:")
    _, scene = read_scene(written(tmp_path, old))

    assert [remark.split(" is ")[0] for remark in remarks(scene)] == ["azurite", "malachite"]
    assert "{kind: shape, name: blue_one_peak_shape}" in remarks(scene)[0]
    assert not any(remarks(read_scene(path)[1]) for path in SHIPPED)


def test_a_paint_file_has_its_own_scattering_in_a_scene(tmp_path: Path) -> None:
    rows = "".join(f"{nm},4,12\n" for nm in range(380, 781, 20))
    head = "# coupole: paint 1\n# name: ochre\n# unit: per mm\n# binder_index: 1.5\nwavelength_nm,K,S\n"
    (tmp_path / "ochre.paint.csv").write_text(head + rows)
    paint = "{kind: paint, pigment: {kind: paint_file, path: ochre.paint.csv}, thickness_mm: 0.05}"
    path = written(tmp_path, SMALL.replace("{kind: diffuse, reflectance: {kind: constant, value: 0.5}}", paint))
    document, scene = read_scene(path)

    inside = paint_inside(scene.objects[0].material, document.path.parent).values

    a, b = 16 / 12, np.sqrt((16 / 12) ** 2 - 1.0)
    assert inside == pytest.approx(1.0 / (a + b / np.tanh(b * 12 * 0.05)))
    (tmp_path / "ochre.paint.csv").write_text(head.replace("per mm", "relative") + rows)
    with pytest.raises(InputError, match="is relative; a layer of a thickness needs"):
        bsdf(scene.objects[0].material, document.path.parent)


def test_a_metal_of_the_users_own_index_is_rendered(tmp_path: Path) -> None:
    rows = "".join(f"{nm} 2.5 3.5\n" for nm in range(360, 820, 20))
    (tmp_path / "iron.txt").write_text(rows)
    own = "{kind: metal, index: {kind: file, path: iron.txt}, roughness: 0.3}"
    path = written(tmp_path, SMALL.replace("{kind: diffuse, reflectance: {kind: constant, value: 0.5}}", own))
    document, scene = read_scene(path)

    mine = bsdf(scene.objects[0].material, document.path.parent)["material"]

    assert (mine["eta"][0], mine["k"][0]) == pytest.approx((2.5, 3.5))
    (tmp_path / "iron.txt").unlink()
    with pytest.raises(InputError, match="no such file"):
        read_scene(path)


def test_an_led_that_the_dome_does_not_have_is_named(tmp_path: Path) -> None:
    document, scene = read_scene(written(tmp_path, SMALL.replace("[0, 7]", "[0, 5000]")))
    with pytest.raises(InputError, match="5000"):
        render_scene(document, scene, tmp_path, lambda camera, done, total: None)


def test_a_machine_without_mitsuba_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, scene = read_scene(written(tmp_path))
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    with pytest.raises(InputError, match=r"pip install 'coupole\[mitsuba,materials\]'"):
        render_scene(document, scene, tmp_path, lambda camera, done, total: None)


def test_the_same_scene_gives_the_same_files(tmp_path: Path) -> None:
    document, scene = read_scene(written(tmp_path))
    for folder in ("one", "two"):
        render_scene(document, scene, tmp_path / folder, lambda camera, done, total: None)
    for file in ("small-main.png", "small.json"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    assert np.array_equal(*(_exr(tmp_path / folder / "small-main.exr")[0] for folder in ("one", "two")))


def test_the_exr_holds_bands_by_wavelength_and_says_that_it_is_simulated(tmp_path: Path) -> None:
    document, scene = read_scene(written(tmp_path))
    render_scene(document, scene, tmp_path, lambda camera, done, total: None)
    pixels, names, told = _exr(tmp_path / "small-main.exr")
    wavelengths = [f"S0.{nm}nm" for nm in range(380, 781, 40)]
    assert pixels.shape == (12, 16, 14)
    assert sorted(names) == sorted(["X", "Y", "Z", *wavelengths])
    assert told["spectralLayoutVersion"] == "1.0"
    assert told["synthetic"] == "true"
    with open_renderer(scene, tmp_path) as renderer:
        radiance = renderer.render(scene.cameras[0]).radiance
    assert pixels[..., names.index("S0.540nm")] == pytest.approx(radiance[..., 4])


def test_the_png_is_srgb_and_says_that_it_is_simulated(tmp_path: Path) -> None:
    from PIL import Image

    document, scene = read_scene(written(tmp_path))
    render_scene(document, scene, tmp_path, lambda camera, done, total: None)
    with Image.open(tmp_path / "small-main.png") as picture:
        assert picture.size == (16, 12)
        assert "simulated" in picture.info["Description"]
        assert picture.info["srgb"] == 0


def test_polarisation_adds_its_picture_and_stokes_channels(tmp_path: Path) -> None:
    document, scene = read_scene(written(tmp_path, SMALL + "polarisation: true\noutputs: {spectra: half}\n"))
    summary = render_scene(document, scene, tmp_path, lambda camera, done, total: None)
    _, names, _ = _exr(tmp_path / "small-main.exr")
    assert (tmp_path / summary["cameras"]["main"]["files"]["polarisation"]).is_file()
    assert {"S1.380nm", "S2.380nm", "S3.780nm"} <= set(names)


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path) -> None:
    document, scene = read_scene(written(tmp_path))
    (tmp_path / "taken").write_text("")
    with pytest.raises(StorageError, match="taken"):
        render_scene(document, scene, tmp_path / "taken", lambda camera, done, total: None)


def test_the_command_prints_one_json_document(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    render(written(tmp_path), out=tmp_path / "out", samples=1, width=8, step=None, as_json=True)
    found = json.loads(capsys.readouterr().out)
    assert found["scene"] == "small"
    assert (tmp_path / "out" / found["cameras"]["main"]["files"]["png"]).is_file()


def test_the_command_says_in_json_what_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError):
        render(tmp_path / "none.yaml", out=tmp_path, samples=None, width=None, step=None, as_json=True)
    assert json.loads(capsys.readouterr().out)["exit_code"] == 2


def _exr(path: Path) -> tuple[Any, list[str], dict[str, Any]]:
    import mitsuba

    mi: Any = mitsuba
    bitmap = mi.Bitmap(str(path))
    told = bitmap.metadata()
    names = [field.name for field in bitmap.struct_()]
    return np.array(bitmap), names, {key: told[key] for key in ("spectralLayoutVersion", "synthetic")}
