"""Checks the closed loop of reflectance over many simulated cells, with materials whose models the fit does not
have.

    python tools/prove_reflectance.py [--draws 3] [--materials NAME ...] [--every 12] [--keep FILE] [--json]

Each material (`sim.objects.specimens`) is rendered in two views and a further one. Each cell has calibrations that
are drawn from the covariances of records (`drawn_records`), and a scan with errors of one of three kinds
(`reflectance_cells.SCANS`).

For each material, four figures are printed: the share of samples whose 95 % intervals contain the truth, by
channel and third of the angle of incidence; the error of the fitted normals relative to that of the scan; the mean
errors of fits under LEDs that were left out; and the error of GGX in the further view relative to that in the
others. The file `--keep` gets a line for each cell; a later call computes only missing cells.

The exit code is 1 unless all of the following hold: intervals contain the truth in 90 to 99 % of the cases; the
error of the normals (rms over all cells) is at most half of the scan's, and for no material larger than the
scan's; radial functions of GGX's residual have at most the error of harmonics and of radial functions; the error
in the further view is at most 1.5 times that in the others. With `--smallest` the figures are not meaningful, and
the exit code is 0.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from reflectance_cells import SCANS, THIRDS_DEG, Judged, acquire, judge
from sim.objects.specimens import SPECIMENS
from smallest import add_smallest

HELD, HALF, NEW_VIEW = (0.90, 0.99), 0.5, 1.5


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=3, help="cells of each material and kind of scan")
    parser.add_argument("--materials", nargs="+", choices=list(SPECIMENS), default=list(SPECIMENS))
    parser.add_argument("--every", type=int, default=12, help="LEDs are lit, of the dome's 1080")
    parser.add_argument("--keep", type=Path, help="file of finished cells, which are not done again")
    parser.add_argument("--json", action="store_true")
    add_smallest(parser, draws=1, materials=["layered"], every=40)
    arguments = parser.parse_args()
    judgement_of_cell = {} if arguments.keep is None else _kept_verdicts(arguments.keep, arguments.every)
    all_cells = [(m, scan, seed) for m in arguments.materials for scan in SCANS for seed in range(arguments.draws)]
    for material in arguments.materials:
        missing = [cell for cell in all_cells if cell[0] == material and cell not in judgement_of_cell]
        for cell, judgement in _judge_missing(material, missing, arguments.every):
            judgement_of_cell[cell] = judgement
            if arguments.keep is not None:
                with arguments.keep.open("a") as file:
                    line = {"cell": cell, "every": arguments.every, "judged": judgement}
                    file.write(json.dumps(line) + "\n")
            print(f"{' '.join(map(str, cell))}: done", file=sys.stderr, flush=True)
    verdicts = [
        verdict(m, [judgement_of_cell[cell] for cell in all_cells if cell[0] == m]) for m in arguments.materials
    ]
    faults = [
        fault for verdict_of_material in verdicts for fault in verdict_of_material["faults"]
    ] + _faults_of_all(verdicts)
    if arguments.json:
        print(json.dumps({"materials": verdicts, "faults": faults}))
    else:
        _print(verdicts, faults, len(all_cells))
    return int(bool(faults) and not arguments.smallest)


def verdict(material: str, cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all cells of a material together, and the limits that they violate."""
    counts = np.sum([cell["inside"] for cell in cells], axis=0)
    inside = counts[..., 0] / np.maximum(counts[..., 1], 1)
    fitted_deg, scanned_deg = _rms(cells, "fitted_deg"), _rms(cells, "scanned_deg")
    mae = {name: float(np.mean([cell["mae"][name] for cell in cells])) for name in cells[0]["mae"]}
    new = float(np.mean([cell["new_view"] / cell["old_view"] for cell in cells]))
    faults = [
        f"{channel}, {low:g} to {high:g} degrees: {share:.1%} of the intervals hold the truth"
        for channel, row in zip("RGB", inside, strict=True)
        for share, low, high in zip(row, THIRDS_DEG[:-1], THIRDS_DEG[1:], strict=True)
        if not HELD[0] <= share <= HELD[1]
    ]
    if fitted_deg > scanned_deg:
        faults.append(f"normals are off by {fitted_deg:.2f} degrees, the scan's by {scanned_deg:.2f}")
    if mae["ggx_rbf"] > min(mae["sh"], mae["rbf"]):
        faults.append("GGX with radial functions misses more than harmonics or radial functions alone")
    if new > NEW_VIEW:
        faults.append(f"a new view is missed by {new:.2f} times the others")
    inside_counts = [cell["normals_inside"] for cell in cells]
    return {
        "material": material,
        "cells": len(cells),
        "inside": inside.tolist(),
        "scanned_deg": scanned_deg,
        "fitted_deg": fitted_deg,
        "normals_inside": sum(n for n, _ in inside_counts) / sum(of for _, of in inside_counts),
        "mae": mae,
        "new_over_old_view": new,
        "faults": [f"{material}: {fault}" for fault in faults],
    }


def _judge_missing(
    material: str, missing: list[tuple[str, str, int]], every: int
) -> Iterable[tuple[tuple[str, str, int], dict[str, Any]]]:
    if not missing:
        return
    with tempfile.TemporaryDirectory(prefix="coupole-loop-") as folder:
        acquisition = acquire(Path(folder), material, every=every)
        for cell in missing:
            _, scan, seed = cell
            place = Path(folder) / f"{scan}-{seed}"
            place.mkdir()
            judgement: Judged = judge(acquisition, scan, seed, place)
            yield cell, judgement.line()


def _faults_of_all(verdicts: list[dict[str, Any]]) -> list[str]:
    fitted_deg, scanned_deg = _rms(verdicts, "fitted_deg"), _rms(verdicts, "scanned_deg")
    if fitted_deg <= HALF * scanned_deg:
        return []
    return [
        f"all materials: normals are off by {fitted_deg:.2f} degrees, "
        f"more than half of the scan's {scanned_deg:.2f}"
    ]


def _rms(verdicts: list[dict[str, Any]], name: str) -> float:
    return float(np.sqrt(np.mean([figures[name] ** 2 for figures in verdicts])))


def _kept_verdicts(path: Path, every: int) -> dict[tuple[str, str, int], dict[str, Any]]:
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    return {tuple(line["cell"]): line["judged"] for line in lines if line["every"] == every}


def _print(verdicts: list[dict[str, Any]], faults: list[str], cells: int) -> None:
    console = Console(soft_wrap=True)
    thirds = [f"{low:g}-{high:g}" for low, high in pairwise(THIRDS_DEG)]
    table = Table("material", *(f"in, {third}" for third in thirds), "normals", "in", "mae: GGX, SH, RBF, GGX+RBF",
                  "new view", box=None)  # fmt: skip
    for material_verdict in verdicts:
        shares = np.array(material_verdict["inside"])
        mae = " ".join(
            f"{1e2 * material_verdict['mae'][name]:.2f}" for name in ("ggx_normal", "sh", "rbf", "ggx_rbf")
        )
        table.add_row(
            material_verdict["material"],
            *(f"{1e2 * column.min():.1f}-{1e2 * column.max():.1f} %" for column in shares.T),
            f"{material_verdict['fitted_deg']:.2f} of {material_verdict['scanned_deg']:.2f} deg",
            f"{1e2 * material_verdict['normals_inside']:.1f} %",
            f"{mae} %",
            f"{material_verdict['new_over_old_view']:.2f}",
        )
    console.print(table)
    for fault in faults:
        console.print(fault, style="red")
    console.print(f"{cells} cells: " + ("all limits kept" if not faults else f"{len(faults)} limits not kept"))


if __name__ == "__main__":
    sys.exit(main())
