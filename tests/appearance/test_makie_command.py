"""`coupole makie`: a photograph of powder on lacquer becomes a drawing that a scene reads."""

from __future__ import annotations

from pathlib import Path

import cells
import numpy as np
import pytest
from PIL import Image

from coupole.appearance.matter.makie_drawing import picture

METAL, RED, BLACK = np.array([0.55, 0.42, 0.16]), np.array([0.30, 0.03, 0.02]), np.array([0.02, 0.02, 0.03])
SIDE_PX = 60


def srgb(v: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1."""
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)


def photograph(path: Path, *, linear: bool = False) -> np.ndarray:
    """Metal on the left, bare red lacquer in the middle, black on the right, a ramp of powder below; the shares
    [h, w] of metal in it."""
    share, lacquer = np.zeros((SIDE_PX, SIDE_PX)), np.tile(RED, (SIDE_PX, SIDE_PX, 1))
    share[:20, :20] = 1.0
    lacquer[:, 40:] = BLACK
    share[20:] = np.linspace(0.0, 1.0, SIDE_PX)
    seen = share[..., None] * METAL + (1.0 - share[..., None]) * lacquer
    if linear:
        import cv2

        cv2.imwrite(str(path), np.rint(65535 * seen[..., ::-1]).astype(np.uint16))
    else:
        Image.fromarray(np.rint(255 * srgb(seen)).astype(np.uint8)).save(path)
    return share


SAMPLES = ("--metal", "10,10", "--lacquer", "30,10", "--lacquer", "50,10")


@pytest.mark.parametrize("linear", [False, True])
def test_the_alpha_channel_is_the_share_of_metal(tmp_path: Path, linear: bool) -> None:
    share = photograph(tmp_path / "box.png", linear=linear)
    options = ("--linear",) if linear else ()
    ended = cells.here("makie", tmp_path / "box.png", *SAMPLES, *options, "--out", tmp_path / "a.png", "--json")
    assert ended.code == 0, ended.err
    assert ended.document["metal"] == pytest.approx(METAL, abs=0.005)
    assert ended.document["lacquers"][1] == pytest.approx(BLACK, abs=0.002)
    written = np.asarray(Image.open(tmp_path / "a.png"), float) / 255.0
    assert written[..., 3] == pytest.approx(share, abs=0.02)
    assert written[5, 30, :3] == pytest.approx(srgb(RED), abs=0.01)


def test_a_scene_reads_the_drawing(tmp_path: Path) -> None:
    photograph(tmp_path / "box.png")
    ended = cells.here("makie", tmp_path / "box.png", *SAMPLES, "--out", tmp_path / "a.png")
    assert ended.code == 0, ended.err
    drawn = picture(tmp_path / "a.png", SIDE_PX)
    assert drawn(np.array([[-20.0, 20.0], [0.0, 20.0], [29.0, -20.0]])) == pytest.approx([1.0, 0.0, 1.0], abs=0.03)


def test_a_merged_bracket_with_noise_gives_the_share_within_0_02(tmp_path: Path) -> None:
    import OpenEXR

    share = photograph(tmp_path / "truth.png")
    rng = np.random.default_rng(1)
    lacquer = np.tile(RED, (SIDE_PX, SIDE_PX, 1))
    lacquer[:, 40:] = BLACK
    seen = 7.0 * (share[..., None] * METAL + (1.0 - share[..., None]) * lacquer)  # in a unit of its own
    seen *= rng.normal(1.0, 0.01, seen.shape)
    channels = {one: np.ascontiguousarray(seen[..., k], np.float32) for k, one in enumerate("RGB")}
    channels["saturated"] = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    channels["saturated"][50:, :5] = 1.0
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(tmp_path / "box.exr"))
    known = ("--known", "30,40,0.508", "--known", "45,40,0.763")
    ended = cells.here("makie", tmp_path / "box.exr", *SAMPLES, *known, "--out", tmp_path / "a.png", "--json")
    assert ended.code == 0, ended.err
    for check in ended.document["known"]:
        assert check["found"] == pytest.approx(check["share"], abs=0.005)
        assert 0.0 < check["u_found"] < 0.01
    assert ended.document["unknown"] == pytest.approx(50 / 3600)
    written = np.asarray(Image.open(tmp_path / "a.png"), float)[..., 3] / 255.0
    off = (written - share)[:50]
    assert np.abs(off.reshape(10, 5, 12, 5).mean(axis=(1, 3))).max() < 0.02
    assert np.quantile(np.abs(off), 0.95) < 0.02
    refused = cells.here("makie", tmp_path / "box.exr", *SAMPLES, "--known", "2,55,0", "--out", tmp_path / "b.png")
    assert refused.code == 2
    assert "saturated or dark" in " ".join(refused.err.split())


def test_noise_and_shadow_are_told(tmp_path: Path) -> None:
    photograph(tmp_path / "box.png")
    powder = ("--metal", "35,40", "--lacquer", "30,10")
    ended = cells.here("makie", tmp_path / "box.png", *powder, "--out", tmp_path / "a.png")
    assert ended.code == 0, ended.err
    assert "beyond 0 or 1" in " ".join(ended.err.split())


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--metal", "10,10", "--lacquer", "30,99"], "--lacquer 30,99: expected X,Y, with column and row"),
        (["--metal", "10", "--lacquer", "30,10"], "--metal 10: expected X,Y, with column and row"),
        (["--metal", "10,10", "--lacquer", "12,10"], "of another colour than the lacquers"),
        (["--metal", "10,10", *["--lacquer", "30,10"] * 4], "one to three"),
        (["--metal", "10,10"], "--lacquer"),
        (["--metal", "10,10", "--lacquer", "30,10", "--known", "5,5,2"], "--known 5,5,2: expected X,Y,SHARE"),
        (["--metal", "10,10", "--lacquer", "30,10", "--known", "5,0.5"], "--known 5,0.5: expected X,Y,SHARE"),
    ],
)
def test_what_tells_nothing_is_refused(tmp_path: Path, options: list[str], words: str) -> None:
    photograph(tmp_path / "box.png")
    ended = cells.here("makie", tmp_path / "box.png", *options, "--out", tmp_path / "a.png")
    assert ended.code == 2
    assert words in " ".join(ended.err.split())
    assert not (tmp_path / "a.png").exists()


def test_another_file_than_png_is_refused(tmp_path: Path) -> None:
    photograph(tmp_path / "box.png")
    ended = cells.here("makie", tmp_path / "box.png", *SAMPLES, "--out", tmp_path / "a.jpg")
    assert ended.code == 2
    assert "a name that ends in .png" in ended.err
