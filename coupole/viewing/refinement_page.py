"""`report.html` of a refinement: how far apart views put the same spots, before and after, and what was moved."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from coupole.calibration.report import HEAD
from coupole.errors import InputError, StorageError
from coupole.intake.plain_data import read_json
from coupole.reflectance.alignment.refined_geometry import ABOUT, REFINED
from coupole.storage.durable import write_synced
from coupole.viewing.raw_preview import png
from coupole.viewing.reflectance_page import STYLE

REPORT = "report.html"
LONGER = 10.0
"""Length of arrows over the disagreement that they show."""
SURPRISING = 3.0
"""Standard deviations of a sum of squares beyond which stated uncertainties are called too small."""
_STYLE = STYLE + "svg{background:#000}line{stroke:#f40;stroke-width:1.5}circle{fill:#f40}"


def write(folder: Path) -> Path:
    """Write the report of a refinement into its folder. Raises InputError, StorageError."""
    path = folder / REPORT
    try:
        about = read_json(folder / ABOUT, allow_nan=True)
    except (OSError, InputError) as error:
        raise InputError(f"{folder / ABOUT}: expected the result of `coupole reflectance refine`") from error
    try:
        write_synced(path, "".join(_page(folder, about)))
    except OSError as error:
        raise StorageError(f"{path}: {error.strerror}") from error
    return path


def remarks(about: dict[str, Any]) -> Iterator[str]:
    """Yield what the maker of the refinement must know, one sentence each."""
    if about["simulated"]:
        yield "frames of a simulated cell"
    for when, words in (("before", "views disagree by"), ("after", "after refinement by")):
        gaps = about["disagreement"][when]
        yield (
            f"{words} {gaps['median_mm']:.3f} mm in the median, {gaps['percentile_95_mm']:.3f} mm in 95 % of "
            f"{gaps['matches']} matches; {gaps['median_px']:.2f} px, {gaps['median_edges']:.1f} edges of "
            "triangles"
        )
    if surprising(about):
        yield (
            "poses, lens and mesh were moved farther than records, scan and options state: square sum "
            f"{about['chi2_of_steps']:.0f}, where about {about['determined']:.0f} is expected. State larger "
            "uncertainties, or look for a record that does not belong to these runs"
        )


def surprising(about: dict[str, Any]) -> bool:
    """Tell whether the steps are larger than the stated uncertainties explain."""
    freedom = about["determined"]
    return bool(about["chi2_of_steps"] > freedom + SURPRISING * np.sqrt(2 * freedom))


def _page(folder: Path, about: dict[str, Any]) -> Iterator[str]:
    title = f"{html.escape(folder.resolve().name)}: views refined"
    yield f"{HEAD}<title>{title}</title><style>{_STYLE}</style><h1>{title}</h1>"
    for remark in remarks(about):
        yield f"<p>{html.escape(remark)}"
    yield "<h2>Disagreement</h2><p>From a spot of the surface to where another view puts it, in the picture of "
    yield f"the view that shows it in the greatest detail; arrows are {LONGER:g} times as long as what they show."
    with h5py.File(folder / REFINED, "r") as file:
        for number, camera in enumerate(about["cameras"]):
            yield f"<h3>{html.escape(camera['run'])}, {html.escape(camera['view'])}</h3>"
            for when in ("before", "after"):
                yield _arrows(file, number, when)
    yield from _cameras(about)
    yield from _lens(about)
    yield from _mesh(about)
    yield (
        f"<p>{about['unknowns']} unknowns, of which the pictures determine {about['determined']:.0f}; square sum "
        f"of the steps over what was stated {about['chi2_of_steps']:.0f}. Matches scatter "
        f"{about['noise_factor']:.1f} times as much as noise and texture alone would make them, and are weighted "
        f"by that; {about['rejected']} were rejected. What pictures cannot tell, as a motion of mesh and cameras "
        "together, keeps the uncertainty that was stated."
    )


def _arrows(file: h5py.File, number: int, when: str) -> str:
    """A view's picture with an arrow for each match that it is the reference of."""
    data = file[f"pictures/{number}"]
    small, blocks = data[()], data.attrs["blocks"]
    height, width = small.shape
    is_own = file[f"{when}/reference"][()] == number
    camera, lens = file["base_from_camera"][number], file["lens"][()]
    starts = file[f"{when}/points_mm"][()][is_own]
    ends = starts + file[f"{when}/shifts_mm"][()][is_own]
    pinhole = lens[:2] / 2 * (width / blocks[1])
    ends_camera = [((points - camera[:3, 3]) @ camera[:3, :3]) for points in (starts, ends)]
    there, here = (pinhole * end[:, :2] / end[:, 2:] for end in reversed(ends_camera))
    at = file[f"{when}/blocks"][()][is_own] * (width / blocks[1])
    lines = "".join(
        f"<line x1={x:.1f} y1={y:.1f} x2={x + LONGER * dx:.1f} y2={y + LONGER * dy:.1f} />"
        f"<circle cx={x:.1f} cy={y:.1f} r=2 />"
        for (x, y), (dx, dy) in zip(at, there - here, strict=True)
    )
    picture = base64.b64encode(png(small)).decode()
    return (
        f'<figure><svg width={width} height={height}><image href="data:image/png;base64,{picture}" '
        f"width={width} height={height} />{lines}</svg><figcaption>{when}</figcaption></figure>"
    )


def _cameras(about: dict[str, Any]) -> Iterator[str]:
    yield "<h2>Cameras</h2><p>Steps along the base's axes and about the camera's, with standard uncertainties."
    yield "<table><tr><th>view<th>moved, mm<th>u, mm<th>stated, mm<th>turned, degrees<th>u<th>stated"
    for camera in about["cameras"]:
        yield f"<tr><th>{html.escape(camera['view'])}" + _cells(camera)
    yield "</table>"


def _mesh(about: dict[str, Any]) -> Iterator[str]:
    mesh = about["mesh"]
    yield "<h2>Mesh</h2><table><tr><th><th>moved, mm<th>u, mm<th>stated, mm<th>turned, degrees<th>u<th>stated"
    yield f"<tr><th>as a whole{_cells(mesh)}</table>"
    yield (
        f"<p>Along its normals it was moved by {mesh['shape_rms_mm']:.3f} mm (root mean square of points "
        f"{mesh['scale_mm']:g} mm apart); their median standard uncertainty is {mesh['shape_median_u_mm']:.3f} "
        f"mm, {mesh['shape_stated_u_mm']:g} mm was stated."
    )


def _cells(six: dict[str, list[float]]) -> str:
    kinds, parts = ("moved", "u", "stated_u"), (slice(0, 3), slice(3, 6))
    texts = (" ".join(f"{value:.3f}" for value in six[kind][part]) for part in parts for kind in kinds)
    return "".join(f"<td>{text}" for text in texts)


def _lens(about: dict[str, Any]) -> Iterator[str]:
    yield "<h2>Lens</h2><table><tr><th><th>moved<th>u<th>stated u"
    for name, parameter in about["lens"].items():
        yield f"<tr><th>{name}<td>{parameter['moved']:.3g}<td>{parameter['u']:.2g}<td>{parameter['stated_u']:.2g}"
    yield "</table>"
