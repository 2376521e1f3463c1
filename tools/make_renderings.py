"""Renders the shipped scenes for docs/pictures/renderings: uv run python tools/make_renderings.py [NAME ...]

With fewer samples and coarser bands than in the scene files: minutes instead of an hour.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from PIL import Image
from PIL.PngImagePlugin import PngImageFile, PngInfo

from coupole.appearance.render import studio
from coupole.commands import restore
from coupole.commands.render_scene import read_scene, render_scene
from coupole.heritage.restoration.restoration_file import Choice
from coupole.heritage.restoration.restoring import render_all
from coupole.heritage.restoration.shown_hypotheses import show_all

ROOT = Path(__file__).parent.parent
PICTURES = ROOT / "docs" / "pictures" / "renderings"
QUICK = {
    "gilt-step-wedge-d65": (40, 480, 40),
    "gilt-step-wedge-a": (40, 480, 40),
    "paint-wedge": (40, 480, 40),
    "urushi-makie": (48, 360, 40),
    "sunset-gilding": (48, 480, 20),
    "sunset-film": (24, 360, 20),
    "arcature": (96, 420, 20),
    "nashiji-stereo": (48, 280, 40),
    "church-candles": (48, 400, 40),
    "church-window": (48, 400, 40),
    "layers-and-wear": (48, 560, 40),
    "nashiji-bowl": (48, 360, 40),
    "makie-box": (16, 360, 40),
}
"""Number of samples, width in pixels, and nm between bands."""
BUST, BUST_QUICK = "restored-bust", Choice(samples=18, width_px=400)
"""Bust of configs/restorations/, for docs/pictures/gallery."""


def main() -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    names = sys.argv[1:] or [*QUICK, BUST]
    if BUST in names:
        _bust()
    for name in (name for name in names if name != BUST):
        samples, width_px, step_nm = QUICK[name]
        document, scene = read_scene(ROOT / "configs" / "scenes" / f"{name}.yaml")
        quick = studio.reduced_scene(scene, samples=samples, width_px=width_px, step_nm=step_nm)
        with tempfile.TemporaryDirectory() as folder:
            render_scene(document, quick, Path(folder), lambda camera, done, total: None)
            for film in sorted(Path(folder).glob("*.mp4")):
                _strip(Path(folder) / f"{film.stem}-frames", Path(folder) / f"{film.stem}.png")
            for path in sorted([*Path(folder).glob("*.png"), *Path(folder).glob("*.mp4")]):
                shutil.copy(path, PICTURES)
                print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


def _bust() -> None:
    """Render three hypotheses side by side, smaller, with all texts of the picture."""
    folder = ROOT / "configs" / "restorations"
    parts, hypotheses = folder / "bust-parts.yaml", folder / "bust.yaml"
    with tempfile.TemporaryDirectory() as out:
        restoration = restore.checked_restoration(folder / "bust.ply", parts, hypotheses, BUST_QUICK, "mm", _quiet)
        show_all(restoration, render_all(restoration, Path(out), _quiet), Path(out), _quiet)
        picture = ROOT / "docs" / "pictures" / "gallery" / f"{BUST}.png"
        _smaller(Path(out) / "side-by-side-front.png", picture)
        print(f"{picture.name}: {picture.stat().st_size / 1000:.0f} kB")


def _quiet(step: str, done_count: int, total: int) -> None: ...


def _smaller(path: Path, to: Path) -> None:
    """Write the same picture with at most 940 pixels in width, with the same texts."""
    chunks = PngInfo()
    with Image.open(path) as picture:
        assert isinstance(picture, PngImageFile), f"{path} is no PNG"
        for keyword, words in picture.text.items():
            chunks.add_itxt(keyword, words)
        small = picture.convert("RGB")
        small.thumbnail((940, 940), Image.Resampling.LANCZOS)
        small.save(to, "PNG", optimize=True, pnginfo=chunks)


def _strip(frames: Path, path: Path) -> None:
    """Write four pictures of a film side by side, from its first to its last."""
    pngs = sorted(frames.glob("*.png"))
    pictures = [Image.open(pngs[round(part * (len(pngs) - 1) / 3)]) for part in range(4)]
    width, height = pictures[0].size
    strip = Image.new("RGB", (4 * width, height))
    for number, picture in enumerate(pictures):
        strip.paste(picture, (number * width, 0))
    strip.save(path, optimize=True)


if __name__ == "__main__":
    main()
