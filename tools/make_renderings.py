"""Renders the shipped scenes for docs/pictures/renderings: uv run python tools/make_renderings.py [NAME ...]

With fewer samples and coarser bands than in the scene files: minutes instead of an hour.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

from coupole.appearance.render import studio
from coupole.commands.render_scene import read_scene, render_scene

ROOT = Path(__file__).parent.parent
PICTURES = ROOT / "docs" / "pictures" / "renderings"
QUICK = {
    "gilt-step-wedge-d65": (40, 480, 40),
    "gilt-step-wedge-a": (40, 480, 40),
    "paint-wedge": (40, 480, 40),
    "urushi-makie": (48, 360, 40),
    "sunset-gilding": (48, 360, 40),
    "arcature": (256, 360, 40),
    "nashiji-stereo": (48, 280, 40),
}
"""Samples, width in pixels, nm between bands."""


def main() -> None:
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[1:] or QUICK:
        samples, width_px, step_nm = QUICK[name]
        document, scene = read_scene(ROOT / "configs" / "scenes" / f"{name}.yaml")
        quick = studio.reduced(scene, samples=samples, width_px=width_px, step_nm=step_nm)
        with tempfile.TemporaryDirectory() as folder:
            render_scene(document, quick, Path(folder), lambda camera, done, total: None)
            for png in sorted(Path(folder).glob("*.png")):
                shutil.copy(png, PICTURES)
                print(f"{png.name}: {png.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
