"""Luminance, coarse bands, daylight, films: against V(lambda), 5 nm sums, another decoder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from spectral_scenes import HERE, constant, everywhere, illuminant, plane, rendered, scene

from coupole.appearance.render import bands, colour, studio
from coupole.appearance.render.rendering import open_renderer
from coupole.appearance.render.scene_file import Scene, with_plain_lights
from coupole.appearance.render.spectra import luminous
from coupole.appearance.spectra import light
from coupole.appearance.spectra.grid import WAVELENGTHS_NM, Array

WHITE = {"kind": "diffuse", "reflectance": constant(1.0)}
GREY = {"kind": "diffuse", "reflectance": constant(0.5)}
DAYLIGHT = {
    "kind": "daylight",
    "when": "2009-07-15T21:09:00+02:00",
    "latitude_deg": 48.853,
    "longitude_deg": 2.349,
    "altitude_m": 35,
}
FILM = {"begins": "2009-07-15T21:09:00+02:00", "ends": "2009-07-15T21:33:00+02:00", "every_s": 720}


def nothing(name: str, done: int, total: int) -> None:
    pass


@pytest.mark.parametrize("observer", ["10 deg", "2 deg"])
@pytest.mark.parametrize("step", [5, 20])
def test_white_under_d65_has_the_luminance_of_v_lambda_for_every_observer(
    observer: str, step: int, tmp_path: Path
) -> None:
    ray = {"kind": "distant", "direction": [0, 0, -1], "spectrum": illuminant("D65")}
    lights = [{**ray, "illuminance_lux": 100.0 * np.pi}]
    wanted = scene([plane(WHITE)], lights, samples=1, observer=observer, bands={"step_nm": step})
    summary = studio.render(wanted, HERE, tmp_path, nothing)
    assert summary["cameras"]["main"]["mean_cd_m2"] == pytest.approx(100.0, rel=1e-3)
    assert summary["cameras"]["main"]["white_cd_m2"] == pytest.approx(100.0, rel=1e-3)


def patches() -> Array:
    """Reflectances [24, 81] of a measured ColorChecker."""
    import colour as colour_science

    known = colour_science.SDS_COLOURCHECKERS["ISO 17321-1"].values()
    return np.array([np.interp(WAVELENGTHS_NM, one.wavelengths, one.values) for one in known])


@pytest.mark.parametrize(("name", "most"), [("D65", 0.2), ("FL2", 0.4), ("FL11", 1.0), ("LED-B3", 0.2)])
def test_bands_of_20_nm_follow_a_lights_own_structure(name: str, most: float) -> None:
    import colour as colour_science

    power, found = light.led(name), patches()
    whole = colour.eye("10 deg", power, power, 5).tristimulus(found * power)
    nodes = bands.rendered_bands(20)
    coarse = colour.eye("10 deg", power, power, 20).tristimulus((found * bands.around_nodes(power, 20))[:, nodes])
    white = colour.eye("10 deg", power, power, 5).tristimulus(power)
    labs = [light.lab(xyz, white) for xyz in (whole, coarse)]
    assert colour_science.delta_E(*labs, method="CIE 2000").max() < most


def test_a_level_white_has_the_light_of_sun_and_sky() -> None:
    wanted = scene([plane(WHITE)], [DAYLIGHT], samples=64, bands={"step_nm": 40})
    sun_disk, sky = with_plain_lights(wanted, HERE).lights
    found = rendered(wanted).radiance.mean(axis=(0, 1))
    level = np.sin(np.radians(5.02)) * np.array(sun_disk.spectrum.values) + np.array(sky.spectrum.values)
    assert found == pytest.approx(bands.around_nodes(level / np.pi, 40)[bands.rendered_bands(40)], rel=0.02)


def test_the_first_light_of_a_page_is_the_sun() -> None:
    from coupole.exchange.look.scene_start import start_of

    start = start_of(with_plain_lights(scene([plane(GREY)], [DAYLIGHT]), HERE), HERE)
    assert start["lights"][0]["illuminant"] == "sun of 2009-07-15 21:09"
    assert start["skyIlluminant"] == "sky of 2009-07-15 21:09"


def test_a_sun_whose_direction_and_spectrum_differ_in_height_is_refused() -> None:
    low = {"kind": "low_sun", "elevation_deg": 8}
    slanted = {"kind": "distant", "direction": [-0.62, -0.35, -0.36], "illuminance_lux": 9000, "spectrum": low}
    with pytest.raises(
        ValueError, match=r"a height of 26\.8 degrees, but its spectrum belongs to a sun at 8 degrees"
    ):
        scene([plane(GREY)], [slanted])


def small_film(**others: Any) -> Scene:
    return scene([plane(GREY)], [DAYLIGHT], samples=1, bands={"step_nm": 40}, film=FILM, **others)


def test_a_film_shows_the_light_go_at_one_white_and_goes_on_where_it_was_stopped(tmp_path: Path) -> None:
    import av

    first = studio.render(small_film(), HERE, tmp_path, nothing)
    made = first["cameras"]["main"]
    assert (made["frames"], made["mean_cd_m2"]) == (3, sorted(made["mean_cd_m2"], reverse=True))
    frames = sorted((tmp_path / "test-main-frames").glob("*.png"))
    levels = [np.asarray(Image.open(frame), dtype=float).mean() for frame in frames]
    assert levels == sorted(levels, reverse=True)
    assert levels[0] - levels[-1] > 40
    with av.open(str(tmp_path / made["files"]["film"])) as film:
        assert "simulated" in film.metadata["comment"]
        shown = [frame.to_ndarray(format="rgb24").mean() for frame in film.decode(video=0)]
    assert shown == pytest.approx(levels, abs=6.0)

    frames[1].with_suffix(".json").unlink()
    before = [frame.stat().st_mtime_ns for frame in frames]
    assert studio.render(small_film(), HERE, tmp_path, nothing) == first
    again = [frame.stat().st_mtime_ns != old for frame, old in zip(frames, before, strict=True)]
    assert again == [False, True, False]
    studio.render(small_film(seed=5), HERE, tmp_path, nothing)
    assert all(frame.stat().st_mtime_ns != old for frame, old in zip(frames, before, strict=True))


def test_a_film_without_daylight_or_without_time_is_refused() -> None:
    with pytest.raises(ValueError, match="`film` needs a light of kind `daylight`"):
        scene([plane(GREY)], [everywhere(illuminant("D65"))], film=FILM)
    with pytest.raises(ValueError, match="ends before it begins"):
        scene([plane(GREY)], [DAYLIGHT], film={**FILM, "ends": FILM["begins"]})


def test_a_denoised_picture_says_so_and_has_less_noise_and_its_spectra_stay(tmp_path: Path) -> None:
    pytest.importorskip("pyoidn")
    camera = {
        "name": "main",
        "position_mm": [0, 0, 500],
        "target_mm": [0, 0, 0],
        "up": [0, 1, 0],
        "optics": {"kind": "field", "degrees": 40},
        "width_px": 64,
        "height_px": 64,
    }
    lamp = {
        "kind": "area",
        "position_mm": [300, 0, 300],
        "target_mm": [0, 0, 0],
        "width_mm": 200,
        "height_mm": 200,
    }
    lights = [{**lamp, "luminance_cd_m2": 5000, "spectrum": illuminant("D65")}]
    pictures = {}
    for denoised in (False, True):
        wanted = scene(
            [plane(GREY)],
            lights,
            cameras=[camera],
            samples=2,
            bands={"step_nm": 40},
            display={"white_cd_m2": 400, "denoised": denoised},
        )
        out = tmp_path / str(denoised)
        out.mkdir()
        summary = studio.render(wanted, HERE, out, nothing)
        assert summary["cameras"]["main"]["denoised"] is denoised
        png = Image.open(out / "test-main.png")
        assert ("denoised by Open Image Denoise" in png.info["Description"]) is denoised
        pictures[denoised] = np.asarray(png, dtype=float)[..., 1]
    noise = {key: np.std(np.diff(picture, axis=0)) for key, picture in pictures.items()}
    assert noise[True] < 0.5 * noise[False]
    assert pictures[True].mean() == pytest.approx(pictures[False].mean(), rel=0.02)
    exr = [(tmp_path / str(key) / "test-main.exr").read_bytes() for key in (False, True)]
    assert exr[0] == exr[1]


def test_eyes_luminance_of_a_spectrum_is_that_of_v_lambda() -> None:
    power = light.illuminant("A")
    eye = colour.eye("10 deg", power, light.illuminant("D65"), 10)
    found = eye.luminance(bands.around_nodes(power, 10)[bands.rendered_bands(10)])
    assert found == pytest.approx(luminous(power), rel=1e-4)
    assert json.dumps(float(found))


def test_a_renderer_has_plain_lights() -> None:
    with open_renderer(scene([plane(GREY)], [DAYLIGHT]), HERE) as renderer:
        assert [one.kind for one in renderer.scene.lights] == ["distant", "environment"]


def test_a_picture_has_the_noise_that_was_asked_for_and_the_samples_that_it_takes() -> None:
    lamp = {
        "kind": "area",
        "position_mm": [300, 0, 300],
        "target_mm": [0, 0, 0],
        "width_mm": 200,
        "height_mm": 200,
    }
    lights = [{**lamp, "luminance_cd_m2": 5000, "spectrum": illuminant("D65")}]
    most = {"samples": 4096, "bands": {"step_nm": 40}}
    coarse, fine = (rendered(scene([plane(GREY)], lights, noise=noise, **most)) for noise in (0.012, 0.004))
    assert coarse.noise is not None
    assert fine.noise is not None
    assert (coarse.noise <= 0.012, fine.noise <= 0.004) == (True, True)
    assert 4 * coarse.samples <= fine.samples <= 4096
    true = rendered(scene([plane(GREY)], lights, seed=99, **most)).radiance
    off = (
        np.median(np.abs(fine.radiance / true - 1.0)[..., 5]) / 0.6745
    )  # of a normal: median to standard deviation
    assert off == pytest.approx(fine.noise, rel=0.5)
