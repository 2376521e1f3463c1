"""`report.html` of a refinement: the distance between the places that views give to the same spots, before and
after, and the steps."""

from __future__ import annotations

import base64
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.pages.maps import picture_png
from coupole.pages.page_parts import Code, Drawing, Inline, Page, Plot, Section, Shape, Table
from coupole.pages.page_rendering import write_page
from coupole.reflectance.alignment.refined_geometry import ABOUT, REFINED

REPORT = "report.html"
LONGER = 10.0
"""Length of arrows, as a multiple of the disagreement that they show."""
SURPRISING = 3.0
"""Number of standard deviations of a sum of squares above which stated uncertainties are called too small."""


def write(folder: Path) -> Path:
    """Write the report of a refinement into its folder. Raises InputError, StorageError."""
    path = folder / REPORT
    try:
        about = read_json(folder / ABOUT, allow_nan=True)
    except (OSError, InputError) as error:
        raise InputError(f"{folder / ABOUT}: expected the result of `coupole reflectance refine`") from error
    write_page(path, _page(folder, about))
    return path


def remarks(about: dict[str, Any]) -> Iterator[str]:
    """Yield remarks for the user who made the refinement, one sentence each."""
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
            "poses, lens and mesh were moved farther than records, scan and options state: the sum of squares is "
            f"{about['chi2_of_steps']:.0f}, where about {about['determined']:.0f} is expected. State larger "
            "uncertainties, or look for a record that does not belong to these runs"
        )


def surprising(about: dict[str, Any]) -> bool:
    """Tell whether the steps are larger than the stated uncertainties explain."""
    freedom = about["determined"]
    return bool(about["chi2_of_steps"] > freedom + SURPRISING * np.sqrt(2 * freedom))


def _page(folder: Path, about: dict[str, Any]) -> Page:
    name = folder.resolve().name
    with h5py.File(folder / REFINED, "r") as file:
        plots = [
            Plot(_arrows(file, number, when, f"{camera['run']}, {camera['view']}: {when}"))
            for number, camera in enumerate(about["cameras"])
            for when in ("before", "after")
        ]
    before, after = (about["disagreement"][when] for when in ("before", "after"))
    return Page(
        title=f"{name}: {len(about['cameras'])} views refined",
        pictures=plots[:2],
        summary=f"Poses, lens and mesh were moved so that {len(about['cameras'])} views put the same spots of the "
        "surface "
        f"into the same places: {before['matches']:,} matches.",
        quality=f"Views disagreed by {before['median_mm']:.3f} mm (median) before, and disagree by "
        f"{after['median_mm']:.3f} "
        "mm now.",
        next_step=_next_step(name, about),
        remark="Frames of a simulated cell." if about["simulated"] else "",
        sections=[
            Section(
                "known",
                "What must be known",
                items=[f"{remark[0].upper()}{remark[1:]}." for remark in remarks(about)],
            ),
            Section("disagreement", "Disagreement", figures=plots[2:], notes=[_ARROWS]),
            Section("cameras", "Cameras", tables=[_cameras(about)], notes=[_STEPS]),
            Section("lens", "Lens", tables=[_lens(about)]),
            _mesh(about),
            Section("unknowns", "Unknowns", words=[_unknowns(about)]),
        ],
    )


_ARROWS = (
    "Arrows lead from a spot of the surface to the place where another view puts it, in the picture of the view "
    f"with the greatest detail; they are {LONGER:g} times as long as the true distance. The first two are at the "
    "top."
)
_STEPS = "Steps along the base's axes and about the camera's axes, with standard uncertainties."


def _next_step(name: str, about: dict[str, Any]) -> Inline:
    if surprising(about):
        return "State larger uncertainties, or look for a record that does not belong to these runs."
    return ["Use it: ", Code(f"coupole reflectance RUN... --refined {name} --out OUT"), "."]


def _unknowns(about: dict[str, Any]) -> str:
    return (
        f"{about['unknowns']} unknowns, of which the pictures determine {about['determined']:.0f}; sum of the "
        f""
        f"squares of the steps, each divided by its stated uncertainty: "
        f"{about['chi2_of_steps']:.0f}. Matches scatter "
        f"{about['noise_factor']:.1f} times as much as noise and texture alone explain, and are weighted "
        f"accordingly; {about['rejected']} were rejected. Motions that pictures cannot determine, such as a "
        f"common motion of mesh and cameras, keep their stated uncertainty."
    )


def _arrows(file: h5py.File, number: int, when: str, title: str) -> Drawing:
    """Return a view's picture with an arrow for each match in which the view is the reference."""
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
    address = f"data:image/png;base64,{base64.b64encode(picture_png(small)).decode()}"
    shapes = [Shape("image", {"href": address, "width": width, "height": height})]
    for (x, y), (dx, dy) in zip(at, LONGER * (there - here), strict=True):
        ends_px = {"x1": f"{x:.1f}", "y1": f"{y:.1f}", "x2": f"{x + dx:.1f}", "y2": f"{y + dy:.1f}"}
        shapes.append(Shape("line", {"class": "arrow", **ends_px}))
        shapes.append(Shape("circle", {"class": "dot", "cx": f"{x:.1f}", "cy": f"{y:.1f}", "r": 2}))
    return Drawing(title, width, height, shapes)


_SIX = ("moved, mm", "u, mm", "stated, mm", "turned, degrees", "u, degrees", "stated, degrees")


def _cameras(about: dict[str, Any]) -> Table:
    rows = [(camera["view"], *_cells(camera)) for camera in about["cameras"]]
    return Table("Steps of the cameras", ("view", *_SIX), rows)


def _mesh(about: dict[str, Any]) -> Section:
    mesh = about["mesh"]
    note = (
        f"Along its normals the mesh was moved by {mesh['shape_rms_mm']:.3f} mm (root mean square of points "
        f"{mesh['scale_mm']:g} mm apart); their median standard uncertainty is {mesh['shape_median_u_mm']:.3f} "
        "mm, "
        f"{mesh['shape_stated_u_mm']:g} mm was stated."
    )
    table = Table("Step of the mesh", ("mesh", *_SIX), [("as a whole", *_cells(mesh))])
    return Section("mesh", "Mesh", tables=[table], notes=[note])


def _cells(six: dict[str, list[float]]) -> Iterator[str]:
    kinds, parts = ("moved", "u", "stated_u"), (slice(0, 3), slice(3, 6))
    return (" ".join(f"{value:.3f}" for value in six[kind][part]) for part in parts for kind in kinds)


def _lens(about: dict[str, Any]) -> Table:
    rows: list[Sequence[Inline]] = [
        (name, f"{step['moved']:.3g}", f"{step['u']:.2g}", f"{step['stated_u']:.2g}")
        for name, step in about["lens"].items()
    ]
    return Table("Steps of the lens", ("parameter", "moved", "u", "stated u"), rows)
