"""Makes docs/gallery.md and its pictures: each virtual object in the simulated dome under four of its LEDs.

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
    title: str
    caption: str
    elevation_deg: float = 60.0
    distance_mm: float = 335.0
    height_mm: float = 5.0


PIECES = [
    Piece(
        {"kind": "sculpted_relief"},
        "Sculpted relief",
        "A carved tile of warm stone, purely diffuse: cast shadows, tool marks.",
        height_mm=10.0,
    ),
    Piece(
        {"kind": "gilt_step_wedge"},
        "Gilt step wedge",
        "Gold leaf of rising thickness on red bole. Film, bole and interface by the transfer matrix, reduced to "
        "the camera's channels (seed 001, section 5; equation 7 corrected: [materials](reference/materials.md)).",
        distance_mm=240.0,
    ),
    Piece(
        {"kind": "paint_wedge"},
        "Paint wedge over black and white",
        "Azurite in rising thickness: Kubelka and Munk with Saunderson's correction (seed 000, equations 5 to 7).",
        distance_mm=240.0,
    ),
    Piece(
        {"kind": "makie_tile"},
        "Makie tile",
        "A drawing in metal powder on black lacquer, mixed by its opacity (seed 002, decomposition into metal and "
        "lacquer).",
        distance_mm=240.0,
    ),
    Piece(
        {"kind": "nashiji_slab"},
        "Nashiji slab",
        "Metal flakes at their depths and tilts in absorbing lacquer, by their normals (seed 002, nashiji).",
        distance_mm=110.0,
    ),
    Piece(
        {"kind": "fabric", "translation_mm": [0, 0, 2]},
        "Fabric",
        "Linen in plain weave, by its normals.",
        distance_mm=240.0,
    ),
    Piece(
        {"kind": "glossy_sphere", "diameter_mm": 80.0},
        "Glossy sphere",
        "Red under a clear coat (GGX, roughness 0.1): one highlight for one LED.",
        elevation_deg=30.0,
        height_mm=40.0,
    ),
    Piece(
        {"kind": "chrome_ball", "diameter_mm": 60.0},
        "Chrome ball",
        "Reflects nothing but the LED: there is no inter-reflection in these frames.",
        elevation_deg=30.0,
        height_mm=30.0,
    ),
    Piece(
        {"kind": "charuco_board", "abc_deg": [20, 0, 0]},
        "ChArUco board",
        "12 x 9 squares of 16 mm, for the camera.",
        distance_mm=420.0,
    ),
    Piece(
        {"kind": "spectralon_tile"},
        "Spectralon tile",
        "99 % diffuse: the reference of all reflectance here.",
        distance_mm=240.0,
    ),
]
_HEAD = """# Gallery of virtual objects

**All pictures are synthetic.** They are frames of the simulated camera (1024 x 768, GBRG, with noise,
developed to one pixel for each Bayer cell) of the simulated dome, each under one of four LEDs;
`tools/make_gallery.py` makes them. Light comes straight from the LED: no inter-reflection, hard shadows, one
ray and one radiance for each triangle, so large triangles show. Materials are reduced to Lambert and GGX in
the camera's three channels. What they answer to in the papers is named; the papers' own pictures are of real
objects or of spectral path tracing, and the likeness is for you to judge.
"""
_RENDERINGS = """
## Spectral renderings

By `coupole render` (Mitsuba; `tools/make_renderings.py`), from the scenes in `configs/scenes/`. These
pictures have 11 or 21 bands and few samples; the scene files ask for 81, and for 21 in the film. Those of the
sun are denoised; the sunset is [a film](pictures/renderings/sunset-film-main.mp4) too. *All are simulated.*

"""
_RESTORED = """
## A bust under three hypotheses

![A bust as bare stone, painted and gilded, and worn, simulated](pictures/gallery/restored-bust.png)

*Simulated.* By `coupole restore` from `configs/restorations/` (18 samples, 21 bands, denoised):
nobody's likeness (`tools/make_bust.py`); gold leaf on yellow ochre for the hair, blue cloth, flesh in lead white
alone, as seed 000 rendered the tomb of Philippe-Dagobert. Paints are assumed shapes, no measured pigments.
"""
_RENDERED = (
    ("gilt-step-wedge-d65-main", "Gold leaf of 0 to 250 nm on red bole, under D65 (seed 001)"),
    ("gilt-step-wedge-a-main", "The same under illuminant A"),
    ("paint-wedge-main", "Azurite, 10 to 320 um, over black and white (seed 000)"),
    ("urushi-makie-main", "Sprinkled gold on black urushi (seed 002)"),
    ("nashiji-stereo-left", "Nashiji for the left eye (seed 002)"),
    ("nashiji-stereo-right", "Nashiji for the right eye"),
    ("sunset-gilding-main", "Gilding in the evening sun of 15 July 2009 at Paris, 21:09, 5 degrees high"),
    (
        "sunset-film-main",
        "The same until 21:33, when the sun is 1.7 degrees high; one exposure",
    ),
    ("arcature-main", "A gilded niche at 21:33: what gold sends onto the stone behind a king's head, by photons"),
    ("arcature-caustic", "The sun's light on the niche's ground and back wall, by photons (seed 001)"),
)


def make(piece: Piece) -> Path:
    """Render one piece; returns the picture's path."""
    kind = piece.thing["kind"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        rig = YAML(typ="safe").load(ROOT / "configs/rigs/sim.yaml")
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


def page() -> str:
    """docs/gallery.md."""
    parts = [_HEAD]
    for piece in PIECES:
        kind = piece.thing["kind"]
        parts.append(
            f"\n## {piece.title}\n\n![{piece.title} under four LEDs, simulated](pictures/gallery/{kind}.png)\n\n"
            f"*Simulated.* {piece.caption}\n"
        )
    parts += [_RESTORED, _RENDERINGS]
    parts += [
        f"![{caption}, simulated](pictures/renderings/{name}.png)\n\n{caption}.\n\n" for name, caption in _RENDERED
    ]
    return "".join(parts).rstrip() + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    asked = parser.parse_args()
    for piece in PIECES:
        if not asked.kinds or piece.thing["kind"] in asked.kinds:
            print(make(piece).relative_to(ROOT))
    (ROOT / "docs/gallery.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
