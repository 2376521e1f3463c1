"""Views of a run as a sparse model in COLMAP's text format, with pictures: for dense stereo, splatting, texturing.

The lens of the record is COLMAP's OPENCV model, or FULL_OPENCV if k3 was estimated. The equations are the same, so
nothing is lost; only the first pixel's centre is at (0.5, 0.5) there. The world is the support frame, in mm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import coupole
from coupole.calibration.optics import Intrinsics, project
from coupole.calibration.rotations import Floats
from coupole.exchange.demosaiced import demosaiced
from coupole.exchange.kept_frames import refuse_discarded_lights
from coupole.exchange.srgb import srgb
from coupole.exchange.target_folder import refuse_standing, writing_into
from coupole.geometry import Transform, apply, inverse
from coupole.motion.packet_rays import PacketMesh
from coupole.reflectance.alignment.refined_geometry import read_refined
from coupole.reflectance.extraction.measured_run import MeasuredRun, MeasuredView, read_measured_run
from coupole.reflectance.extraction.seen_surface import seen_surface
from coupole.storage.durable import write_synced
from coupole.storage.run import Run

MODEL, PICTURES = "sparse/0", "images"
MOST_POINTS = 50_000
_MOST_FRAMES = 48
"""Greatest number of frames, spread over the LEDs, whose mean is the picture of a view: it has light from all
sides, and almost no shadows."""
_WHITE_QUANTILE = 0.999
_TO_CENTRE_PX = 0.5
"""Offset from our pixels to COLMAP's, whose first pixel goes from 0 to 1."""


@dataclass(frozen=True)
class PosedPicture:
    """A view, and the centres of the triangles that it sees."""

    name: str
    """Name of its file."""
    support_from_camera: Transform
    triangles: NDArray[np.int64]
    """[n] numbers of the triangles, increasing."""
    pixels: Floats
    """[n, 2] pixels of the triangles' centres; the first pixel's centre is (0, 0)."""
    codes: NDArray[np.uint8]
    """[h, w, 3] sRGB, blue first."""


def export_colmap(
    folder: Path,
    out: Path,
    *,
    records: Sequence[Path] = (),
    refined_folder: Path | None = None,
    overwrite: bool,
    say: Callable[[str, int, int], None],
) -> list[Path]:
    """Write `images/VIEW.png` (8 bit, sRGB, the mean of about 48 frames of the view) and the folder `sparse/0`.

    The folder has cameras, images and points. The points are centres of at most 50 000 triangles that at least two
    views see, with these views. Poses and lens are from the run's records, from the named records, or from
    `refined_folder`, a folder of `coupole reflectance refine`.

    Raises InputError if records or mesh are missing, if frames were discarded, or if files exist already (unless
    `overwrite`); StorageError.
    """
    run = Run(folder)
    refuse_discarded_lights(run, run.views, "colmap")
    measured_run = read_measured_run(folder, records=records)
    if refined_folder is not None:
        measured_run = read_refined(refined_folder).of(measured_run)
    model = out / MODEL
    pictures = [out / PICTURES / f"{view.name}.png" for view in measured_run.views]
    texts = [model / name for name in ("cameras.txt", "images.txt", "points3D.txt")]
    if not overwrite:
        refuse_standing([*texts, *pictures])
    mesh = PacketMesh(measured_run.corners_mm)
    views = []
    with writing_into(model), writing_into(out / PICTURES):
        for number, (view, path) in enumerate(zip(measured_run.views, pictures, strict=True)):
            views.append(_posed_picture(measured_run, view, mesh))
            import cv2

            write_synced(path, cv2.imencode(".png", views[-1].codes)[1].tobytes())
            say("views", number + 1, len(pictures))
        centres_mm = apply(inverse(measured_run.base_from_support), measured_run.corners_mm.mean(axis=1))
        origin = "refined by overlapping views" if refined_folder is not None else "by the run's calibrations"
        source = "simulated" if measured_run.run.is_simulated else "measured"
        head = (
            f"# Coupole {coupole.__version__}: {measured_run.run.folder.name}, {source}; {origin}; world in mm\n"
        )
        contents = (
            camera_text(measured_run.lens, measured_run.frames.size_px),
            *texts_of(views, centres_mm, measured_run.lens),
        )
        for path, text in zip(texts, contents, strict=True):
            write_synced(path, head + text)
    return [*texts, *pictures]


def camera_text(lens: Intrinsics, size_px: tuple[int, int]) -> str:
    """cameras.txt with one camera."""
    centre = (lens.cx + _TO_CENTRE_PX, lens.cy + _TO_CENTRE_PX)
    figures = [lens.fx, lens.fy, *centre, lens.k1, lens.k2, lens.p1, lens.p2]
    name = "OPENCV"
    if lens.k3 != 0.0:
        name, figures = "FULL_OPENCV", [*figures, lens.k3, 0.0, 0.0, 0.0]
    width, height = size_px
    return f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {name} {width} {height} {_row(figures)}\n"


def texts_of(posed_pictures: Sequence[PosedPicture], centres_mm: Floats, lens: Intrinsics) -> tuple[str, str]:
    """images.txt and points3D.txt; `centres_mm` [m, 3] of all triangles, support frame."""
    triangles, times = np.unique(
        np.concatenate([picture.triangles for picture in posed_pictures]), return_counts=True
    )
    if (times > 1).any():  # COLMAP's bundle adjustment fails for a point in one image
        triangles = triangles[times > 1]
    point_triangles = triangles[
        np.unique(np.linspace(0, len(triangles) - 1, min(len(triangles), MOST_POINTS)).astype(np.int64))
    ]
    tracks: list[list[int]] = [[] for _ in point_triangles]
    colours = np.zeros((len(point_triangles), 3))
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, picture in enumerate(posed_pictures, start=1):
        camera_from_support = inverse(picture.support_from_camera)
        x, y, z, w = Rotation.from_matrix(camera_from_support[:3, :3]).as_quat(canonical=True)
        pose = _row([w, x, y, z, *camera_from_support[:3, 3]])
        images.append(f"{number} {pose} 1 {picture.name}")
        is_chosen = np.isin(picture.triangles, point_triangles, assume_unique=True)
        points = np.searchsorted(point_triangles, picture.triangles[is_chosen])
        pixels = picture.pixels[is_chosen]
        column, row = np.rint(pixels).astype(int).T
        colours[points] += picture.codes[row, column, ::-1]
        for place, point in enumerate(points.tolist()):
            tracks[point] += [number, place]
        at = (pixels + _TO_CENTRE_PX).tolist()
        images.append(" ".join(f"{u:.6f} {v:.6f} {n + 1}" for (u, v), n in zip(at, points.tolist(), strict=True)))
    points_lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    for number, (place, colour, track) in enumerate(
        zip(centres_mm[point_triangles], colours, tracks, strict=True), start=1
    ):
        red, green, blue = np.rint(colour / (len(track) // 2)).astype(int)
        points_lines.append(f"{number} {_row(place)} {red} {green} {blue} 0 {' '.join(map(str, track))}")
    return "\n".join(images) + "\n", "\n".join(points_lines) + "\n"


def _posed_picture(measured_run: MeasuredRun, view: MeasuredView, mesh: PacketMesh) -> PosedPicture:
    corners = measured_run.corners_mm
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    width, height = measured_run.frames.size_px
    surface = seen_surface(mesh, normals, measured_run.lens, view.base_from_camera, (width, height))
    centres_mm = apply(inverse(view.base_from_camera), corners[surface.triangles].mean(axis=1))
    pixels = project(centres_mm, measured_run.lens.vector()).pixels
    column, row = np.rint(pixels).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    is_visible = np.zeros(len(pixels), np.bool_)
    is_visible[inside] = surface.places[row[inside], column[inside]] == np.flatnonzero(inside)
    return PosedPicture(
        f"{view.name}.png",
        inverse(measured_run.base_from_support) @ view.base_from_camera,
        surface.triangles[is_visible],
        pixels[is_visible],
        _picture(measured_run, view),
    )


def _picture(measured_run: MeasuredRun, view: MeasuredView) -> NDArray[np.uint8]:
    """[h, w, 3] sRGB, blue first, of the mean of frames under LEDs on all sides."""
    frames = [led_frames[0] for led_frames in view.by_led.values()]
    samples = frames[:: -(-len(frames) // _MOST_FRAMES)]
    total = np.zeros(samples[0].read().shape)
    for frame in samples:
        total += np.maximum(frame.read().astype(np.float64) - measured_run.frames.black_dn, 0.0)
    white = float(np.quantile(total, _WHITE_QUANTILE)) or 1.0
    mosaic = np.rint(65535.0 * np.clip(total / white, 0.0, 1.0)).astype(np.uint16)
    colour = demosaiced(mosaic, measured_run.frames.pattern)[..., ::-1]
    codes: NDArray[np.uint8] = np.rint(255.0 * srgb(colour / 65535.0)).astype(np.uint8)
    return codes


def _row(values: Sequence[float] | Floats) -> str:
    return " ".join(f"{float(value):.12g}" for value in values)
