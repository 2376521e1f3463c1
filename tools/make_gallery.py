"""Makes pictures of docs/gallery.md: each virtual object in the simulated dome under four of its LEDs.

`python tools/make_gallery.py [KIND ...]`; all of them take about two minutes.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image
from ruamel.yaml import YAML

from coupole.preflight.job import read_job
from coupole.viewing.simulated_frames import simulate

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs/pictures/gallery"
_SENSOR = {"width_px": 1024, "height_px": 768, "pixel_pitch_um": 22.0, "max_frames_per_s": 100}


@dataclass(frozen=True)
class Piece:
    """One picture of the gallery."""

    thing: dict[str, Any]
    elevation_deg: float = 60.0
    distance_mm: float = 335.0
    height_mm: float = 5.0


PIECES = [
    Piece({"kind": "sculpted_relief"}, height_mm=10.0),
    Piece({"kind": "gilt_step_wedge"}, distance_mm=240.0),
    Piece({"kind": "paint_wedge"}, distance_mm=240.0),
    Piece({"kind": "makie_tile"}, distance_mm=240.0),
    Piece({"kind": "nashiji_slab"}, distance_mm=110.0),
    Piece({"kind": "fabric", "translation_mm": [0, 0, 2]}, distance_mm=240.0),
    Piece({"kind": "glossy_sphere", "diameter_mm": 80.0}, elevation_deg=30.0, height_mm=40.0),
    Piece({"kind": "chrome_ball", "diameter_mm": 60.0}, elevation_deg=30.0, height_mm=30.0),
    Piece({"kind": "charuco_board", "abc_deg": [20, 0, 0]}, distance_mm=420.0),
    Piece({"kind": "spectralon_tile"}, distance_mm=240.0),
]


def make(piece: Piece) -> Path:
    """Render one piece; returns the picture's path."""
    kind = piece.thing["kind"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = YAML(typ="safe", pure=True).load(ROOT / "configs/rigs/sim.yaml")
        rig["sensor"] = _SENSOR
        rig["dome"]["leds"] = str(ROOT / "configs/domes/coupole.csv")
        rig["world"] = {"serves": "always", "settings": {"seed": 1, "shading": "flat", "things": [piece.thing]}}
        view = {
            "kind": "look_at",
            "name": kind.replace("_", "-"),
            "target_mm": [0, 0, piece.height_mm],
            "distance_mm": piece.distance_mm,
            "azimuth_deg": -90,
            "elevation_deg": piece.elevation_deg,
        }
        plan = {
            "schema_version": 1,
            "name": "gallery",
            "rig": "rig.yaml",
            "views": [view],
            "lights": {"kind": "ids", "ids": [150, 420, 700, 1000]},
            "exposure": {"kind": "fixed", "exposure_us": 8000},
        }
        (folder / "rig.yaml").write_text(json.dumps(rig))
        (folder / "plan.yaml").write_text(json.dumps(plan))
        simulate(
            read_job(folder / "plan.yaml"), folder / "out", 4, width_px=None, progress=lambda done, total: None
        )
        with Image.open(folder / "out/sheet.png") as sheet:
            small = sheet.quantize(128)
            path = PICTURES / f"{kind}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            small.save(path, "PNG", optimize=True)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    options = parser.parse_args()
    for piece in PIECES:
        if not options.kinds or piece.thing["kind"] in options.kinds:
            print(make(piece).relative_to(ROOT))


if __name__ == "__main__":
    main()
