"""Measures texels of single pixels and of sizes in mm on rendered objects with painted detail.

    python tools/prove_texels.py [--sizes auto 0.8 1.6] [--objects ridge ...] [--object-sizes auto 0.1] [--json]

The relief (`tests/runs/relief_cells.py`: waves of paint of 2.4 mm and of bumps of 6 mm, which its mesh does not
have) is acquired in two views and evaluated; texels of each size are made in a separate process.

For each size, the following is printed: the width of texels and pixels; the median error of kd and normals, and
the share of 95 % intervals that contain the truth, which for a texel is the mean over its pixels; the error of
pictures under LEDs that were left out, beside that of the best fit of triangles in the same pixels, and the share
of their 95 % intervals that contain the truth; and seconds, memory and disk, with the forecast of each.

Then five small objects are acquired (`painted_objects.py`: paint and bumps of 0.2 to 1 mm on triangles of 0.3 mm,
pixels of 0.05 mm). For each object and size, the following is printed: the share of 95 % intervals of kd and of
tilts that contain the truth, by strata; how many dB pictures of left-out LEDs are better than by the best fit of
triangles, and which fit `relight` takes; and the contrast of a pattern of 5 lines per mm in these pictures,
relative to that in the frames, for texels and for triangles.

With `--coarse MM`, each object is also evaluated on a mesh of triangles of that width (`coarse_meshes.py`), and
pictures of left-out LEDs by its texels are compared with those on the object's mesh of 0.3 mm triangles.

The exit code is 1 if less than 80 % of the intervals of kd of the relief contain the truth, if the forecast of
memory was too small by more than half, or if an object has less than it must: 90 % of the intervals in a stratum
of at least 500 texels and, with single pixels and paint, 3 dB and four fifths of the contrast. `relight` must take
what is better. On a coarse mesh, pictures may be 1 dB worse. More than 99 % of the intervals are told, as these
are too wide. With `--smallest` the figures are not meaningful, and the exit code is 0.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import re
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "tests/runs")]

from relief_cells import DETAIL, DIFFUSE, F0, ROUGHNESS, shipped_cell  # noqa: E402
from texel_truth import seen_by_texels  # noqa: E402

from coarse_meshes import faults_of_coarse, judge_coarse, print_coarse  # noqa: E402
from coupole.commands.texels_told import read_size  # noqa: E402
from coupole.reflectance.fits import TEXELS  # noqa: E402
from coupole.reflectance.ggx import tangents  # noqa: E402
from coupole.reflectance.new_light.light_kinds import LedLight  # noqa: E402
from coupole.reflectance.run_intervals import half_width_of_picture  # noqa: E402
from coupole.reflectance.run_job import reflectance_of  # noqa: E402
from coupole.reflectance.run_relighting import scene_of_view  # noqa: E402
from coupole.reflectance.run_result import VARIANCES, RunResult, ViewSamples  # noqa: E402
from coupole.reflectance.texels.pixel_file import FOLDER, read_view_texels, texel_uncertainty  # noqa: E402
from coupole.reflectance.texels.texel_check import WIDENED_BY_EVERY, held_out_pictures  # noqa: E402
from coupole.reflectance.texels.texel_forecast import foresee_texels  # noqa: E402
from coupole.reflectance.texels.texel_job import add_texels  # noqa: E402
from drawn_records import draw_records  # noqa: E402
from judged_texels import Acquired, acquire_painted, faults_of_painted, judge_painted, print_painted  # noqa: E402
from painted_objects import OBJECTS  # noqa: E402
from smallest import add_smallest  # noqa: E402

LEAST_HELD, MOST_OVER = 0.80, 1.5
_QUANTILE = 1.96


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--sizes", nargs="*", default=["auto", "0.8", "1.6"], help="as --texels takes them; of the relief"
    )
    parser.add_argument("--every", type=int, default=24, help="LEDs are lit, of the dome's 1080")
    parser.add_argument("--objects", nargs="*", choices=list(OBJECTS), default=list(OBJECTS))
    parser.add_argument("--object-sizes", nargs="+", default=["auto", "0.1"], help="as --texels takes them")
    parser.add_argument(
        "--coarse", nargs="+", type=float, default=[], metavar="MM", help="edges of coarse meshes of the objects"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the world of the objects")
    parser.add_argument("--json", action="store_true")
    add_smallest(parser, sizes=["1.6"], every=48, objects=["ridge"], object_sizes=["0.2"], coarse=[2.0])
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="coupole-texels-") as folder:
        relief_run = acquire(Path(folder) / "relief", arguments.every) if arguments.sizes else None
        rows = [judge(relief_run, size) for size in arguments.sizes if relief_run is not None]
        painted_rows, coarse_rows = [], []
        for name in arguments.objects:
            object_run = acquire_painted(Path(folder) / name, name, every=arguments.every, seed=arguments.seed)
            for size in arguments.object_sizes:
                out = shutil.copytree(object_run.result, Path(folder) / f"{name}-{size}")
                painted_rows.append(judge_painted(object_run, out, read_size(size)))
                coarse_rows += [
                    judge_coarse(object_run, out, edge_mm, read_size(size)) for edge_mm in arguments.coarse
                ]
                shutil.rmtree(out)
    faults = [fault for row in rows for fault in _faults(row)]
    faults += [fault for row in painted_rows for fault in faults_of_painted(row)]
    faults += [fault for row in coarse_rows for fault in faults_of_coarse(row)]
    if arguments.json:
        print(json.dumps({"sizes": rows, "objects": painted_rows, "coarse": coarse_rows, "faults": faults}))
    else:
        _print(rows)
        print_painted(painted_rows)
        if coarse_rows:
            print_coarse(coarse_rows)
        print(f"{len(rows)} sizes; {len(painted_rows)} objects and sizes; {len(faults)} faults")
        for fault in faults:
            print(fault)
    return int(bool(faults) and not arguments.smallest)


def acquire(folder: Path, every: int) -> Acquired:
    folder.mkdir()
    material = {"diffuse": DIFFUSE, "f0": F0, "roughness": ROUGHNESS}
    cell = shipped_cell(folder, material=material, shading="pixel", detail=list(DETAIL))
    cell.write(lights={"kind": "every", "every": every})
    outcome = cell.acquire()
    if outcome.code:
        raise RuntimeError(outcome.err)
    draw_records(folder / "records", None)
    relief_run = Acquired("relief", cell.run_folder, folder / "records", folder / "result")
    reflectance_of(relief_run.request, relief_run.result)
    return relief_run


def judge(relief_run: Acquired, size: str) -> dict[str, Any]:
    """Make the texels of a size, and compare them with the truth."""
    out = relief_run.result.with_name(f"result-{size}")
    shutil.copytree(relief_run.result, out)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        row = pool.apply(_make, (relief_run, out, size))
    result = RunResult(out)
    held_shares, errors = [], []
    for view in result.views:
        kd_off, kd_held, tilts_off_deg, tilts_held = _against_truth(result, view)
        errors.append((np.median(kd_off), np.median(tilts_off_deg)))
        held_shares.append((kd_held.mean(), tilts_held.mean()))
    row["kd_off_percent"], row["normals_off_deg"] = map(float, np.mean(errors, axis=0) * (100.0, 1.0))
    row["kd_held"], row["tilts_held"] = map(float, np.mean(held_shares, axis=0))
    row["pictures_held"], row["half_width"] = _pictures_held(result)
    shutil.rmtree(out)
    return row


def _make(relief_run: Acquired, out: Path, size: str) -> dict[str, Any]:
    """Make texels twice, because numba compiles the first time, in a separate process so that its memory can be
    measured."""
    request, texel_size = relief_run.request, read_size(size)
    add_texels(request, out, texel_size)
    shutil.rmtree(out / FOLDER)
    forecast = foresee_texels(request, out, texel_size)
    assert forecast is not None
    begun_s = time.monotonic()
    about = add_texels(request, out, texel_size)
    taken_s = time.monotonic() - begun_s
    (triangle_fit,) = set(about["mae"]) - {TEXELS}
    return {
        "size": size,
        "texels": sum(about["pixels"].values()),
        "side_px": sorted({view.side_px for view in forecast.views}),
        "psnr_db": about["held_out_psnr_db"][TEXELS],
        "triangles_psnr_db": about["held_out_psnr_db"][triangle_fit],
        "mae_percent": 100 * about["mae"][TEXELS],
        "time_s": taken_s,
        "memory_bytes": _peak_bytes(),
        "disk_bytes": sum(path.stat().st_size for path in (out / FOLDER).iterdir()),
        "foreseen": {
            "texels": forecast.texels,
            "time_s": forecast.time_s,
            "memory_bytes": forecast.memory_bytes,
            "disk_bytes": forecast.disk_bytes,
        },
    }


def _peak_bytes() -> int:
    """Return the peak memory of this process, from Linux. (The usage of resources would include its parent's
    memory.)"""
    line = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    assert line is not None
    return 1024 * int(line[1])


def _against_truth(result: RunResult, view: ViewSamples) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return relative errors of kd, for channels that a texel has measured itself, and which of them are within
    their intervals; and the angular errors of the normals, and which of their tilts are within their intervals."""
    texels = read_view_texels(result, view)
    truth = seen_by_texels(result, view, texels)
    row, column = np.divmod(texels.pixels, 512)
    own_channel = np.array([[1, 2], [0, 1]])[row % 2, column % 2]
    channels = np.arange(3)[None] if texels.side_px > 1 else own_channel[:, None]
    kd = np.take_along_axis(texels.kd, np.broadcast_to(channels, (len(own_channel), channels.shape[1])), 1)
    off = np.log(kd * np.pi / np.array(DIFFUSE)[channels]) - np.log(truth.paint)[:, None]
    variances = texels.covariance[:, VARIANCES]
    u_kd = np.sqrt(variances[:, 2] + np.sum(np.square(texel_uncertainty(result, view))))
    steps = np.array([tangents(*normal) for normal in texels.normals.astype(float)])
    tilts = np.einsum("nki,ni->nk", steps, truth.bumpy - texels.normals)
    tilts_held = np.abs(tilts) < _QUANTILE * np.sqrt(variances[:, :2])
    cosines = np.clip(np.sum(texels.normals * truth.bumpy, axis=1), -1, 1)
    return np.abs(off), np.abs(off) < _QUANTILE * u_kd[:, None], np.degrees(np.arccos(cosines)), tilts_held


def _pictures_held(result: RunResult) -> tuple[float, float]:
    """Return the share of the 95 % intervals of pictures under left-out LEDs that contain the frames, and their
    median half width relative to the picture. Only LEDs that were not used to find the widths count."""
    held_count, count, widths = 0, 0, []
    for view in result.views:
        scene = scene_of_view(result, view.view, TEXELS)
        makers = {
            "picture": lambda led, scene=scene: scene.picture([LedLight(number=led)]),
            "half": lambda led, scene=scene: half_width_of_picture(scene, [LedLight(number=led)]),
        }
        pictures = list(held_out_pictures(result, view, makers))
        for frame, made in [pair for number, pair in enumerate(pictures) if number % WIDENED_BY_EVERY]:
            known = np.isfinite(frame) & (made["picture"] > 0.0) & np.isfinite(made["half"])
            off, half = np.abs(made["picture"] - frame)[known], made["half"][known]
            held_count, count = held_count + int((off < half).sum()), count + off.size
            widths.append(half / made["picture"][known])
    return held_count / count, float(np.median(np.concatenate(widths)))


def _faults(row: dict[str, Any]) -> list[str]:
    faults = []
    if row["kd_held"] < LEAST_HELD:
        faults.append(f"{row['size']}: {row['kd_held']:.1%} of the intervals of kd hold")
    if row["memory_bytes"] > MOST_OVER * row["foreseen"]["memory_bytes"]:
        over = row["memory_bytes"] / row["foreseen"]["memory_bytes"]
        faults.append(f"{row['size']}: took {over:.2f} of the memory that was foreseen")
    return faults


def _print(rows: list[dict[str, Any]]) -> None:
    """Print the rows of docs/how-to/reflectance-of-a-run.md; in brackets what was foreseen."""
    titles = (
        "`--texels`", "texels", "kd off, intervals hold", "normals off, intervals hold",
        "left-out LEDs, triangles", "their intervals hold, half width", "time", "memory", "disk",
    )  # fmt: skip
    print(f"| {' | '.join(titles)} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        foreseen = row["foreseen"]
        cells = (
            row["size"], f"{row['texels']} ({foreseen['texels']})",
            f"{row['kd_off_percent']:.1f} %, {row['kd_held']:.1%}",
            f"{row['normals_off_deg']:.2f} degrees, {row['tilts_held']:.1%}",
            f"{row['psnr_db']:.1f} dB, {row['triangles_psnr_db']:.1f} dB",
            f"{row['pictures_held']:.1%}, {row['half_width']:.0%}",
            f"{row['time_s']:.1f} ({foreseen['time_s']:.1f}) s",
            f"{row['memory_bytes'] / 1e9:.2f} ({foreseen['memory_bytes'] / 1e9:.2f}) GB",
            f"{row['disk_bytes'] / 1e6:.2f} ({foreseen['disk_bytes'] / 1e6:.2f}) MB",
        )  # fmt: skip
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    sys.exit(main())
