"""Views for programs that relight pictures, read back by decoders written here from the formats' layouts."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cells
import cv2
import h5py
import numpy as np
import pytest
from archives import make_run
from numpy.typing import NDArray
from places import SHARED_DATA

from coupole.exchange.rti.iiif import write_tiles
from coupole.reflectance.light_interpolation import weights
from coupole.reflectance.uncalibrated import PicturedView

Floats = NDArray[np.float64]
HEIGHT, WIDTH = 40, 56
NEW = np.array([[0.3, 0.2, 0.933], [-0.1, 0.5, 0.86], [0.45, -0.45, 0.77], [-0.5, -0.1, 0.86]])
Looks = Callable[[Floats], Floats]
"""Encoded picture [h, w, 3] of a direction to the light."""


def unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def lights(count: int) -> Floats:
    """[count, 3], down to 20 degrees above the picture's plane."""
    z = 1 - (1 - math.sin(math.radians(20))) * (np.arange(count) + 0.5) / count
    turn = 2.4 * np.arange(count)
    side = np.sqrt(1 - z * z)
    return np.stack([side * np.cos(turn), side * np.sin(turn), z], axis=1)


def egg(light: Floats) -> Floats:
    """[h, w, 3] linear: a coloured, satin bump that is not symmetric in any axis, on a plane of another colour."""
    y, x = np.mgrid[1 : -1 : HEIGHT * 1j, -1.4 : 1.4 : WIDTH * 1j]
    bump = np.exp(-3 * ((x - 0.4) ** 2 + 2 * (y - 0.25) ** 2))
    normals = unit(np.stack([3 * (x - 0.4) * bump, 6 * (y - 0.25) * bump, np.ones_like(x)], axis=-1))
    colour = np.where(bump[..., None] > 0.3, (0.8, 0.5, 0.2), (0.3, 0.4, 0.5))
    gloss = 0.3 * np.maximum(normals @ unit(light + np.array([0, 0, 1])), 0) ** 20
    return np.maximum(normals @ light, 0)[..., None] * colour + gloss[..., None]


def displayed(linear: Floats) -> Floats:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def write_result(folder: Path, pictures: Floats, directions: Floats) -> Path:
    """What `coupole reflectance --pictures` leaves, as far as exports read it; [lights, h, w, 3], white 1."""
    (folder / "samples").mkdir(parents=True)
    with h5py.File(folder / "samples/pictures.h5", "w") as file:
        file.attrs["full_scale"] = 65535
        file["mask"], file["directions"] = np.ones(pictures.shape[1:3], bool), directions
        file["intensities"] = np.ones((len(directions), 3))
        codes = np.rint(np.clip(pictures, 0, 1) * 65535).astype(np.uint16)
        file["values"] = codes.reshape(len(directions), -1, 3)
    np.save(folder / "normals.npy", np.tile(np.float32([0, 0, 1]), (*pictures.shape[1:3], 1)))
    (folder / "result.json").write_text(json.dumps({"schema": "coupole-reflectance-pictures/1"}))
    return folder


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_result(tmp_path_factory.mktemp("egg") / "egg", truth(lights(60)), lights(60))


def truth(directions: Floats) -> Floats:
    """White is the 99.9 % quantile of the pixels' brightest values under the lights of the result."""
    brightest = np.max([egg(one) for one in lights(60)], axis=0).max(axis=-1)
    return np.stack([egg(one) for one in directions]) / np.quantile(brightest, 0.999)


def export(source: Path, out: Path, *options: str) -> dict[str, Any]:
    ended = cells.here("export", source, *options, "--out", out, "--json")
    assert ended.code == 0, ended.err
    return ended.document


def rms_dn(a: Floats, b: Floats) -> float:
    return 255 * float(np.sqrt(np.mean((a - b) ** 2)))


def psnr_db(a: Floats, b: Floats) -> float:
    return float(-10 * np.log10(np.mean((a - b) ** 2)))


def read_relight(folder: Path) -> Looks:
    """As OpenLIME does it: planes of vec3 textures, one function of light for each plane, or each channel's."""
    info = json.loads((folder / "info.json").read_text())
    material, count = info["materials"][0], info["nplanes"]
    jpegs = [cv2.imread(str(folder / f"plane_{number}.jpg"))[..., ::-1] for number in range(count // 3)]
    codes = np.concatenate(jpegs, axis=2)
    assert codes.shape == (info["height"], info["width"], count)
    planes = (codes / 255 - material["bias"]) * np.array(material["scale"])

    def of_terms(light: Floats) -> Floats:
        terms = ptm_terms(light) if info["type"] == "ptm" else hsh_terms(light)
        return np.stack([planes[..., channel::3] @ terms for channel in range(3)], axis=-1)

    def of_tables(light: Floats) -> Floats:
        tables = np.array(info["basis"], float).reshape(count + 1, -1, 3)
        shares = grid_shares(light, info["resolution"]) if info["type"] == "bilinear" else gaussians(light, info)
        values = np.einsum("l,plc->pc", shares, tables)
        functions = (values[1:] - 127 * shares.sum()) / np.array(material["range"])[:, None]
        return values[0] / 255 + planes @ functions

    return of_terms if info["colorspace"] == "rgb" else of_tables


def ptm_terms(light: Floats) -> Floats:
    x, y, _ = light
    return np.array([1, x, y, x * x, x * y, y * y])


def hsh_terms(light: Floats) -> Floats:
    """As viewers have it, by angles."""
    phi, c = math.atan2(light[1], light[0]) % (2 * math.pi), light[2]
    side, pi = math.sqrt(c - c * c), math.pi
    a, b = math.sqrt(6 / pi) * side, math.sqrt(30 / pi)
    return np.array(
        [
            1 / math.sqrt(2 * pi),
            a * math.cos(phi),
            math.sqrt(3 / (2 * pi)) * (-1 + 2 * c),
            a * math.sin(phi),
            b * (math.cos(2 * phi) * (-c + c * c)),
            b * (math.cos(phi) * (-1 + 2 * c) * side),
            math.sqrt(5 / (2 * pi)) * (1 - 6 * c + 6 * c * c),
            b * ((-1 + 2 * c) * side * math.sin(phi)),
            b * ((-c + c * c) * math.sin(2 * phi)),
        ]
    )


def grid_shares(light: Floats, resolution: int) -> Floats:
    length = np.abs(light).sum()
    x = ((light[0] + light[1]) / length + 1) / 2 * (resolution - 1)
    y = ((light[1] - light[0]) / length + 1) / 2 * (resolution - 1)
    column, row = min(resolution - 2, int(x)), min(resolution - 2, int(y))
    dx, dy = x - column, y - row
    shares = np.zeros((resolution, resolution))
    shares[row, column : column + 2] = (1 - dy) * np.array([1 - dx, dx])
    shares[row + 1, column : column + 2] = dy * np.array([1 - dx, dx])
    return shares.ravel()


def gaussians(light: Floats, info: dict[str, Any]) -> Floats:
    away2 = np.sum((np.reshape(info["lights"], (-1, 3)) - light) ** 2, axis=1)
    values: Floats = np.exp(-away2 / info["sigma"] ** 2)
    return values / values.sum()


@pytest.mark.parametrize("basis", ["bilinear", "rbf", "ptm", "hsh"])
def test_relight_planes_show_what_the_export_says_that_they_show(basis: str, result: Path, tmp_path: Path) -> None:
    said = export(result, tmp_path, "--to", "relight", "--basis", basis)
    looks = read_relight(tmp_path / "egg")
    wanted = displayed(truth(lights(60)))
    shown = np.stack([np.clip(looks(light), 0, 1) for light in lights(60)])
    missed = rms_dn(shown, wanted)
    assert missed == pytest.approx(said["misses_dn"]["egg"], abs=0.03)
    assert missed < {"bilinear": 2.5, "rbf": 6.0, "ptm": 14.0, "hsh": 9.0}[basis]
    if basis in ("ptm", "hsh"):
        rows = np.stack([(ptm_terms if basis == "ptm" else hsh_terms)(light) for light in lights(60)])
        flat = wanted.reshape(60, -1)
        fitted = np.clip(rows @ np.linalg.lstsq(rows, flat, rcond=None)[0], 0, 1).reshape(wanted.shape)
        assert rms_dn(shown, fitted) < 1.0


def test_planes_are_jpegs_of_red_green_blue_at_full_resolution(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path, "--to", "relight", "--planes", "18")
    content = (tmp_path / "egg/plane_5.jpg").read_bytes()
    adobe = content.index(b"\xff\xee\x00\x0eAdobe")
    assert content[adobe + 15] == 0  # transform: none
    frame = content.index(b"\xff\xc0")
    assert [content[frame + 11 + 3 * channel] for channel in range(3)] == [0x11] * 3
    assert not (tmp_path / "egg/plane_6.jpg").exists()


def test_bilinear_planes_are_as_near_to_interpolation_as_eight_bits_allow(result: Path, tmp_path: Path) -> None:
    export(result, tmp_path, "--to", "relight")
    looks, new, given = read_relight(tmp_path / "egg"), unit(NEW), displayed(truth(lights(60)))
    sums = np.einsum("nl,lhwc->nhwc", weights(lights(60), new, "linear"), given)
    shown = np.stack([looks(light) for light in new])
    assert rms_dn(np.clip(shown, 0, 1), np.clip(sums, 0, 1)) < 1.5


@pytest.mark.parametrize("name", ["bear", pytest.param("cat", marks=pytest.mark.full)])
def test_planes_of_a_real_object_are_as_good_as_interpolation_under_lights_left_out(
    name: str, tmp_path: Path
) -> None:
    folder = SHARED_DATA / "photometric" / name
    if not folder.is_dir():
        pytest.skip("no real pictures beside the project")
    directions = np.loadtxt(folder / "light_directions.txt")
    strengths = np.loadtxt(folder / "light_intensities.txt")
    files = (folder / "filenames.txt").read_text().split()
    crop = np.s_[60:156, 60:156]
    pictures = np.stack([cv2.imread(str(folder / one), -1)[crop][..., ::-1] for one in files]) / 65535
    pictures /= strengths[:, None, None]
    pictures /= np.quantile(pictures.max(axis=(0, 3)), 0.999)
    left = np.arange(4, len(files), 8)
    kept = np.setdiff1d(np.arange(len(files)), left)
    source = write_result(tmp_path / name, pictures[kept], directions[kept])
    export(source, tmp_path, "--to", "relight", "--overwrite")
    looks, wanted = read_relight(tmp_path / name), displayed(pictures[left])
    between = weights(directions[kept], directions[left], "linear")
    sums = np.einsum("nl,lhwc->nhwc", between, displayed(pictures[kept]))
    shown = np.stack([looks(unit(light)) for light in directions[left]])
    lost = psnr_db(np.clip(sums, 0, 1), wanted) - psnr_db(np.clip(shown, 0, 1), wanted)
    assert lost < 0.6, lost


def test_a_polynomial_texture_map_is_read_from_its_layout(result: Path, tmp_path: Path) -> None:
    said = export(result, tmp_path, "--to", "ptm")
    content = (tmp_path / "egg.ptm").read_bytes()
    version, kind, width, height, scales, biases = (line.decode() for line in content.split(b"\n")[:6])
    assert (version, kind, width, height) == ("PTM_1.2", "PTM_FORMAT_LRGB", str(WIDTH), str(HEIGHT))
    scale, bias = np.array(scales.split(), float), np.array(biases.split(), int)
    start = len(content) - 9 * WIDTH * HEIGHT
    assert content[start - 1 : start] == b"\n"
    pixels = np.frombuffer(content[start:], np.uint8)
    luminance = (pixels[: 6 * WIDTH * HEIGHT].reshape(HEIGHT, WIDTH, 6)[::-1] - bias) * scale
    colour = pixels[6 * WIDTH * HEIGHT :].reshape(HEIGHT, WIDTH, 3)[::-1]
    shown = []
    for x, y, _ in lights(60):
        lit = luminance @ np.array([x * x, y * y, x * y, x, y, 1])
        shown.append(np.clip(lit[..., None] * colour / 255 / 255, 0, 1))
    missed = rms_dn(np.array(shown), displayed(truth(lights(60))))
    assert missed == pytest.approx(said["misses_dn"]["egg"], abs=0.03)
    assert missed < 16.0


def test_hemispherical_harmonics_are_read_from_their_layout(result: Path, tmp_path: Path) -> None:
    said = export(result, tmp_path, "--to", "rti")
    content = (tmp_path / "egg.rti").read_bytes()
    header = f"#HSH1.2\r\n3\r\n{WIDTH} {HEIGHT} 3\r\n9 2 1\r\n".encode()
    assert content.startswith(header)
    scale, bias = np.frombuffer(content, "<f4", 18, len(header)).reshape(2, 9).astype(float)
    codes = np.frombuffer(content, np.uint8, offset=len(header) + 72).reshape(HEIGHT, WIDTH, 3, 9)
    shown = [np.clip((codes / 255 * scale + bias) @ hsh_terms(light), 0, 1) for light in lights(60)]
    missed = rms_dn(np.array(shown), displayed(truth(lights(60))))
    assert missed == pytest.approx(said["misses_dn"]["egg"], abs=0.03)
    assert missed < 9.0


def test_a_manifest_leads_to_pictures_of_the_sizes_that_it_says(result: Path, tmp_path: Path) -> None:
    base = "https://museum.example/eggs"
    export(result, tmp_path, "--to", "iiif", "--base-url", base + "/")
    manifest = json.loads((tmp_path / "manifest.json").read_text())
    assert (manifest["id"], manifest["type"]) == (f"{base}/manifest.json", "Manifest")
    (canvas,) = manifest["items"]
    (page,) = canvas["items"]
    (painting,) = page["items"]
    assert (painting["motivation"], painting["target"]) == ("painting", canvas["id"])
    assert (canvas["width"], canvas["height"]) == (WIDTH, HEIGHT)
    images = painting["body"]["items"]
    assert len(images) == 6
    shown = {}
    for image in images:
        picture = cv2.imread(str(tmp_path / image["id"].removeprefix(base + "/")))
        assert picture.shape == (image["height"], image["width"], 3) == (HEIGHT, WIDTH, 3)
        service = image["service"][0]["id"]
        assert json.loads((tmp_path / service.removeprefix(base + "/") / "info.json").read_text())["id"] == service
        shown[image["id"].split("/")[-5]] = picture.astype(float)
    flanks = {"left": np.s_[:, :8], "right": np.s_[:, 8:], "top": np.s_[:10], "bottom": np.s_[10:]}
    for side, flank in flanks.items():
        bump = shown[f"egg-{side}"][4:24, 30:46]
        assert bump[flank].mean() > bump.mean() + 2.0, side


@pytest.mark.parametrize(
    ("told", "kind"),
    [
        ({"simulated": True, "uncalibrated_run": "vase"}, "simulated: vase"),
        ({"simulated": False, "uncalibrated_run": "vase"}, "measured: vase"),
        ({"simulated": None}, "not known whether it was measured or simulated: egg"),
    ],
)
def test_files_say_whether_their_pictures_were_simulated(
    told: dict[str, Any], kind: str, result: Path, tmp_path: Path
) -> None:
    source = tmp_path / "egg"
    shutil.copytree(result, source)
    (source / "result.json").write_text(json.dumps({"schema": "coupole-reflectance-pictures/1", **told}))
    export(source, tmp_path / "r", "--to", "relight", "--basis", "ptm")
    export(source, tmp_path / "i", "--to", "iiif")
    info, manifest = (json.loads((tmp_path / name).read_text()) for name in ("r/egg/info.json", "i/manifest.json"))
    wanted = f"Coupole, pictures under known lights, {kind}"
    assert info["origin"] == wanted
    assert manifest["metadata"][0]["value"]["none"] == [wanted]


def test_tiles_at_their_canonical_addresses_put_the_picture_together(tmp_path: Path) -> None:
    y, x = np.mgrid[:700, :1301]
    picture = np.stack([x / 6, y / 3, (x + y) / 9], axis=-1).astype(np.uint8)
    write_tiles(picture, tmp_path, "https://example.org/a")
    info = json.loads((tmp_path / "info.json").read_text())
    (tiles,) = info["tiles"]
    for factor in tiles["scaleFactors"]:
        side = tiles["width"] * factor
        for top in range(0, 700, side):
            for left in range(0, 1301, side):
                wide, high = min(side, 1301 - left), min(side, 700 - top)
                size = f"{-(-wide // factor)},{-(-high // factor)}"
                region = "full" if (wide, high) == (1301, 700) else f"{left},{top},{wide},{high}"
                tile = cv2.imread(str(tmp_path / region / size / "0/default.jpg"))[..., ::-1].astype(float)
                whole = picture[top : top + high, left : left + wide].astype(float)
                assert f"{tile.shape[1]},{tile.shape[0]}" == size
                assert abs(tile.mean(axis=(0, 1)) - whole.mean(axis=(0, 1))).max() < 1.5
    for size in info["sizes"]:
        name = f"{size['width']},{size['height']}"
        assert cv2.imread(str(tmp_path / "full" / name / "0/default.jpg")).shape[1::-1] == tuple(size.values())
    assert cv2.imread(str(tmp_path / "full/max/0/default.jpg")).shape == (700, 1301, 3)


def test_pictures_for_rti_are_counted_with_their_linear_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_pictures(run: Path, view: str, out: Path, say: object) -> PicturedView:
        out.mkdir()
        for led in range(4):
            cv2.imwrite(str(out / f"led{led:04d}.png"), np.full((4, 6, 3), 9000 + led, np.uint16))
        (out / "filenames.txt").write_text("told")
        files = tuple(sorted(out.glob("*.png")))
        return PicturedView(tuple(range(4)), files, 500.0 * lights(4), 60.0, is_simulated=True)

    def lights_of_view(run: Path, view: str) -> PicturedView:
        return PicturedView(tuple(range(4)), (), 500.0 * lights(4), 60.0, is_simulated=True)

    monkeypatch.setattr("coupole.exchange.rti.rti_pictures.write_pictures", write_pictures)
    monkeypatch.setattr("coupole.exchange.rti.export_views.lights_of_view", lights_of_view)
    run = make_run(tmp_path / "runs").run.folder
    said = export(run, tmp_path / "out", "--to", "lp", "--views", "top")
    written = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert len(written) == 4 + 5 + 2
    assert (said["files"], said["bytes"]) == (len(written), sum(path.stat().st_size for path in written))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--to", "dome"), "expected one of relight, ptm, rti, iiif"),
        (("--to", "tiff"), "expected one of relight, ptm, rti, iiif"),
        (("--to", "relight", "--basis", "sh"), "expected one of bilinear, rbf, ptm, hsh"),
        (("--to", "relight", "--basis", "hsh", "--planes", "18"), "with bilinear or rbf"),
        (("--to", "ptm", "--basis", "ptm"), "--basis: is for --to relight"),
        (("--to", "relight", "--planes", "0"), "--planes 0: expected 27 or 18"),
        (("--to", "relight", "--basis", ""), "--basis: is empty"),
        (("--to", "iiif", "--base-url", ""), "--base-url: is empty"),
        (("--to", "rocrate", "--licence", "CC0", "--author", "A"), "rocrate is for a run or a result"),
        (("--to", "rti", "--base-url", "https://a.example"), "is for --to iiif"),
        (("--to", "iiif", "--base-url", "eggs/"), "expected the http address"),
        (("--to", "iiif", "--base-url", "https://[::1"), "expected the http address"),
        (("--to", "iiif", "--base-url", "http://x/a b"), "expected the http address"),
        (("--to", "iiif", "--base-url", 'https://x/<b>"'), "expected the http address"),
        (("--to", "iiif", "--base-url", "https://x:99999/"), "expected the http address"),
        (("--to", "iiif", "--base-url", "https://x/a%2"), "expected the http address"),
        (("--to", "ptm", "--views", "top"), "a result of pictures has one view"),
    ],
)
def test_what_does_not_fit_is_refused(options: tuple[str, ...], said: str, result: Path, tmp_path: Path) -> None:
    ended = cells.here("export", result, *options, "--out", tmp_path / "new")
    assert ended.code == 2
    assert said in " ".join(ended.err.split())
    assert not (tmp_path / "new").exists()


def test_lights_that_do_not_determine_harmonics_and_files_that_stand_are_refused(tmp_path: Path) -> None:
    ring = unit(np.array([[math.cos(turn), math.sin(turn), 0.8] for turn in np.arange(12)]))
    pictures = truth(ring)
    source = write_result(tmp_path / "ring", pictures, ring)
    ended = cells.here("export", source, "--to", "rti", "--out", tmp_path)
    assert ended.code == 2
    assert "12 lights at these directions do not determine 9 coefficients" in " ".join(ended.err.split())
    (tmp_path / "ring.ptm").write_text("mine")
    ended = cells.here("export", source, "--to", "ptm", "--out", tmp_path)
    assert ended.code == 2
    assert (tmp_path / "ring.ptm").read_text() == "mine"
    black = write_result(tmp_path / "black", np.zeros_like(pictures), ring)
    ended = cells.here("export", black, "--to", "relight", "--out", tmp_path)
    assert ended.code == 2
    assert "black: the pictures are black" in " ".join(ended.err.split())
