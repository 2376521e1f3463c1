"""Camera poses of a run from a COLMAP model, instead of the poses from the run's records.

A bundle adjustment may move, turn and scale its model. With three views or more a similarity brings the cameras'
centres onto the centres of the records by least squares (Umeyama, PAMI 13(4), 1991). With one or two views the
model is taken as it is, in the frame of `coupole export RUN --to colmap`: the support frame, in mm. Poses that are
farther from the records than `MOST_APART` times the records' standard uncertainty are refused. A lens that is not
the records' lens is refused too. COLMAP's files state no uncertainties, so the uncertainties of the records are
used for these poses.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from coupole.calibration.optics import NAMES
from coupole.calibration.posed_camera import MOST_APART
from coupole.calibration.rotations import Floats, between, inverses, nearest_rotation
from coupole.errors import InputError
from coupole.reflectance.alignment.colmap_model import ColmapCamera, ColmapModel, read_model
from coupole.reflectance.extraction.measured_run import MeasuredRun
from coupole.storage.durable import sha256

LEAST_FITTED = 3
"""Least number of views that determine a similarity."""
_TO_CENTRE_PX = 0.5
"""Shift from our pixel coordinates to COLMAP's, px. In COLMAP the first pixel ends at 1."""
_SAME = 1e-6
"""Allowed difference of lens parameters that the record does not estimate, as a share of the larger of 1 and their
value."""


@dataclass(frozen=True)
class ColmapPoses:
    """Poses of the views of a run."""

    path: Path
    """File of COLMAP's images."""
    base_from_camera: Floats
    """[v, 4, 4] mm, in the order of the run's views."""
    scale: float
    """Number of mm in one unit of the model."""
    steps_from_records: Floats
    """[v, 6] steps from the records' poses to these poses: mm, and rad in the camera's frame."""
    over_u: Floats
    """[v, 2] shift and turn, divided by the records' standard uncertainty."""

    def of(self, measured_run: MeasuredRun) -> MeasuredRun:
        """Return the run with these poses."""
        views = zip(measured_run.views, self.base_from_camera, strict=True)
        return replace(
            measured_run,
            views=tuple(replace(view, base_from_camera=base_from_camera) for view, base_from_camera in views),
        )

    def summary(self) -> dict[str, Any]:
        """Return the entry about these poses for a result's summary."""
        shift_mm = np.linalg.norm(self.steps_from_records[:, :3], axis=1)
        turn_deg = np.degrees(np.linalg.norm(self.steps_from_records[:, 3:], axis=1))
        return {
            "sha256": sha256(self.path),
            "fitted": len(self.steps_from_records) >= LEAST_FITTED,
            "mm_per_unit": float(f"{self.scale:.9g}"),
            "median_moved_mm": round(float(np.median(shift_mm)), 6),
            "median_turned_deg": round(float(np.median(turn_deg)), 7),
            "most_over_u": round(float(self.over_u.max()), 3),
        }


def read_poses(folder: Path, measured_run: MeasuredRun) -> ColmapPoses:
    """Read the poses of a run, given by its records, from a COLMAP folder. Raises InputError if there is no model,
    a view is missing or appears twice, the lens is another one, the centres lie on a line, or the records do not
    allow the poses."""
    model = read_model(folder)
    camera_from_world = _of_views(model, measured_run)
    recorded_poses = np.stack([view.base_from_camera for view in measured_run.views])
    world_from_camera = inverses(camera_from_world)
    if len(recorded_poses) >= LEAST_FITTED:
        _refuse_a_line(model.path, recorded_poses[:, :3, 3], _uncertainties(measured_run)[:, 0])
        scale, base_from_world = similarity(world_from_camera[:, :3, 3], recorded_poses[:, :3, 3])
    else:
        scale, base_from_world = 1.0, measured_run.base_from_support
    scaled_poses = world_from_camera.copy()
    scaled_poses[:, :3, 3] *= scale
    base_from_camera = base_from_world @ scaled_poses
    steps = between(recorded_poses, base_from_camera)
    lengths = np.stack([np.linalg.norm(steps[:, part], axis=1) for part in (slice(0, 3), slice(3, 6))], axis=1)
    poses = ColmapPoses(model.path, base_from_camera, scale, steps, lengths / _uncertainties(measured_run))
    _refuse_far(poses, measured_run)
    return poses


def similarity(of_points: Floats, to_points: Floats) -> tuple[float, Floats]:
    """Return scale s and transform T [4, 4], by which T (s p) brings points p [n, 3] onto other points by least
    squares (Umeyama)."""
    middle_of, middle_to = of_points.mean(axis=0), to_points.mean(axis=0)
    of, to = of_points - middle_of, to_points - middle_to
    covariance = to.T @ of
    turn = nearest_rotation(covariance)
    square_sum = float(np.sum(of**2))
    scale = float(np.trace(turn.T @ covariance)) / max(square_sum, np.finfo(float).tiny)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, middle_to - scale * turn @ middle_of
    return scale, motion


def _of_views(model: ColmapModel, measured_run: MeasuredRun) -> Floats:
    """[v, 4, 4] camera_from_world of the run's views. Raises InputError for a view without a pose or with another
    lens."""
    stems = [Path(image.name).stem for image in model.images]
    by_name = dict(zip(stems, model.images, strict=True))
    camera_from_world = []
    for view in measured_run.views:
        if (count := stems.count(view.name)) != 1:
            names = ", ".join(sorted(image.name for image in model.images)[:5]) or "none"
            raise InputError(
                f"{model.path}: has {count} images of the view {view.name}; expected {view.name}.png, as `coupole "
                f"export {measured_run.run.folder} --to colmap` names it; found {names}"
            )
        image = by_name[view.name]
        if image.camera not in model.cameras:
            raise InputError(f"{model.path}: image {image.name}: its camera {image.camera} is not in the model")
        _refuse_other_lens(model.path, image.camera, model.cameras[image.camera], measured_run)
        camera_from_world.append(image.camera_from_world)
    return np.stack(camera_from_world)


def _refuse_other_lens(path: Path, number: int, camera: ColmapCamera, measured_run: MeasuredRun) -> None:
    """Raise InputError for another lens: poses are valid only for the lens with which they were found."""
    where = f"{path.with_stem('cameras')}: camera {number}"
    if camera.size_px != measured_run.frames.size_px:
        raise InputError(f"{where}: expected pictures of {measured_run.frames.size_px} px; found {camera.size_px}")
    parameters = dict(camera.parameters)
    if "f" in parameters:
        parameters["fx"] = parameters["fy"] = parameters.pop("f")
    prior = measured_run.camera
    u = dict(zip(prior.free, np.sqrt(np.diag(prior.covariance)), strict=False))
    for name in (*NAMES, *(name for name in parameters if name not in NAMES)):
        lens_parameter = getattr(measured_run.lens, name, 0.0) + (_TO_CENTRE_PX if name in ("cx", "cy") else 0.0)
        apart, most_apart = (
            abs(parameters.get(name, 0.0) - lens_parameter),
            max(MOST_APART * u.get(name, 0.0), _SAME * max(1.0, abs(lens_parameter))),
        )
        if apart > most_apart:
            raise InputError(
                f"{where}: another lens than the record's: {name} is {parameters.get(name, 0.0):.6g} there, "
                f"{lens_parameter:.6g} by the record, which allows {most_apart:.2g}. Keep the camera "
                "as it was exported (COLMAP's bundle adjuster: refine_focal_length, refine_principal_point and "
                "refine_extra_params 0)"
            )


def _uncertainties(measured_run: MeasuredRun) -> Floats:
    """[v, 2] standard uncertainty of the records' poses in their worst direction: mm, rad."""
    u_poses = []
    for view in measured_run.views:
        first = len(view.pointing.free)
        pose_covariance = view.pointing.covariance[first : first + 6, first : first + 6]
        u_poses.append(
            [np.sqrt(np.linalg.eigvalsh(part)[-1]) for part in (pose_covariance[:3, :3], pose_covariance[3:, 3:])]
        )
    return np.array(u_poses)


def _refuse_a_line(path: Path, centres_mm: Floats, u_mm: Floats) -> None:
    _, spread_mm, _ = np.linalg.svd(centres_mm - centres_mm.mean(axis=0))
    if spread_mm[1] < MOST_APART * u_mm.max():
        raise InputError(
            f"{path}: the run's cameras stand on a line (within {spread_mm[1]:.2g} mm), about which COLMAP's "
            "model may be turned; take more views, or use `coupole reflectance refine`"
        )


def _refuse_far(poses: ColmapPoses, measured_run: MeasuredRun) -> None:
    view, kind = np.unravel_index(np.argmax(poses.over_u), poses.over_u.shape)
    if poses.over_u[view, kind] <= MOST_APART:
        return
    length = float(np.linalg.norm(poses.steps_from_records[view, 3 * kind : 3 * kind + 3]))
    how_far = f"{np.degrees(length):.3g} degrees" if kind else f"{length:.3g} mm"
    conditions = (
        f"after a similarity to the {len(poses.steps_from_records)} cameras of the records"
        if len(poses.steps_from_records) >= LEAST_FITTED
        else "in the support's frame, in mm; with one or two views the model must be in this frame"
    )
    raise InputError(
        f"{poses.path}: the camera of {measured_run.views[view].name} is {how_far} from its place in the "
        f"records, {conditions}: {poses.over_u[view, kind]:.1f} times their standard uncertainty; expected "
        f"{MOST_APART:g} at most. Is it another run's model, or a reconstruction that failed? Else calibrate "
        "hand-eye anew"
    )
