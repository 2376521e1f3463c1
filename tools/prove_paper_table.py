"""The paper's table of uncertainty (Lucat et al. 2025, 6.1) beside ours, on a simulated cell with the paper's
uncertainties.

    python tools/prove_paper_table.py [--every 20] [--material layered] [--depth 0.8] [--json]

A relief of triangles with edges of 0.36 mm is rendered with pixels of 47 um, in a part of the real camera's field.
It is evaluated with records whose errors are drawn from the paper's figures: camera 0.3 mm and LEDs 0.7 mm (each
in all directions together), their normals 0.21 degrees, the mesh's position 0.1 mm, its vertices 30 um. It is
evaluated again with a scanner of 20 um, and with this scanner and a camera with less noise.

For each case, the table at 68 % is printed by source, with the share of samples whose intervals contain the truth.
The exit code is 1 if the intervals of 68 % contain less than 63 or more than 73 %, or those of 95 % less than 92
or more than 98 %. With `--smallest` the shares are not meaningful, and the exit code is 0.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

import reflectance_cells as loop  # noqa: E402
from coupole.appearance.shapes.solids import relief  # noqa: E402
from coupole.reflectance.run_job import RunRequest, extract_runs  # noqa: E402
from coupole.reflectance.run_result import RunResult  # noqa: E402
from coupole.reflectance.run_uncertainty import QUANTILE, TABLE_QUANTILE, known_samples, uncertainty_of  # noqa: E402
from coupole.reflectance.sample_uncertainty import bounds  # noqa: E402
from drawn_records import Scale, draw_records  # noqa: E402
from sim.objects.specimens import SPECIMENS  # noqa: E402
from sim.optics.sensor_model import SensorModel  # noqa: E402
from smallest import add_smallest  # noqa: E402

PITCH_UM, SIZE_MM, TRIANGLES, DEPTH_MM = 5.5, 22.0, 8_600, 0.8
EACH = 3.0**-0.5
"""Factor from an uncertainty in all directions together to that in each direction."""
CAMERA_MM, LED_MM, LED_NORMAL_DEG, MESH_MM = 0.3 * EACH, 0.7 * EACH, 0.21 * 2**-0.5, 0.1 * EACH
QUIET = SensorModel(full_well_e=135_000.0, read_noise_e=3.0)
"""Noise of a quieter camera: ten times the electrons, and a fourth of the noise in the dark."""
LEVELS = {"68": TABLE_QUANTILE, "95": QUANTILE}
HELD = {"68": (0.63, 0.73), "95": (0.92, 0.98)}
"""Limits of the shares. All samples share one draw of lens, camera and mesh, so shares scatter more than their
number suggests."""
VIEW = {**cells.TOP, "target_mm": [0, 0, 2]}
_SAMPLES = 60_000


@dataclass(frozen=True)
class Case:
    """A cell of the table, with the paper's value."""

    name: str
    vertex_um: float
    sensor: SensorModel
    paper: str


CASES = (
    Case("scanner 30 um", 30.0, SensorModel(), "[-10.7, +14.0], 95th [-15.2, +22.4]"),
    Case("scanner 20 um", 20.0, SensorModel(), "[-8.1, +9.5]"),
    Case("scanner 20 um, low-noise camera", 20.0, QUIET, "less than 3.6"),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=20, help="LEDs are lit, of the dome's 1080")
    parser.add_argument("--material", choices=list(SPECIMENS), default="layered")
    parser.add_argument("--depth", type=float, default=DEPTH_MM, help="of the relief, mm")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--triangles", type=int, default=TRIANGLES, help="of the relief")
    parser.add_argument("--cases", type=int, default=len(CASES), help="so many of the table")
    add_smallest(parser, every=90, triangles=800, cases=1)
    arguments = parser.parse_args()
    cases = []
    for case in CASES[: arguments.cases]:
        with tempfile.TemporaryDirectory(prefix="coupole-table-") as folder:
            run_folder = _acquire(Path(folder), case, arguments)
            cases.append(_of(case, Path(folder), run_folder, arguments.seed))
    if arguments.json:
        print(json.dumps(cases))
    else:
        _print(cases)
    share_and_bounds = [(case_figures["held"][level], *HELD[level]) for case_figures in cases for level in LEVELS]
    return int(not arguments.smallest and not all(low <= share <= high for share, low, high in share_and_bounds))


def _of(case: Case, folder: Path, acquisition: loop.Acquired, seed: int) -> dict[str, Any]:
    scale = Scale(LED_MM, LED_NORMAL_DEG, CAMERA_MM, PITCH_UM, sensor=case.sensor)
    records = draw_records(folder / "records", seed, scale)
    random = np.random.default_rng((seed, 5))
    scan = trimesh.load(acquisition.mesh, process=False)
    scan.vertices = scan.vertices + 1e-3 * case.vertex_um * random.standard_normal(scan.vertices.shape)
    scan.vertices = scan.vertices + MESH_MM * random.standard_normal(3)
    scan.export(folder / "scan.ply")
    request = RunRequest((acquisition.old,), folder / "scan.ply", records, scan_noise_um=case.vertex_um)
    extract_runs(request, folder / "result")
    result, truth = RunResult(folder / "result"), loop.Truth.of(acquisition, folder / "result")
    table = uncertainty_of(result, case.vertex_um, paper=False)
    assert table is not None
    return {**asdict(case), "table": table, "held": _inside_shares(result, truth, case.vertex_um)}


def _acquire(folder: Path, case: Case, options: argparse.Namespace) -> loop.Acquired:
    side_mm = SIZE_MM * (options.triangles / TRIANGLES) ** 0.5  # the edges of the triangles stay unchanged
    mesh = trimesh.Trimesh(*_weld(relief(side_mm, options.triangles, options.depth, 1)), process=False)
    mesh.export(folder / "object.ply")
    (folder / "cell").mkdir()
    cell = cells.CellFolder(folder / "cell", speed=10.0, write_now=False)
    cell.plan_data["object"]["mesh"] = str(folder / "object.ply")
    cell.rig_data["sensor"] |= {"width_px": 512, "height_px": 384, "pixel_pitch_um": PITCH_UM}
    sensor = {"full_well_e": case.sensor.full_well_e, "read_noise_e": case.sensor.read_noise_e}
    cell.world_settings.update(white_at_us=8000, material={"specimen": options.material}, shading="pixel")
    cell.world_settings.update(interreflection=False, camera={"kind": "memory", "sensor": sensor})
    cell.write(views=[VIEW], lights={"kind": "every", "every": options.every}, darks_per_view=8)
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(outcome.err)
    return loop.Acquired(options.material, cell.run_folder, cell.run_folder, folder / "object.ply")


def _weld(corners_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of triangles [n, 3, 3]."""
    places, faces = np.unique(corners_mm.reshape(-1, 3).round(6), axis=0, return_inverse=True)
    return places, faces.reshape(-1, 3)


def _inside_shares(result: RunResult, truth: loop.Truth, vertex_um: float) -> dict[str, float]:
    """Return the share of samples of all channels whose intervals contain the truth."""
    (view,) = result.views
    inside = {level: [0, 0] for level in LEVELS}
    for channel in range(result.channels):
        samples = known_samples(result, view, channel, vertex_um, most=_SAMPLES, of_triangles=len(view.triangles))
        true = truth.reflectance(view.view, view.triangles[samples.rows], view.leds[samples.leds])[:, channel]
        ratio = true / samples.f
        for level, quantile in LEVELS.items():
            low, high = bounds(samples.places, samples.sources, quantile)
            good = np.isfinite(ratio)
            inside[level][0] += int(np.count_nonzero((ratio > low) & (ratio < high) & good))
            inside[level][1] += int(good.sum())
    return {level: n / of for level, (n, of) in inside.items()}


def _print(case_figures: list[dict[str, Any]]) -> None:
    console = Console(soft_wrap=True)
    for case in case_figures:
        table = Table(case["name"], "median, %", "95th, %", "less by, median and 95th", box=None)
        whole = case["table"]["monte_carlo"]
        for name, row in ({"all sources": whole} | case["table"]["without"]).items():
            less = [1.0 - _width(row[key]) / _width(whole[key]) for key in ("median", "percentile_95")]
            reduction = "" if row is whole else f"{100 * less[0]:.1f} % {100 * less[1]:.1f} %"
            label = name if row is whole else f"without {name}"
            table.add_row(label, _interval(row["median"]), _interval(row["percentile_95"]), reduction)
        table.add_row("the paper", case["paper"])
        console.print(table)
        shares = case["held"]
        console.print(f"hold the truth: 68 %: {100 * shares['68']:.1f} %, 95 %: {100 * shares['95']:.1f} %\n")


def _width(interval: list[float]) -> float:
    return interval[1] - interval[0]


def _interval(values: list[float]) -> str:
    return f"[{values[0]:+.1f}, {values[1]:+.1f}]"


if __name__ == "__main__":
    sys.exit(main())
