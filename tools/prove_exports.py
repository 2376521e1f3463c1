"""Measures the losses of exports of a result: pixels are relit from each file, and compared with the result.

    python tools/prove_exports.py [RESULT] [--pixels 4000] [--write]

Without RESULT, a result is made from a run of a glossy relief in the simulated cell.

Pixels of the measured views are lit by a dozen distant lights each. Files are read by tests/export_readers: by
other libraries or, if there are none, by their documented layout. Their models (glTF 2.0 appendix B with
KHR_materials_specular, OpenPBR as MaterialX 1.39 builds it) are implemented there independently. White under a
light from above has the value 1. Tables of single materials are made for eight triangles; samples are compared
with those of the result. `--write` puts the table into docs/reference/exports.md. Exits with 1 if the loss of a
format exceeds the `MOST_LOST` of its reader.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from rich.console import Console

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/runs")]

from export_readers import readers_with  # noqa: E402
from export_readers.lit_models import (  # noqa: E402
    Lit,
    Materials,
    ggx,
    lab_differences,
    lit_pixels,
    relative_errors,
    true_light,
    unit,
)
from relief_cells import DIFFUSE, F0, RECORDS, ROUGHNESS, shipped_cell  # noqa: E402

from coupole.exchange.of_results.export_result import export_result  # noqa: E402
from coupole.exchange.of_results.measured_surface import ExportChoice, MeasuredSurface, read_surface  # noqa: E402
from coupole.reflectance.run_job import RunRequest, reflectance_of  # noqa: E402
from smallest import add_smallest  # noqa: E402

TRIANGLES = 8
ADAPTIVE = {"bsdf": 0.003}
"""Wanted error of a second, adaptive table of a format, for 95 % of the directions."""
DOCUMENT, BEGIN, END = ROOT / "docs/reference/exports.md", "<!-- figures -->\n", "<!-- end of figures -->\n"
Row = tuple[np.ndarray, np.ndarray, float]
"""Values from the file and expected values, [n, 3] or [n, 1], and the relative error that 95 % of them may
have."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, nargs="?")
    parser.add_argument("--pixels", type=int, default=4000)
    parser.add_argument("--write", action="store_true", help="put the table into the documentation")
    add_smallest(parser, pixels=100)
    arguments = parser.parse_args()
    lines = ["| `--to` | relative error, median | 95 % | dE00, mean | 95 % |", "|---|---|---|---|---|"]
    too_much = []
    with tempfile.TemporaryDirectory(prefix="coupole-exports-") as name:
        result = arguments.result or _make_result(Path(name))
        for to, (exported_values, true_values, most) in _compare_exports(
            result, Path(name), arguments.pixels
        ).items():
            median, high = np.quantile(relative_errors(exported_values, true_values), [0.5, 0.95])
            cells = ("", "")
            if true_values.shape[1] == 3:
                finite = np.isfinite(exported_values).all(axis=1)
                colours = lab_differences(exported_values[finite], true_values[finite])
                cells = (f"{colours.mean():.3f}", f"{np.quantile(colours, 0.95):.3f}")
            lines.append(f"| `{to}` | {median:.1e} | {high:.1e} | {cells[0]} | {cells[1]} |")
            if high > most:
                too_much.append(f"{to}: 95 % of the values are off by up to {high:.1e}, more than {most:g}")
    table = "\n".join(lines) + "\n"
    print(table, end="")
    if arguments.write:
        before, _, rest = DOCUMENT.read_text().partition(BEGIN)
        DOCUMENT.write_text(before + BEGIN + table + END + rest.partition(END)[2])
    print("".join(f"{line}\n" for line in too_much), end="", file=sys.stderr)
    return int(bool(too_much))


def _make_result(folder: Path) -> Path:
    cell = shipped_cell(folder, material={"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS})
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(outcome.err)
    records = tuple(sorted(RECORDS.glob("*.yaml")))
    reflectance_of(RunRequest((cell.run_folder,), calibrations=records), folder / "result")
    return folder / "result"


def _compare_exports(result: Path, folder: Path, count: int) -> dict[str, Row]:
    console = Console(stderr=True)
    surface = read_surface(result)
    random = np.random.default_rng(1)
    lit = lit_pixels(surface, count, random)
    true_values = true_light(surface, lit)
    sampled_triangles = tuple(
        map(int, random.choice(np.flatnonzero(surface.has_material), TRIANGLES, replace=False))
    )
    row_of_export: dict[str, Row] = {}
    for to, reader in readers_with("relit").items():
        with console.status(to):
            export_result(result, to, folder / to)
            row_of_export[to] = reader.relit(folder / to, lit), true_values, reader.MOST_LOST
    for to, reader in readers_with("evaluate").items():
        for most_error in (None, ADAPTIVE[to]) if to in ADAPTIVE else (None,):
            name = to if most_error is None else f"{to} --adaptive {most_error}"
            with console.status(name):
                export_result(result, to, folder / name, options=ExportChoice(sampled_triangles, most_error))
                rows = [_of_table(surface, folder / name, n, reader, random) for n in sampled_triangles]
                values, true = (np.concatenate(part) for part in zip(*rows, strict=True))
                row_of_export[name] = values, true, reader.MOST_LOST
    for to, reader in readers_with("values").items():
        export_result(result, to, folder / to, options=ExportChoice(sampled_triangles))
        values, true = _of_samples(surface, folder / to, sampled_triangles, reader)
        row_of_export[to] = values, true, reader.MOST_LOST
    return row_of_export


def _of_table(
    surface: MeasuredSurface, folder: Path, number: int, reader: Any, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    ways = unit(random.normal(size=(2, 4000, 3)))
    ways[..., 2] = np.abs(ways[..., 2])
    light, camera = ways[:, (ways[..., 2] > 0.2).all(axis=0)][:, :1000]
    up = np.tile([0.0, 0.0, 1.0], (len(light), 1))
    material = [
        np.repeat(values[number][None], len(light), 0) for values in (surface.kd, surface.ks, surface.alpha)
    ]
    nothing = np.zeros(len(light), np.int64)
    true_values = ggx(Materials(up, *material), Lit(nothing, light, camera, nothing, nothing, nothing))
    (path,) = folder.glob(f"triangle{number}.*")
    return reader.evaluate(path, light, camera), true_values


def _of_samples(
    surface: MeasuredSurface, folder: Path, chosen_triangles: tuple[int, ...], reader: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Return each value beside the nearest value of the result, [n, 1], because neither file says which LED a
    sample is from."""
    exported_values, true_values = [], []
    for number in chosen_triangles:
        for channel, name in enumerate(("red", "green", "blue")[: surface.result.channels]):
            f = []
            for view in surface.result.views:
                if number in view.triangles:
                    with h5py.File(view.path, "r") as file:
                        f.append(file["f"][int(np.searchsorted(view.triangles, number)), :, channel])
            sample_values = np.sort(np.concatenate(f))
            sample_values = sample_values[np.isfinite(sample_values)]
            (path,) = folder.glob(f"triangle{number}_{name}.*")
            values = reader.values(path)
            after = np.clip(np.searchsorted(sample_values, values), 1, len(sample_values) - 1)
            nearest = np.where(
                values - sample_values[after - 1] < sample_values[after] - values,
                sample_values[after - 1],
                sample_values[after],
            )
            exported_values.append(values)
            true_values.append(nearest)
    return np.concatenate(exported_values)[:, None], np.concatenate(true_values)[:, None]


if __name__ == "__main__":
    sys.exit(main())
