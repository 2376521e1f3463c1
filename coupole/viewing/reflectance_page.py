"""`report.html` of a result of pictures under known lights: pictures first, then what must be known about them."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from coupole.calibration.report import HEAD
from coupole.errors import StorageError
from coupole.reflectance.picture_job import PEAK_QUANTILE
from coupole.reflectance.picture_result import CONES, INTERVALS, MATERIALS, REPORT, PictureResult
from coupole.reflectance.relighting import read_interpolation, relit
from coupole.reflectance.relit_intervals import FEWEST_LIGHTS
from coupole.storage.durable import write_synced
from coupole.viewing.raw_preview import png

WIDTH_PX = 480
MOST_CHECKS = 6
POOR_RESIDUAL = 0.05
"""Residual of square roots of values, as a share of the diffuse part's, beyond which the material model itself is
in doubt."""
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;max-width:1100px;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse}td,th{padding:.2em .8em .2em 0;text-align:left;vertical-align:top}
figure{display:inline-block;margin:.3em}figcaption{font-size:12px;color:#666}img{display:block;background:#000}
.bad{color:#b00}
"""


def write(folder: Path) -> Path:
    """Write the report of a result into its folder. Raises InputError, StorageError."""
    path = folder / REPORT
    try:
        write_synced(path, "".join(_page(PictureResult(folder))))
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def remarks(about: dict[str, Any]) -> Iterator[str]:
    """Yield what the maker of the result must know, one sentence each."""
    if run := about.get("uncalibrated_run"):
        yield (
            f"of the run {run} without calibrations: values are relative, and lights stand where rig and LED "
            "table have them as seen from one point; normals and materials are of single pixels"
        )
    yield (
        f"{about['pixels']} pixels under {about['lights'] - len(about['left_out'])} lights; the materials leave "
        f"{100 * about['residual']:.1f} % (median, of square roots)"
    )
    if about["not_fitted"]:
        yield f"{about['not_fitted']} pixels saw too few lights and have no normal"
    if about["residual"] > POOR_RESIDUAL:
        yield (
            "the materials explain the pictures poorly: is the object translucent or fluorescent, are the "
            "pictures linear, are the lights in the order of the pictures?"
        )
    if about["suspect_pictures"]:
        names = ", ".join(f"{name} ({gain:.2f})" for name, gain in about["suspect_pictures"].items())
        yield f"pictures brighter or darker than all others say they should be: {names}"
    if about["held_out_psnr_db"] is not None:
        yield f"left-out lights are made with {about['held_out_psnr_db']:.2f} dB (PSNR, linear, inside the mask)"


def _page(result: PictureResult) -> Iterator[str]:
    about = result.about
    title = html.escape(result.folder.resolve().name)
    yield f"{HEAD}<title>{title}</title><style>{STYLE}</style><h1>{title}</h1>"
    for remark in remarks(about):
        yield f"<p>{html.escape(remark)}"
    with h5py.File(result.folder / MATERIALS) as file:
        fields = {name: np.asarray(file[name]) for name in ("normal", "kd", "ks", "alpha", "residual")}
    yield "<h2>Normals and materials</h2>"
    yield figure("normals", result.picture(0.5 + 0.5 * fields["normal"].astype(np.float32)))
    yield figure("diffuse", display(result.picture(fields["kd"])))
    yield figure("specular", display(result.picture(fields["ks"])))
    yield figure("roughness alpha, white 1", grey(result.picture(fields["alpha"])))
    yield figure("what the materials leave, white 10 %", grey(result.picture(fields["residual"]) / 0.1))
    yield "<p>Where no light stands near the mirror direction, specular and roughness are guesses."
    if about["left_out"]:
        yield "<h2>Left-out lights: measured, made, difference (white 5 % of white)</h2>"
        yield from _checks(result)
    yield "<h2>Figures</h2><table>"
    yield f"<tr><th>kernel<td>{html.escape(about['kernel'])}"
    for kernel, rms in about["left_out_rms"].items():
        yield f"<tr><th>{html.escape(kernel)}: rms at lights left out<td>{rms:.5f} of full scale"
    for row in about["held_out"]:
        yield f"<tr><th>light {row['light']}<td>{row['psnr_db']:.2f} dB, mean absolute error {row['mae']:.5f}"
    yield f"<tr><th>time<td>{about['seconds']:.1f} s</table>"
    yield from _intervals(result)


def _intervals(result: PictureResult) -> Iterator[str]:
    """Yield what is known of normals and relit pictures, and what is not."""
    cones_deg = np.load(result.folder / CONES)[result.mask]
    if np.isfinite(cones_deg).any():
        yield f"<p>Cones that hold 95 % of the normals: half angle {np.nanmedian(cones_deg):.1f} degrees (median)."
        shares = result.picture(cones_deg / np.float32(30.0))
        yield figure("half angle of the normals' 95 % cones, white 30 degrees", grey(shares))
    if (result.folder / INTERVALS).exists():
        yield "<p>Relit pictures have intervals: coupole reflectance relight with --interval or --uncertainty."
    else:
        yield f"<p>No interval is stated for relit pictures: these need at least {FEWEST_LIGHTS} lights."
    yield "<p>No uncertainty is stated for the materials."


def _checks(result: PictureResult) -> Iterator[str]:
    interpolation = read_interpolation(result.folder)
    left_out = np.asarray(result.about["left_out"])
    for light in left_out[:: 1 + len(left_out) // MOST_CHECKS]:
        photo = result.picture(result.values(np.array([light]))[0])
        model = relit(result, interpolation, result.directions[light])
        white = float(np.quantile(photo[result.mask], PEAK_QUANTILE))
        yield "<div>"
        yield figure(f"light {light}, measured", display(photo, white))
        yield figure("made", display(model, white))
        yield figure("difference", np.clip(np.abs(model - photo) / (0.05 * white), 0, 1))
        yield "</div>"


def display(picture: NDArray[np.float32], white: float = 0.0) -> NDArray[np.float32]:
    """[h, w, 3] for the eye: gamma 2.2, the brightest thousandth white."""
    finite = np.nan_to_num(picture)
    shares: NDArray[np.float32] = np.clip(
        finite / (white or max(float(np.quantile(finite, PEAK_QUANTILE)), 1e-12)), 0, 1
    )
    return shares ** np.float32(1 / 2.2)


def grey(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.repeat(np.clip(np.nan_to_num(picture), 0, 1)[..., None], 3, axis=2)


def figure(caption: str, picture: NDArray[np.float32]) -> str:
    codes = (255 * np.clip(np.nan_to_num(picture), 0, 1)).astype(np.uint8)
    width = min(WIDTH_PX, codes.shape[1])
    data = base64.b64encode(png(codes, width)).decode()
    image = f'<img src="data:image/png;base64,{data}" alt="{caption}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"
