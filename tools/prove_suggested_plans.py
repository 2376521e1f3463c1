"""Proves what `coupole plan suggest` promises, by runs of the suggested plans in the simulated cell.

    python tools/prove_suggested_plans.py [--cases N] [--budget TIME] [--keep FOLDER]

There are three meshes, each with one of the assumed materials. For each, a plan is suggested and acquired, and its
reflectance is fitted, by the user's commands. The medians of the stated uncertainties of the result are compared
with the promised ones. The share of the mesh's triangles that got a material is shown beside the promised share.
The rendered highlights have Fresnel's term. LEDs and arm are at their true positions, which differ from those in
the records. Exits with 1 unless each ratio is within a fifth of 1; not with `--smallest`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT)]

from coupole.reflectance.suggestion.supposed_materials import SUPPOSED  # noqa: E402
from coupole.scan.simplify import simplified_mesh  # noqa: E402
from smallest import add_smallest  # noqa: E402

CASES = (("relief", "objects/relief.ply", "glossy", None), ("plaque", "objects/plaque.ply", "metal", 15_000),
         ("bust", "restorations/bust.ply", "matt", None))  # fmt: skip
"""Name, mesh, material, and largest number of triangles. The plaque's triangles are smaller than the pixels of the
simulated cell, so its mesh is simplified."""
MOST_OFF = 0.2
CONFIGS = ROOT / "configs"
FIGURES = ("normal_deg", "kd_percent", "ks_percent", "alpha_percent")


def write_cell(folder: Path, mesh: str, material: str, most_triangles: int | None) -> None:
    """Write the simulated cell with an object of one material, and the object's mesh without colours."""
    material_values, pi = SUPPOSED[material], 3.141592653589793
    colour, f0 = [round(material_values.kd * pi, 4)] * 3, [material_values.ks] * 3
    settings = f"    material: {{diffuse: {colour}, f0: {f0}, roughness: {material_values.alpha}}}\n"
    text = (CONFIGS / "rigs" / "sim.yaml").read_text()
    text = text.replace("../domes", str(CONFIGS / "domes")).replace("../../runs", str(folder / "runs"))
    place = text.index("    white_at_us:")
    (folder / "rig.yaml").write_text(text[:place] + settings + text[place:])
    whole = trimesh.load(CONFIGS / mesh, process=False)
    vertices_mm, triangles = np.asarray(whole.vertices, np.float64), np.asarray(whole.faces, np.int64)
    if most_triangles is not None:
        vertices_mm, triangles = simplified_mesh(vertices_mm, triangles, most_triangles)
    trimesh.Trimesh(vertices_mm, triangles, process=False).export(folder / "object.ply")


def coupole(folder: Path, *arguments: str) -> dict[str, Any]:
    """Return a function that runs a command in the folder and returns its JSON."""
    command = [sys.executable, "-m", "coupole", *arguments, "--json"]
    process = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if process.returncode:
        words = process.stderr[-2000:] or process.stdout[-2000:]
        sys.exit(f"{' '.join(arguments)} ended with {process.returncode}: {words}")
    document: dict[str, Any] = json.loads(process.stdout)
    return document


def rehearse(
    folder: Path, mesh: str, material: str, most_triangles: int | None, budget: str, *options: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the promised figures of one case, and the content of `result.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    write_cell(folder, mesh, material, most_triangles)
    promised_figures = coupole(
        folder, "plan", "suggest", "object.ply", "--rig", "rig.yaml", "--calibrations",
        str(CONFIGS / "calibrations"),
        "--material", material, "--budget", budget, *options,
    )  # fmt: skip
    run = coupole(folder, "acquire", "object.yaml")["run"]
    result_figures = coupole(folder, "reflectance", run, "--out", "result")
    return promised_figures, result_figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--cases", type=int, default=len(CASES), help="so many of the cases")
    parser.add_argument("--budget", default="1min", help="of each plan")
    parser.add_argument("--views", type=int, default=24, help="views of each plan, at most")
    parser.add_argument("--keep", type=Path, help="folder for plans, runs and results; otherwise they are removed")
    add_smallest(parser, cases=1, budget="20s", views=2)
    options = parser.parse_args()
    table, is_off = Table("object", "material", "views, LEDs", "known", *FIGURES, box=None), False
    with tempfile.TemporaryDirectory(prefix="coupole-suggested-") as folder:
        for name, mesh, material, most_triangles in CASES[: options.cases]:
            of_case = (options.keep or Path(folder)) / name
            promised_figures, result_figures = rehearse(
                of_case, mesh, material, most_triangles, options.budget, "--views", str(options.views)
            )
            stated_figures = result_figures["material_uncertainty"]["ggx_normal"]
            triangles = len(trimesh.load(of_case / "object.ply", process=False).faces)
            known_share = (result_figures["triangles"] - result_figures["not_fitted"]) / triangles
            pairs = [(promised_figures["expected"][material][key], stated_figures[key]) for key in FIGURES]
            ratios = [promise / result for promise, result in pairs]
            is_off |= any(abs(ratio - 1.0) > MOST_OFF for ratio in ratios)
            cells = [
                f"{promise:.3g} / {result:.3g} = {ratio:.2f}"
                for (promise, result), ratio in zip(pairs, ratios, strict=True)
            ]
            size = f"{len(promised_figures['views'])}, {promised_figures['leds']}"
            known_words = f"{promised_figures['known_share']:.1%} / {known_share:.1%}"
            table.add_row(name, material, size, known_words, *cells)
    Console(soft_wrap=True, width=200).print(table, "promised / stated by the result", sep="\n")
    return int(is_off and not options.smallest)


if __name__ == "__main__":
    sys.exit(main())
