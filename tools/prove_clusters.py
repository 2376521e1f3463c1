"""Clusters of an object whose reflectance varies everywhere, compared with the triangles' own materials in
pictures.

    python tools/prove_clusters.py [--finer 1] [--clusters N ...] [--waves 1|3] [--every 12]

The shipped relief is rendered with colours that run over it continuously, in two views of 512 x 384 pixels: from
bright ochre to a third of it in one wave, as a patina has it, or each channel by itself in three. 1,000 clusters
are those of the paper, for 416,859 triangles (seed 003, Fig. 6); here they serve 16,000, and with `--finer 5`
395,000 (a quarter of an hour). One cluster for 417 triangles, the paper's share, is told too.
Errors are means over blocks of 2 x 2 pixels under LEDs left out, as the paper's. Exits with 1 if 1,000 clusters
miss more than 1.3 times what the triangles' own materials miss.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

from coupole.reflectance.run_clusters import cluster_result  # noqa: E402
from coupole.reflectance.run_job import RunRequest, reflectance_of  # noqa: E402
from coupole.reflectance.run_result import RunResult  # noqa: E402
from make_relief import relief  # noqa: E402
from reflectance_cells import OLD_VIEWS  # noqa: E402

CLUSTERS, TRIANGLES_FOR_EACH, MOST_RATIO = 1000, 417, 1.3
MATERIAL = {"diffuse": (0.7, 0.7, 0.7), "f0": (0.05, 0.05, 0.05), "roughness": 0.3}
WAVES_MM = (90.0, 60.0, 45.0)
"""Periods of the three colours' waves over the object; of a single one the first."""
MIDDLE, HALF = np.array([0.60, 0.50, 0.38]), np.array([0.30, 0.25, 0.19])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--finer", type=int, default=1, help="edges of triangles and pixels are a so many-th")
    parser.add_argument("--clusters", type=int, nargs="*", default=[], help="numbers to try besides")
    parser.add_argument("--waves", type=int, choices=(1, 3), default=1, help="of colour")
    parser.add_argument("--every", type=int, default=12, help="LEDs are lit, of the dome's 1080")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="coupole-clusters-") as folder:
        result = _result(Path(folder), arguments.every, arguments.waves, arguments.finer)
        fitted = int(np.isfinite(RunResult(result).materials("ggx_normal").alpha).sum())
        ratios = {}
        for count in sorted({fitted // TRIANGLES_FOR_EACH, CLUSTERS, *arguments.clusters}):
            told = cluster_result(result, count, 2_000_000_000)
            ratios[count] = told["mae_ratio"]
            mae = " ".join(f"{name} {1e2 * value:.3f} %" for name, value in told["mae"].items() if value)
            print(f"{count} clusters for {fitted} triangles: {mae}; ratio {told['mae_ratio']:.3f}", flush=True)
    return int(ratios[CLUSTERS] > MOST_RATIO)


def _result(folder: Path, every: int, waves: int, finer: int) -> Path:
    """Of a run of the coloured relief."""
    mesh = trimesh.Trimesh(*relief(finer), process=False)
    x, y, z = np.asarray(mesh.vertices).T
    along = (x + 0.5 * y, y - 0.3 * x, 0.7 * x + 0.7 * y + 2.0 * z)
    phases = [2 * np.pi * s / w for s, w in zip(along, WAVES_MM, strict=True)]
    linear = MIDDLE + HALF * np.sin(np.stack(phases if waves == 3 else phases[:1] * 3, axis=1))
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    mesh.visual.vertex_colors = np.round(255 * srgb).astype(np.uint8)
    mesh.export(folder / "coloured.ply")
    (folder / "cell").mkdir()
    cell = cells.CellFolder(folder / "cell", speed=10.0 / finer**2, write_now=False)
    cell.plan_data["object"]["mesh"] = str(folder / "coloured.ply")
    size = {"width_px": 512 * finer, "height_px": 384 * finer, "pixel_pitch_um": 44.0 / finer}
    cell.rig_data["sensor"] |= size
    cell.world_settings.update(white_at_us=8000, material=MATERIAL, shading="pixel", interreflection=False)
    cell.write(views=list(OLD_VIEWS), lights={"kind": "every", "every": every}, darks_per_view=2)
    ended = cell.acquire()
    if ended.code:
        raise RuntimeError(ended.err)
    records = tuple(sorted((ROOT / "configs/calibrations").glob("*.yaml")))
    reflectance_of(RunRequest((cell.run_folder,), calibrations=records), folder / "result")
    return folder / "result"


if __name__ == "__main__":
    sys.exit(main())
