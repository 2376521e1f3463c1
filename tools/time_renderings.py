"""Measures times of renderings beside those of the papers: a table for docs/gallery.md.

    uv run python tools/time_renderings.py [NAME[=NOISE] ...] [--size 1200] [--step 5] [--samples 512]

Each scene of `configs/scenes` is rendered with its first camera as a square picture, until half of the pixels have
at most the given noise (or until `--samples` are reached). Dumazet et al. 2008 took 8 hours for a picture of 1200
x 1200 pixels (figure 12).
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from coupole.appearance.render.rendering import Spectral, open_renderer
from coupole.appearance.render.scene_file import Bands, FieldOfView, Scene
from coupole.commands.render_scene import read_scene
from smallest import add_smallest

SCENES = Path(__file__).parent.parent / "configs" / "scenes"
NOISES = {"gilt-step-wedge-d65": 0.05, "sunset-gilding": 0.1, "nashiji-stereo": 0.1}
_HEAD = ("scene", "pixels", "bands", "noise wanted", "noise reached", "paths a pixel", "wall s", "CPU s")


def square(scene: Scene, size_px: int, step_nm: int, noise: float, most: int) -> Scene:
    """Return the scene with only its first camera, with equal height and width."""
    camera = scene.cameras[0]
    optics = FieldOfView(kind="field", degrees=camera.field_deg())
    square_camera = camera.model_copy(update={"width_px": size_px, "height_px": size_px, "optics": optics})
    bands = Bands.model_validate({"step_nm": step_nm})
    return scene.model_copy(update={"cameras": (square_camera,), "bands": bands, "noise": noise, "samples": most})


def time_picture(scene: Scene) -> tuple[Spectral, float, float]:
    """Return the picture, and its seconds: on the clock, and of all cores together."""
    wall, cpu = time.perf_counter(), time.process_time()
    with open_renderer(scene, SCENES) as renderer:
        rendering = renderer.render(scene.cameras[0])
    return rendering, time.perf_counter() - wall, time.process_time() - cpu


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", metavar="NAME[=NOISE]", help=f"Default: {', '.join(NOISES)}.")
    parser.add_argument("--size", type=int, default=1200, help="Pixels along each side.")
    parser.add_argument("--step", type=int, nargs="+", default=[5], choices=[5, 10, 20, 40], help="nm.")
    parser.add_argument("--samples", type=int, default=512, help="Paths through a pixel, at most.")
    add_smallest(parser, size=8, step=[40], samples=4)
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores; load before: {os.getloadavg()[0]:.1f}")
    print(f"| {' | '.join(_HEAD)} |\n|{'---|' * len(_HEAD)}", flush=True)
    for text in options.scenes or list(NOISES)[: 1 if options.smallest else None]:
        name, _, noise_text = text.partition("=")
        noise = float(noise_text) if noise_text else NOISES.get(name, 0.1)
        for step_nm in options.step:
            _, scene = read_scene(SCENES / f"{name}.yaml")
            rendering, wall_s, cpu_s = time_picture(square(scene, options.size, step_nm, noise, options.samples))
            row = (name, f"{options.size} x {options.size}", len(rendering.wavelengths_nm), f"{noise:g}")
            figures = (f"{rendering.noise:.3f}", rendering.samples, f"{wall_s:.0f}", f"{cpu_s:.0f}")
            print(f"| {' | '.join(str(cell) for cell in (*row, *figures))} |", flush=True)


if __name__ == "__main__":
    main()
