"""Clusters of an object whose reflectance varies everywhere, compared with the triangles' own materials in
pictures.

    python tools/prove_clusters.py [--triangles 400000] [--clusters N ...] [--waves 1|3] [--every 12] [--keep DIR]

A relief whose colours vary continuously is rendered in two views. With one wave, the colour varies between bright
ochre and a third of it, like a patina; with three, each channel has its own wave. By default this is the shipped
relief, of which 16,000 triangles are seen by 512 x 384 pixels. `--triangles` sets the approximate number of
visible triangles. The relief is then a fifth as high, so that it stays in focus; the camera has the same field
with finer pixels, 8 for each triangle, and its records are drawn at random (`drawn_records`). 400,000 triangles
take half an hour, and 5 GB of disk.

1,000 clusters are those of the paper, for 416,859 triangles (Lucat et al. 2025, Fig. 6). The result for one
cluster per 417 triangles, the paper's ratio, is printed too. As in the paper, errors are means over blocks of 2 x
2 pixels under LEDs that were left out. Exits with 1 if the error with 1,000 clusters is more than 1.3 times that
with the triangles' own materials. Run and result stay in the folder `--keep`; a later call continues with them.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

import make_relief  # noqa: E402
from coupole.reflectance.run_clusters import cluster_result  # noqa: E402
from coupole.reflectance.run_job import RunRequest, reflectance_of  # noqa: E402
from coupole.reflectance.run_result import RunResult  # noqa: E402
from drawn_records import Scale, draw_records  # noqa: E402
from reflectance_cells import OLD_VIEWS  # noqa: E402
from smallest import add_smallest  # noqa: E402

CLUSTERS, TRIANGLES_FOR_EACH, MOST_RATIO = 1000, 417, 1.3
SLOW, PATIENCE_S = 0.5, 60.0
"""Speed of a world that renders large frames, and the time for which it may be silent meanwhile."""
PIXELS_FOR_EACH = 8.0
"""Pixels for each triangle, with `--triangles`."""
FLATTER = 0.2
"""Heights of the finer relief, relative to the shipped one, so that it stays in focus."""
FINE_VIEWS = tuple(
    {**cells.TOP, "name": name, "target_mm": [0, 0, 5], "azimuth_deg": azimuth_deg}
    for name, azimuth_deg in (("front", -90), ("back", 90))
)
COVERED, SEEN = 0.69, 0.97
"""Shares of the frame that show the relief, and of its carved triangles that are seen."""
MATERIAL = {"diffuse": (0.7, 0.7, 0.7), "f0": (0.05, 0.05, 0.05), "roughness": 0.3}
WAVES_MM = (90.0, 60.0, 45.0)
"""Periods of the waves of the three colours over the object; a single wave has the first period."""
MIDDLE, HALF = np.array([0.60, 0.50, 0.38]), np.array([0.30, 0.25, 0.19])


@dataclass(frozen=True)
class Fine:
    """A finer relief, and a camera with correspondingly finer pixels and the field of the shipped camera."""

    triangles: int
    """Approximate number of triangles that are seen."""

    @property
    def size_px(self) -> tuple[int, int]:
        width_px = 128 * math.ceil(math.sqrt(PIXELS_FOR_EACH * self.triangles * 4 / 3 / COVERED) / 128)
        return width_px, width_px * 3 // 4

    @property
    def pitch_um(self) -> float:
        return 44.0 * 512 / self.size_px[0]

    def relief(self) -> trimesh.Trimesh:
        rows = round(math.sqrt(self.triangles / SEEN * 3 / 4 / 2))
        vertices_mm, faces = make_relief.relief(rows * 4 // 3, rows)
        return trimesh.Trimesh(vertices_mm * [1.0, 1.0, FLATTER], faces, process=False)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--triangles", type=int, help="that are seen, about; by itself those of the shipped relief"
    )
    parser.add_argument("--clusters", type=int, nargs="*", default=[], help="numbers to try besides")
    parser.add_argument("--waves", type=int, choices=(1, 3), default=1, help="of colour")
    parser.add_argument("--every", type=int, default=12, help="LEDs are lit, of the dome's 1080")
    parser.add_argument("--keep", type=Path, help="folder for run and result")
    add_smallest(parser, every=60)
    arguments = parser.parse_args()
    fine = None if arguments.triangles is None else Fine(arguments.triangles)
    with tempfile.TemporaryDirectory(prefix="coupole-clusters-") as scratch:
        folder = arguments.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        result = _result(folder, fine, arguments.every, arguments.waves)
        fit_count = int(np.isfinite(RunResult(result).materials("ggx_normal").alpha).sum())
        ratios = {}
        for count in sorted({fit_count // TRIANGLES_FOR_EACH, CLUSTERS, *arguments.clusters}):
            report = cluster_result(result, count, 2_000_000_000)
            ratios[count] = report["mae_ratio"]
            mae = " ".join(f"{name} {1e2 * value:.3f} %" for name, value in report["mae"].items() if value)
            print(
                f"{count} clusters for {fit_count} triangles: {mae}; ratio {report['mae_ratio']:.3f}", flush=True
            )
    return int(ratios[CLUSTERS] > MOST_RATIO)


def _result(folder: Path, fine: Fine | None, every: int, waves: int) -> Path:
    """Make the result of a run of the coloured relief; the run and the records are made only if they are
    missing."""
    about = folder / "run.txt"
    if not about.exists():
        about.write_text(str(_acquire(folder, fine, every, waves)))
    records = ROOT / "configs/calibrations"
    if fine is not None:
        records = folder / "records"
        if not records.exists():
            draw_records(records, 0, Scale(pitch_um=fine.pitch_um, size_px=fine.size_px))
    request = RunRequest((Path(about.read_text()),), calibrations=tuple(sorted(records.glob("*.yaml"))))
    report = reflectance_of(request, folder / "result", say=_say)
    mae = " ".join(f"{name} {1e2 * value:.3f} %" for name, value in report["mae"].items() if value)
    print(
        f"{report['triangles']} triangles, {report['samples']} samples, {report['seconds']:.0f} s: {mae}",
        flush=True,
    )
    return folder / "result"


def _acquire(folder: Path, fine: Fine | None, every: int, waves: int) -> Path:
    """Return the run of the coloured relief."""
    mesh = trimesh.load(ROOT / "configs/objects/relief.ply", process=False) if fine is None else fine.relief()
    mesh.visual.vertex_colors = _colours(np.asarray(mesh.vertices), waves)
    mesh.export(folder / "coloured.ply")
    (folder / "cell").mkdir()
    cell = cells.CellFolder(folder / "cell", speed=10.0 if fine is None else SLOW, write_now=False)
    cell.plan_data["object"]["mesh"] = str(folder / "coloured.ply")
    cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": 44.0}
    cell.world_settings.update(white_at_us=8000, material=MATERIAL, shading="pixel", interreflection=False)
    if fine is not None:
        width_px, height_px = fine.size_px
        sensor = {"width_px": width_px, "height_px": height_px, "pixel_pitch_um": fine.pitch_um}
        cell.rig_data["sensor"] |= {**sensor, "max_frames_per_s": 1.0}
        cell.rig_data["robot"]["settings"]["link_timeout_s"] = PATIENCE_S
        cell.rig_data["ledbox"]["settings"]["watchdog_s"] = PATIENCE_S
        cell.world_settings["camera"] = {"kind": "memory", "sensor": {"prnu": 0.0}}
    views = OLD_VIEWS if fine is None else FINE_VIEWS
    cell.write(views=list(views), lights={"kind": "every", "every": every}, darks_per_view=2)
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(outcome.err)
    return cell.run_folder


def _colours(vertices_mm: NDArray[np.float64], waves: int) -> NDArray[np.uint8]:
    """[n, 3] sRGB of the vertices."""
    x, y, z = vertices_mm.T
    along = (x + 0.5 * y, y - 0.3 * x, 0.7 * x + 0.7 * y + 2.0 * z)
    phases = [2 * np.pi * s / w for s, w in zip(along, WAVES_MM, strict=True)]
    linear = MIDDLE + HALF * np.sin(np.stack(phases if waves == 3 else phases[:1] * 3, axis=1))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    codes: NDArray[np.uint8] = np.round(255 * srgb).astype(np.uint8)
    return codes


def _say(step: str, done_count: int, of: int) -> None:
    if done_count == of:
        print(f"{time.strftime('%H:%M:%S')} {step}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
